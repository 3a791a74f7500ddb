"""The end of a training run: calibration, scores, the model card, and the files that are written.

Scores are taken as prediction would answer: at the frames' own GSD, by the weights and looks that are kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from brmgeo.codes import LABEL_UNKNOWN as UNKNOWN
from brmgeo.files import set_aside, whole_files, write_bytes
from brmgeo.segment.augment import MEAN, STD
from brmgeo.segment.ground import ScoredFrame, TrainingGround
from brmgeo.segment.metrics import LogitHistogram, MaskScores, best_threshold, segmentation_scores
from brmgeo.segment.onnx_export import export_onnx
from brmgeo.segment.predict import LOOKS, Segmenter
from brmgeo.segment.recipe import Recipe
from brmgeo.segment.train import tensors_of
from brmgeo.segment.unet import shifted
from brmgeo.segment.weights import ModelCard, save_weights

#: What a run writes: the weights first, for all else belongs to them.
RESULTS = ("model.safetensors", "model.md", "model.onnx", "reliability.png")


def finish(
    state: Mapping[str, Tensor],
    recipe: Recipe,
    ground: TrainingGround,
    out: Path,
    *,
    steps: int,
    reliability: Callable[[Mapping[str, LogitHistogram]], bytes],
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Calibrates on validation frames, scores as prediction would answer, writes weights, card and ONNX.

    All of it is made in a folder of its own and moved to ``out`` when it is whole, the weights first: those of a run that
    is killed on the way are those of before, or none.

    Args:
        state: the trained weights.
        steps: that they were trained for.
        reliability: draws reliability.png from what the network said before and after calibration.
        say: is told what comes out, line by line.

    Returns the calibration and the scores of every kind of ground.
    """
    low, high = recipe.augment.gsd_m
    card = ModelCard(
        settings=recipe.unet.plain(), mean=MEAN, std=STD, threshold=0.5, temperature=1.0, gsd_min_m=low, gsd_max_m=high,
        gsd_work_m=recipe.work_gsd_m,
        data={"recipe": recipe.title, "steps": steps, "sources": ground.credits},
        licence=licence_of(ground.credits),
    )  # fmt: skip
    with whole_files(out, RESULTS, say) as made:
        weights = made / "model.safetensors"
        save_weights(weights, tensors_of(state), card)
        asked = {
            looks: histograms(Segmenter.load(weights, "torch", looks=looks), ground.validation)
            for looks in range(1, LOOKS + 1)
        }
        reached = {looks: best_threshold(grounds)[1] for looks, grounds in asked.items()}
        looks = max(reached, key=lambda k: reached[k])
        say(f"IoU on validation {reached[1]:.4f} by one look, {reached[2]:.4f} by two: weights for {looks}")
        before = weighed(asked[looks])
        temperature, shift = before.calibration()
        card = replace(card, temperature=round(temperature, 4))
        # The shift goes into the weights: whoever reads them, or the ONNX, has calibrated answers without knowing of it.
        tensors = tensors_of(shifted(state, shift))
        save_weights(weights, tensors, card)
        # What fits the mean of two looks goes into each of them, which is nearly the same: so the threshold is chosen,
        # and the calibration's error taken, on what comes out.
        segmenter = Segmenter.load(weights, "torch", looks=looks)
        grounds = histograms(segmenter, ground.validation)
        after = weighed(grounds)
        card = replace(card, threshold=round(best_threshold(grounds)[0], 3))
        calibration = {
            "looks": segmenter.looks,
            "temperature": card.temperature,
            "shift": round(shift, 4),
            "threshold": card.threshold,
            "calibration_error_before": round(before.calibration_error(), 4),
            "calibration_error": round(after.calibration_error(), 4),
        }
        say(
            f"calibrated on validation: temperature {card.temperature}, shift {calibration['shift']}, "
            f"threshold {card.threshold}"
        )
        scores = _all_scores(replace(segmenter, card=card), ground)
        for name, row in scores.items():
            say(f"{name}: " + ", ".join(f"{k} {v:g}" for k, v in row.items()))
        # The scores belong into the card; the tensors and with them the answers stay what they are.
        card = replace(card, metrics={"calibration": calibration, **scores})
        save_weights(weights, tensors, card)
        export_onnx(weights, made / "model.onnx")
        write_bytes(made / "reliability.png", reliability({"as trained": before, "calibrated": after}))
        # What belongs to other weights goes before they do.
        belongings = ("model.onnx", "metrics.json")
        set_aside(out, belongings, say)
        for name in belongings:
            (out / name).unlink(missing_ok=True)
    return {"calibration": calibration, "scores": scores}


