"""Measure the network's backends on one frame of 512 x 512 px: time, agreement with torch float32, masks' IoU.

    python benchmarks/segmentation.py [--weights FILE] [--rounds 9] [--threads 2] [--write docs/segmentation-runtime.md]

All backends in one process, one frame each in turn, so that a busy machine slows all of them alike; medians, and ratios to
torch float32. What runs the network is timed alone, one look: normalised picture in, probability out; below the table, the
whole of what `brmgeo segment` does with a frame, by one look and by two. Agreement is measured on
generated scenes, on rendered frames of ``--frames`` where given, and on the frames of the real flight in BRMGEO_REAL_DATA
(default ../shared/data) where that is there. int8 is calibrated on other pictures than it is measured on.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import logging
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from brmgeo.geo.grid import lattice
from brmgeo.segment.onnx_export import check_seal
from brmgeo.segment.predict import SHIPPED, Segmenter
from brmgeo.segment.weights import load_network
from brmgeo.synth.imagery import render_imagery
from brmgeo.synth.town import generate_town

SIDE = 512
REAL = Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
Run = Callable[[np.ndarray], np.ndarray]


def generated(seed: int, count: int) -> list[np.ndarray]:
    """Pictures of a generated town at 0.3 m per pixel."""
    side_m = 0.3 * SIDE * 3
    town = generate_town((0.0, 0.0, 900.0, 900.0), seed)
    box = lattice((200.0, 200.0, 200.0 + side_m, 200.0 + side_m), "EPSG:5187", 0.3)
    whole = render_imagery(town, box)
    cut = [whole[r : r + SIDE, c : c + SIDE] for r in (0, SIDE, 2 * SIDE) for c in (0, SIDE, 2 * SIDE)]
    full = [p for p in cut if p.shape == (SIDE, SIDE, 3)]
    return full[:count]


def real(count: int) -> list[np.ndarray]:
    """Crops of the real flight's frames, none where it is not there."""
    files = sorted((REAL / "flight-sheffield" / "frames").glob("*.JPG"))
    step = max(1, len(files) // count)
    return [cv2.imread(str(f))[44 : 44 + SIDE, 144 : 144 + SIDE, ::-1] for f in files[::step]][:count]


def quiet() -> contextlib.ExitStack:
    stack = contextlib.ExitStack()
    stack.enter_context(warnings.catch_warnings())
    warnings.simplefilter("ignore")
    stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
    logging.getLogger().setLevel(logging.ERROR)
    return stack


def torch_runs(weights: Path, threads: int) -> Iterator[tuple[str, Run]]:
    torch.set_num_threads(threads)
    network, card = load_network(weights)

    def run(net: Any, dtype: torch.dtype, layout: torch.memory_format) -> Run:
        def answer(x: np.ndarray) -> np.ndarray:
            with torch.inference_mode():
                seen = torch.from_numpy(x).to(dtype).contiguous(memory_format=layout)
                return torch.sigmoid(net(seen).float() / card.temperature).numpy()

        return answer

    yield "torch float32", run(network, torch.float32, torch.contiguous_format)
    last = torch.channels_last
    spread = load_network(weights)[0].to(memory_format=last)
    yield "torch float32, channels last", run(spread, torch.float32, last)
    half = load_network(weights)[0].to(torch.bfloat16).to(memory_format=last)
    yield "torch bfloat16, channels last", run(half, torch.bfloat16, last)
    try:
        compiled = torch.compile(load_network(weights)[0].to(memory_format=last))
        answer = run(compiled, torch.float32, last)
        with quiet():
            answer(np.zeros((1, 3, SIDE, SIDE), np.float32))
        yield "torch.compile, channels last", answer
    except Exception as error:  # no compiler, or none that it likes
        print(f"torch.compile: not available ({type(error).__name__}: {str(error).splitlines()[0][:100]})")


def onnx_runs(
    graph: Path, threads: int, calibration: list[np.ndarray], folder: Path
) -> Iterator[tuple[str, Run, int]]:
    import onnxruntime as ort
    from onnxruntime.quantization import (
        CalibrationDataReader,
        QuantFormat,
        QuantType,
        quantize_dynamic,
        quantize_static,
    )
    from onnxruntime.quantization.shape_inference import quant_pre_process

    def session(path: Path) -> Run:
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        opened = ort.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
        return lambda x: opened.run(None, {"picture": x})[0]

    check_seal(graph.read_bytes(), str(graph))
    yield "ONNX Runtime float32", session(graph), graph.stat().st_size

    class Pictures(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self.left = iter(calibration)

        def get_next(self) -> dict[str, np.ndarray] | None:
            x = next(self.left, None)
            return None if x is None else {"picture": x}

    ready = folder / "ready.onnx"
    with quiet():
        quant_pre_process(graph, ready, skip_symbolic_shape=True)
        dynamic = folder / "dynamic.onnx"
        quantize_dynamic(ready, dynamic, weight_type=QuantType.QUInt8)
    with contextlib.suppress(Exception):  # dynamic convolutions exist for few types only
        yield "ONNX Runtime int8, dynamic", session(dynamic), dynamic.stat().st_size
    convolutions = {"every layer": [], "all but the first and last": None}
    import onnx

    names = [n.name for n in onnx.load(ready).graph.node if n.op_type in ("Conv", "ConvTranspose")]
    for title, spared in convolutions.items():
        static = folder / f"static-{len(title)}.onnx"
        with quiet():
            quantize_static(
                ready,
                static,
                Pictures(),
                quant_format=QuantFormat.QDQ,
                per_channel=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                op_types_to_quantize=["Conv"],
                nodes_to_exclude=[names[0], names[1], names[-1], names[-2]] if spared is None else [],
            )
        yield f"ONNX Runtime int8, static, {title}", session(static), static.stat().st_size


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(int((a | b).sum()), 1))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--weights", type=Path, default=SHIPPED.with_suffix(".safetensors"))
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--frames", type=Path, help="a folder of more pictures to measure agreement on")
    parser.add_argument("--write", type=Path, help="the document whose table is replaced")
    args = parser.parse_args()

    _, card = load_network(args.weights)
    mean, std = np.array(card.mean, np.float32), np.array(card.std, np.float32)

    def normalised(image: np.ndarray) -> np.ndarray:
        x = (image.astype(np.float32) / 255.0 - mean) / std
        return np.ascontiguousarray(np.moveaxis(x, -1, 0)[None])

    sets = {"generated": generated(901, 6), "Sheffield": real(8)}
    if args.frames:
        files = sorted(args.frames.glob("*.jpg"))[::7][:8]
        sets["rendered frames"] = [cv2.imread(str(f))[:448, 64:576, ::-1] for f in files]
    calibration = [normalised(p) for p in (*generated(902, 6), *real(16)[1::2])]
    pictures = {name: [normalised(p) for p in images] for name, images in sets.items() if images}

    with tempfile.TemporaryDirectory() as scratch:
        runs: list[tuple[str, Run, int]] = [
            (name, run, args.weights.stat().st_size) for name, run in torch_runs(args.weights, args.threads)
        ]
        runs += onnx_runs(args.weights.with_suffix(".onnx"), args.threads, calibration, Path(scratch))
        x = pictures["generated"][0]
        seconds: dict[str, list[float]] = {name: [] for name, _, _ in runs}
        graph = args.weights.with_suffix(".onnx")
        segmenters = {k: Segmenter.load(graph, "onnx", args.threads, looks=k) for k in (1, 2)}
        whole: dict[int, list[float]] = {k: [] for k in segmenters}
        for round_ in range(args.rounds + 1):
            for name, run, _ in runs:
                start = time.perf_counter()
                run(x)
                if round_:  # the first warms up
                    seconds[name].append(time.perf_counter() - start)
            # Each after an untimed call of its own and in turn the first: what ran before would count for one of them alone.
            for looks in sorted(segmenters, reverse=bool(round_ % 2)):
                segmenters[looks].probability(sets["generated"][0])
                start = time.perf_counter()
                segmenters[looks].probability(sets["generated"][0])
                if round_:
                    whole[looks].append(time.perf_counter() - start)
        truth = {name: [runs[0][1](p) for p in those] for name, those in pictures.items()}
        base = float(np.median(seconds[runs[0][0]]))
        head = [
            "backend",
            "ms a frame",
            "ratio",
            "MB",
            "largest difference",
            *[f"mask IoU, {n}" for n in pictures],
        ]
        rows = [head, ["---"] * len(head)]
        for name, run, size in runs:
            took = float(np.median(seconds[name]))
            apart, overlaps = 0.0, []
            for group, those in pictures.items():
                pairs = [(run(p), t) for p, t in zip(those, truth[group], strict=True)]
                apart = max(apart, *(float(np.abs(a - b).max()) for a, b in pairs))
                a, b = (np.concatenate([q[k].ravel() > card.threshold for q in pairs]) for k in (0, 1))
                overlaps.append(f"{iou(a, b):.4f}")
            rows.append(
                [
                    name,
                    f"{1000 * took:.0f}",
                    f"{took / base:.2f}",
                    f"{size / 1e6:.1f}",
                    f"{apart:.1e}",
                    *overlaps,
                ]
            )
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    one, two = (1000 * float(np.median(whole[k])) for k in (1, 2))
    table += (
        f"\n\nA frame of {SIDE} x {SIDE} px from picture to probability, ONNX Runtime: {one:.0f} ms by one look, "
        f"{two:.0f} ms by two ({two / one:.2f} times)."
    )
    print(table)
    if args.write:
        text = args.write.read_text(encoding="utf-8")
        before, rest = text.split("<!-- table -->", 1)
        after = rest.split("<!-- /table -->", 1)[1]
        note = (
            f"Weights {card.digest}, {args.threads} threads, medians of {args.rounds} interleaved rounds, torch "
            f"{torch.__version__}. Trust the ratios, not the milliseconds."
        )
        args.write.write_text(
            f"{before}<!-- table -->\n{table}\n\n{note}\n<!-- /table -->{after}", encoding="utf-8"
        )


if __name__ == "__main__":
    main()
