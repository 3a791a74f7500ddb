"""Simulated flights: a flight folder, or its views in memory, over any footprints and imagery.

An aircraft follows a path at constant speed with rounded corners, banks in the turns, wobbles and drifts in height. Its
camera sees the footprints through the full camera model; what the flight's instruments say (height, attitude,
odometry, compass) carries errors of its own. Everything follows from one seed: the same seed, settings and ground
give the same bytes. ``simulate_views`` runs the same course as ``simulate`` without the folder.

Odometry errors are those of monocular visual-inertial odometry at height: a scale bias, a random walk of the heading,
and noise. Mask errors are those of a segmentation network: buildings missed (some of them in every frame, as a
network does), false blobs, and wobbly edges; or pixels flipped in smooth patches to a given pixel accuracy.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numba as nb
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, uniform_filter
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from brmgeo.errors import InputError
from brmgeo.flight.camera import border_pixels, pixel_from_point, ray_from_pixel, world_from_camera
from brmgeo.flight.motion import motions
from brmgeo.flight.readings import Attitude, Camera, FloatArray, Odometry, Reference
from brmgeo.flight.values import Motion, View
from brmgeo.flight.view import make_view
from brmgeo.geo.crs import LONLAT, convergence_rad, transformer

GRAVITY = 9.80665
EDGE_STEP_M = 2.0

# Streams of randomness, so that switching one effect on or off leaves the others as they are.
_COURSE, _SENSORS, _ODOMETRY, _MASK, _LATENT, _PICTURE = range(6)


@dataclass(frozen=True, slots=True)
class MaskErrors:
    """What a segmentation network does wrong.

    Attributes:
        missed: share of buildings missing from a frame's mask.
        missed_always: how much of that is the building's own doing: 0 misses at random in each frame, 1 misses
            the same buildings in every frame (correlation of a latent Gaussian).
        false_blobs: mean number of false buildings in a frame.
        blob_radius_m: their median radius; it varies by half.
        edge_sigma_m: standard deviation of edges about the truth, per axis.
        edge_scale_m: length over which an edge's error changes.
        pixel_accuracy: when given, pixels are flipped in smooth patches, after the errors above, until this share
            of all pixels is as it was; 0.916 is the accuracy of the paper's network.
    """

    missed: float = 0.12
    missed_always: float = 0.5
    false_blobs: float = 3.0
    blob_radius_m: float = 4.0
    edge_sigma_m: float = 0.5
    edge_scale_m: float = 3.0
    pixel_accuracy: float | None = None

    @classmethod
    def none(cls) -> MaskErrors:
        """A perfect network."""
        return cls(missed=0.0, false_blobs=0.0, edge_sigma_m=0.0)

    @classmethod
    def degraded(cls, pixel_accuracy: float = 0.916) -> MaskErrors:
        """Only pixel errors, to a given accuracy."""
        return cls(missed=0.0, false_blobs=0.0, edge_sigma_m=0.0, pixel_accuracy=pixel_accuracy)


@dataclass(frozen=True, slots=True)
class OdometryErrors:
    """Errors of monocular visual-inertial odometry.

    Attributes:
        scale_sigma: standard deviation of the scale bias when ``scale_bias`` is None.
        scale_bias: the bias itself: 0.05 makes every step 5 % too long.
        drift_deg_sqrt_min: heading random walk, degrees per root minute.
        noise_m_sqrt_s: position random walk per axis, metres per root second.
        reset_times_s: at each of these times the filter starts again: two seconds of silence, then a new origin and yaw.
        rate_hz: poses a second.
    """

    scale_sigma: float = 0.05
    scale_bias: float | None = None
    drift_deg_sqrt_min: float = 0.75
    noise_m_sqrt_s: float = 0.05
    reset_times_s: tuple[float, ...] = ()
    rate_hz: float = 10.0

    @classmethod
    def none(cls) -> OdometryErrors:
        """Perfect odometry (in a frame of arbitrary origin and yaw all the same)."""
        return cls(scale_sigma=0.0, scale_bias=0.0, drift_deg_sqrt_min=0.0, noise_m_sqrt_s=0.0)


@dataclass(frozen=True, slots=True)
class FlightSettings:
    """How the simulated aircraft flies and what its instruments are worth.

    Attributes:
        camera, mount: the camera and how it sits in the body.
        speed_m_s, frame_interval_s, agl_m: cruise.
        agl_sigma_m: slow changes of height about ``agl_m``.
        wobble_deg: standard deviation of roll and pitch about the flight's own.
        cruise_pitch_deg: nose-down attitude of a multirotor at cruise.
        crab_sigma_deg: angle between nose and course, one draw a flight.
        turn_radius_m: rounding of the path's corners.
        attitude_error_deg: error of the measured roll and pitch: one draw a flight and as much again each frame.
        agl_error_m: error of the measured height: one draw a flight and as much again each frame.
        compass_error_deg: error of the compass, one draw a flight and as much again each frame; None for no compass.
        masks, odometry: their error models; odometry None flies without.
        exposure_s: shutter time, for motion blur.
        exposure_sigma: standard deviation of the picture's brightness from frame to frame, as a factor.
        noise_levels: standard deviation of sensor noise at middle grey, of 255.
        vignette: share of light lost in the corners.
        jpeg_quality: of the written frames.
        sun_azimuth_deg: where the light on the walls comes from, clockwise from north.
    """

    camera: Camera = field(default_factory=lambda: Camera.from_fov(640, 480, 43.0))
    mount: Attitude = field(default_factory=Attitude)
    speed_m_s: float = 5.0
    frame_interval_s: float = 5.0
    agl_m: float = 150.0
    agl_sigma_m: float = 2.0
    wobble_deg: float = 1.5
    cruise_pitch_deg: float = 2.0
    crab_sigma_deg: float = 3.0
    turn_radius_m: float = 8.0
    attitude_error_deg: float = 0.2
    agl_error_m: float = 0.4
    compass_error_deg: float | None = None
    masks: MaskErrors = field(default_factory=MaskErrors)
    odometry: OdometryErrors | None = field(default_factory=OdometryErrors)
    exposure_s: float = 1.0 / 250.0
    exposure_sigma: float = 0.05
    noise_levels: float = 3.0
    vignette: float = 0.15
    jpeg_quality: int = 92
    sun_azimuth_deg: float = 152.0

    def exact(self) -> FlightSettings:
        """The same flight with perfect instruments and masks."""
        return replace(
            self,
            attitude_error_deg=0.0,
            agl_error_m=0.0,
            masks=MaskErrors.none(),
            odometry=None if self.odometry is None else OdometryErrors.none(),
        )


# ---------------------------------------------------------------- ground


@dataclass(frozen=True, slots=True)
class Ground:
    """Footprints made ready for drawing; make it once with ``from_polygons`` and use it for many flights.

    Attributes:
        xy: (v, 2) vertices of all rings in the map frame, edges cut to ``EDGE_STEP_M``; the last repeats the first.
        ring_start: (r + 1,) first vertex of each ring.
        polygon_start: (p + 1,) first ring of each polygon.
        bounds: (p, 4) left, bottom, right, top of each polygon.
        area_m2: (p,) areas.
        height_m: (p,) heights above ground, 0 where unknown.
    """

    xy: FloatArray
    ring_start: NDArray[np.int64]
    polygon_start: NDArray[np.int64]
    bounds: FloatArray
    area_m2: FloatArray
    height_m: FloatArray

    @classmethod
    def from_polygons(cls, polygons: Sequence[Any], heights_m: Sequence[float] | None = None) -> Ground:
        """Ready ground from shapely Polygons or MultiPolygons (map CRS, metres) and their heights."""
        geometries = np.asarray(list(polygons), dtype=object)
        heights = np.zeros(len(geometries)) if heights_m is None else np.asarray(heights_m, dtype=np.float64)
        if len(heights) != len(geometries):
            raise ValueError(f"{len(heights)} heights for {len(geometries)} polygons")
        if not len(geometries):
            none = np.zeros(1, dtype=np.int64)
            return cls(np.empty((0, 2)), none, none, np.empty((0, 4)), np.empty(0), np.empty(0))
        parts, owner = shapely.get_parts(geometries, return_index=True)
        fine = shapely.segmentize(parts, EDGE_STEP_M)
        rings, ring_owner = shapely.get_rings(fine, return_index=True)
        xy, vertex_owner = shapely.get_coordinates(rings, return_index=True)
        ring_start = np.searchsorted(vertex_owner, np.arange(len(rings) + 1))
        polygon_start = np.searchsorted(ring_owner, np.arange(len(parts) + 1))
        return cls(
            np.ascontiguousarray(xy),
            ring_start.astype(np.int64),
            polygon_start.astype(np.int64),
            np.asarray(shapely.bounds(parts), dtype=np.float64),
            np.asarray(shapely.area(parts), dtype=np.float64),
            np.nan_to_num(heights[owner]),
        )

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounds of all footprints (left, bottom, right, top)."""
        if not len(self.bounds):
            raise InputError("the map has no building: give bounds to fly in")
        low, high = self.bounds[:, :2].min(axis=0), self.bounds[:, 2:].max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def near(self, left: float, bottom: float, right: float, top: float) -> NDArray[np.int64]:
        """Indices of the polygons whose bounds touch a box."""
        b = self.bounds
        return np.flatnonzero((b[:, 0] <= right) & (b[:, 2] >= left) & (b[:, 1] <= top) & (b[:, 3] >= bottom))


