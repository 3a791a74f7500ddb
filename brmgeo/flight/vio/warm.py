"""The warm start: the first seconds are gone through twice, the second time with what the first taught."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.vio.delay import coarse_delay
from brmgeo.flight.vio.filter import VioFilter


class TimedFrame(NamedTuple):
    """One frame: its time in seconds, the grey picture (h, w) uint8, and the height above ground in metres."""

    t_s: float
    grey: NDArray[np.uint8]
    agl_m: float


def warm_up(vio: VioFilter, first: Sequence[TimedFrame], interval_s: float | None = None) -> None:
    """Starts ``vio``, a new filter, with what another one makes of the flight's first frames.

    Args:
        vio: its IMU reaches from the first frame to beyond the last.
        first: the frames of the first ``warm_s``, which ``vio`` takes in once more afterwards.
        interval_s: see ``coarse_delay``.

    A short beginning teaches nothing, and neither does a blind one: then ``vio`` is left to start by itself.
    """
    n = len(first)
    if n and vio.settings.delay_sigma_s > 0.0:
        times = np.array([frame.t_s for frame in first])
        pictures = [frame.grey for frame in first]
        vio.delay = coarse_delay(times, pictures, vio.imu, vio.camera, vio.mount, interval_s)
    if n > 1 and first[-1].t_s - first[0].t_s >= 0.25 * vio.settings.warm_s:
        warm = VioFilter(vio.camera, vio.mount, vio.imu, vio.settings)
        warm.delay = vio.delay
        blind = [warm.frame(*frame)[1] for frame in first]
        if sum(blind) <= 0.1 * n and not blind[-1]:
            vio.start(first[0].t_s, first[0].agl_m, warm)
