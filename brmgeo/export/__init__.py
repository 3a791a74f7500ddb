"""Results out: maps for QGIS, pictures, and flights in the formats that other programs read.

Adapters only: each module turns values into one kind of file. Files appear whole or not at all, and the
same values give the same bytes: no clock, host or path goes into them.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def utc_ms(start_utc: datetime | None, t_s: NDArray[np.float64]) -> NDArray[np.int64]:
    """(n,) int64 milliseconds since 1970-01-01 UTC of flight times ``t_s`` (n,), seconds after ``start_utc``.

    Without ``start_utc`` the times count from 1970-01-01 UTC itself: right for Unix stamps, and a flight
    whose clock starts at zero then plays on 1 January 1970. A ``start_utc`` without time zone is UTC.
    """
    start = EPOCH if start_utc is None else start_utc
    start = start.replace(tzinfo=UTC) if start.tzinfo is None else start
    # Whole milliseconds first: a float of 1.7e12 ms is exact, its sum with a fraction may round unevenly.
    start_ms = round((start - EPOCH) / timedelta(milliseconds=1))
    return start_ms + np.rint(np.asarray(t_s, dtype=np.float64) * 1000.0).astype(np.int64)


def shown_until_ms(start_ms: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) int64 last millisecond at which each of n frames is the current one: 1 ms before the next begins.

    ``start_ms`` (n,) int64 must not decrease. The last frame lasts as long as the median of the others (1 s when alone).
    """
    steps = np.diff(start_ms)
    last = round(float(np.median(steps))) if len(steps) else 1000
    ends = np.append(start_ms[1:], start_ms[-1:] + max(last, 1)) - 1
    return np.maximum(ends, start_ms)


def iso_utc(ms: int) -> str:
    """``2026-01-31T09:00:00.250Z`` of milliseconds since 1970-01-01 UTC."""
    return (EPOCH + timedelta(milliseconds=int(ms))).strftime("%Y-%m-%dT%H:%M:%S.") + f"{int(ms) % 1000:03d}Z"