@dataclass(frozen=True, slots=True)
class Imagery:
    """A picture of the ground from straight above: (h, w, 3) uint8 RGB, north up, its corner and metres per pixel."""

    rgb: NDArray[np.uint8]
    left: float
    top: float
    gsd_m: float

    def crop(self, box: tuple[float, float, float, float]) -> Imagery:
        """The part within (left, bottom, right, top), or the nearest pixel of it."""
        rows, cols = self.rgb.shape[:2]
        c0, c1 = ((x - self.left) / self.gsd_m for x in (box[0], box[2]))
        r0, r1 = ((self.top - y) / self.gsd_m for y in (box[3], box[1]))
        left, top = min(max(math.floor(c0), 0), cols - 1), min(max(math.floor(r0), 0), rows - 1)
        right, bottom = min(max(math.ceil(c1), left + 1), cols), min(max(math.ceil(r1), top + 1), rows)
        return Imagery(
            self.rgb[top:bottom, left:right],
            self.left + left * self.gsd_m,
            self.top - top * self.gsd_m,
            self.gsd_m,
        )

    def coarser(self, factor: int) -> Imagery:
        """The same at ``factor`` times the metres per pixel, by averaging."""
        rows, cols = (max(1, n // factor) for n in self.rgb.shape[:2])
        if factor <= 1 or rows * factor > self.rgb.shape[0] or cols * factor > self.rgb.shape[1]:
            return self
        small = cv2.resize(
            self.rgb[: rows * factor, : cols * factor], (cols, rows), interpolation=cv2.INTER_AREA
        )
        return Imagery(np.asarray(small, dtype=np.uint8), self.left, self.top, self.gsd_m * factor)


# ---------------------------------------------------------------- paths


def rectangle(
    centre: tuple[float, float], heading_deg: float, perimeter_m: float = 1075.0, aspect: float = 0.75
) -> FloatArray:
    """(5, 2) closed rectangle flown to the right; the first side points to ``heading_deg`` (clockwise from north).

    The paper's flight is 1 075 m long; ``aspect`` is short side over long side.
    """
    long = perimeter_m / 2.0 / (1.0 + aspect)
    f, r = long / 2.0, long * aspect / 2.0
    ahead = np.array([math.sin(math.radians(heading_deg)), math.cos(math.radians(heading_deg))])
    right = np.array([ahead[1], -ahead[0]])
    corners = [(-f, -r), (f, -r), (f, r), (-f, r), (-f, -r)]
    return np.array([np.asarray(centre) + a * ahead + b * right for a, b in corners])


def lawnmower(
    bounds: tuple[float, float, float, float], spacing_m: float, heading_deg: float = 90.0
) -> FloatArray:
    """(n, 2) back-and-forth lines that cover ``bounds``, flown along ``heading_deg``."""
    left, bottom, right, top = bounds
    centre = np.array([(left + right) / 2.0, (bottom + top) / 2.0])
    ahead = np.array([math.sin(math.radians(heading_deg)), math.cos(math.radians(heading_deg))])
    side = np.array([ahead[1], -ahead[0]])
    half = np.array([(right - left) / 2.0, (top - bottom) / 2.0])
    reach_along, reach_across = float(np.abs(ahead) @ half), float(np.abs(side) @ half)
    lines = max(1, round(2.0 * reach_across / spacing_m) + 1)
    points = []
    for i, across in enumerate(np.linspace(-reach_across, reach_across, lines) if lines > 1 else [0.0]):
        ends = (-reach_along, reach_along) if i % 2 == 0 else (reach_along, -reach_along)
        points += [centre + a * ahead + across * side for a in ends]
    return np.array(points)


def random_mission(
    bounds: tuple[float, float, float, float], seed: int, length_m: float = 1500.0, leg_m: float = 250.0
) -> FloatArray:
    """(n, 2) legs of random length and turn within ``bounds``, ``length_m`` long in all."""
    rng = np.random.default_rng([seed, 101])
    left, bottom, right, top = bounds
    low, high = np.array([left, bottom]), np.array([right, top])
    points = [low + rng.uniform(0.2, 0.8, 2) * (high - low)]
    course, flown = rng.uniform(0, 2 * math.pi), 0.0
    while flown < length_m:
        leg = min(rng.uniform(0.5, 1.5) * leg_m, length_m - flown)
        for _ in range(100):
            turn = course + rng.normal(0.0, 1.0)
            goal = points[-1] + leg * np.array([math.cos(turn), math.sin(turn)])
            if (goal >= low).all() and (goal <= high).all():
                break
            course = rng.uniform(0, 2 * math.pi)
        goal = np.clip(goal, low, high)
        flown += max(float(np.linalg.norm(goal - points[-1])), 1.0)
        course = math.atan2(*(goal - points[-1])[::-1])
        points.append(goal)
    return np.array(points)


def path_from_geojson(file: Path | str, crs: str) -> FloatArray:
    """(n, 2) waypoints in ``crs`` from a GeoJSON file (longitude, latitude): its first LineString, or its Points in order.

    Raises InputError when the file holds neither, or is not GeoJSON.
    """
    file = Path(file)
    try:
        data = json.loads(file.read_text(encoding="utf-8-sig"))
        features = data["features"] if data["type"] == "FeatureCollection" else [data]
        shapes = [f["geometry"] if f["type"] == "Feature" else f for f in features]
        lines = [g["coordinates"] for g in shapes if g["type"] == "LineString"]
        points = [g["coordinates"] for g in shapes if g["type"] == "Point"]
        lonlat = np.array([[float(v) for v in p[:2]] for p in (lines[0] if lines else points)])
    except OSError as error:
        raise InputError(f"{file}: the waypoints cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError, IndexError):
        raise InputError(f"{file}: not a GeoJSON file with a LineString or Points") from None
    if len(lonlat) < 2 or (np.abs(lonlat) > [180.0, 90.0]).any():
        raise InputError(f"{file}: give at least two waypoints, in longitude and latitude (RFC 7946)")
    x, y = transformer(LONLAT, crs).transform(lonlat[:, 0], lonlat[:, 1])
    return np.stack([x, y], axis=-1)


def place(
    shape: FloatArray,
    ground: Ground,
    seed: int,
    bounds: tuple[float, float, float, float] | None = None,
    margin_m: float = 60.0,
    min_built: float = 0.08,
) -> FloatArray:
    """``shape`` (n, 2), turned and moved at random so that it lies over built-up ground of the map.

    Built-up means that, within squares of 120 m along the path, buildings cover ``min_built`` of the ground on average
    and a quarter of that everywhere. Where 500 draws find no such place, the most built-up one of them is taken.
    Raises InputError when the shape does not fit into the bounds (default: those of the footprints).
    """
    left, bottom, right, top = ground.extent if bounds is None else bounds
    low, high = np.array([left, bottom]) + margin_m, np.array([right, top]) - margin_m
    cell = 30.0
    size = np.maximum(np.ceil((np.array([right, top]) - [left, bottom]) / cell).astype(int), 1)
    built = np.zeros((size[1], size[0]))
    middle = (ground.bounds[:, :2] + ground.bounds[:, 2:]) / 2.0
    at = np.floor((middle - [left, bottom]) / cell).astype(int)
    inside = (at >= 0).all(axis=1) & (at < size).all(axis=1)
    np.add.at(built, (at[inside, 1], at[inside, 0]), ground.area_m2[inside] / cell**2)
    built = uniform_filter(built, 4, mode="constant")

    rng = np.random.default_rng([seed, 102])
    centred = shape - (shape.min(axis=0) + shape.max(axis=0)) / 2.0
    best: FloatArray | None = None
    best_share = -1.0
    for _ in range(500):
        angle = rng.uniform(0.0, 2.0 * math.pi)
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        turned = np.asarray(centred @ turn.T, dtype=np.float64)
        room_low, room_high = low - turned.min(axis=0), high - turned.max(axis=0)
        if (room_high < room_low).any():
            continue
        path: FloatArray = turned + rng.uniform(room_low, room_high)
        along = np.asarray(shapely.get_coordinates(shapely.segmentize(shapely.LineString(path), 25.0)))
        rc = np.clip(np.floor((along - [left, bottom]) / cell).astype(int), 0, size - 1)
        shares = built[rc[:, 1], rc[:, 0]]
        if shares.mean() >= min_built and shares.min() >= min_built / 4.0:
            return path
        if shares.mean() > best_share:
            best, best_share = path, float(shares.mean())
    if best is None:
        raise InputError(
            f"a path of {np.ptp(shape, axis=0).round()} m does not fit {margin_m:g} m inside bounds "
            f"({left:.0f}, {bottom:.0f}, {right:.0f}, {top:.0f}): fly a shorter one or give wider bounds"
        )
    return best


# ---------------------------------------------------------------- the flight itself


@dataclass(frozen=True, slots=True)
class Course:
    """The true flight, 100 times a second, and what the instruments say at the frames.

    ``t_s`` (m,), ``xyz_m`` (m, 3) with z above ground, ``roll_pitch_yaw`` (m, 3) radians; ``frame_index`` (n,) rows of
    the frames; ``measured_*`` (n,) at the frames, rounded as the folder writes them.
    """

    t_s: FloatArray
    xyz_m: FloatArray
    roll_pitch_yaw: FloatArray
    frame_index: NDArray[np.int64]
    measured_agl_m: FloatArray
    measured_roll_deg: FloatArray
    measured_pitch_deg: FloatArray
    measured_grid_heading_deg: FloatArray | None

    @property
    def frame_times_s(self) -> FloatArray:
        """(n,) float64 times of the frames."""
        return self.t_s[self.frame_index]


RATE_HZ = 100


def _rounded(path: FloatArray, radius: float) -> FloatArray:
    # Replace every corner by an arc that touches both legs, no longer than half of either.
    keep = np.r_[True, np.linalg.norm(np.diff(path, axis=0), axis=1) > 1e-6]
    path = path[keep]
    out = [path[0]]
    for before, corner, after in zip(path[:-2], path[1:-1], path[2:]):
        a, b = before - corner, after - corner
        la, lb = float(np.linalg.norm(a)), float(np.linalg.norm(b))
        a, b = a / la, b / lb
        half = math.acos(float(np.clip(a @ b, -1.0, 1.0))) / 2.0
        if half > math.radians(89.9) or half < math.radians(0.5) or radius <= 0:
            out.append(corner)
            continue
        cut = min(radius / math.tan(half), 0.49 * la, 0.49 * lb)
        r = cut * math.tan(half)
        middle = corner + (a + b) / np.linalg.norm(a + b) * math.hypot(cut, r)
        start, end = corner + a * cut - middle, corner + b * cut - middle
        sweep = math.atan2(start[0] * end[1] - start[1] * end[0], float(start @ end))
        for share in np.linspace(0.0, 1.0, max(2, math.ceil(abs(sweep) * r / 0.25))):
            c, s = math.cos(sweep * share), math.sin(sweep * share)
            out.append(middle + [c * start[0] - s * start[1], s * start[0] + c * start[1]])
    out.append(path[-1])
    return np.array(out)


def _smooth_noise(rng: np.random.Generator, n: int, seconds: float) -> FloatArray:
    # Unit variance, correlated over about ``seconds``.
    sigma = seconds * RATE_HZ
    # Drawn coarse and stretched: a long filter over every sample would be most of the flight's cost.
    stride = max(1, int(sigma / 8))
    coarse = gaussian_filter1d(rng.normal(size=n // stride + 34), sigma / stride, mode="wrap")
    coarse *= math.sqrt(2.0 * math.sqrt(math.pi) * sigma / stride)
    return np.interp(np.arange(n), np.arange(len(coarse)) * stride, coarse)


def fly(path: FloatArray, settings: FlightSettings, seed: int) -> Course:
    """The true course along ``path`` (k, 2; metres in the map frame) and the instruments' readings at the frames.

    Raises InputError for a path of fewer than two different points, or a speed, interval or height that is not positive.
    """
    path = np.asarray(path, dtype=np.float64)
    if path.ndim != 2 or len(path) < 2 or not np.isfinite(path).all() or not np.ptp(path, axis=0).any():
        raise InputError("a flight path needs at least two different points: give more waypoints")
    for name in ("speed_m_s", "frame_interval_s", "agl_m"):
        if not (math.isfinite(getattr(settings, name)) and getattr(settings, name) > 0):
            raise InputError(f"{name} is {getattr(settings, name)}: give a positive number")
    rng = np.random.default_rng([seed, _COURSE])
    track = _rounded(path, settings.turn_radius_m)
    track = track[np.r_[True, np.linalg.norm(np.diff(track, axis=0), axis=1) > 1e-6]]
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(track, axis=0), axis=1))]
    n = max(2, int(along[-1] / settings.speed_m_s * RATE_HZ) + 1)
    # Four seconds more at either end, cut off below: the flight begins and ends at cruise, and no filter sees an edge.
    lead = 4 * RATE_HZ
    run = lead / RATE_HZ * settings.speed_m_s + 1.0
    ends = [(track[0] - track[1]) / along[1], (track[-1] - track[-2]) / (along[-1] - along[-2])]
    track = np.concatenate([track[:1] + run * ends[0], track, track[-1:] + run * ends[1]])
    along = np.r_[-run, along, along[-1] + run]
    t = np.arange(-lead, n + lead) / RATE_HZ
    s = t * settings.speed_m_s
    # A multirotor's path is no polygon of tiny chords: smooth it over a fifth of a second.
    xy = np.stack([np.interp(s, along, track[:, k]) for k in range(2)], axis=-1)
    xy = gaussian_filter1d(xy, 0.2 * RATE_HZ, axis=0, mode="nearest")
    velocity = np.gradient(xy, t, axis=0)
    course = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    course = gaussian_filter1d(course, 0.3 * RATE_HZ, mode="nearest")
    accel = gaussian_filter1d(np.gradient(velocity, t, axis=0), 0.3 * RATE_HZ, axis=0, mode="nearest")
    t, xy, course, accel = (values[lead:-lead] for values in (t, xy, course, accel))
    yaw = course + math.radians(settings.crab_sigma_deg) * rng.normal()

    ahead = np.cos(yaw) * accel[:, 0] + np.sin(yaw) * accel[:, 1]
    aside = -np.sin(yaw) * accel[:, 0] + np.cos(yaw) * accel[:, 1]
    wobble = math.radians(settings.wobble_deg)
    roll = -np.arctan2(aside, GRAVITY) + wobble * _smooth_noise(rng, n, 0.7)
    pitch = np.arctan2(ahead, GRAVITY) + wobble * _smooth_noise(rng, n, 0.7)
    pitch += math.radians(settings.cruise_pitch_deg)
    agl = settings.agl_m + settings.agl_sigma_m * _smooth_noise(rng, n, 8.0)
    agl = np.maximum(agl, 0.2 * settings.agl_m)

    every = settings.frame_interval_s * RATE_HZ
    frames = np.unique(np.round(np.arange(0.0, n - 1e-9, every)).astype(np.int64))
    frames = frames[frames < n]
    rng = np.random.default_rng([seed, _SENSORS])
    k = len(frames)

    def read(truth: FloatArray, sigma: float, decimals: int) -> FloatArray:
        return np.round(truth[frames] + sigma * (rng.normal() + rng.normal(size=k)), decimals)

    heading = None
    measured_agl = read(agl, settings.agl_error_m, 3)
    measured_roll = read(np.degrees(roll), settings.attitude_error_deg, 4)
    measured_pitch = read(np.degrees(pitch), settings.attitude_error_deg, 4)
    if settings.compass_error_deg is not None:
        heading = read(90.0 - np.degrees(yaw), settings.compass_error_deg, 3) % 360.0
    return Course(
        t,
        np.concatenate([xy, agl[:, None]], axis=1),
        np.stack([roll, pitch, yaw], axis=-1),
        frames,
        np.maximum(measured_agl, 0.1 * settings.agl_m),
        measured_roll,
        measured_pitch,
        heading,
    )


def odometry_of(course: Course, errors: OdometryErrors, seed: int) -> Odometry:
    """Odometry with errors along a course, in a frame of random origin and yaw, rounded as the folder writes it."""
    rng = np.random.default_rng([seed, _ODOMETRY])
    stride = max(1, round(RATE_HZ / errors.rate_hz))
    rows = np.arange(0, len(course.t_s), stride)
    t, xyz, rpy = course.t_s[rows], course.xyz_m[rows], course.roll_pitch_yaw[rows]
    dt = np.diff(t, prepend=t[0])
    n = len(t)
    scale = 1.0 + (errors.scale_sigma * rng.normal() if errors.scale_bias is None else errors.scale_bias)
    drift = math.radians(errors.drift_deg_sqrt_min) * np.cumsum(rng.normal(size=n) * np.sqrt(dt / 60.0))
    turn = rng.uniform(-math.pi, math.pi) + drift
    step = np.diff(xyz, axis=0, prepend=xyz[:1]) * scale
    # A step belongs to the time between two poses: turn it by the mean of their errors.
    between = np.r_[turn[0], (turn[1:] + turn[:-1]) / 2.0]
    silent = np.zeros(n, dtype=bool)
    origin = np.zeros((n, 3))
    for when in errors.reset_times_s:
        silent |= (t > when) & (t < when + 2.0)
        after = t >= when
        new_yaw = rng.uniform(-math.pi, math.pi)
        turn, between = turn + after * new_yaw, between + after * new_yaw
    c, s = np.cos(between), np.sin(between)
    turned = np.stack([c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1], step[:, 2]], axis=-1)
    walk = rng.normal(size=(n, 3)) * (errors.noise_m_sqrt_s * np.sqrt(dt))[:, None]
    track = np.cumsum(turned + walk, axis=0)
    for when in errors.reset_times_s:
        first = int(np.searchsorted(t, when + 2.0))
        if first < n:
            origin[first:] = track[first]
    track = track - origin
    quaternion = Rotation.from_euler(
        "ZYX", np.stack([rpy[:, 2] + turn, rpy[:, 1], rpy[:, 0]], axis=-1)
    ).as_quat()
    wxyz = np.round(quaternion[:, [3, 0, 1, 2]], 9)
    wxyz /= np.linalg.norm(wxyz, axis=1, keepdims=True)
    keep = ~silent
    return Odometry(np.round(t, 6)[keep], np.round(track, 4)[keep], wxyz[keep], "odometry.tum")


# ---------------------------------------------------------------- masks


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _paint(  # type: ignore[no-untyped-def]
    xy,
    ring_start,
    polygon_start,
    chosen,
    values,
    heights,
    field,
    field_box,
    rot,
    position,
    lens,
    bend,
    max_r,
    image,
):
    # Polygons of the ground through the camera into the image, pixel-centre rule, even-odd within a polygon, later
    # ones over earlier ones. rot is world_from_camera; field (2, rows, cols) moves vertices: metres in x and y on a grid
    # of field_box (left, bottom, spacing).
    height, width = image.shape
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    k1, k2, p1, p2, k3 = bend[0], bend[1], bend[2], bend[3], bend[4]
    longest = 1
    for index in range(chosen.shape[0]):
        p = chosen[index]
        longest = max(longest, ring_start[polygon_start[p + 1]] - ring_start[polygon_start[p]])
    us = np.empty(longest)
    vs = np.empty(longest)
    crossings = np.empty(longest)
    for index in range(chosen.shape[0]):
        p = chosen[index]
        first = ring_start[polygon_start[p]]
        last = ring_start[polygon_start[p + 1]]
        low = np.inf
        high = -np.inf
        for i in range(first, last):
            x = xy[i, 0]
            y = xy[i, 1]
            if field.shape[1] > 1:
                gx = min(max((x - field_box[0]) / field_box[2], 0.0), field.shape[2] - 1.001)
                gy = min(max((y - field_box[1]) / field_box[2], 0.0), field.shape[1] - 1.001)
                c = int(gx)
                r = int(gy)
                a = gx - c
                b = gy - r
                wx = (field[0, r, c] * (1 - a) + field[0, r, c + 1] * a) * (1 - b)
                wx += (field[0, r + 1, c] * (1 - a) + field[0, r + 1, c + 1] * a) * b
                wy = (field[1, r, c] * (1 - a) + field[1, r, c + 1] * a) * (1 - b)
                wy += (field[1, r + 1, c] * (1 - a) + field[1, r + 1, c + 1] * a) * b
                x += wx
                y += wy
            x -= position[0]
            y -= position[1]
            z = heights[index] - position[2]
            ex = x * rot[0, 0] + y * rot[1, 0] + z * rot[2, 0]
            ey = x * rot[0, 1] + y * rot[1, 1] + z * rot[2, 1]
            ez = x * rot[0, 2] + y * rot[1, 2] + z * rot[2, 2]
            radius = math.sqrt(ex * ex + ey * ey)
            # Points far outside or behind the camera are drawn in to a circle around the frame: there they still bound
            # their polygon, and neither the horizon nor a folding distortion can bring them back into the picture.
            if radius > max_r * ez:
                ex *= max_r / radius
                ey *= max_r / radius
            else:
                ex /= ez
                ey /= ez
            r2 = ex * ex + ey * ey
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            u = (ex * radial + 2.0 * p1 * ex * ey + p2 * (r2 + 2.0 * ex * ex)) * fx + cx
            v = (ey * radial + p1 * (r2 + 2.0 * ey * ey) + 2.0 * p2 * ex * ey) * fy + cy
            us[i - first] = u
            vs[i - first] = v
            low = min(low, v)
            high = max(high, v)
        for row in range(max(0, math.ceil(low)), min(height - 1, math.floor(high)) + 1):
            count = 0
            for ring in range(polygon_start[p], polygon_start[p + 1]):
                for i in range(ring_start[ring] - first, ring_start[ring + 1] - first - 1):
                    v0 = vs[i]
                    v1 = vs[i + 1]
                    if (v0 <= row) != (v1 <= row):
                        crossings[count] = us[i] + (row - v0) / (v1 - v0) * (us[i + 1] - us[i])
                        count += 1
            crossings[:count].sort()
            for k in range(0, count - 1, 2):
                start = max(0.0, math.ceil(crossings[k]))
                stop = min(float(width), math.ceil(crossings[k + 1]))
                for column in range(int(start), int(stop)):
                    image[row, column] = values[index]


_NO_FIELD = np.zeros((2, 1, 1))


class _Pose(NamedTuple):
    rotation: FloatArray
    position: FloatArray
    box: tuple[float, float, float, float]  # bounds of the ground in sight


@dataclass(frozen=True, slots=True)
class Simulator:
    """Draws what the camera of one flight sees; every frame has randomness of its own, whatever the order."""

    ground: Ground
    settings: FlightSettings
    course: Course
    seed: int

    def pose(self, frame: int, reach: float = 6.0) -> _Pose:
        """The camera's true pose at a frame, and the box of ground it may see (``reach`` heights at most)."""
        row = self.course.frame_index[frame]
        roll, pitch, yaw = self.course.roll_pitch_yaw[row]
        rotation = world_from_camera(self.settings.mount, roll, pitch, yaw)
        position = self.course.xyz_m[row]
        rays = ray_from_pixel(self.settings.camera, border_pixels(self.settings.camera, 9)) @ rotation.T
        flat = np.hypot(rays[:, 0], rays[:, 1])
        with np.errstate(divide="ignore"):
            distance = np.where(rays[:, 2] < 0, position[2] * flat / -rays[:, 2], np.inf)
        distance = np.minimum(distance, reach * position[2])
        points = position[:2] + rays[:, :2] / np.maximum(flat, 1e-12)[:, None] * distance[:, None]
        # The border alone bounds the ground in sight only when the nadir is added: near the horizon it opens.
        points = np.concatenate([points, position[None, :2]])
        low, high = points.min(axis=0) - 5.0, points.max(axis=0) + 5.0
        return _Pose(rotation, position, (float(low[0]), float(low[1]), float(high[0]), float(high[1])))

    def paint(
        self,
        image: NDArray[Any],
        pose: _Pose,
        ground: Ground,
        chosen: NDArray[np.int64],
        values: NDArray[Any],
        heights: FloatArray,
        field: FloatArray = _NO_FIELD,
        field_box: tuple[float, float, float] = (0.0, 0.0, 1.0),
    ) -> None:
        """Paint ``values`` (k,) of the polygons ``chosen`` (k,) at ``heights`` (k,) above ground into ``image``."""
        camera = self.settings.camera
        corner = ray_from_pixel(camera, np.array([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]]))
        widest = float(np.hypot(corner[:, 0], corner[:, 1]).max())
        _paint(
            ground.xy,
            ground.ring_start,
            ground.polygon_start,
            chosen,
            values,
            heights,
            field,
            field_box,
            pose.rotation,
            pose.position,
            (camera.fx, camera.fy, camera.cx, camera.cy),
            camera.distortion,
            widest * (1.05 if camera.is_distorted else 3.0),
            image,
        )

    def _pile(
        self, pose: _Pose, chosen: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.bool_]]:
        # Buildings as piles of outlines, far ones first and roofs last, close enough for every pixel of their walls to
        # be met: (k,) polygons, (k,) heights, (k,) whether it is the roof.
        x, y, agl = pose.position
        bounds = self.ground.bounds[chosen]
        distance = np.hypot(*((bounds[:, :2] + bounds[:, 2:]) / 2.0 - [x, y]).T)
        far_first = np.argsort(-distance, kind="stable")
        chosen, distance, bounds = chosen[far_first], distance[far_first], bounds[far_first]
        # A roof as high as the camera would cover the sky.
        tall = np.minimum(self.ground.height_m[chosen], 0.8 * agl)
        size = np.hypot(*(bounds[:, 2:] - bounds[:, :2]).T)
        lean_px = tall * (distance + size / 2.0) / (agl - tall) * self.settings.camera.fx / agl
        layers = np.clip(np.ceil(lean_px / 1.5), 1, 300).astype(np.int64) * (tall > 0)
        index = np.repeat(np.arange(len(chosen)), layers + 1)
        order = np.arange(len(index)) - np.repeat(np.cumsum(layers + 1) - layers - 1, layers + 1)
        at = tall[index] * order / np.maximum(layers[index], 1)
        return chosen[index], at, order == layers[index]

    def mask(self, frame: int, relief: bool = False) -> NDArray[np.uint8]:
        """(height, width) uint8 mask of a frame as the network would give it: 0 other, 255 building.

        With ``relief`` roofs stand where their height puts them in the picture, and walls are no building; else outlines
        are where the map has them.
        """
        errors = self.settings.masks
        rng = np.random.default_rng([self.seed, _MASK, frame])
        pose = self.pose(frame)
        left, bottom, right, top = pose.box
        image = np.zeros((self.settings.camera.height, self.settings.camera.width), dtype=np.uint8)
        chosen = self.ground.near(*pose.box)

        field, field_box = _NO_FIELD, (left, bottom, errors.edge_scale_m)
        if errors.edge_sigma_m > 0:
            size = (
                math.ceil((top - bottom) / errors.edge_scale_m) + 2,
                math.ceil((right - left) / errors.edge_scale_m) + 2,
            )
            field = rng.standard_normal((2, *size)) * errors.edge_sigma_m
        if errors.missed > 0 and len(chosen):
            # One latent number a building for the whole flight, one a frame: mixed, they are standard normal again.
            always = math.sqrt(errors.missed_always)
            own = ndtri(_hash_uniform(chosen, self.seed))
            latent = always * own + math.sqrt(1.0 - always**2) * rng.standard_normal(len(chosen))
            chosen = chosen[latent >= ndtri(errors.missed)]
        heights, roof = np.zeros(len(chosen)), np.ones(len(chosen), dtype=np.bool_)
        if relief:
            chosen, heights, roof = self._pile(pose, chosen)
        values = np.where(roof, 255, 0).astype(np.uint8)
        self.paint(image, pose, self.ground, chosen, values, heights, field, field_box)

        blobs = int(rng.poisson(errors.false_blobs))
        if blobs:
            fake = _blobs(rng, blobs, pose.box, errors.blob_radius_m)
            every = np.arange(blobs, dtype=np.int64)
            self.paint(image, pose, fake, every, np.full(blobs, 255, dtype=np.uint8), np.zeros(blobs))
        if errors.pixel_accuracy is not None:
            _flip(image, 1.0 - errors.pixel_accuracy, rng)
        return image

    def picture(self, frame: int, imagery: Imagery) -> NDArray[np.uint8]:
        """(height, width, 3) uint8 RGB: the frame as the camera takes it from ``imagery``.

        Buildings with a height stand up: their roofs are moved to where the camera sees them, and walls that face the
        camera fill the gap. Beyond the imagery its border goes on; above the horizon there is a grey sky.
        """
        settings = self.settings
        rng = np.random.default_rng([self.seed, _PICTURE, frame])
        pose = self.pose(frame)
        height, width = settings.camera.height, settings.camera.width
        x0, y0, agl = pose.position

        # Metres above ground of what each pixel shows; walls count negative.
        plane = np.zeros((height, width), dtype=np.float32)
        chosen = self.ground.near(*pose.box)
        index, at, roof = self._pile(pose, chosen[self.ground.height_m[chosen] > 0])
        values = np.where(roof, at, -np.maximum(at, 1e-3)).astype(np.float32)
        self.paint(plane, pose, self.ground, index, values, at)

        rays = _ray_grid(settings.camera) @ pose.rotation.T.astype(np.float32)
        down = rays[..., 2] < -1e-3
        reach = (np.abs(plane) - np.float32(agl)) / np.where(down, rays[..., 2], np.float32(-1e-3))
        dx, dy = rays[..., 0] * reach, rays[..., 1] * reach
        part = imagery.crop(pose.box)
        part = part.coarser(max(1, int(agl / settings.camera.fx / imagery.gsd_m + 0.25)))
        # Offsets from the nadir are small numbers: float32 holds them to less than a millimetre.
        columns = dx / np.float32(part.gsd_m) + np.float32((x0 - part.left) / part.gsd_m - 0.5)
        rows = np.float32((part.top - y0) / part.gsd_m - 0.5) - dy / np.float32(part.gsd_m)
        seen = cv2.remap(part.rgb, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        light = np.asarray(seen, dtype=np.float32)

        wall = plane < 0
        if wall.any():
            light[wall] = _walls(
                dx[wall], dy[wall], -plane[wall], float(x0), float(y0), settings.sun_azimuth_deg
            )
        light[~down] = (176.0, 186.0, 196.0)

        row = min(int(self.course.frame_index[frame]), len(self.course.t_s) - 2)
        light = _motion_blur(light, settings, self.course, row)
        u = (np.arange(width, dtype=np.float32) - (width - 1) / 2) / (width / 2)
        v = (np.arange(height, dtype=np.float32) - (height - 1) / 2) / (height / 2)
        light *= (1.0 - settings.vignette * (u[None, :] ** 2 + v[:, None] ** 2) / 2.0)[..., None]
        light *= np.float32(math.exp(settings.exposure_sigma * rng.standard_normal()))
        if settings.noise_levels > 0:
            noise = rng.standard_normal(light.shape, dtype=np.float32) * np.float32(settings.noise_levels)
            light += noise * np.sqrt(np.maximum(light, 8.0) / 128.0)
        return np.clip(np.rint(light), 0, 255).astype(np.uint8)

    def view(self, frame: int, image: NDArray[np.uint8], gsd_m: float, **options: Any) -> View:
        """The view that the localizer makes of a frame, from what the instruments say."""
        c = self.course
        return make_view(
            image,
            self.settings.camera,
            self.settings.mount,
            math.radians(c.measured_roll_deg[frame]),
            math.radians(c.measured_pitch_deg[frame]),
            float(c.measured_agl_m[frame]),
            gsd_m,
            t_s=float(c.frame_times_s[frame]),
            file=frame_name(frame),
            **options,
        )


@lru_cache(maxsize=4)
def _ray_grid(camera: Camera) -> NDArray[np.float32]:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return ray_from_pixel(camera, np.stack([u, v], axis=-1)).astype(np.float32)


def _walls(
    dx: NDArray[np.floating[Any]],
    dy: NDArray[np.floating[Any]],
    z: NDArray[np.floating[Any]],
    x0: float,
    y0: float,
    sun_azimuth_deg: float,
) -> NDArray[np.float32]:
    # (k, 3) light of wall points: lit by how far the wall, which faces the camera, also faces the sun; a storey is 3 m.
    azimuth = math.radians(sun_azimuth_deg)
    away = np.hypot(dx, dy) + 1e-6
    facing = -(dx * math.sin(azimuth) + dy * math.cos(azimuth)) / away
    shade = 0.62 + 0.3 * facing
    along = (dx + x0 % 3000.0) * 0.8 + (dy + y0 % 3000.0) * 0.6
    window = (
        (np.mod(z, 3.0) > 0.9)
        & (np.mod(z, 3.0) < 2.2)
        & (np.mod(along, 3.0) > 0.8)
        & (np.mod(along, 3.0) < 2.3)
    )
    shade = np.where(window, shade * 0.55, shade)
    return np.asarray(shade[:, None] * np.array([206.0, 200.0, 190.0]), dtype=np.float32)


def _motion_blur(
    light: NDArray[np.float32], settings: FlightSettings, course: Course, row: int
) -> NDArray[np.float32]:
    # The picture's own movement while the shutter is open, at its centre, as a short line of light.
    rotations = [world_from_camera(settings.mount, *course.roll_pitch_yaw[i]) for i in (row, row + 1)]
    centre = rotations[0][:, 2]
    if centre[2] > -0.05:
        return light
    point = course.xyz_m[row] + centre * (course.xyz_m[row, 2] / -centre[2])
    before, after = (
        pixel_from_point(settings.camera, r, course.xyz_m[row + i], point) for i, r in enumerate(rotations)
    )
    shift = (after - before) * (RATE_HZ * settings.exposure_s)
    length = float(np.hypot(*shift))
    if not 0.2 < length < 60.0:
        return light
    half = math.ceil(length / 2.0) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.float32)
    for share in np.linspace(-0.5, 0.5, 8 * half + 1):
        c, r = half + shift[0] * share, half + shift[1] * share
        i, j = int(r), int(c)
        a, b = r - i, c - j
        kernel[i : i + 2, j : j + 2] += np.outer([1 - a, a], [1 - b, b])
    blurred = cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(blurred, dtype=np.float32)


