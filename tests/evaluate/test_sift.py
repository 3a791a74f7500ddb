"""SIFT finds a frame cut from the very same picture, and says nothing about one from elsewhere."""

from __future__ import annotations

import cv2
import numpy as np

from brmgeo.evaluate.sift import SiftMatcher


def picture(seed: int, size: int = 600) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.full((size, size), 120, np.uint8)
    for _ in range(500):
        centre, axes = rng.integers(0, size, 2), rng.integers(4, 25, 2)
        cv2.ellipse(
            image,
            centre.tolist(),
            axes.tolist(),
            float(rng.uniform(0, 180)),
            0,
            360,
            int(rng.integers(0, 255)),
            -1,
        )
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def test_a_turned_and_scaled_cut_is_found_where_it_was_cut() -> None:
    imagery = picture(1)
    matcher = SiftMatcher(imagery, left=1000.0, top=5000.0, gsd_m=0.5)
    # a frame of 0.4 m/px about the point (col 330, row 250), turned by 37 degrees
    matrix = cv2.getRotationMatrix2D((330, 250), 37, 0.5 / 0.4)
    matrix[:, 2] += np.array([120 - 330, 110 - 250])
    frame = cv2.warpAffine(imagery, matrix, (240, 220))
    fix = matcher.locate(frame, 0.4, anchor_px=(110.5, 120.5))
    assert fix is not None
    assert np.linalg.norm(fix.xy - [1000 + 330.5 * 0.5, 5000 - 250.5 * 0.5]) < 0.5
    assert abs(fix.scale_ratio - 1) < 0.05


def test_a_frame_from_elsewhere_gives_no_place() -> None:
    matcher = SiftMatcher(picture(1), left=0.0, top=0.0, gsd_m=0.5)
    assert matcher.locate(picture(2, 240), 0.5, (120, 120)) is None
    assert matcher.locate(np.zeros((240, 240), np.uint8), 0.5, (120, 120)) is None


def test_imagery_without_a_feature_gives_no_place_and_no_crash() -> None:
    matcher = SiftMatcher(np.full((300, 300), 90, np.uint8), left=0.0, top=0.0, gsd_m=0.5)
    assert matcher.locate(picture(2, 240), 0.5, (120, 120)) is None
