"""`brmgeo simulate`: flight folders over built maps, one or many, and the flight that localize makes for itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from brmgeo.errors import MissingInputError, SettingsError
from brmgeo.files import digest, list_written, require_replaceable, require_writable, whole_folder, write_text
from brmgeo.flight.folder import may_be_remade
from brmgeo.geo.raster import box_of
from brmgeo.locate.maps import Maps, read_maps
from brmgeo.region import FlightSettings, Region
from brmgeo.synth.flight import OdometryErrors, SimulationSettings, read_simulation_settings, simulate
from brmgeo.synth.mission import FineImagery, flight_path, imagery_along, read_ground, simulator_settings
from brmgeo.workflow.disk import disk_errors
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.schedule import scheduler
from brmgeo.workflow.stage import Json, canonical, plain

from .maps import native_imagery
from .regions import town_style

Mode = Literal["masks", "frames", "both"]
SIMULATED = frozenset(
    ("flight.toml", "frames.csv", "frames", "masks", "imu.csv", "altimeter.csv", "reference.csv")
    + ("odometry.tum", "odometry.csv", "odometry.covariance.csv", "odometry.json", ".recipe.json")
)
_COMPASS_DEG = 3.0


@dataclass(frozen=True, slots=True)
class Simulation:
    """A flight to simulate over built maps; small, so that it travels to a worker.

    Attributes:
        maps_dir, own: the maps, and the region's camera and flight settings.
        path: rectangle, lawnmower, random, or a GeoJSON file.
        mode: masks, frames or both.
        scale_bias: of the odometry; None draws it.
        no_odometry, compass: what the aircraft carries.
        interval_s: seconds between frames; None for the region's.
        imagery: a (h, w, 3) picture by path in place of the maps' own, for flights on another day; None for the maps'.
        native: the region's imagery where that is finer than its maps: frames are drawn from it.
        settings_file: a TOML file with settings of the simulator in place of the region's and the defaults; None for none.
    """

    maps_dir: Path
    own: FlightSettings
    path: str = "rectangle"
    mode: Mode = "masks"
    scale_bias: float | None = None
    no_odometry: bool = False
    compass: bool = False
    interval_s: float | None = None
    imagery: Path | None = None
    native: FineImagery | None = None
    settings_file: Path | None = None

    def settings(self) -> SimulationSettings:
        """The simulator's settings: the region's, then the file's, then the options'; SettingsError for a bad file."""
        made = simulator_settings(self.own)
        if self.settings_file is not None:
            made = read_simulation_settings(self.settings_file, made)
        if self.no_odometry:
            made = replace(made, odometry=None)
        elif self.scale_bias is not None:
            made = replace(
                made, odometry=replace(made.odometry or OdometryErrors(), scale_bias=self.scale_bias)
            )
        if self.interval_s is not None:
            made = replace(made, frame_interval_s=self.interval_s)
        return replace(made, compass_error_deg=_COMPASS_DEG) if self.compass else made

    def imagery_file(self, maps: Maps) -> Path | None:
        """The picture that frames are drawn from; None where none are drawn."""
        return None if self.mode == "masks" else self.imagery or maps.imagery


def check_simulation(what: Simulation) -> None:
    """Raises MissingInputError when the maps lack what a simulation needs, SettingsError for a bad file of settings."""
    what.settings()
    maps = read_maps(what.maps_dir)
    if maps.footprints is None:
        raise MissingInputError(
            f"{maps.folder / 'footprints.gpkg'} is not there; a flight is simulated from the footprints: run brmgeo maps"
        )
    if what.mode != "masks" and what.imagery_file(maps) is None:
        raise MissingInputError(
            f"{maps.folder / 'imagery.tif'} is not there; frames are drawn from imagery: choose --mode masks"
        )


def simulate_flight(what: Simulation, seed: int, out: Path, name: str) -> Path:
    """Writes a flight folder over built maps, in place of an earlier one; returns it."""
    require_simulated(out)
    check_simulation(what)
    maps = read_maps(what.maps_dir)
    assert maps.footprints is not None
    ground, settings = read_ground(maps.footprints), what.settings()
    route = flight_path(what.path, ground, seed, maps.bounds, maps.crs)
    file = what.imagery_file(maps)
    native = what.native if what.imagery is None else None
    imagery = None if file is None else imagery_along(route, settings, file, native)
    place = out.absolute().parent
    with (
        disk_errors(f"simulate {name}", place),
        whole_folder(out, say=Progress().say, ours=lambda _: True) as scratch,
    ):
        simulate(scratch, ground, route, maps.crs, settings, seed, mode=what.mode, imagery=imagery, name=name)
    return out


def simulate_flights(
    what: Simulation, jobs: Sequence[tuple[int, Path, str]], scheduler_spec: str | None
) -> list[Path]:
    """Many flights, one for each (seed, folder, name), side by side; returns their folders."""
    check_simulation(what)
    for _, out, _ in jobs:
        require_simulated(out)
    folder = jobs[0][1].absolute().parent
    require_writable(folder)
    progress = Progress()
    with (
        scheduler(scheduler_spec, shared=folder, say=progress.say) as map,
        progress.stage("simulate") as bar,
    ):
        return list(bar.watch(map)(_simulate_one, [(what, *job) for job in jobs]))


def _simulate_one(job: tuple[Simulation, int, Path, str]) -> Path:
    return simulate_flight(*job)


def require_simulated(out: Path) -> None:
    """SettingsError when ``out`` holds anything but a flight that was simulated: a real one is flown but once."""
    if (out / "flight.toml").is_file() and not may_be_remade(out):
        raise SettingsError(
            f"{out}: there is a flight that brmgeo did not simulate (its flight.toml does not say simulated = true), and it "
            "would be lost; give a new folder or an empty one",
            needs="out",
        )
    require_replaceable(out, "flight.toml", "a simulated flight", lambda p: p.name in SIMULATED)


def other_day(own: Region, maps_dir: Path, season: str, seed: int, out: Path) -> Path:
    """Writes a generated region's imagery as it is on another day of ``season``, on the maps' lattice; returns ``out``."""
    from brmgeo.export.cog import write_cog
    from brmgeo.synth.day import another_day
    from brmgeo.synth.imagery import render_imagery
    from brmgeo.synth.town import generate_town

    if own.generate is None:
        raise SettingsError(
            f"--season {season}: region {own.name} is not generated, so nobody knows how it looks on another day; "
            "leave --season out"
        )
    assert own.bounds is not None
    box = box_of(maps_dir / "buildings.tif")
    style = town_style(own.generate.style, own.generate.season)
    town = generate_town(own.bounds, own.generate.seed, style, own.crs)
    picture = render_imagery(another_day(town, season, seed), box)  # type: ignore[arg-type]
    write_cog(out, (picture, np.ones(picture.shape[:2], bool)), box, kind="imagery")
    return out


@dataclass(frozen=True, slots=True)
class _DefaultFlight:
    """What a default flight depends on: its seed, what is drawn, the region's settings and its footprints' digest."""

    seed: int
    mode: Mode
    flight: Mapping[str, Json]
    imagery: Mapping[str, Json] | None
    footprints: str


def default_flight(own: Region, maps_dir: Path, data: Path, seed: int) -> Path:
    """The flight that is simulated when none is given: the paper's rectangle, made once a seed.

    Frames, for the network to make masks of, where the maps have imagery; else masks.
    """
    # Not the name that brmgeo simulate gives: a flight that somebody made is never replaced by this one.
    name = f"default-{seed}"
    out = data / "source" / own.name / "flights" / name
    maps = read_maps(maps_dir.absolute())
    mode: Mode = "frames" if maps.imagery is not None else "masks"
    recipe = canonical(
        plain(
            _DefaultFlight(
                seed=seed,
                mode=mode,
                flight=own.flight.model_dump(),
                imagery=None if own.imagery is None else own.imagery.model_dump(mode="json"),
                footprints="" if maps.footprints is None else digest(maps.footprints),
            )
        )
    )
    note = out / ".recipe.json"
    if not note.is_file() or note.read_text(encoding="utf-8") != recipe:
        Progress().say(f"{name}: simulating the paper's rectangle over {own.name} (seed {seed})")
        native = native_imagery(own, data) if mode != "masks" else None
        simulate_flight(Simulation(maps.folder, own.flight, mode=mode, native=native), seed, out, name)
        write_text(note, recipe)
        list_written(out, [note.name])
    return out
