"""Figures of a flight, after the paper's Fig. 9 (paths), 10 (first candidates) and 11 (candidates that thin out).

Every function gives the bytes of a picture (PNG where there is a map behind, SVG for curves) without time stamps, so that
the same flight gives the same bytes.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from brmgeo.codes import BUILDING, UNKNOWN
from brmgeo.flight.values import Estimate, View
from brmgeo.match import GroundMap

Extent = tuple[float, float, float, float]

REFERENCE, ODOMETRY, ONLINE, SMOOTHED, CANDIDATE = "#111111", "#d1495b", "#f2a541", "#1b7fbd", "#e63946"
STATUS_COLOUR = {"converged": "#2a9d5c", "ambiguous": "#f2a541", "lost": "#8d99ae"}
# Colour of each value of a building map.
_PALETTE = np.full((256, 3), 245, np.uint8)
_PALETTE[BUILDING], _PALETTE[UNKNOWN] = (92, 103, 125), (215, 215, 215)

_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "svg.hashsalt": "brmgeo",
    "svg.fonttype": "path",
}


@dataclass(frozen=True, slots=True)
class Background:
    """A picture of the ground: (h, w, 3) uint8 or (h, w) uint8 0/1/255, and its (left, bottom, right, top) in metres."""

    pixels: NDArray[np.uint8]
    bounds: Extent


@dataclass(frozen=True, slots=True)
class Paths:
    """The paths of one flight, each (n, 2) float64 metres in the map's CRS, NaN where unknown; None when absent."""

    reference: NDArray[np.float64] | None
    odometry: NDArray[np.float64] | None
    smoothed: NDArray[np.float64] | None


def paths_figure(background: Background, paths: Paths, estimates: Sequence[Estimate]) -> bytes:
    """PNG: reference, odometry alone, online fixes and smoothed path over the map (Fig. 9)."""
    with mpl.rc_context(_STYLE):
        fixes = np.array([e.mean for e in estimates if e.status == "converged"]).reshape(-1, 2)
        shown = [
            p for p in (paths.reference, paths.smoothed, paths.odometry, fixes) if p is not None and len(p)
        ]
        box = _frame(np.concatenate(shown) if shown else None, background.bounds)
        figure, axes = _map_axes(box, 9.0)
        _ground(axes, background, box)
        handles = []
        for path, colour, label, width in (
            (paths.odometry, ODOMETRY, "odometry alone, started at the true pose", 1.6),
            (paths.smoothed, SMOOTHED, "smoothed", 2.2),
            (paths.reference, REFERENCE, "reference", 1.4),
        ):
            if path is None:
                continue
            axes.plot(*path.T, color="white", linewidth=width + 1.8, alpha=0.8, solid_capstyle="round")
            style = "--" if label == "reference" else "-"
            axes.plot(*path.T, style, color=colour, linewidth=width, solid_capstyle="round")
            handles.append(Line2D([], [], color=colour, linestyle=style, linewidth=width, label=label))
        if len(fixes):
            axes.scatter(
                fixes[:, 0], fixes[:, 1], s=26, color=ONLINE, edgecolor="black", linewidth=0.6, zorder=5
            )
            axes.scatter(
                fixes[0, 0],
                fixes[0, 1],
                s=150,
                marker="*",
                color="#ffe066",
                edgecolor="black",
                linewidth=0.9,
                zorder=6,
            )
            handles.append(_dot(ONLINE, "o", "online fixes"))
            handles.append(_dot("#ffe066", "*", "first fix", 11))
        axes.legend(handles=handles, loc="upper left", framealpha=0.92, fontsize=8)
        _scale_bar(axes, box)
        return _png(figure)


def first_candidates_figure(
    background: Background, estimate: Estimate, reference_xy: NDArray[np.float64] | None
) -> bytes:
    """PNG: the candidates of the first frame over the whole map, with the true place (Fig. 10)."""
    with mpl.rc_context(_STYLE):
        figure, axes = _map_axes(background.bounds, 9.0)
        _ground(axes, background, background.bounds, pale=True)
        _candidates(axes, estimate, background.bounds, 220)
        handles = [_dot(CANDIDATE, "o", f"candidates ({estimate.candidate_count:,})")]
        if reference_xy is not None:
            _truth(axes, reference_xy)
            handles.append(_dot("#00b4d8", "P", "true place", 9))
        axes.legend(handles=handles, loc="upper left", framealpha=0.92, fontsize=8)
        _scale_bar(axes, background.bounds)
        return _png(figure)


