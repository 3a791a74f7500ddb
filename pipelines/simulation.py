"""Settings of the simulator from a TOML file: every error model of ``brmgeo.synth.flight``, named as there."""

from __future__ import annotations

import math
import tomllib
import types
import typing
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from brmgeo.errors import MissingInputError, SettingsError
from brmgeo.flight.camera import border_pixels, ray_from_pixel
from brmgeo.flight.readings import Attitude, Camera
from brmgeo.settings import nearest
from brmgeo.synth.flight import FlightSettings, MaskErrors, OdometryErrors

#: Least and most of a number; what is not named is 0 or more.
_RANGES = {
    **dict.fromkeys(("missed", "missed_always", "vignette"), (0.0, 1.0)),
    "pixel_accuracy": (0.5, 1.0),
    "speed_m_s": (0.1, 200.0),
    "frame_interval_s": (0.02, 60.0),
    "agl_m": (5.0, 5000.0),
    "rate_hz": (0.5, 100.0),
    "jpeg_quality": (1, 100),
    "blob_radius_m": (0.1, 1000.0),
    "edge_scale_m": (0.1, 1000.0),
    "turn_radius_m": (0.1, 1000.0),
    "sun_azimuth_deg": (-360.0, 360.0),
    "cruise_pitch_deg": (-45.0, 45.0),
    "scale_bias": (-0.9, 10.0),
}
_CAMERA = ("width", "height", "fov_deg", "fx", "fy", "cx", "cy", "distortion")
_MOUNT = ("roll_deg", "pitch_deg", "yaw_deg")
_MODELS = {"masks": MaskErrors, "odometry": OdometryErrors}
_SECTIONS = ("camera", "mount", *_MODELS)


def read_simulation_settings(path: Path, base: FlightSettings) -> FlightSettings:
    """``base`` with what a TOML file changes.

    Top-level keys are those of ``FlightSettings`` (``agl_sigma_m``, ``exposure_s``, ``noise_levels``, ...), ``[masks]`` and
    ``[odometry]`` those of ``MaskErrors`` and ``OdometryErrors``; ``[camera]`` and ``[mount]`` are as in flight.toml.

    Raises MissingInputError when there is no such file, SettingsError for what is not TOML, a key that nobody knows
    (with the nearest one) and a value of another type or out of range.
    """
    if not path.is_file():
        raise MissingInputError(f"--settings {path}: no such file; give a TOML file (see docs/FLIGHT.md)")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: not TOML: {error}; mend it there") from None
    plain = [f.name for f in fields(FlightSettings) if f.name not in _SECTIONS]
    changes: dict[str, Any] = {}
    for key, value in table.items():
        if key not in _SECTIONS:
            changes |= _values(path, "", {key: value}, FlightSettings, [*plain, *_SECTIONS])
        elif not isinstance(value, dict):
            raise SettingsError(f"{path}: {key!r} must be a section: [{key}]")
    for key, model in _MODELS.items():
        if key in table:
            start = getattr(base, key) or model()
            names = [f.name for f in fields(model)]
            changes[key] = replace(start, **_values(path, key, table[key], model, names))
    if "camera" in table:
        changes["camera"] = _camera(path, table["camera"], base.camera)
    if "mount" in table:
        turns = _numbers(path, "mount", table["mount"], _MOUNT)
        own = (base.mount.roll_rad, base.mount.pitch_rad, base.mount.yaw_rad)
        changes["mount"] = Attitude(
            *(math.radians(turns[k]) if k in turns else old for k, old in zip(_MOUNT, own))
        )
    return replace(base, **changes)


def _values(path: Path, section: str, table: dict[str, Any], model: type, known: list[str]) -> dict[str, Any]:
    kinds = typing.get_type_hints(model)
    out: dict[str, Any] = {}
    for key, value in table.items():
        _check_name(path, section, key, known)
        kind = kinds[key]
        options = typing.get_args(kind) if isinstance(kind, types.UnionType) else (kind,)
        if typing.get_origin(options[0]) is tuple:
            if not isinstance(value, list):
                raise SettingsError(
                    f"{path}: {_where(section, key)} is {value!r}: it must be a list of numbers"
                )
            out[key] = tuple(_number(path, section, key, v, float) for v in value)
        else:
            out[key] = _number(path, section, key, value, options[0])
    return out


