"""Curves and pictures of a training run, as the bytes of files."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from brmgeo.codes import LABEL_BUILDING, LABEL_UNKNOWN
from brmgeo.pictures import encode


def training_table(epochs: Sequence[Mapping[str, Any]]) -> str:
    """CSV of the epochs' named values, one row an epoch."""
    table = io.StringIO()
    writer = csv.DictWriter(table, list(epochs[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(epochs)
    return table.getvalue()


def training_figure(epochs: Sequence[Mapping[str, Any]]) -> bytes:
    """PNG: training and validation loss, and the IoU on validation crops, over the steps."""
    figure = Figure(figsize=(8.5, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    steps = [e["step"] for e in epochs]
    left.plot(steps, [e["loss"] for e in epochs], marker="o", ms=3, label="training")
    left.plot(steps, [e["validation_loss"] for e in epochs], marker="o", ms=3, label="validation")
    left.set(xlabel="step", ylabel="loss", ylim=(0, None))
    left.legend(frameon=False)
    right.plot(steps, [e["validation_iou"] for e in epochs], color="tab:green", marker="o", ms=3)
    right.set(xlabel="step", ylabel="IoU on validation crops", ylim=(0, 1))
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    return _png(figure)


def reliability_figure(curves: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]) -> bytes:
    """PNG of reliability: by name, (n,) probabilities that were said and (n,) shares that are building."""
    figure = Figure(figsize=(4.2, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="0.7", lw=1)
    for name, (said, was) in curves.items():
        axes.plot(said, was, marker="o", ms=4, label=name)
    axes.set(
        xlabel="probability said", ylabel="share that is building", xlim=(0, 1), ylim=(0, 1), aspect="equal"
    )
    axes.legend(frameon=False)
    return _png(figure)


def crops_figure(
    images: NDArray[np.uint8],
    labels: NDArray[np.uint8],
    probability: NDArray[np.float32],
    most: int = 24,
    columns: int = 8,
) -> bytes:
    """PNG: crops with their true outlines (yellow) above the probability (blue to red; unknown ground grey).

    Args:
        images: (n, s, s, 3) uint8 RGB.
        labels: (n, s, s) uint8.
        probability: (n, s, s) float32.
        most: crops that are shown, evenly chosen.
        columns: crops in a row.
    """
    chosen = np.linspace(0, len(images) - 1, min(most, len(images))).astype(int)
    cells = []
    for i in chosen:
        shown = images[i].copy()
        outline, _ = cv2.findContours(
            (labels[i] == LABEL_BUILDING).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
        )
        cv2.drawContours(shown, outline, -1, (255, 255, 0), 1)
        heat = cv2.applyColorMap((probability[i] * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[
            ..., ::-1
        ].copy()
        heat[labels[i] == LABEL_UNKNOWN] = 90
        cells.append(np.pad(np.vstack([shown, heat]), ((2, 2), (2, 2), (0, 0)), constant_values=255))
    while len(cells) % columns:
        cells.append(np.full_like(cells[0], 255))
    rows = [np.hstack(cells[i : i + columns]) for i in range(0, len(cells), columns)]
    return encode(np.asarray(np.vstack(rows), dtype=np.uint8))


def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, dpi=110, format="png")
    return out.getvalue()