def shrinking_figure(
    background: Background,
    estimates: Sequence[Estimate],
    reference_xy: NDArray[np.float64] | None,
    flown_m: NDArray[np.float64] | None,
) -> bytes:
    """PNG: candidates of six frames from the first to the first fix and on (Fig. 11).

    ``reference_xy`` is (n, 2) and ``flown_m`` (n,) metres flown, or None without a reference.
    """
    with mpl.rc_context(_STYLE):
        n = len(estimates)
        first = next((i for i, e in enumerate(estimates) if e.status == "converged"), n - 1)
        chosen = sorted(
            {0, *np.linspace(0, max(first, min(5, n - 1)), min(5, n)).round().astype(int).tolist(), n - 1}
        )
        chosen = chosen[:6]
        left, bottom, right, top = background.bounds
        height = (
            3.1 * len(range(0, len(chosen), 3)) * max(0.6, min(1.6, (top - bottom) / (right - left))) + 0.5
        )
        figure = Figure(figsize=(10.0, height), dpi=110, layout="constrained")
        grid = figure.subplots(-(-len(chosen) // 3), min(3, len(chosen)), squeeze=False).ravel()
        for axes in grid:
            axes.set_axis_off()
        for axes, index in zip(grid, chosen, strict=False):
            estimate = estimates[index]
            _ground(axes, background, background.bounds, pale=True)
            _candidates(axes, estimate, background.bounds, 110)
            if reference_xy is not None:
                _truth(axes, reference_xy[index])
            way = "" if flown_m is None else f", {flown_m[index]:.0f} m flown"
            axes.set_title(
                f"frame {index + 1}{way}: {estimate.candidate_count:,}, {estimate.status}", fontsize=8
            )
        return _png(figure)


@dataclass(frozen=True, slots=True)
class SeenFrame:
    """One frame as the camera and the matcher saw it.

    Attributes:
        title: what is written above it.
        picture: (H, W, 3) uint8 RGB of the camera, or None when the flight has masks only.
        view: (h, w) float32 share of building of the levelled view, nose up.
        known: (h, w) bool, where the view says something.
        ground: (h, w) uint8 building map (0, 1, 255 unknown) below the same pixels at the fix, or None without a fix.
    """

    title: str
    picture: NDArray[np.uint8] | None
    view: NDArray[np.float32]
    known: NDArray[np.bool_]
    ground: NDArray[np.uint8] | None


def map_below(ground: GroundMap, view: View, xy: NDArray[np.float64], yaw_rad: float) -> NDArray[np.uint8]:
    """(h, w) uint8 building map at each pixel of a view whose nadir is at ``xy``; 255 beyond the map."""
    rows, cols = np.indices(view.building.shape) + 0.5
    ahead, left = (view.nadir_px[0] - rows) * view.gsd_m, (view.nadir_px[1] - cols) * view.gsd_m
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    col = np.floor((xy[0] + ahead * c - left * s - ground.left) / ground.gsd_m).astype(np.int64)
    row = np.floor((ground.top - xy[1] - ahead * s - left * c) / ground.gsd_m).astype(np.int64)
    h, w = ground.building.shape
    inside = (row >= 0) & (row < h) & (col >= 0) & (col < w)
    out = np.full(view.building.shape, UNKNOWN, np.uint8)
    out[inside] = ground.building[row[inside], col[inside]]
    return out


def seen_figure(frames: Sequence[SeenFrame]) -> bytes:
    """PNG: one row a frame: the camera's picture, its levelled building mask, and the map at the fix with the mask on it."""
    with mpl.rc_context(_STYLE):
        pictures = any(f.picture is not None for f in frames)
        columns = 2 + pictures
        figure = Figure(figsize=(3.3 * columns, 2.75 * len(frames)), dpi=110, layout="constrained")
        grid = figure.subplots(len(frames), columns, squeeze=False)
        for row, seen in zip(grid, frames, strict=True):
            for axes in row:
                axes.set_axis_off()
            if pictures and seen.picture is not None:
                row[0].imshow(seen.picture, interpolation="antialiased")
            mask, ground = row[-2], row[-1]
            grey = np.where(seen.known, 245 - 153 * seen.view, 205.0).astype(np.uint8)
            mask.imshow(grey, cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
            row[0].set_title(seen.title, fontsize=8)
            if seen.ground is None:
                ground.text(
                    0.5, 0.5, "no fix", ha="center", va="center", transform=ground.transAxes, color="#5c677d"
                )
                continue
            ground.imshow(_PALETTE[seen.ground], interpolation="antialiased")
            if (seen.view >= 0.5).any() and (seen.view < 0.5).any():
                ground.contour(seen.view, levels=[0.5], colors=[CANDIDATE], linewidths=0.9)
        heads = ["camera"] * pictures + ["mask, levelled, nose up", "map at the fix, mask in red"]
        for axes, head in zip(grid[0], heads, strict=True):
            title = axes.get_title(loc="left")
            axes.set_title(f"{head}\n{title}" if title else head, fontsize=8)
        return _png(figure)


def curves_figure(
    estimates: Sequence[Estimate],
    errors_m: NDArray[np.float64] | None,
    odometry_errors_m: NDArray[np.float64] | None,
) -> bytes:
    """SVG: position error with the 2 sigma band, sigma, entropy of the belief and number of candidates over time."""
    with mpl.rc_context(_STYLE):
        t = np.array([e.t_s for e in estimates]) - (estimates[0].t_s if estimates else 0.0)
        sigma = np.array([np.sqrt(max(np.trace(e.covariance), 0.0) / 2) for e in estimates])
        converged = np.array([e.status == "converged" for e in estimates], dtype=bool)
        entropy = np.array([e.extra.get("entropy", np.nan) for e in estimates])
        count = np.array([e.candidate_count for e in estimates], dtype=float)
        rows: list[str] = ["error"] if errors_m is not None else []
        rows += ["sigma", "entropy" if np.isfinite(entropy).any() else "candidates"]
        figure = Figure(figsize=(10.0, 2.1 * len(rows) + 0.4), layout="constrained")
        all_axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False).ravel()
        for axes, row in zip(all_axes, rows, strict=True):
            _status_bands(axes, t, [e.status for e in estimates])
            axes.grid(True, axis="y", color="#dddddd", linewidth=0.6)
            axes.set_axisbelow(True)
            if row == "error" and errors_m is not None:
                if odometry_errors_m is not None:
                    axes.plot(t, odometry_errors_m, color=ODOMETRY, linewidth=1.4, label="odometry alone")
                axes.plot(
                    t,
                    np.where(converged, errors_m, np.nan),
                    "o-",
                    color=SMOOTHED,
                    markersize=3,
                    label="online fix",
                )
                axes.plot(
                    t,
                    np.where(converged, 2 * sigma, np.nan),
                    "--",
                    color="#555555",
                    linewidth=1,
                    label="2 sigma",
                )
                axes.set_yscale("symlog", linthresh=1.0)
                axes.set_ylim(bottom=0)
                axes.set_ylabel("error, m")
                axes.legend(loc="upper right", ncols=3, fontsize=8, framealpha=0.9)
            elif row == "sigma":
                axes.semilogy(t, np.maximum(sigma, 1e-3), color="#333333", linewidth=1.4)
                axes.set_ylabel("sigma, m")
            elif row == "entropy":
                axes.plot(t, entropy, color="#6a4c93", linewidth=1.4)
                axes.set_ylabel("entropy of\nthe belief, nats")
            else:
                axes.semilogy(t, np.maximum(count, 0.5), color="#6a4c93", linewidth=1.4)
                axes.set_ylabel("candidates")
        all_axes[-1].set_xlabel("time since the first frame, s")
        all_axes[0].legend(
            handles=[
                *all_axes[0].get_legend_handles_labels()[0],
                *_status_handles({e.status for e in estimates}),
            ],
            loc="upper right",
            ncols=6,
            fontsize=7.5,
            framealpha=0.9,
        )
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
        return buffer.getvalue()


def _map_axes(box: Extent, width: float) -> tuple[Figure, Axes]:
    left, bottom, right, top = box
    height = max(4.0, min(11.0, width * (top - bottom) / (right - left)))
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    axes = figure.subplots()
    axes.set_axis_off()
    return figure, axes


def _ground(axes: Axes, background: Background, box: Extent, pale: bool = False) -> None:
    left, bottom, right, top = background.bounds
    pixels = background.pixels
    if pixels.ndim == 2:
        pixels = _PALETTE[pixels]
    if pale:
        pixels = (pixels.astype(np.float32) * 0.45 + 255 * 0.55).astype(np.uint8)
    axes.imshow(pixels, extent=(left, right, bottom, top), interpolation="antialiased")
    axes.set_xlim(box[0], box[2])
    axes.set_ylim(box[1], box[3])
    axes.set_aspect("equal")


def _frame(points: NDArray[np.float64] | None, bounds: Extent) -> Extent:
    points = None if points is None else points[np.isfinite(points).all(axis=1)]
    if points is None or not len(points):
        return bounds
    low, high = points.min(axis=0), points.max(axis=0)
    margin = max(80.0, 0.12 * float((high - low).max()))
    low, high = low - margin, high + margin
    # a shape between 3:4 and 16:9 reads best on a page
    width, height = high - low
    grow_x = max(0.0, 0.9 * height - width) / 2
    grow_y = max(0.0, 0.55 * width - height) / 2
    return (low[0] - grow_x, low[1] - grow_y, high[0] + grow_x, high[1] + grow_y)


def _candidates(axes: Axes, estimate: Estimate, bounds: Extent, across: int) -> None:
    """Candidates as a heat map of ``across`` bins: by mass, over three decades, so that single cells stay visible."""
    xy, mass = estimate.candidates, estimate.candidate_mass
    left, bottom, right, top = bounds
    inside = (xy[:, 0] >= left) & (xy[:, 0] < right) & (xy[:, 1] > bottom) & (xy[:, 1] <= top)
    xy, mass = xy[inside], mass[inside]
    if not len(xy):
        return
    sampled = estimate.candidate_count > len(estimate.candidates)
    if sampled:
        # Only some of them are at hand: bins so fine that most hold none would show the drawing, not the candidates.
        across = min(across, round(1.6 * math.sqrt(len(xy))))
    size = max(right - left, top - bottom) / max(across, 8)
    shape = (math.ceil((top - bottom) / size), math.ceil((right - left) / size))
    heat = np.zeros(shape)
    rows = np.minimum(((top - xy[:, 1]) / size).astype(np.int64), shape[0] - 1)
    np.add.at(heat, (rows, ((xy[:, 0] - left) / size).astype(np.int64)), mass if mass.any() else 1.0)
    share = heat / heat.max()
    picture = np.empty((*shape, 4))
    picture[..., :3] = to_rgb(CANDIDATE)
    tone = np.clip(1.0 + np.log10(np.maximum(share, 1e-12)) / 3.0, 0.0, 1.0)
    picture[..., 3] = np.where(heat > 0, 0.2 + 0.75 * tone, 0.0)
    extent = (left, left + shape[1] * size, top - shape[0] * size, top)
    axes.imshow(picture, extent=extent, interpolation="bilinear" if sampled else "nearest", zorder=3)
    heavy = np.argwhere(share > 0.05)
    if len(heavy) <= 12:
        # A handful of cells on a map of kilometres would be missed.
        at = np.column_stack([left + (heavy[:, 1] + 0.5) * size, top - (heavy[:, 0] + 0.5) * size])
        axes.scatter(
            at[:, 0], at[:, 1], s=150, facecolor="none", edgecolor=CANDIDATE, linewidth=1.3, zorder=5
        )
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)


def _truth(axes: Axes, xy: NDArray[np.float64]) -> None:
    axes.scatter(xy[0], xy[1], s=70, marker="P", color="#00b4d8", edgecolor="white", linewidth=1.0, zorder=6)


def _dot(colour: str, marker: str, label: str, size: float = 6) -> Line2D:
    return Line2D(
        [], [], color=colour, marker=marker, linestyle="", markersize=size, markeredgecolor="black",
        markeredgewidth=0.5, label=label,
    )  # fmt: skip


def _scale_bar(axes: Axes, box: Extent) -> None:
    width = box[2] - box[0]
    length = next(v for v in (5000, 2000, 1000, 500, 200, 100, 50, 20, 10, 5, 1) if v < width / 4 or v == 1)
    x, y = box[0] + 0.04 * width, box[1] + 0.04 * (box[3] - box[1])
    axes.plot([x, x + length], [y, y], color="white", linewidth=6, solid_capstyle="butt")
    axes.plot([x, x + length], [y, y], color="black", linewidth=3, solid_capstyle="butt")
    label = f"{length // 1000} km" if length >= 1000 else f"{length} m"
    axes.annotate(
        label, (x + length / 2, y), xytext=(0, 5), textcoords="offset points", ha="center", fontsize=8,
        fontweight="bold", bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
    )  # fmt: skip


def _status_bands(axes: Axes, t: NDArray[np.float64], status: Sequence[str]) -> None:
    if len(t) == 0:
        return
    edges = np.concatenate([[t[0]], (t[1:] + t[:-1]) / 2, [t[-1]]])
    start = 0
    for i in range(1, len(status) + 1):
        if i == len(status) or status[i] != status[start]:
            axes.axvspan(edges[start], edges[i], color=STATUS_COLOUR[status[start]], alpha=0.16, linewidth=0)
            start = i
    axes.set_xlim(edges[0], max(edges[-1], edges[0] + 1e-3))


def _status_handles(present: set[str]) -> list[Line2D]:
    return [
        Line2D([], [], color=colour, alpha=0.4, linewidth=7, label=status)
        for status, colour in STATUS_COLOUR.items()
        if status in present
    ]


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
