"""A flight's frames as the smoother needs them: kept only where somebody wants to smooth, for they grow with the flight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import LABEL_BUILDING
from brmgeo.errors import SettingsError
from brmgeo.flight.values import Motion, View
from brmgeo.match.smooth import Anchor
from brmgeo.match.state import State, damaged


@dataclass(frozen=True, slots=True, eq=False)
class PackedView:
    """A view in a quarter of the memory.

    Attributes:
        building: (h, w) uint8, steps of 1/255.
        known: (ceil(h w / 8),) uint8, one bit a pixel.
        gsd_m, nadir_px, agl_m, radius_m: as in ``View``.
    """

    building: NDArray[np.uint8]
    known: NDArray[np.uint8]
    gsd_m: float
    nadir_px: tuple[float, float]
    agl_m: float
    radius_m: float

    @staticmethod
    def of(view: View) -> PackedView:
        """The view, packed."""
        return PackedView(
            building=np.rint(view.building * LABEL_BUILDING).astype(np.uint8),
            known=np.packbits(view.known),
            gsd_m=view.gsd_m,
            nadir_px=view.nadir_px,
            agl_m=view.agl_m,
            radius_m=view.radius_m,
        )

    def view(self, t_s: float) -> View:
        """The view again, without its name."""
        shape, size = self.building.shape, self.building.size
        return View(
            t_s=t_s,
            building=self.building.astype(np.float32) / np.float32(LABEL_BUILDING),
            known=np.unpackbits(self.known, count=size).astype(np.bool_).reshape(shape),
            gsd_m=self.gsd_m,
            nadir_px=self.nadir_px,
            agl_m=self.agl_m,
            radius_m=self.radius_m,
        )


class History:
    """All frames so far: times (seconds), motions, measured poses and, where they are given, views."""

    def __init__(self) -> None:
        self.times_s: list[float] = []
        self.motions: list[Motion] = []
        self.anchors: list[Anchor | None] = []
        self.views: list[PackedView] = []

    def add(self, t_s: float, motion: Motion, view: View | None = None) -> None:
        """Take in a frame; its pose is not measured yet."""
        self.times_s.append(t_s)
        self.motions.append(motion)
        self.anchors.append(None)
        if view is not None:
            self.views.append(PackedView.of(view))

    def state(self) -> State:
        """Named arrays, a row a frame; NaN stands for what is not known."""
        nan = math.nan
        motions = [
            (m.dt_s, *(m.step_m if m.step_m is not None else (nan, nan)), _number(m.yaw_rad), m.sigma_m,
             _number(m.compass_yaw_rad))
            for m in self.motions
        ]  # fmt: skip
        none = Anchor(np.full(3, nan), np.full((3, 3), nan), nan)
        anchors = [none if a is None else a for a in self.anchors]
        frames = [(v.gsd_m, *v.nadir_px, v.agl_m, v.radius_m) for v in self.views]
        empty = [np.empty(0, np.uint8)]
        return {
            "t_s": np.array(self.times_s, np.float64),
            "motion": np.array(motions, np.float64).reshape(-1, 6),
            "pose": np.array([a.pose for a in anchors], np.float64).reshape(-1, 3),
            "covariance": np.array([a.covariance for a in anchors], np.float64).reshape(-1, 3, 3),
            "fit": np.array([a.fit for a in anchors], np.float64),
            "frame": np.array(frames, np.float64).reshape(-1, 5),
            "shape": np.array([v.building.shape for v in self.views], np.int64).reshape(-1, 2),
            "building": np.concatenate([*(v.building.ravel() for v in self.views), *empty]),
            "known": np.concatenate([*(v.known for v in self.views), *empty]),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take up what ``state`` gave; InputError where its arrays contradict each other."""
        n = len(state["t_s"])
        size = state["shape"].prod(axis=1)
        bits = -(-size // 8)
        if any(len(state[name]) != n for name in ("motion", "pose", "covariance", "fit")) or (
            len(size) not in (0, n)
            or len(state["frame"]) != len(size)
            or (int(size.sum()), int(bits.sum())) != (state["building"].size, state["known"].size)
        ):
            raise damaged("the history's parts differ in length")
        self.times_s = state["t_s"].tolist()
        self.motions = [motion_of(row) for row in state["motion"]]
        self.anchors = [
            None if math.isnan(pose[0]) else Anchor(pose, covariance, float(fit))
            for pose, covariance, fit in zip(state["pose"], state["covariance"], state["fit"])
        ]
        buildings = np.split(state["building"], np.cumsum(size)[:-1])
        knowns = np.split(state["known"], np.cumsum(bits)[:-1])
        self.views = [
            PackedView(
                building=building.reshape(shape),
                known=known,
                gsd_m=float(row[0]),
                nadir_px=(float(row[1]), float(row[2])),
                agl_m=float(row[3]),
                radius_m=float(row[4]),
            )
            for building, known, shape, row in zip(buildings, knowns, state["shape"], state["frame"])
        ]


def motion_of(row: NDArray[np.float64]) -> Motion:
    """The motion of one row of a history's state."""
    return Motion(
        dt_s=float(row[0]),
        step_m=None if math.isnan(row[1]) else row[1:3].copy(),
        yaw_rad=None if math.isnan(row[3]) else float(row[3]),
        sigma_m=float(row[4]),
        compass_yaw_rad=None if math.isnan(row[5]) else float(row[5]),
    )


def kept(history: History | None) -> History:
    """The history; SettingsError where none is kept."""
    if history is None:
        raise SettingsError(
            "to smooth takes all frames of the flight, and this matcher keeps none: make it with history=True"
        )
    return history


def _number(value: float | None) -> float:
    return math.nan if value is None else value