def _number(path: Path, section: str, key: str, value: Any, kind: type) -> float:
    good = isinstance(value, int if kind is int else int | float) and not isinstance(value, bool)
    if not good or not math.isfinite(value):
        words = "a whole number" if kind is int else "a finite number"
        raise SettingsError(f"{path}: {_where(section, key)} is {value!r}: it must be {words}")
    low, high = _RANGES.get(key, (0.0, math.inf))
    if not low <= value <= high:
        raise SettingsError(
            f"{path}: {_where(section, key)} is {value:g}: it must be within {low:g} to {high:g}"
        )
    return kind(value)  # type: ignore[no-any-return]


def _numbers(path: Path, section: str, table: dict[str, Any], known: tuple[str, ...]) -> dict[str, float]:
    for key, value in table.items():
        _check_name(path, section, key, list(known))
        if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
            raise SettingsError(f"{path}: {_where(section, key)} is {value!r}: it must be a finite number")
    return {key: float(value) for key, value in table.items()}


def _camera(path: Path, table: dict[str, Any], base: Camera) -> Camera:
    bend = table.get("distortion", [0.0] * 5)
    given = _numbers(path, "camera", {k: v for k, v in table.items() if k != "distortion"}, _CAMERA)
    if not isinstance(bend, list) or len(bend) != 5:
        raise SettingsError(
            f"{path}: [camera] distortion is {bend!r}: it must be five numbers [k1, k2, p1, p2, k3]"
        )
    k1, k2, p1, p2, k3 = (
        float(_numbers(path, "camera", {"distortion": v}, _CAMERA)["distortion"]) for v in bend
    )
    width, height = (int(given.get(k, old)) for k, old in (("width", base.width), ("height", base.height)))
    inner = [k for k in ("fx", "fy", "cx", "cy") if k in given]
    if "fov_deg" in given and inner:
        raise SettingsError(f"{path}: [camera] has both fov_deg and {inner[0]}: keep one kind")
    if not (8 <= width <= 30000 and 8 <= height <= 30000) or not 0.1 <= given.get("fov_deg", 43.0) <= 179:
        raise SettingsError(f"{path}: [camera] {width} x {height} pixels or its fov_deg are out of range")
    if len(inner) == 4:
        fx, fy, cx, cy = (given[k] for k in ("fx", "fy", "cx", "cy"))
        if min(fx, fy) < 1.0:
            raise SettingsError(f"{path}: [camera] fx, fy are {fx:g}, {fy:g}: they must be 1 or more")
    elif inner:
        raise SettingsError(f"{path}: [camera] has {', '.join(inner)}: give all of fx, fy, cx, cy or fov_deg")
    else:
        if "fov_deg" not in given and (width, height) != (base.width, base.height):
            raise SettingsError(f"{path}: [camera] changes the size: give its fov_deg too")
        plain = Camera.from_fov(width, height, given["fov_deg"]) if "fov_deg" in given else base
        fx, fy, cx, cy = plain.fx, plain.fy, plain.cx, plain.cy
    camera = Camera(width, height, fx, fy, cx, cy, (k1, k2, p1, p2, k3))
    try:
        ray_from_pixel(camera, border_pixels(camera))
    except ValueError as error:
        raise SettingsError(f"{path}: [camera] distortion: {error}") from None
    return camera


def _check_name(path: Path, section: str, key: str, known: list[str]) -> None:
    if key not in known:
        raise SettingsError(
            f"{path}: unknown key {key!r}{f' in [{section}]' if section else ''}: {nearest(key, known)}"
        )


def _where(section: str, key: str) -> str:
    return f"[{section}] {key}" if section else key