def frame_name(frame: int) -> str:
    """The file name of a simulated frame."""
    return f"frame_{frame:05d}.jpg"


def _hash_uniform(index: NDArray[np.int64], seed: int) -> FloatArray:
    # A number in (0, 1) for each building, the same in every frame of a flight (splitmix64, Steele et al. 2014).
    mix = np.random.default_rng([seed, _LATENT]).integers(0, 2**63, dtype=np.uint64)
    with np.errstate(over="ignore"):
        z = index.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + mix
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    return ((z >> np.uint64(11)).astype(np.float64) + 0.5) / 2.0**53


def _blobs(
    rng: np.random.Generator, n: int, box: tuple[float, float, float, float], radius_m: float
) -> Ground:
    # Star-shaped outlines with a few lobes, anywhere in the box.
    corners = 24
    angle = np.linspace(0.0, 2.0 * math.pi, corners + 1)
    angle[-1] = 0.0  # closed exactly
    centre = rng.uniform(box[:2], box[2:], (n, 2))
    radius = radius_m * np.exp(0.5 * rng.standard_normal(n))
    lobes = rng.standard_normal((n, 2, 3)) * 0.15
    wave = np.stack([f(np.outer([2, 3, 4], angle)) for f in (np.cos, np.sin)])
    outline = radius[:, None] * np.maximum(1.0 + np.einsum("nij,ija->na", lobes, wave), 0.3)
    xy = centre[:, None, :] + outline[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    none = np.zeros(n)
    starts = np.arange(n + 1, dtype=np.int64)
    return Ground(xy.reshape(-1, 2), starts * (corners + 1), starts, np.zeros((n, 4)), none, none)


def _flip(image: NDArray[np.uint8], share: float, rng: np.random.Generator) -> None:
    # Smooth noise above its own quantile: exactly ``share`` of the pixels, in patches of some ten pixels.
    height, width = image.shape
    coarse = rng.standard_normal((height // 12 + 3, width // 12 + 3)).astype(np.float32)
    noise = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    count = round(share * image.size)
    if count:
        flat = np.argpartition(noise.ravel(), image.size - count)[image.size - count :]
        image.ravel()[flat] ^= np.uint8(255)


# ---------------------------------------------------------------- in memory


class SimulatedViews(NamedTuple):
    """A flight in memory: what the matcher gets, and the truth at the frames for scores."""

    views: list[View]
    motions: list[Motion]
    reference: Reference
    yaw_rad: FloatArray


def simulate_views(
    ground: Ground,
    path: FloatArray,
    settings: FlightSettings | None = None,
    seed: int = 0,
    gsd_m: float = 0.5,
    *,
    relief: bool = False,
    **view_options: Any,
) -> SimulatedViews:
    """Views, motions, reference and true yaw (n,) of a masks-only flight, by the same course as ``simulate``.

    Args:
        ground: the footprints that are really there; give others than the map's to fly off the map.
        path: (k, 2) waypoints in the map frame, metres.
        gsd_m: ground sampling distance of the views.
        view_options: handed to ``make_view``.
    """
    settings = settings or FlightSettings()
    course = fly(path, settings, seed)
    simulator = Simulator(ground, settings, course, seed)
    views = [
        simulator.view(i, simulator.mask(i, relief), gsd_m, **view_options)
        for i in range(len(course.frame_index))
    ]
    track = None if settings.odometry is None else odometry_of(course, settings.odometry, seed)
    compass = None
    if course.measured_grid_heading_deg is not None:
        compass = [math.radians(90.0 - h) for h in course.measured_grid_heading_deg]
    steps = motions(track, course.frame_times_s, compass_yaw_rad=compass)
    reference = Reference(course.frame_times_s, course.xyz_m[course.frame_index, :2])
    return SimulatedViews(views, steps, reference, course.roll_pitch_yaw[course.frame_index, 2])


# ---------------------------------------------------------------- as a folder


def imu_of(course: Course, seed: int) -> tuple[FloatArray, FloatArray]:
    """(m, 3) rad/s and (m, 3) m/s2 of a consumer-grade unit in the body frame along a course, at its own rate.

    Noise densities 0.005 deg/s and 0.002 m/s2 per root Hz, constant biases of 0.1 deg/s and 0.02 m/s2.
    """
    rng = np.random.default_rng([seed, _SENSORS, 1])
    roll, pitch, yaw = course.roll_pitch_yaw.T
    turn = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1))
    gyro = (turn[:-1].inv() * turn[1:]).as_rotvec() * RATE_HZ
    # A reading is of its own time, not of the hundredth of a second after it.
    gyro = (np.concatenate([gyro[:1], gyro]) + np.concatenate([gyro, gyro[-1:]])) / 2.0
    velocity = np.gradient(course.xyz_m, course.t_s, axis=0)
    accel = np.gradient(velocity, course.t_s, axis=0)
    accel = turn.inv().apply(accel + [0.0, 0.0, GRAVITY])
    root = math.sqrt(RATE_HZ)
    gyro += math.radians(0.1) * rng.normal(size=3) + math.radians(0.005) * root * rng.normal(size=gyro.shape)
    accel += 0.02 * rng.normal(size=3) + 0.002 * root * rng.normal(size=accel.shape)
    return gyro, accel


def _toml(name: str, settings: FlightSettings, reference: str, altimeter: bool) -> str:
    camera, mount = settings.camera, settings.mount
    lens = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    lines = ["# Simulated by brmgeo: no real flight"]
    lines += [
        f"name = {json.dumps(name)}",
        "[camera]",
        f"width = {camera.width}",
        f"height = {camera.height}",
    ]
    lines += [f"{key} = {float(value)!r}" for key, value in lens.items()]
    if camera.is_distorted:
        lines.append(f"distortion = [{', '.join(repr(float(v)) for v in camera.distortion)}]")
    lines.append("[mount]")
    for key in ("roll", "pitch", "yaw"):
        lines.append(f"{key}_deg = {round(math.degrees(getattr(mount, key + '_rad')), 9)!r}")
    if settings.odometry is not None:
        lines += ["[odometry]", 'file = "odometry.tum"', 'format = "tum"']
    lines += ["[height]", 'source = "frames"']
    if altimeter:
        lines += ["[altimeter]", 'file = "altimeter.csv"']
    lines += ["[reference]", 'file = "reference.csv"', f"crs = {json.dumps(reference)}"]
    return "\n".join(lines) + "\n"


def _write_rows(
    path: Path, header: str, columns: Sequence[Any], formats: Sequence[str], separator: str = ","
) -> None:
    # One format call over all numbers: row by row it would be most of a masks-only flight's time.
    table = np.column_stack(columns)
    row = separator.join(formats) + "\n"
    path.write_text(
        header + (row * len(table)) % tuple(table.ravel().tolist()), encoding="utf-8", newline="\n"
    )


def simulate(
    out: Path | str,
    ground: Ground,
    path: FloatArray,
    crs: str,
    settings: FlightSettings | None = None,
    seed: int = 0,
    *,
    mode: Literal["masks", "frames", "both"] = "masks",
    imagery: Imagery | None = None,
    relief: bool | None = None,
    lonlat: bool = False,
    name: str | None = None,
) -> Path:
    """Writes the flight folder ``out`` and returns it; the same arguments give the same bytes.

    Args:
        out: a folder that is not there yet, or empty.
        ground, path: as for ``simulate_views``, in ``crs``.
        mode: ``masks`` writes masks/ only (no network is needed to localize the flight), ``frames`` pictures
            rendered from ``imagery`` with imu.csv and altimeter.csv, ``both`` all of it.
        relief: roofs stand where their height puts them; default: in pictures and the masks that go with them.
        lonlat: write the reference as longitude and latitude, else as x, y in ``crs``.

    Raises InputError when ``out`` holds files already, or pictures are wanted without imagery.
    """
    out = Path(out)
    settings = settings or FlightSettings()
    if mode != "masks" and imagery is None:
        raise InputError(f"mode {mode!r} draws pictures and needs imagery: give some, or choose mode 'masks'")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(
            f"{out}: a simulated flight needs a new or empty folder: remove it or choose another"
        )
    course = fly(path, settings, seed)
    simulator = Simulator(ground, settings, course, seed)
    out.mkdir(parents=True, exist_ok=True)
    pictures, masks = mode in ("frames", "both"), mode in ("masks", "both")
    for folder, wanted in (("frames", pictures), ("masks", masks)):
        if wanted:
            (out / folder).mkdir()
    count = len(course.frame_index)
    for i in range(count):
        if masks:
            image = simulator.mask(i, pictures if relief is None else relief)
            _write_image(
                out / "masks" / f"{Path(frame_name(i)).stem}.png", image, [cv2.IMWRITE_PNG_BILEVEL, 1]
            )
        if pictures:
            assert imagery is not None
            shown = simulator if relief is not False else replace(simulator, ground=_flat(ground))
            _write_image(
                out / "frames" / frame_name(i),
                shown.picture(i, imagery)[:, :, ::-1],
                [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality],
            )

    x, y = course.xyz_m[course.frame_index[0], :2]
    header = "t_s,file,agl_m,roll_deg,pitch_deg"
    columns: list[Any] = [
        course.frame_times_s,
        course.measured_agl_m,
        course.measured_roll_deg,
        course.measured_pitch_deg,
    ]
    formats = ["%.2f", "%.3f", "%.4f", "%.4f"]
    if course.measured_grid_heading_deg is not None:
        header += ",yaw_deg"
        convergence = math.degrees(convergence_rad(crs, float(x), float(y)))
        columns.append((course.measured_grid_heading_deg + convergence) % 360.0)
        formats.append("%.6f")
    rows = [[f % v for f, v in zip(formats, values)] for values in zip(*columns)]
    lines = [",".join([row[0], frame_name(i), *row[1:]]) for i, row in enumerate(rows)]
    (out / "frames.csv").write_text("\n".join([header, *lines]) + "\n", encoding="utf-8", newline="\n")

    if settings.odometry is not None:
        track = odometry_of(course, settings.odometry, seed)
        xyzw = [track.wxyz[:, k] for k in (1, 2, 3, 0)]
        values = [track.t_s, *track.xyz_m.T, *xyzw]
        _write_rows(out / "odometry.tum", "", values, ["%.6f"] + ["%.4f"] * 3 + ["%.17g"] * 4, " ")
    every = slice(None, None, RATE_HZ // 5)
    t, place_xy = course.t_s[every], course.xyz_m[every, :2]
    if lonlat:
        lon, lat = transformer(crs, LONLAT).transform(place_xy[:, 0], place_xy[:, 1])
        _write_rows(out / "reference.csv", "t_s,lon,lat\n", [t, lon, lat], ["%.2f", "%.9f", "%.9f"])
    else:
        _write_rows(out / "reference.csv", "t_s,x,y\n", [t, place_xy], ["%.2f", "%.4f", "%.4f"])
    if pictures:
        gyro, accel = imu_of(course, seed)
        values = [course.t_s, gyro, accel]
        _write_rows(
            out / "imu.csv", "t_s,gx,gy,gz,ax,ay,az\n", values, ["%.2f"] + ["%.7f"] * 3 + ["%.6f"] * 3
        )
        rng = np.random.default_rng([seed, _SENSORS, 2])
        tenth = slice(None, None, RATE_HZ // 10)
        agl = course.xyz_m[tenth, 2]
        agl = agl + settings.agl_error_m * (rng.normal() + rng.normal(size=len(agl)))
        _write_rows(out / "altimeter.csv", "t_s,agl_m\n", [course.t_s[tenth], agl], ["%.2f", "%.3f"])
    toml = _toml(name or f"simulated-{seed}", settings, LONLAT if lonlat else crs, pictures)
    (out / "flight.toml").write_text(toml, encoding="utf-8", newline="\n")
    return out


def _flat(ground: Ground) -> Ground:
    return replace(ground, height_m=np.zeros_like(ground.height_m))


def _write_image(path: Path, image: NDArray[np.uint8], options: list[int]) -> None:
    ok, data = cv2.imencode(path.suffix, image, options)
    assert ok
    path.write_bytes(data.tobytes())
