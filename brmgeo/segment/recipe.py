"""Recipes of training: TOML files that say what is trained, how, and on what ground.

A recipe holds the U-Net, the training run, the augmentation, and the sources. A source is ground of one of these kinds:

- ``generated``: towns that brmgeo invents, by seed, painted once and kept in data/work/scenes;
- ``tiles``: training tiles of regions by name (cut now where they are not as wanted), or, without ``regions``, those in a
  folder, such as tiles made of other people's pairs;
- ``pairs``: a folder with images/ and masks/ of equal names, small square tiles that are laid into mosaics;
- ``xyz``: the same, with names that end in X-Y-Z of a web-mercator tile: they are put together as they lie on the ground;
- ``flight``: a flight folder whose frames have masks; for tests only. Where ``roof_m`` says how high roofs stand, the
  network's answers are scored once more after they were laid onto the ground as ``localize`` lays them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from brmgeo.errors import MissingInputError, SettingsError
from brmgeo.segment.augment import AugmentSettings
from brmgeo.segment.train import TrainSettings
from brmgeo.segment.unet import UNetSettings
from brmgeo.settings import Toml, build, read_toml


class SourceSpec(BaseModel):
    """One source of a recipe; see the head of this file for the kinds.

    ``split`` says what the whole source is for; of ``xyz`` ``validation_share`` of it (the west) is for validation.
    ``tiles`` that are for training take their regions' own train and validation splits; a region is in one source
    only. ``weight``: how often the source is drawn in training. ``roof_m``: of a flight whose masks are outlines on the
    ground, the height of the roofs that answers are also laid down from; 0: they are scored as they are alone.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    name: str
    kind: Literal["generated", "tiles", "pairs", "xyz", "flight"]
    split: Literal["train", "validation", "test"] = "train"
    weight: Annotated[float, Field(gt=0)] = 1.0
    seeds: tuple[int, ...] = ()
    days: Annotated[int, Field(ge=0, le=2)] = 0
    size_m: Annotated[float, Field(ge=300, le=3000)] = 700.0
    regions: tuple[str, ...] = ()
    gsd_m: Annotated[float, Field(gt=0, le=1)] | None = None
    zoom: Annotated[int, Field(ge=10, le=24)] = 21
    validation_share: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    roof_m: Annotated[float, Field(ge=0, le=50)] = 0.0
    attribution: str = ""
    licence: str = ""

    @model_validator(mode="after")
    def _sound(self) -> SourceSpec:
        if self.kind == "generated" and not self.seeds:
            raise ValueError("is of kind generated and names no seeds")
        if self.kind == "flight" and self.split != "test":
            raise ValueError('a flight is for tests only: split = "test"')
        if self.roof_m and self.kind != "flight":
            raise ValueError("roof_m is of flights only; take it out")
        if self.kind == "pairs" and (self.gsd_m is None or self.split != "train"):
            raise ValueError("pairs are for training, and need their gsd_m")
        return self

    @property
    def asks_for_folder(self) -> bool:
        """Whether its ground lies in a folder that somebody names."""
        return self.kind in ("pairs", "xyz", "flight") or (self.kind == "tiles" and not self.regions)


@dataclass(frozen=True, slots=True)
class Recipe:
    """A training run as a file: what is trained, on what, and how.

    Pictures of a GSD that was not trained for are resampled to ``work_gsd_m``. Raises SettingsError where that lies outside
    the crops' GSD, for a network of other pictures than RGB, and for sources of one name or region.
    """

    title: str
    work_gsd_m: Annotated[float, Field(gt=0, le=2)]
    source: tuple[SourceSpec, ...]
    validation_crops: Annotated[int, Field(ge=1, le=500)] = 24
    unet: UNetSettings = field(default_factory=UNetSettings)
    training: TrainSettings = field(default_factory=TrainSettings)
    augment: AugmentSettings = field(default_factory=AugmentSettings)

    def __post_init__(self) -> None:
        names = [s.name for s in self.source]
        regions = [region for s in self.source for region in s.regions]
        if same := [name for name in names if names.count(name) > 1]:
            raise SettingsError(f"source {same[0]}: two sources have this name; give each its own")
        if same := [region for region in regions if regions.count(region) > 1]:
            raise SettingsError(
                f"region {same[0]} is named twice; its tiles are cut for one purpose, so name it once"
            )
        if self.unet.in_channels != 3:
            raise SettingsError(
                f"unet.in_channels {self.unet.in_channels}: pictures have 3, red, green and blue"
            )
        low, high = self.augment.gsd_m
        if not low <= self.work_gsd_m <= high:
            raise SettingsError(
                f"work_gsd_m {self.work_gsd_m:g} lies outside the crops' augment.gsd_m [{low:g}, {high:g}]: "
                "pictures would be resampled to what was never trained for"
            )


def read_recipe(path: Path) -> Recipe:
    """The recipe in a file, and in those it is based on.

    ``base = "NAME"`` takes NAME.toml beside the file as it is, but for what the file says itself: tables are merged key by
    key, sources by name, new ones come last. Raises MissingInputError, or SettingsError in one line, naming file, line, key
    and fault.
    """
    return build(_with_base(path, ()), Recipe)


def _with_base(path: Path, above: tuple[Path, ...]) -> Toml:
    try:
        toml = read_toml(path)
    except MissingInputError:
        known = ", ".join(sorted(p.stem for p in path.parent.glob("*.toml"))) or "none"
        asked = f" (the base of {above[-1].name})" if above else ""
        raise MissingInputError(f"{path}: there is no such recipe{asked}; there are: {known}") from None
    base = toml.data.get("base")
    if base is None:
        return toml
    if not isinstance(base, str) or not re.fullmatch(r"\w[\w.-]*", base):
        raise toml.refuse(
            f"give the name of a recipe in the same folder, without .toml (found {base!r})", "base"
        )
    below = path.with_name(f"{base}.toml")
    if below in (*above, path):
        raise toml.refuse(f"{base!r} leads back to this recipe: take one of the two out", "base")
    own = replace(toml, data={key: value for key, value in toml.data.items() if key != "base"})
    return own.over(_with_base(below, (*above, path)))
