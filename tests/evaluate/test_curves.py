"""Curves and pictures of a training run show what they are given."""

from __future__ import annotations

import csv

import cv2
import numpy as np

from brmgeo.evaluate.curves import crops_figure, reliability_figure, training_figure, training_table

EPOCHS = [
    {"epoch": k, "step": 10 * k, "loss": 1.0 / k, "validation_loss": 1.2 / k, "validation_iou": 0.1 * k}
    for k in (1, 2, 3)
]


def seen(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1]


def test_the_table_holds_every_epoch() -> None:
    rows = list(csv.DictReader(training_table(EPOCHS).splitlines()))
    assert [{k: float(v) for k, v in row.items()} for row in rows] == EPOCHS


def test_figures_change_with_what_they_show() -> None:
    first, again = training_figure(EPOCHS), training_figure(EPOCHS)
    assert first == again != training_figure(EPOCHS[:2])
    said = np.linspace(0.0, 1.0, 5)
    assert reliability_figure({"a": (said, said)}) != reliability_figure({"a": (said, said**2)})
    assert seen(first).shape[0] > 300


def test_crops_lie_above_what_was_found_in_them() -> None:
    images = np.full((5, 16, 16, 3), (200, 10, 30), np.uint8)
    labels = np.zeros((5, 16, 16), np.uint8)
    labels[:, 4:12, 4:12] = 255
    labels[:, :, 14:] = 127
    probability = np.zeros((5, 16, 16), np.float32)
    probability[:, 4:12, 4:12] = 1.0
    picture = seen(crops_figure(images, labels, probability, most=3, columns=2))
    assert picture.shape == (2 * 36, 2 * 20, 3)
    assert picture[2, 2].tolist() == [200, 10, 30]
    assert picture[2 + 4, 2 + 4].tolist() == [255, 255, 0]
    red, _, blue = picture[2 + 16 + 8, 2 + 8].tolist()
    assert red > blue
    assert picture[2 + 16 + 8, 2 + 15].tolist() == [90, 90, 90]
    assert picture[36 + 8, 20 + 8].tolist() == [255, 255, 255]  # three crops in two columns
    assert (images == (200, 10, 30)).all()  # the crops are validated on again
