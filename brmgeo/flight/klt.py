"""Points followed from frame to frame: corners, pyramidal Lucas-Kanade, forward-backward check.

Sources: Shi & Tomasi, "Good Features to Track" (CVPR 1994); Lucas & Kanade (IJCAI 1981) in the pyramids of Bouguet
("Pyramidal Implementation of the Lucas Kanade Feature Tracker", Intel 2000); the forward-backward check of Kalal,
Mikolajczyk & Matas (ICPR 2010); contrast-limited histogram equalization of Zuiderveld (Graphics Gems IV, 1994).

A point is matched against the frame in which it was last anchored, not against the frame just before: following from
frame to frame adds an error every time, and at ten frames a second most of the drift would be of that kind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.readings import FloatArray


@dataclass(frozen=True, slots=True)
class KltSettings:
    """How points are found and followed.

    Attributes:
        features: points followed at most.
        cells: (rows, columns) of the grid over which new points are spread evenly.
        spacing_px: least distance between points when they are found.
        quality: least corner strength, as a share of the strongest corner's.
        window_px: side of the patch that is matched.
        levels: pyramid levels above the full frame.
        forward_backward_px: a point that does not come back to its anchor within this is dropped.
        reanchor_px, reanchor_share: points are anchored anew once they have moved by this (median), or once fewer than
            this share of the points anchored last are left.
        clahe_below: frames whose grey levels spread less than this (standard deviation, of 255) are equalized first;
            others are only brought to one mean and spread, which costs a twentieth. 0 never equalizes, 256 always.
    """

    features: int = 150
    cells: tuple[int, int] = (5, 6)
    spacing_px: float = 16.0
    quality: float = 0.01
    window_px: int = 17
    levels: int = 3
    forward_backward_px: float = 0.6
    reanchor_px: float = 16.0
    reanchor_share: float = 0.8
    clahe_below: float = 25.0


class KltTracker:
    """Follows points through a sequence of frames.

    After each ``step`` (and ``refill``) ``px`` is (n, 2) float64, pixels (u, v) of the living points in the newest frame
    (OpenCV's convention, whole numbers are centres), and ``ids`` (n,) int64 names them for good.
    """

    def __init__(self, settings: KltSettings | None = None) -> None:
        self.settings = settings or KltSettings()
        s = self.settings
        self.px: FloatArray = np.empty((0, 2))
        self.ids: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self.anchor_px: FloatArray = np.empty((0, 2))
        self._anchor: NDArray[np.uint8] | None = None
        self._now: NDArray[np.uint8] | None = None
        self._anchored = 0
        self._next_id = 0
        self._surprise = np.inf  # how far off the predictions were last time, pixels
        self._raw: NDArray[np.uint8] | None = None
        self._clahe = cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8))
        self._flat = s.clahe_below > 255.0
        self._options: dict[str, Any] = {
            "winSize": (s.window_px, s.window_px),
            "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01),
        }

    def step(self, grey: NDArray[np.uint8], predicted_px: FloatArray | None = None) -> NDArray[np.bool_]:
        """(n,) bool: which of the points there were are still there; ``px`` and ``ids`` then hold those only.

        Args:
            grey: (h, w) uint8 frame.
            predicted_px: (n, 2) where the points are expected, or None: where they were.
        """
        s = self.settings
        self._raw = grey
        self._now = self._prepared(grey)
        if not len(self.px) or self._anchor is None:
            return np.empty(0, dtype=np.bool_)
        start = self.anchor_px.astype(np.float32)
        guess = (self.px if predicted_px is None else predicted_px).astype(np.float32)
        guess = np.where(np.isfinite(guess), guess, start)
        # A patch half a window off is found without the coarse levels, which are most of the work.
        levels = s.levels
        if predicted_px is not None and self._surprise < s.window_px / 4.0:
            levels = 0 if self._surprise < s.window_px / 10.0 else min(1, levels)
        place, alive = self._match(start, guess, levels)
        lost = np.flatnonzero(~alive)
        if levels < s.levels and lost.size > 0.1 * len(alive):
            place[lost], alive[lost] = self._match(start[lost], guess[lost], s.levels)
        if alive.any():
            off = np.abs(place - guess)[alive].max(axis=1)
            self._surprise = float(np.partition(off, int(0.9 * off.size))[int(0.9 * off.size)])
        self.px, self.anchor_px, self.ids = place[alive], self.anchor_px[alive], self.ids[alive]
        return alive

    def _match(
        self, start: NDArray[np.float32], guess: NDArray[np.float32], levels: int
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        # Where the anchored patches are now, and which of them come back to where they started.
        s = self.settings
        assert self._anchor is not None
        assert self._now is not None
        options = self._options | {"flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
        there, found, _ = cv2.calcOpticalFlowPyrLK(
            self._anchor, self._now, start[:, None], guess[:, None].copy(), maxLevel=levels, **options
        )
        place = there[:, 0].astype(np.float64)
        height, width = self._now.shape
        rim = s.window_px / 4.0
        alive = found[:, 0] > 0
        alive &= (place >= rim).all(axis=1) & (place <= [width - 1 - rim, height - 1 - rim]).all(axis=1)
        kept = np.flatnonzero(alive)
        if kept.size:
            # The way back begins where it should end: the finest level is enough.
            back, returned, _ = cv2.calcOpticalFlowPyrLK(
                self._now, self._anchor, there[kept], start[kept, None].copy(), maxLevel=0, **options
            )
            off = np.hypot(*(back[:, 0] - start[kept]).T)
            alive[kept] = (returned[:, 0] > 0) & (off < s.forward_backward_px)
        return place, np.asarray(alive)

    def _prepared(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self._flat:
            return np.asarray(self._clahe.apply(grey), dtype=np.uint8)
        # Exposure changes from frame to frame, and Lucas-Kanade takes grey levels for what they are.
        mean, spread = (float(v[0, 0]) for v in cv2.meanStdDev(grey))
        scale = 50.0 / max(spread, 5.0)
        return np.asarray(cv2.addWeighted(grey, scale, grey, 0.0, 128.0 - scale * mean), dtype=np.uint8)

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Drop the points that are not ``chosen`` (n,) bool."""
        self.px, self.anchor_px, self.ids = self.px[chosen], self.anchor_px[chosen], self.ids[chosen]

    @property
    def wants_anchor(self) -> bool:
        """True when the points have moved far, or many are gone: time for ``refill``."""
        if len(self.px) < max(8, self.settings.reanchor_share * self._anchored):
            return True
        moved = np.hypot(*(self.px - self.anchor_px).T)
        return bool(np.median(moved) > self.settings.reanchor_px)

    def refill(self) -> int:
        """Anchor all points in the newest frame and find new ones where there are few; how many, at the end, are new."""
        assert self._now is not None
        assert self._raw is not None
        s = self.settings
        flat = float(cv2.meanStdDev(self._raw)[1][0, 0]) < s.clahe_below
        if flat != self._flat:  # anchor and frames are prepared alike
            self._flat = flat
            self._now = self._prepared(self._raw)
        height, width = self._now.shape
        new = np.empty((0, 2))
        if len(self.px) < 0.85 * s.features:
            free = np.full((height, width), 255, dtype=np.uint8)
            rim = s.window_px // 2
            free[:rim], free[-rim:], free[:, :rim], free[:, -rim:] = 0, 0, 0, 0
            for u, v in np.rint(self.px).astype(int):
                cv2.circle(free, (int(u), int(v)), int(s.spacing_px), 0, -1)
            corners = cv2.goodFeaturesToTrack(
                self._now, 4 * s.features, s.quality, s.spacing_px, mask=free, blockSize=5
            )
            if corners is not None:
                corners = corners[:, 0].astype(np.float64)  # strongest first
                rows, cols = s.cells
                share = np.array([cols / width, rows / height])
                cell = (corners * share).astype(int) @ [1, cols]
                held = np.bincount(((self.px * share).astype(int) @ [1, cols]), minlength=rows * cols)
                order = np.argsort(cell, kind="stable")
                first = np.searchsorted(cell[order], cell[order])
                rank = np.empty(len(corners), dtype=int)
                rank[order] = np.arange(len(corners)) - first
                # The emptiest cells first, each by the strength of its corners.
                turn = np.argsort(rank + held[cell], kind="stable")
                new = corners[turn[: s.features - len(self.px)]]
        self.px = np.concatenate([self.px, new])
        self.ids = np.concatenate([self.ids, np.arange(self._next_id, self._next_id + len(new))])
        self._next_id += len(new)
        self.anchor_px = self.px.copy()
        self._anchor = self._now
        self._anchored = len(self.px)
        return len(new)

    def forget(self) -> None:
        """Drop all points, after a gap."""
        self.keep(np.zeros(len(self.px), dtype=np.bool_))
        self._surprise = np.inf
