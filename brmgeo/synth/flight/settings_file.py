"""Settings of the simulator from a TOML file: every error model of ``brmgeo.synth.flight``, named as there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from pydantic import Field

from brmgeo.flight.camera import border_pixels, ray_from_pixel
from brmgeo.flight.readings import Attitude, Camera
from brmgeo.settings import Toml, build, read_toml
from brmgeo.synth.flight.settings import SimulationSettings

_Pixels = Annotated[int, Field(ge=8, le=30000)]
_Focal = Annotated[float, Field(ge=1.0)]


def read_simulation_settings(path: Path, base: SimulationSettings) -> SimulationSettings:
    """``base`` with what a TOML file changes.

    Top-level keys are those of ``SimulationSettings`` (``agl_sigma_m``, ``exposure_s``, ``noise_levels``, ...), ``[masks]``
    and ``[odometry]`` those of ``MaskErrors`` and ``OdometryErrors``; ``[camera]`` and ``[mount]`` are as in flight.toml.
    ``[told_mount]`` is the mount that flight.toml gets where that is another.

    Raises MissingInputError when there is no such file, SettingsError for what is not TOML, a key that nobody knows
    (with the nearest one) and a value of another type or out of range.
    """
    toml = read_toml(path)
    plain = {key: value for key, value in toml.data.items() if key not in ("camera", "mount", "told_mount")}
    made = build(replace(toml, data=plain), SimulationSettings, base)
    if "camera" in toml.data:
        made = replace(made, camera=_camera(toml, base.camera))
    if "mount" in toml.data:
        made = replace(made, mount=_mount(toml, "mount", made.mount))
    if "told_mount" in toml.data:
        made = replace(made, told_mount=_mount(toml, "told_mount", made.known_mount))
    return made


def _mount(toml: Toml, key: str, before: Attitude) -> Attitude:
    own = (math.degrees(v) for v in (before.roll_rad, before.pitch_rad, before.yaw_rad))
    turns = build(toml, _MountKeys, _MountKeys(*own), at=(key,))
    return Attitude(*(math.radians(v) for v in (turns.roll_deg, turns.pitch_deg, turns.yaw_deg)))


@dataclass(frozen=True, slots=True)
class _MountKeys:
    roll_deg: float
    pitch_deg: float
    yaw_deg: float


@dataclass(frozen=True, slots=True)
class _CameraKeys:
    width: _Pixels
    height: _Pixels
    fov_deg: Annotated[float, Field(ge=0.1, le=179.0)] | None = None
    fx: _Focal | None = None
    fy: _Focal | None = None
    cx: float | None = None
    cy: float | None = None
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        given = [name for name in ("fx", "fy", "cx", "cy") if getattr(self, name) is not None]
        if self.fov_deg is not None and given:
            raise ValueError(f"has both fov_deg and {given[0]}: keep one kind")
        if 0 < len(given) < 4:
            raise ValueError(f"has {', '.join(given)}: give all of fx, fy, cx, cy or fov_deg")


def _camera(toml: Toml, base: Camera) -> Camera:
    keys = build(toml, _CameraKeys, _CameraKeys(base.width, base.height), at=("camera",))
    size = keys.width, keys.height
    if keys.fx is not None and keys.fy is not None and keys.cx is not None and keys.cy is not None:
        camera = Camera(*size, keys.fx, keys.fy, keys.cx, keys.cy)
    elif keys.fov_deg is not None:
        camera = Camera.from_fov(*size, keys.fov_deg)
    elif size != (base.width, base.height):
        raise toml.refuse("changes the size: give its fov_deg too", "camera")
    else:
        camera = base
    camera = replace(camera, distortion=keys.distortion)
    try:
        ray_from_pixel(camera, border_pixels(camera))
    except ValueError as error:
        raise toml.refuse(str(error), "camera", "distortion") from None
    return camera