def _all_scores(segmenter: Segmenter, ground: TrainingGround) -> dict[str, dict[str, float]]:
    """The scores of all ground that is not trained on; what cannot be told of one (features without room) is left out."""
    return {
        f"{split}: {name}{height}": {k: v for k, v in own.summary().items() if math.isfinite(v)}
        for split, sets in (("validation", ground.validation), ("test", ground.test))
        for name, pictures in sets.items()
        for height, own in score(segmenter, pictures).items()
    }


def histograms(segmenter: Segmenter, validation: Mapping[str, Sequence[ScoredFrame]]) -> list[LogitHistogram]:
    """What a ``Segmenter`` says of each kind of validation ground."""
    parts = []
    for pictures in validation.values():
        own = LogitHistogram()
        for picture in pictures:
            image, label = picture.read()
            p = np.clip(segmenter.probability(image, picture.gsd_m).astype(np.float64), 1e-7, 1 - 1e-7)
            own.add(np.log(p / (1 - p)).astype(np.float32), label)
        parts.append(own)
    return parts


def weighed(parts: Sequence[LogitHistogram]) -> LogitHistogram:
    """All kinds of ground in one, each counting the same, whatever its area."""
    whole = LogitHistogram()
    most = max(int((h.building + h.other).sum()) for h in parts)
    for own in parts:
        times = most / max(int((own.building + own.other).sum()), 1)
        whole.building += np.rint(own.building * times).astype(np.int64)
        whole.other += np.rint(own.other * times).astype(np.int64)
    return whole


def score(segmenter: Segmenter, pictures: Sequence[ScoredFrame]) -> dict[str, MaskScores]:
    """The scores of frames by a network, at the frames' own GSD.

    Under "" those of the answers as they are; where these can be laid onto the ground, under ", laid down from H m" those
    of what lies there, over the pixels whose roofs are within the frame.
    """
    total = {"": MaskScores()}
    for picture in pictures:
        image, label = picture.read()
        probability = segmenter.probability(image, picture.gsd_m)
        answers = {"": (probability, label)}
        if picture.lowered:
            laid = picture.lowered(probability)
            own = np.where(np.isnan(laid), np.uint8(UNKNOWN), label)
            answers[f", laid down from {picture.roof_m:g} m"] = laid, own
        for how, (seen, truth) in answers.items():
            found = segmentation_scores(seen, truth, segmenter.card.threshold, picture.gsd_m)
            total[how] = total.get(how, MaskScores()) + found
    return total


_OWN_LICENCE = "Apache-2.0 for the weights"


def licence_of(credits: Sequence[Mapping[str, Any]]) -> str:
    """One line for the model card: the weights' own licence and what their sources and those of earlier parts ask for."""
    asked = []
    for credit in _with_earlier(credits):
        licence, attribution = credit.get("licence"), credit.get("attribution")
        if credit.get("split") == "test":
            continue
        if not licence and credit.get("kind") in ("tiles", "pairs", "xyz"):
            licence = "terms not stated"
        if licence:
            asked.append(f"{credit['name']}: " + (f"{attribution} ({licence})" if attribution else licence))
    return _OWN_LICENCE + ("; trained on " + "; ".join(dict.fromkeys(asked)) if asked else "")


def _with_earlier(credits: Sequence[Mapping[str, Any]]) -> Iterator[Mapping[str, Any]]:
    """The credits, and after weights that training went on from theirs; in place of them where the terms are the same."""
    for credit in credits:
        data = credit.get("data")
        sources = data.get("sources") if isinstance(data, Mapping) else None
        earlier: list[Mapping[str, Any]] = []
        if credit.get("kind") == "start" and isinstance(sources, list):
            earlier = list(_with_earlier([s for s in sources if isinstance(s, Mapping) and "name" in s]))
        told = str(credit.get("licence", "")).startswith(_OWN_LICENCE) and any(
            c.get("licence") for c in earlier
        )
        if not told:
            yield credit
        yield from earlier
