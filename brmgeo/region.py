"""A region: a named area with one lattice, described by one TOML file.

``load_region`` turns the file into a frozen, validated ``Region``. It is strict: an unknown key, a missing
key or a value out of range is refused with file, key and the nearest valid key, so that a typing error never
becomes a silently ignored setting.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from brmgeo.codes import BUILDING_LAYERS, GROUP_BOUNDARY_LAYER, disc_radii
from brmgeo.errors import MissingInputError
from brmgeo.settings import build, nearest, read_toml

Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class FootprintsSettings(_Settings):
    """Where outlines come from. ``paths`` are files or globs below the region's source folder."""

    paths: tuple[str, ...] = ("sheets/*.dxf",)
    layers: tuple[str, ...] = BUILDING_LAYERS
    snap_m: Annotated[float, Field(ge=0, le=1)] = 0.1
    max_dropped_share: Share = 0.05
    crs: str | None = None
    encoding: str | None = None
    layer: str | None = None
    attribution: str = ""
    repairs_layer: bool = False

    @field_validator("layers")
    @classmethod
    def _no_group_boundary(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if GROUP_BOUNDARY_LAYER in value:
            raise ValueError(
                f"{GROUP_BOUNDARY_LAYER} bounds a group of houses and is not a building: remove it"
            )
        if not value:
            raise ValueError("no layer is named")
        return value


_TILED = {"level", "pixel_ratio", "missing_share", "grid"}
# Keys of [imagery] by kind: one that would be ignored is refused.
_GOES_WITH = {
    "tiles": _TILED | {"path", "template"},
    "mbtiles": _TILED | {"path"},
    "service": _TILED | {"url", "key_env", "connections", "rate_per_s", "retries", "timeout_s"},
    "raster": {"path", "crs", "bands", "value_range"},
}
_GOES_WITH_ALL = {"kind", "attribution", "terms", "compression"}


class ImagerySettings(_Settings):
    """Where imagery comes from.

    ``kind``: ``tiles`` (a folder), ``mbtiles``, ``service`` (a URL template of the user's own, with the terms that
    the user has checked) or ``raster`` (GeoTIFFs, world files, NGII ortho named by sheet number). ``pixel_ratio`` 2:
    tiles of 512 px where the grid's have 256.
    """

    kind: Literal["tiles", "mbtiles", "service", "raster"]
    path: str = "tiles"
    grid: Literal["kakao", "webmercator"] = "kakao"
    level: Annotated[int, Field(ge=0, le=24)] | None = None
    pixel_ratio: Literal[1, 2] = 1
    template: str | None = None
    url: str | None = None
    key_env: str | None = None
    connections: Annotated[int, Field(ge=1, le=16)] = 4
    rate_per_s: Annotated[float, Field(gt=0, le=100)] = 5.0
    retries: Annotated[int, Field(ge=0, le=20)] = 5
    timeout_s: Positive = 20.0
    missing_share: Share = 0.0
    crs: str | None = None
    bands: tuple[Annotated[int, Field(ge=1)], ...] | None = None
    value_range: tuple[float, float] | None = None
    attribution: str = ""
    terms: str = ""
    compression: Literal["jpeg", "zstd"] = "jpeg"

    @model_validator(mode="after")
    def _complete(self) -> ImagerySettings:
        foreign = sorted(self.model_fields_set - _GOES_WITH[self.kind] - _GOES_WITH_ALL)
        if self.kind == "mbtiles" and self.grid == "kakao" and "grid" in self.model_fields_set:
            raise ValueError(
                "an MBTiles file is in grid 'webmercator', not 'kakao': correct 'grid', or leave it out"
            )
        if foreign:
            raise ValueError(
                f"{foreign[0]!r} does not go with kind {self.kind!r}: leave it out, or correct the kind"
            )
        if self.kind in ("tiles", "service") and self.level is None:
            raise ValueError(f"kind {self.kind!r} needs 'level', the zoom level of the tiles")
        if self.kind == "service":
            if not self.url:
                raise ValueError("kind 'service' needs 'url', a template with {z}, {x} and {y}")
            if not self.terms or not self.attribution:
                raise ValueError(
                    "kind 'service' needs 'terms' and 'attribution': state under which terms you may fetch the tiles"
                )
        return self


class RatioMapSettings(_Settings):
    """Radii of the ratio maps: given in metres, or from n, AGL and field of view by eq. 3."""

    radii_m: tuple[Positive, ...] | None = None
    n: Annotated[int, Field(ge=1, le=16)] | None = None
    agl_m: Positive | None = None
    fov_deg: Annotated[float, Field(gt=0, lt=180)] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> RatioMapSettings:
        derived = (self.n, self.agl_m, self.fov_deg)
        if self.radii_m is not None:
            if any(v is not None for v in derived):
                raise ValueError("give either 'radii_m', or 'n', 'agl_m' and 'fov_deg' (eq. 3), not both")
            if not self.radii_m:
                raise ValueError("'radii_m' is empty")
            if len(set(self.radii_m)) != len(self.radii_m):
                raise ValueError("'radii_m' names a radius twice")
        elif any(v is None for v in derived):
            raise ValueError("give 'radii_m', or all of 'n', 'agl_m' and 'fov_deg' (eq. 3)")
        return self

    def radii(self) -> tuple[float, ...]:
        """Radii in metres, largest first; eq. 3 where n, AGL and field of view are given."""
        if self.radii_m is not None:
            return tuple(sorted(self.radii_m, reverse=True))
        assert self.n is not None
        assert self.agl_m is not None
        assert self.fov_deg is not None
        ground = self.agl_m * math.tan(math.radians(self.fov_deg) / 2)
        return disc_radii(ground, self.n)


class FlightSettings(_Settings):
    """Defaults for simulated flights over the region and for matchers; the paper's figures."""

    agl_m: Positive = 150.0
    fov_deg: Annotated[float, Field(gt=0, lt=180)] = 43.0
    width_px: Annotated[int, Field(ge=64, le=8192)] = 640
    height_px: Annotated[int, Field(ge=64, le=8192)] = 480
    speed_m_s: Positive = 5.0
    interval_s: Positive = 5.0
    max_speed_m_s: Positive = 20.0
    rings: Annotated[int, Field(ge=1, le=16)] = 3
    e1: Positive = 0.3
    eps_m: Positive = 25.0
    d_max_m: Positive = 75.0


class TrainingSettings(_Settings):
    """How training tiles are cut from the region; ``hold_out`` keeps the whole region for testing.

    ``split``: ``blocks`` deals spatial blocks to training, validation and test; a split's name takes the whole region.
    """

    tile_px: Annotated[int, Field(ge=64, le=2048, multiple_of=32)] = 512
    overlap_px: Annotated[int, Field(ge=0, le=1024)] = 128
    gsd_m: tuple[Annotated[float, Field(ge=0.02, le=10)], ...] = (0.23, 0.35, 0.47)
    empty_share: Share = 0.2
    hold_out: bool = False
    split: Literal["blocks", "train", "validation", "test"] = "blocks"
    block_m: Annotated[float, Field(ge=50, le=100_000)] = 400.0
    guard_m: Annotated[float, Field(ge=0, le=10_000)] = 20.0
    validation_share: Share = 0.15
    test_share: Share = 0.15
    seed: Annotated[int, Field(ge=0)] = 0
    min_known_share: Share = 0.5
    max_cloud_share: Share = 0.5
    image_format: Literal["jpg", "png"] = "jpg"
    shard_tiles: Annotated[int, Field(ge=1, le=100_000)] = 256

    @model_validator(mode="after")
    def _sound(self) -> TrainingSettings:
        if not self.gsd_m or len(set(self.gsd_m)) != len(self.gsd_m):
            raise ValueError("'gsd_m' names no GSD, or one twice")
        if len({round(gsd * 1000) for gsd in self.gsd_m}) != len(self.gsd_m):
            raise ValueError(
                f"two of 'gsd_m' {list(self.gsd_m)} are the same to the millimetre: leave one out"
            )
        if self.overlap_px >= self.tile_px:
            raise ValueError("'overlap_px' must be smaller than 'tile_px'")
        if self.validation_share + self.test_share > 1:
            raise ValueError("'validation_share' and 'test_share' are more than 1 together")
        if self.hold_out and self.split in ("train", "validation"):
            raise ValueError(
                f"a region with hold_out = true is never trained on: leave split = {self.split!r} out, or hold_out"
            )
        return self


class GenerateSettings(_Settings):
    """A region made by brmgeo itself: a seed is the whole recipe.

    ``style`` is a seed of its own for roofs, light, density and camera (the plain style where it is not given),
    ``season`` the time of the year in place of the style's.
    """

    seed: Annotated[int, Field(ge=0)]
    style: Annotated[int, Field(ge=0)] | None = None
    season: Literal["spring", "summer", "autumn", "winter"] | None = None


class MapSettings(_Settings):
    """What maps are made of. ``bounds`` are (left, bottom, right, top) metres in ``crs``; ``sheets`` NGII sheet numbers.

    With both, the lattice covers ``bounds`` and the map is known where the sheets lie; with neither, the footprints say
    where the maps are.
    """

    name: Name
    title: str = ""
    crs: str
    gsd_m: Annotated[float, Field(ge=0.05, le=10)] = 0.5
    bounds: tuple[float, float, float, float] | None = None
    sheets: tuple[str, ...] = ()
    footprints: FootprintsSettings = FootprintsSettings()
    imagery: ImagerySettings | None = None
    ratio: RatioMapSettings = RatioMapSettings(n=3, agl_m=150.0, fov_deg=43.0)
    generate: GenerateSettings | None = None

    @field_validator("sheets")
    @classmethod
    def _numbers(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for number in value:
            if not re.fullmatch(r"\d{5,9}", number):
                raise ValueError(f"{number!r} is not an NGII sheet number of 5 to 9 digits")
        if len(set(value)) != len(value):
            raise ValueError("names a sheet twice")
        return value

    @field_validator("crs")
    @classmethod
    def _epsg(cls, value: str) -> str:
        if not re.fullmatch(r"EPSG:\d{4,6}", value):
            raise ValueError(f"{value!r} is not of the form 'EPSG:5187'")
        return value

    @model_validator(mode="after")
    def _spans_ground(self) -> Self:
        if self.bounds is not None:
            left, bottom, right, top = self.bounds
            if not (left < right and bottom < top):
                raise ValueError(
                    "'bounds' must be [left, bottom, right, top] with left < right and bottom < top"
                )
        return self


class Region(MapSettings):
    """One region: its maps, at a stated place, how it is flown over, and how training tiles are cut from it."""

    flight: FlightSettings = FlightSettings()
    training: TrainingSettings = TrainingSettings()

    @model_validator(mode="after")
    def _placed(self) -> Self:
        if self.bounds is None and not self.sheets:
            raise ValueError("give 'bounds' or 'sheets': the region has no place")
        return self


def load_region(path: Path) -> Region:
    """The region that ``path`` describes.

    Raises MissingInputError where there is no such file, SettingsError (one line: file, key, fault, nearest
    valid key) for everything else.
    """
    try:
        toml = read_toml(path)
    except MissingInputError:
        known = sorted(p.stem for p in path.parent.glob("*.toml") if not p.stem.startswith("_"))
        raise MissingInputError(
            f"{path}: there is no region {path.stem!r}: {nearest(path.stem, known)}; a region is one file in this folder"
        ) from None
    region = build(toml, Region)
    if region.name != path.stem:
        raise toml.refuse(
            f"{region.name!r} differs from the file's name {path.stem!r}; make them equal", "name"
        )
    return region
