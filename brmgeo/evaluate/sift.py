"""The baseline that the paper's Fig. 1 shows to fail: SIFT features of a frame against the region's imagery.

Frames and imagery are matched as pictures: SIFT, Lowe's ratio test, a similarity transform by RANSAC
(D. Lowe, IJCV 2004; OpenCV's implementation). It has no odometry and no building map.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.evaluate.report import ReportTable
from brmgeo.evaluate.scores import FALSE_FIX_M
from brmgeo.flight.folder import Flight
from brmgeo.flight.values import View
from brmgeo.flight.view import make_view
from brmgeo.geo.raster import read_overview


@dataclass(frozen=True, slots=True)
class SiftFix:
    """A place that SIFT claims: (x, y) metres, the number of RANSAC inliers, and the scale found against the one known."""

    xy: NDArray[np.float64]
    inliers: int
    scale_ratio: float


class SiftMatcher:
    """Matches frames to imagery by SIFT.

    Args:
        imagery: (H, W, 3) uint8 RGB or (H, W) uint8, north up.
        left, top: world coordinates of the imagery's upper left corner, metres.
        gsd_m: metres per pixel of the imagery.
        max_features: features kept of the imagery, the strongest first.
        min_inliers: matches that must agree on one similarity transform.
    """

    def __init__(
        self,
        imagery: NDArray[np.uint8],
        left: float,
        top: float,
        gsd_m: float,
        max_features: int = 60_000,
        min_inliers: int = 12,
    ) -> None:
        self._left, self._top, self._gsd_m, self._min_inliers = left, top, gsd_m, min_inliers
        points, self._descriptors = _features(imagery, max_features)
        self._points = points
        self._index = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 64})
        if len(points) >= 2:
            # OpenCV's index breaks off over nothing, and a bare field has no feature.
            self._index.add([self._descriptors])
            self._index.train()

    def locate(
        self, image: NDArray[np.uint8], gsd_m: float, anchor_px: tuple[float, float], max_features: int = 2000
    ) -> SiftFix | None:
        """Where the picture ``image`` was taken, or None when too few matches agree.

        Args:
            image: (h, w, 3) uint8 RGB or (h, w) uint8, a levelled frame.
            gsd_m: metres per pixel of the frame; a match with a scale off by more than a factor 1.3 is refused.
            anchor_px: (row, col) of the point whose place is asked for, usually the nadir.
        """
        points, descriptors = _features(image, max_features)
        if len(points) < self._min_inliers or len(self._points) < 2:
            return None
        pairs = self._index.knnMatch(descriptors, k=2)
        good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < 0.8 * p[1].distance]
        if len(good) < self._min_inliers:
            return None
        source = points[[m.queryIdx for m in good]]
        target = self._points[[m.trainIdx for m in good]]
        matrix, kept = cv2.estimateAffinePartial2D(
            source, target, method=cv2.RANSAC, ransacReprojThreshold=4.0, maxIters=5000, confidence=0.999
        )
        if matrix is None:
            return None
        inliers = int(kept.sum())
        scale = math.hypot(matrix[0, 0], matrix[1, 0])
        ratio = scale * self._gsd_m / gsd_m
        if inliers < self._min_inliers or not 1 / 1.3 < ratio < 1.3:
            return None
        row, col = anchor_px
        place = matrix @ np.array([col, row, 1.0])
        xy = np.array([self._left + place[0] * self._gsd_m, self._top - place[1] * self._gsd_m])
        return SiftFix(xy=xy, inliers=inliers, scale_ratio=float(ratio))


def _features(image: NDArray[np.uint8], count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = cv2.SIFT.create(nfeatures=count).detectAndCompute(grey, None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    # OpenCV puts pixel centres on whole numbers; ours lie at +0.5.
    return np.array([k.pt for k in keypoints], np.float32) + np.float32(0.5), descriptors


@functools.lru_cache(maxsize=1)
def _sift_matcher(imagery: Path, changed_ns: int) -> tuple[SiftMatcher, float]:
    """Features of a region's imagery, and its metres per pixel."""
    # The time of the last change is in the key, so that imagery made anew is read anew.
    pixels, bounds = read_overview(imagery, 4000)
    gsd_m = (bounds[2] - bounds[0]) / pixels.shape[2]
    return SiftMatcher(np.moveaxis(pixels, 0, -1), bounds[0], bounds[3], gsd_m), gsd_m


def sift_fixes(
    imagery: Path, pictures: Iterable[NDArray[np.uint8]], level: Callable[[int, NDArray[Any], float], View]
) -> Iterator[tuple[SiftFix | None, float]]:
    """The paper's Fig. 1: where SIFT finds each frame (h, w, 3) in a region's imagery, None where nowhere; and the seconds
    that finding it took, of the levelled frame as the matchers' are.

    ``level(index, grey, gsd_m)`` makes a view of a frame's (h, w) float32 grey levels in [0, 1].
    """
    matcher, gsd_m = _sift_matcher(imagery, imagery.stat().st_mtime_ns)
    for index, picture in enumerate(pictures):
        view = level(index, picture.astype(np.float32).mean(axis=2) / 255.0, gsd_m)
        began = time.perf_counter()
        fix = matcher.locate((view.building * 255).astype(np.uint8), gsd_m, view.nadir_px)
        yield fix, time.perf_counter() - began


def sift_table(
    imagery: Path, flight: Flight, truth: NDArray[np.float64] | None, note: str = ""
) -> ReportTable:
    """The paper's Fig. 1 as a table: SIFT features of each frame against the region's imagery.

    Args:
        imagery: a raster in the map's CRS.
        flight: with frames.
        truth: (n, 2) where each frame was taken, metres in the map's CRS; None where nobody knows.
        note: what is to be said below the table.
    """

    def level(index: int, grey: NDArray[Any], gsd_m: float) -> View:
        f = flight.frames[index]
        return make_view(
            grey, flight.camera, flight.mount, f.roll_rad, f.pitch_rad, f.agl_m, gsd_m, t_s=f.t_s
        )

    found = right = 0
    pictures = (flight.image(index) for index in range(len(flight.frames)))
    for index, (fix, _) in enumerate(sift_fixes(imagery, pictures, level)):
        if fix is not None:
            found += 1
            if truth is not None and np.linalg.norm(fix.xy - truth[index]) <= FALSE_FIX_M:
                right += 1
    total = len(flight.frames)
    return ReportTable(
        "SIFT against the imagery (the paper's Fig. 1)",
        ("", "frames", "share"),
        (
            ("frames", str(total), ""),
            ("with a match that RANSAC accepts", str(found), f"{found / total:.0%}"),
            (
                "of these within 50 m of the reference",
                str(right) if truth is not None else "–",
                f"{right / total:.0%}",
            ),
        ),
        note,
    )
