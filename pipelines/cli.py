"""The ``brmgeo`` command. A known error is one line on stderr and exit status 2."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import Any, Literal

import click
from click.core import ParameterSource

from brmgeo import __version__, extras, files
from brmgeo.errors import BrmgeoError, SettingsError, one_line

DATA = click.Path(file_okay=False, path_type=Path)
FILE = click.Path(dir_okay=True, path_type=Path)
METHODS = ("mask", "ratio", "paper")
SEASONS = ("spring", "summer", "autumn", "winter")
TRACEBACK = "--traceback"
#: EX_SOFTWARE of sysexits.h: a defect of brmgeo.
DEFECT = 70
data_option = click.option(
    "--data",
    type=DATA,
    default=Path("data"),
    show_default=True,
    help="Folder with regions/, source/, work/ and out/.",
)
scheduler_option = click.option(
    "--scheduler",
    envvar="SCHEDULER",
    default=None,
    help="serial, local (default) or tcp://host:8786 of a running Dask scheduler.",
)


weights_option = click.option(
    "--weights", type=FILE, help="Weights of the network, .onnx or .safetensors (default: those that ship)."
)
looks_option = click.option(
    "--looks",
    type=click.IntRange(1, 2),
    help="Looks of the network at a picture, 1 or 2 (default: as its weights say; the shipped ones 2); nothing where a "
    "flight's own masks are taken.",
)


class _Numbers(click.ParamType[tuple[float, ...]]):
    """Comma-separated numbers."""

    name = "a,b,..."

    def __init__(self, count: int | None = None) -> None:
        self.count = count

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """The numbers as floats; click's own error for anything else."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(v) for v in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not a list of numbers separated by commas", param, ctx)
        if self.count is not None and len(numbers) != self.count:
            self.fail(f"{value!r} has {len(numbers)} numbers, not {self.count}", param, ctx)
        return numbers


class _Command(click.Command):
    """A command that says which of its options mends an error whose ``needs`` names a parameter."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # The last door reads it; here it is only allowed, before and after the command's name.
        self.params.append(click.Option([TRACEBACK], is_flag=True, expose_value=False, hidden=True))

    def invoke(self, ctx: click.Context) -> Any:
        """As click's own, with the option named in the message; numbers that are none, or have no end, are refused.

        Scratch of runs that were killed goes first: this one may have no need of any, and would leave it.
        """
        files.sweep_scratch()
        for param in self.params:
            value = ctx.params.get(param.name or "")
            if any(
                isinstance(v, float) and not isfinite(v)
                for v in (value if isinstance(value, tuple) else (value,))
            ):
                raise click.BadParameter("give finite numbers, not nan or inf", ctx, param)
        try:
            return super().invoke(ctx)
        except BrmgeoError as error:
            option = next((o for p in self.params if (o := _shown(p, ctx)) and p.name == error.needs), None)
            if option is not None:
                error.args = (f"{error} ({option})",)
                error.needs = None
            raise


def _shown(param: click.Parameter, ctx: click.Context) -> str | None:
    """An option as it is typed, ``--crs TEXT``; None for what is no option."""
    if not isinstance(param, click.Option):
        return None
    value = "" if param.is_flag else f" {param.make_metavar(ctx)}"
    return f"{param.opts[0]}{value}"


def _refuse_given(why: str, *parameters: str) -> None:
    """SettingsError for the first of these parameters that the command line has, where it would change nothing."""
    context = click.get_current_context()
    for param in context.command.params:
        given = context.get_parameter_source(param.name or "") is ParameterSource.COMMANDLINE
        if param.name in parameters and given:
            name = param.opts[0] if isinstance(param, click.Option) else param.make_metavar(context)
            raise SettingsError(f"{context.info_name}: {name} {why}")


class _Group(click.Group):
    command_class = _Command


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="brmgeo")
@click.option(
    TRACEBACK,
    is_flag=True,
    expose_value=False,
    help="Show where an unexpected error comes from, for a report.",
)
def cli() -> None:
    """Tell a drone where it is, without GNSS, from free building maps."""
    # Else matplotlib makes a folder among the user's settings, and torch one in the temporary folder that stays.
    with contextlib.suppress(RuntimeError):
        cache = files.user_cache()
        os.environ.setdefault("MPLCONFIGDIR", str(cache / "matplotlib"))
        os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(cache / "torch"))
    # A proxy that curl does not know: whatever a file has in it, GDAL asks no host.
    os.environ["GDAL_HTTP_PROXY"] = os.environ["GDAL_HTTPS_PROXY"] = "none://"


@cli.command()
@click.argument("region", required=False)
@data_option
@scheduler_option
@click.option(
    "--footprints",
    type=FILE,
    multiple=True,
    help="Build from these files, without a region file: a file, a folder or a pattern; repeatable.",
)
@click.option("--crs", help="With --footprints: the region's CRS, projected in metres, such as EPSG:5187.")
@click.option("--out", type=DATA, help="Where results go (default data/out/REGION).")
@click.option("--imagery", type=FILE, help="With --footprints: a GeoTIFF, or a folder or pattern of them.")
@click.option("--imagery-crs", help="With --imagery: the CRS of images that do not say theirs (world files).")
@click.option("--sheets", help="With --footprints: NGII sheets that the files cover; the map is known there.")
@click.option(
    "--bounds", type=_Numbers(4), help="With --footprints: left,bottom,right,top where the map is known."
)
@click.option("--gsd", "gsd_m", type=float, help="With --footprints: metres per pixel (default 0.5).")
@click.option(
    "--radii",
    "radii_m",
    type=_Numbers(),
    help="With --footprints: radii in metres (default: eq. 3, 150 m, 43 deg).",
)
@click.option("--layer", help="With --footprints: the layer to read of files that hold several.")
@click.option("--encoding", help="With --footprints: text encoding of shapefiles without .cpg.")
@click.option(
    "--source-crs",
    help="With --footprints: the CRS of files that do not say theirs (shapefiles without .prj).",
)
@click.option("--repairs", is_flag=True, help="Also write what was repaired as a layer of footprints.gpkg.")
def maps(
    region: str | None,
    data: Path,
    scheduler: str | None,
    footprints: tuple[Path, ...],
    crs: str | None,
    out: Path | None,
    imagery: Path | None,
    imagery_crs: str | None,
    sheets: str | None,
    bounds: tuple[float, ...] | None,
    gsd_m: float | None,
    radii_m: tuple[float, ...] | None,
    layer: str | None,
    encoding: str | None,
    source_crs: str | None,
    repairs: bool,
) -> None:
    """Build all maps of REGION: footprints, imagery, building mask, ratio maps, preview, QGIS project."""
    from . import maps as job

    if footprints:
        if region is not None:
            raise SettingsError(f"maps: give either REGION ({region}) or --footprints, not both")
        if crs is None or out is None:
            raise SettingsError(
                "maps --footprints: give --crs (such as EPSG:5187) and --out (a folder for the results)"
            )
        spec = job.maps_of_files(
            out,
            footprints,
            crs=crs,
            imagery=imagery,
            imagery_crs=imagery_crs,
            sheets=sheets,
            bounds=bounds,
            gsd_m=gsd_m,
            radii_m=radii_m,
            layer=layer,
            encoding=encoding,
            source_crs=source_crs,
            repairs=repairs,
        )
        job.build_maps(spec, out / ".brmgeo", out, Path.cwd(), scheduler)
        return
    if region is None:
        raise SettingsError(
            "maps: give a REGION (such as demo), or --footprints FILE --crs EPSG:... --out DIR"
        )
    given: dict[str, object] = {
        "--crs": crs,
        "--imagery": imagery,
        "--imagery-crs": imagery_crs,
        "--sheets": sheets,
        "--bounds": bounds,
        "--radii": radii_m,
    }
    given |= {"--gsd": gsd_m, "--layer": layer, "--encoding": encoding, "--source-crs": source_crs}
    for option, value in given.items():
        if value is not None:
            raise SettingsError(
                f"maps {region}: {option} goes with --footprints; a region's own settings are in its TOML file"
            )
    job.build_region(region, data, out, repairs, scheduler)


@cli.command()
@click.argument("regions", nargs=-1)
@data_option
@scheduler_option
@click.option("--out", type=DATA, help="Where tiles go (default data/out/REGION/tiles); needed with --pairs.")
@click.option(
    "--split",
    type=click.Choice(["blocks", "train", "validation", "test"]),
    help="The split of all tiles, or blocks, in place of the region file's (with --pairs: train by default).",
)
@click.option(
    "--gsd", "gsd_m", type=_Numbers(), help="Metres per pixel, in place of the region file's; of --pairs."
)
@click.option("--align", is_flag=True, help="Move the labels by their measured offset from the imagery.")
@click.option(
    "--pairs",
    type=(DATA, DATA),
    metavar="IMAGES MASKS",
    help="Make tiles of foreign images and masks of the same names, without a REGION.",
)
@click.option("--name", help="With --pairs: what to call them (default: pairs).")
@click.option("--attribution", help="With --pairs: whose pictures they are; it goes into tiles.json.")
@click.option("--terms", default="", help="With --pairs: under which terms they may be used.")
@click.option(
    "--empty-share",
    type=float,
    help="With --pairs: at most this share of the tiles has no building (0.2 by default; 1 keeps all).",
)
def tiles(
    regions: tuple[str, ...],
    data: Path,
    scheduler: str | None,
    out: Path | None,
    split: str | None,
    gsd_m: tuple[float, ...] | None,
    align: bool,
    pairs: tuple[Path, Path] | None,
    name: str | None,
    attribution: str | None,
    terms: str,
    empty_share: float | None,
) -> None:
    """Cut training tiles (image + label pairs) of REGIONS, or make them of foreign --pairs."""
    from . import training as job
    from .trainable import require_all_trainable

    if pairs is not None:
        from .training_pairs import cut_pairs

        if regions or align:
            raise SettingsError(
                "tiles --pairs: leave REGION and --align out; pairs have neither map nor place"
            )
        if out is None or gsd_m is None or len(gsd_m) != 1 or not attribution:
            raise SettingsError(
                "tiles --pairs: give --out (a folder), --gsd (metres per pixel, one number) and --attribution"
            )
        if split == "blocks":
            raise SettingsError(
                "tiles --pairs: pairs have no place to make blocks of; give train, validation or test"
            )
        cut_pairs(
            *pairs,
            out,
            gsd_m=gsd_m[0],
            name=name or "pairs",
            split=split or "train",
            attribution=attribution,
            terms=terms,
            scheduler_spec=scheduler,
            empty_share=empty_share,
        )
        return
    if not regions:
        raise SettingsError(
            "tiles: give a REGION (such as demo), or --pairs IMAGES MASKS --gsd ... --out DIR"
        )
    if out is not None and len(regions) > 1:
        raise SettingsError("tiles: --out takes one REGION; without it each goes to data/out/REGION/tiles")
    given = {
        "--name": name,
        "--attribution": attribution,
        "--terms": terms or None,
        "--empty-share": empty_share,
    }
    for option, value in given.items():
        if value is not None:
            raise SettingsError(f"tiles: {option} goes with --pairs; a region's own is in its TOML file")
    require_all_trainable(regions, data, split)
    for region in regions:
        job.cut_region(region, data, out, scheduler, split, gsd_m, align)


@cli.command()
@click.argument("region", required=False)
@data_option
@click.option(
    "--recipe",
    default="short",
    show_default=True,
    help="A recipe of data/recipes by name, or the path of one: what is trained, on what, how.",
)
@click.option(
    "--source",
    "sources",
    metavar="NAME=PATH",
    multiple=True,
    help="The folder of a source that the recipe names; repeatable.",
)
@click.option(
    "--out",
    type=DATA,
    help="Where results go (default data/out/REGION/unet, of another recipe unet-RECIPE; without REGION "
    "data/out/RECIPE/unet).",
)
@click.option("--steps", type=click.IntRange(min=1), help="Train this many steps, in place of the recipe's.")
@click.option("--threads", type=click.IntRange(min=1), help="Processor threads (default: all).")
@click.option(
    "--start",
    type=FILE,
    help="Weights (.safetensors) to go on from, such as the shipped ones, on ground of your own.",
)
def train(
    region: str | None,
    data: Path,
    recipe: str,
    sources: tuple[str, ...],
    out: Path | None,
    steps: int | None,
    threads: int | None,
    start: Path | None,
) -> None:
    """Train the U-Net by a recipe, and test it on REGION, which it never trains on. A killed run is taken up again."""
    from . import train as job
    from .regions import recipe_named

    path = recipe_named(recipe, data)
    folders: dict[str, Path] = {}
    for text in sources:
        name, sign, folder = text.partition("=")
        if not (name and sign and folder):
            raise SettingsError(f"train --source {text}: give NAME=PATH, such as kampala=../kampala")
        folders[name] = Path(folder)
    # Runs by two recipes are two runs: neither takes up the other's checkpoint.
    folder = f"unet-{path.stem}" if region and path.stem != "short" else "unet"
    job.train(
        path,
        data,
        out or data / "out" / (region or path.stem) / folder,
        paths=folders,
        test_regions=(region,) if region else (),
        steps=steps,
        threads=threads,
        start=start,
        say=click.echo,
    )


@cli.command("new-region")
@click.argument("name")
@data_option
@click.option("--sheets", help="NGII sheet numbers, separated by commas.")
@click.option("--bounds", type=_Numbers(4), help="left,bottom,right,top: degrees, or metres with --crs.")
@click.option("--crs", default="EPSG:4326", show_default=True, help="CRS of --bounds.")
@click.option("--title", default="", help="What people call the place.")
def new_region(
    name: str, data: Path, sheets: str | None, bounds: tuple[float, ...] | None, crs: str, title: str
) -> None:
    """Write a region file from sheet numbers or bounds: CRS, extents and sheets are worked out."""
    from .maps import missing_sources
    from .regions import new_region as write

    numbers = tuple(s.strip() for s in sheets.split(",") if s.strip()) if sheets else ()
    box = None if bounds is None else (bounds[0], bounds[1], bounds[2], bounds[3])
    path = write(name, data, numbers, box, crs, title)
    click.echo(f"wrote {path}")
    for line in missing_sources(name, data):
        click.echo(line)


@cli.command()
@click.argument("region")
@data_option
@click.option("--verify", is_flag=True, help="Also hold the contents of all outputs against their records.")
def status(region: str, data: Path, verify: bool) -> None:
    """Show how each stage of REGION stands: fresh, stale, missing or damaged."""
    from . import maps, training

    for line in [*maps.status_lines(region, data, verify), *training.status_lines(region, data, verify)]:
        click.echo(line)


@cli.command()
@click.argument("region")
@click.argument("stage")
@data_option
def why(region: str, stage: str, data: Path) -> None:
    """Explain why STAGE of REGION would run again: which setting or input changed."""
    from . import maps, training

    for line in training.why_lines(region, stage, data) or maps.why_lines(region, stage, data):
        click.echo(line)


@cli.command()
@click.argument("region", required=False)
@data_option
@scheduler_option
@click.option("--maps", "maps_dir", type=DATA, help="Folder of built maps, in place of REGION.")
@click.option(
    "--out", type=DATA, help="The flight folder to write (default data/source/REGION/flights/NAME)."
)
@click.option("--name", help="Name of the flight (default simulated-SEED).")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option(
    "--count",
    type=click.IntRange(1, 100_000),
    help="Simulate this many flights, with seeds from --seed on, side by side; --out is then the folder of their folders.",
)
@click.option(
    "--path",
    default="rectangle",
    show_default=True,
    help="rectangle (1 075 m, the paper's), lawnmower, random, or a GeoJSON file.",
)
@click.option(
    "--mode",
    type=click.Choice(["masks", "frames", "both"]),
    default="both",
    show_default=True,
    help="What the camera folder holds.",
)
@click.option(
    "--scale-bias",
    type=click.FloatRange(-0.9, 10.0),
    help="Scale bias of the odometry, such as 0.05 (default: drawn, sigma 5 %).",
)
@click.option(
    "--season",
    type=click.Choice(SEASONS),
    help="Draw the frames of a generated REGION as it is on another day of this season: other light, crops and cars.",
)
@click.option("--no-odometry", is_flag=True, help="Fly without odometry.")
@click.option(
    "--interval",
    "interval_s",
    type=click.FloatRange(0.02, 60.0),
    help="Seconds between frames (default: the region's, 5); 0.1 to 0.5 is what brmgeo odometry follows best.",
)
@click.option("--compass", is_flag=True, help="Write a compass heading (3 deg) into frames.csv.")
@click.option(
    "--settings",
    "settings_file",
    type=FILE,
    help="A TOML file with the simulator's settings: mount, distortion, errors of masks and odometry, blur, noise, ... "
    "(docs/FLIGHT.md has an example); the options above win over it.",
)
def simulate(
    region: str | None,
    data: Path,
    scheduler: str | None,
    maps_dir: Path | None,
    out: Path | None,
    name: str | None,
    seed: int,
    count: int | None,
    path: str,
    mode: str,
    scale_bias: float | None,
    season: str | None,
    no_odometry: bool,
    interval_s: float | None,
    compass: bool,
    settings_file: Path | None,
) -> None:
    """Simulate a flight over REGION: frames or masks, odometry and reference in one folder; an IMU with frames."""
    from . import simulate as job
    from .built import maps_for
    from .maps import native_imagery

    if out is None and region is None:
        raise SettingsError("simulate --maps: give --out, the flight folder to write")
    if count is not None and name is not None:
        raise SettingsError(
            "simulate --count: each flight is named by its seed, simulated-SEED; leave --name out"
        )
    if no_odometry:
        _refuse_given("is of the odometry, and --no-odometry has none: leave one out", "scale_bias")
    if season is not None and (region is None or mode == "masks"):
        raise SettingsError("simulate --season: needs a generated REGION, and --mode frames or both")
    built = maps_for("simulate", region, maps_dir, data, scheduler)
    what = job.Simulation(
        maps_dir=built.folder.absolute(),
        own=built.flight,
        path=path,
        mode=mode,  # type: ignore[arg-type]
        scale_bias=scale_bias,
        no_odometry=no_odometry,
        compass=compass,
        interval_s=interval_s,
        settings_file=None if settings_file is None else settings_file.absolute(),
    )
    flights = data / "source" / built.name / "flights"
    with files.scratch_folder("day") as scratch:
        if season is not None and built.region is not None:
            file = scratch / "other-day.tif"
            what = replace(what, imagery=job.other_day(built.region, built.folder, season, seed, file))
        elif built.region is not None and mode != "masks":
            what = replace(what, native=native_imagery(built.region, data))
        if count is None:
            name = name or f"simulated-{seed}"
            click.echo(f"wrote {job.simulate_flight(what, seed, out or flights / name, name)}")
            return
        names = [(s, f"simulated-{s}") for s in range(seed, seed + count)]
        jobs = [(s, (out or flights) / n, n) for s, n in names]
        job.simulate_flights(what, jobs, scheduler)
        click.echo(f"wrote {count} flights, {names[0][1]} to {names[-1][1]}, into {out or flights}")


@cli.command()
@click.argument("region", required=False)
@data_option
@scheduler_option
@click.option(
    "--maps",
    "maps_dir",
    type=DATA,
    help="Folder of built maps (buildings.tif), in place of REGION.",
)
@click.option(
    "--flight", type=DATA, help="The flight folder; with a REGION, a simulated flight where not given."
)
@click.option("--method", type=click.Choice(METHODS), default="mask", show_default=True)
@click.option("--out", type=DATA, help="Where results go (default data/out/REGION/flights/NAME/METHOD).")
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the simulated flight."
)
@click.option(
    "--compass",
    is_flag=True,
    help="Trust yaw_deg of frames.csv as a compass heading (clockwise from true north).",
)
@click.option(
    "--max-speed",
    "max_speed_m_s",
    type=click.FloatRange(0.1, 500),
    help="Metres per second that bound the movement where there is no odometry (default: the region's, 20).",
)
@click.option(
    "--odometry-sigma",
    type=_Numbers(),
    help="Noise of an odometry step per axis: METRES, or METRES,SHARE of its length (default 0.15,0.01; beside what the "
    "odometry states itself).",
)
@click.option(
    "--compass-sigma",
    "compass_sigma_deg",
    type=click.FloatRange(0.1, 180),
    help="With --compass: its standard deviation, degrees (default 8.6).",
)
@click.option(
    "--tilt-sigma",
    "tilt_sigma_deg",
    type=click.FloatRange(0, 11),
    help="Standard deviation of the camera mount's roll and pitch, degrees (default: what the flight says); from 4 on the "
    "mount is looked for.",
)
@click.option(
    "--odometry",
    type=click.Choice(["auto", "given"]),
    default="auto",
    show_default=True,
    help="auto: made from the frames where the flight has none and they are dense enough; given: only its own.",
)
@click.option(
    "--sift", is_flag=True, help="Also match the frames to the imagery by SIFT, the paper's Fig. 1."
)
@click.option(
    "--masks",
    "masks",
    type=click.Choice(["given", "network"]),
    default="given",
    show_default=True,
    help="given: the flight's own masks, and the network's only where it has none; network: always the network's.",
)
@weights_option
@click.option(
    "--as",
    "answer",
    type=click.Choice(["probability", "mask"]),
    help="What the matcher gets of the network: probabilities, or masks above the threshold.",
)
@click.option(
    "--roof-height",
    "roof_m",
    type=click.FloatRange(0, 100),
    help="Metres above ground at which the roofs stand that the network finds (default 3, one storey).",
)
@looks_option
def localize(
    region: str | None,
    data: Path,
    scheduler: str | None,
    maps_dir: Path | None,
    flight: Path | None,
    method: str,
    out: Path | None,
    seed: int,
    compass: bool,
    max_speed_m_s: float | None,
    odometry_sigma: tuple[float, ...] | None,
    compass_sigma_deg: float | None,
    tilt_sigma_deg: float | None,
    odometry: str,
    sift: bool,
    masks: str,
    weights: Path | None,
    answer: str | None,
    roof_m: float | None,
    looks: int | None,
) -> None:
    """Locate a flight over REGION (or over --maps) and write fixes, paths, candidates, scores and a report."""
    from brmgeo.files import plain_name
    from brmgeo.flight.folder import read_flight
    from brmgeo.locate.masks import NetworkUse

    from . import localize as job
    from .built import maps_for
    from .regions import note_flown
    from .simulate import default_flight

    if flight is not None:
        _refuse_given("is that of a simulated flight, and --flight is there already: leave one out", "seed")
    if not compass:
        _refuse_given("is of the compass: give --compass too", "compass_sigma_deg")
    if method == "paper":
        sensors = ("odometry_sigma", "compass_sigma_deg", "tilt_sigma_deg")
        _refuse_given(
            "is nothing that --method paper weighs: leave it out, or choose mask or ratio", *sensors
        )
    if odometry_sigma is not None and len(odometry_sigma) > 2:
        raise SettingsError(
            f"localize: --odometry-sigma has {len(odometry_sigma)} numbers: give METRES or METRES,SHARE"
        )
    step_m, step_share = (*(odometry_sigma or ()), None, None)[:2]
    known = job.Sensors(step_m, step_share, compass_sigma_deg, tilt_sigma_deg)
    built = maps_for("localize", region, maps_dir, data, scheduler)
    if flight is None:
        if built.region is None:
            raise SettingsError("localize --maps: give --flight, the folder of the flight")
        flight = default_flight(built.region, built.folder, data, seed)
    if out is None and region is None:
        raise SettingsError("localize --maps: give --out, the folder for the results")
    flown = read_flight(flight)
    out = out or data / "out" / built.name / "flights" / plain_name(flown.name, "flight") / method
    cache = data / "work" / "masks" if region is not None else out.absolute().parent / ".brmgeo-masks"
    own_use = NetworkUse()
    use = NetworkUse(
        masks,  # type: ignore[arg-type]
        weights,
        answer or own_use.answer,  # type: ignore[arg-type]
        cache,
        own_use.roof_m if roof_m is None else roof_m,
        looks=looks,
    )
    job.localize(
        built.folder,
        flown,
        method,
        out,
        flight_settings=built.flight,
        compass=compass,
        sift=sift,
        max_speed_m_s=max_speed_m_s,
        sensors=known,
        odometry=odometry,
        network=use,
        attribution=built.attribution,
    )
    if region is not None:
        note_flown(built.name, data, out)


@cli.command()
@click.argument("region", required=False)
@data_option
@scheduler_option
@click.option(
    "--maps", "maps_dir", type=DATA, help="Folder of built maps (with footprints.gpkg), in place of REGION."
)
@click.option(
    "--results", type=DATA, multiple=True, help="Compare what localize wrote below this folder; repeatable."
)
@click.option(
    "--flights", type=click.IntRange(1, 100_000), default=50, show_default=True, help="Simulated flights."
)
@click.option("--first-seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--methods", default=",".join(METHODS), show_default=True)
@click.option(
    "--path", default="rectangle", show_default=True, help="rectangle, lawnmower, random, or a GeoJSON file."
)
@click.option(
    "--scale-bias",
    type=click.FloatRange(-0.9, 0.9),
    default=0.05,
    show_default=True,
    help="Of the odometry, with the sign drawn by seed.",
)
@click.option(
    "--hide",
    type=click.Choice(["east", "west", "north", "south"]),
    help="Hide this half of the map and fly over it: nothing may be found.",
)
@click.option(
    "--conditions",
    help="Fly under conditions of real flights, a row each: some of long-legs, tilted, tilted-near, poor-masks, old-map, "
    "photos (all together); default: plain flights.",
)
@click.option(
    "--masks",
    "masks",
    help="Compare masks over the same flights: some of true, network (on rendered frames), degraded (to pixel accuracy "
    "0.916), simulated; default: simulated alone, on flights without frames.",
)
@weights_option
@looks_option
@click.option(
    "--sift",
    is_flag=True,
    help="Also match each flight's frames to the imagery by SIFT, the paper's Fig. 1 (draws frames: slow).",
)
@click.option(
    "--season",
    type=click.Choice(SEASONS),
    help="Draw the frames of a generated REGION as on another day of this season.",
)
@click.option(
    "--out", type=DATA, help="Where flights.csv and summary.md go (default data/out/REGION/evaluation)."
)
def evaluate(
    region: str | None,
    data: Path,
    scheduler: str | None,
    maps_dir: Path | None,
    results: tuple[Path, ...],
    flights: int,
    first_seed: int,
    methods: str,
    path: str,
    scale_bias: float,
    hide: str | None,
    conditions: str | None,
    masks: str | None,
    weights: Path | None,
    looks: int | None,
    sift: bool,
    season: str | None,
    out: Path | None,
) -> None:
    """Fly many simulated flights over REGION through the matchers, or compare --results, side by side."""
    from brmgeo.evaluate.trials import FrameSource, MaskComparison, Trial
    from brmgeo.synth.mission import PATHS

    from . import evaluate as job
    from .built import maps_for
    from .maps import native_imagery
    from .regions import note_flown
    from .simulate import other_day

    if results:
        kept = {"results", "out", "data", "scheduler"}
        params = click.get_current_context().command.params
        others = [p.name for p in params if p.name and p.expose_value and p.name not in kept]
        _refuse_given("goes with simulated flights, and --results are flown already: leave one out", *others)
        click.echo(job.compare_results(results, out))
        return
    built = maps_for("evaluate", region, maps_dir, data, scheduler)
    if out is None:
        if region is None:
            raise SettingsError("evaluate --maps: give --out, the folder for the table")
        out = (
            data
            / "out"
            / built.name
            / "evaluation"
            / (f"hidden-{hide}" if hide else path if path in PATHS else "waypoints")
        )
        # What is flown otherwise goes beside the plain table, not over it.
        told = (
            "conditions" if conditions else "",
            "masks" if masks else "",
            "sift" if sift else "",
            season or "",
        )
        kind = "".join(f"-{w}" for w in told if w)
        out = out.with_name(out.name + kind)
    chosen, kinds, under = (
        tuple(dict.fromkeys(m.strip() for m in (text or "").split(",") if m.strip()))
        for text in (methods, masks, conditions)
    )
    if (weights is not None or looks is not None) and "network" not in kinds:
        raise SettingsError(
            "evaluate: --weights and --looks are of the network's masks: give --masks network too"
        )
    compared = MaskComparison(kinds, weights, looks) if kinds else None
    if season is not None and (region is None or not (sift or "network" in kinds)):
        raise SettingsError("evaluate --season: needs a generated REGION, and --sift or --masks network")
    with files.scratch_folder("day") as scratch:
        drawn = FrameSource()
        if season is not None and built.region is not None:
            file = scratch / "other-day.tif"
            other_day(built.region, built.folder, season, first_seed, file)
            drawn = FrameSource(imagery=file, season=season)
        elif built.region is not None and (kinds or sift):
            drawn = FrameSource(native=native_imagery(built.region, data))
        first = Trial(
            maps_dir=built.folder.absolute(),
            own=built.flight,
            seed=first_seed,
            methods=chosen,
            path=path,
            scale_bias=scale_bias,
            hide=hide,  # type: ignore[arg-type]
            masks=compared,
            sift=sift,
            drawn=drawn,
        )
        click.echo(job.evaluate(job.Evaluation(first, flights, out, scheduler, under)))
    if region is not None:
        note_flown(built.name, data, out)


@cli.command()
@click.argument("source", type=FILE)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="Folder for the masks of frames; a .tif for a raster's.",
)
@weights_option
@click.option("--backend", type=click.Choice(["onnx", "torch"]), help="What runs the network (default onnx).")
@click.option(
    "--as",
    "answer",
    type=click.Choice(["mask", "probability"]),
    default="mask",
    show_default=True,
    help="Masks above the threshold, or probabilities.",
)
@click.option("--gsd", "gsd_m", type=float, help="Metres per pixel of the images in a plain folder.")
@click.option(
    "--levels", type=_Numbers(2), help="Levels that are black and white, LOW,HIGH, in images of over 8 bits."
)
@click.option(
    "--bands", type=_Numbers(), help="Bands of a raster that are red, green and blue, such as 3,2,1."
)
@looks_option
def segment(
    source: Path,
    out: Path,
    weights: Path | None,
    backend: str | None,
    answer: str,
    gsd_m: float | None,
    levels: tuple[float, ...] | None,
    bands: tuple[float, ...] | None,
    looks: int | None,
) -> None:
    """Find the buildings in SOURCE: a flight folder, a folder of images, or a georeferenced raster of any size."""
    from . import segment as job

    if bands is not None and any(b != int(b) for b in bands):
        raise SettingsError(f"segment: --bands {bands} are numbers of bands, from 1")
    line = job.segment(
        source,
        out,
        weights,
        backend=backend,
        answer=answer,  # type: ignore[arg-type]
        gsd_m=gsd_m,
        levels=None if levels is None else (levels[0], levels[1]),
        bands=None if bands is None else tuple(int(b) for b in bands),
        looks=looks,
    )
    click.echo(line)


@cli.command()
@click.argument("results", type=DATA)
@click.option(
    "--path",
    "what",
    type=click.Choice(["online", "smoothed", "reference", "candidates"]),
    default="online",
    show_default=True,
    help="The online fixes, the smoothed path, the reference, or the candidates of all frames.",
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    required=True,
    help="The file to write: .gpkg, .geojson or .csv.",
)
@click.option(
    "--crs", help="CRS to write in, such as EPSG:4326 (default: the map's; GeoJSON: always degrees)."
)
def export(results: Path, what: str, out: Path, crs: str | None) -> None:
    """Write a path or the candidates of RESULTS (a folder that localize wrote) in another format or CRS."""
    from . import results as job

    click.echo(job.export_results(results, what, out, crs))


@cli.command("export-onnx")
@click.argument("weights", type=FILE, required=False)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="The .onnx file to write.")
@click.option(
    "--tile",
    "tile_px",
    type=click.IntRange(16, 8192),
    default=512,
    show_default=True,
    help="Pixels of a tile: the QGIS plugin Deepness needs one fixed size.",
)
@click.option("--any-size", is_flag=True, help="Take pictures of any size, as brmgeo itself runs it.")
def export_onnx(weights: Path | None, out: Path, tile_px: int, any_size: bool) -> None:
    """Write WEIGHTS (.safetensors; default: those that ship) as ONNX for QGIS (Deepness) and other programs."""
    from brmgeo.segment.onnx_export import export_onnx as export
    from brmgeo.segment.predict import SHIPPED

    if out.suffix != ".onnx" or not out.absolute().parent.is_dir():
        raise SettingsError(
            f"export-onnx --out {out}: give a name that ends in .onnx, in a folder that is there"
        )
    card = export(weights or SHIPPED.with_suffix(".safetensors"), out, None if any_size else tile_px)
    click.echo(f"wrote {out}, weights {card.digest}, {'any size' if any_size else f'{tile_px} px tiles'}")


@cli.command("import")
@click.argument("log", type=FILE)
@click.option("--out", type=DATA, required=True, help="The flight folder to write.")
@click.option("--name", help="Name of the flight (default: the log's).")
@click.option("--topic", help="The odometry to take where the log holds several.")
@click.option("--image-topic", help="The pictures to take where a bag holds several cameras.")
@click.option("--imu-topic", help="The inertial readings to take where a bag holds several.")
@click.option(
    "--format", "format_name", help="tum, euroc, kitti, vins-mono, vins-fusion or csv, of a text file."
)
@click.option("--quaternion", type=click.Choice(["wxyz", "xyzw"]), help="Order of a text file's quaternions.")
@click.option(
    "--times", "frame_times_s", type=FILE, help="Times of KITTI poses: a text file, one time a line."
)
@click.option("--photos", type=FILE, help="Photos taken at the camera triggers that the log tells.")
@click.option("--video", type=FILE, help="A video of the flight.")
@click.option(
    "--video-start",
    "video_start_s",
    type=float,
    default=0.0,
    help="The log's time at which the video begins, seconds.",
)
@click.option("--fov", "fov_deg", type=float, help="Field of view across the short side, degrees.")
@click.option(
    "--camera",
    help="fx,fy,cx,cy[,k1,k2,p1,p2[,k3]] in pixels, or a calibration file (Kalibr, OpenVINS, OpenCV, ROS, VINS).",
)
@click.option("--agl", "agl_m", type=float, help="Height above ground, metres, the same for all frames.")
@click.option(
    "--ground", "ground_m", type=float, help="Height of the ground above the GNSS altitude's datum, metres."
)
@click.option(
    "--mount",
    "mount_deg",
    type=_Numbers(3),
    help="Camera in the body: roll,pitch,yaw degrees.",
)
@click.option(
    "--body",
    "body_deg",
    type=_Numbers(3),
    default=(0.0, 0.0, 0.0),
    help="The log's body in ours: roll,pitch,yaw degrees.",
)
@click.option(
    "--axes",
    type=click.Choice(["flu", "frd", "optical", "nadir"]),
    help="Axes of the odometry: x nose, y left, z up; right-down; of a camera that looks ahead; of one that looks down.",
)
@click.option("--imu-units", help="Units of the log's IMU where they are others: deg/s, g or mg, by commas.")
@click.option(
    "--rate",
    "rate_hz",
    type=click.FloatRange(min=0, min_open=True),
    help="Take at most this many frames a second.",
)
@click.option(
    "--shift-frames", "shift_frames_s", type=float, default=0.0, help="Seconds to add to the frames' times."
)
def import_(
    log: Path,
    out: Path,
    name: str | None,
    topic: str | None,
    image_topic: str | None,
    imu_topic: str | None,
    format_name: str | None,
    quaternion: Any,
    frame_times_s: Path | None,
    photos: Path | None,
    video: Path | None,
    video_start_s: float,
    fov_deg: float | None,
    camera: str | None,
    agl_m: float | None,
    ground_m: float | None,
    mount_deg: tuple[float, ...] | None,
    body_deg: tuple[float, ...],
    axes: Literal["flu", "frd", "optical", "nadir"] | None,
    imu_units: str | None,
    rate_hz: float | None,
    shift_frames_s: float,
) -> None:
    """Make a flight folder of LOG: a ROS bag, PX4 or ArduPilot log, text of poses, or a folder of geotagged photos."""
    from brmgeo.flight.calibration import read_calibration
    from brmgeo.flight.logs import ImportSettings, LogOptions
    from brmgeo.flight.readings import Camera
    from brmgeo.flight.tables import read_times

    from . import logs as job

    units = tuple(u.strip() for u in (imu_units or "").split(",") if u.strip())
    for unit in units:
        if unit not in ("deg/s", "g", "mg"):
            raise SettingsError(f"import: --imu-units {unit!r} is unknown: known are deg/s, g, mg")
    if camera is not None and fov_deg is not None:
        raise SettingsError("import: --camera and --fov both tell the focal length: give one of them")
    lens: Camera | tuple[float, ...] | None = None
    if camera is not None and (Path(camera).exists() or camera.lower().endswith((".yaml", ".yml"))):
        lens = read_calibration(Path(camera))
    elif camera is not None:
        lens = _Numbers().convert(camera, None, None)
        if len(lens) not in (4, 8, 9):
            raise SettingsError(
                f"import: --camera has {len(lens)} numbers: give fx,fy,cx,cy, or these and k1,k2,p1,p2 or k1,k2,p1,p2,k3, "
                "or a calibration file"
            )
    options = LogOptions(
        topic=topic,
        image_topic=image_topic,
        imu_topic=imu_topic,
        quaternion=quaternion,
        frame_times_s=read_times(frame_times_s) if frame_times_s else None,
        format=format_name,
    )
    settings = ImportSettings(
        options=options,
        name=name,
        photos=photos,
        video=video,
        video_start_s=video_start_s,
        fov_deg=fov_deg,
        camera=lens,
        agl_m=agl_m,
        ground_m=ground_m,
        mount_deg=mount_deg,
        body_deg=body_deg,
        axes=axes,
        imu_units=units,
        rate_hz=rate_hz,
        shift_frames_s=shift_frames_s,
    )
    for line in job.import_log(log, out, settings):
        click.echo(line)
    click.echo(f"wrote {out}")


@cli.command()
@click.argument("paths", type=FILE, nargs=-1, required=True)
@click.option("--topic", help="The odometry to look at where the log holds several.")
@click.option(
    "--times", "frame_times_s", type=FILE, help="Times of KITTI poses: a text file, one time a line."
)
@click.option("--write", type=click.Path(path_type=Path), help="Write it as Markdown into this file.")
def inspect(
    paths: tuple[Path, ...], topic: str | None, frame_times_s: Path | None, write: Path | None
) -> None:
    """Tell what is in PATHS (logs, bags, photo or flight folders): how long, how far, where, gaps, rates, units, faults."""
    from brmgeo.flight.logs import LogOptions
    from brmgeo.flight.logs.inspect import inspect as look
    from brmgeo.flight.tables import read_times

    from . import logs as job

    options = LogOptions(topic, frame_times_s=read_times(frame_times_s) if frame_times_s else None)
    unread = 0
    if write is not None:
        if not write.absolute().parent.is_dir():
            raise SettingsError(
                f"inspect --write {write}: there is no folder {write.parent}; make it or choose another"
            )
        text, unread = job.inspect_document(paths, options)
        files.write_text(write, text)
        click.echo(f"wrote {write}")
    for path in paths if write is None else ():
        try:
            for line in look(path, options):
                click.echo(line)
        except BrmgeoError as error:
            if len(paths) == 1:
                raise
            click.echo(f"{path.name}: {error}")
            unread += 1
    if unread:
        raise SettingsError(f"inspect: {unread} of {len(paths)} paths could not be read, as told above")


@cli.command()
@click.argument("flight", type=DATA)
@click.option(
    "--method",
    type=click.Choice(["auto", "vio", "planar"]),
    default="auto",
    show_default=True,
    help="vio: frames, IMU and height; planar: frames, attitude and height.",
)
@click.option(
    "--thin",
    type=DATA,
    help="Also write the flight with its odometry and only every --every seconds a frame, for localize.",
)
@click.option("--every", "every_s", type=float, default=5.0, show_default=True, help="Seconds, with --thin.")
def odometry(flight: Path, method: str, thin: Path | None, every_s: float) -> None:
    """Make the odometry of FLIGHT (a folder) from its own frames, IMU and height, and write it there."""
    from . import odometry as job

    if thin is None:
        _refuse_given("goes with --thin: give both or none", "every_s")
    facts = job.make_odometry(flight, job.method_named(method))
    for line in job.summary(facts):
        click.echo(line)
    if thin is not None:
        click.echo(f"wrote {job.thin_flight(flight, thin, every_s)}")


def main() -> None:
    """Entry point of the ``brmgeo`` command."""
    clean_up_when_told_to_end()
    status = last_door(lambda: cli(standalone_mode=False), sys.argv[1:])
    # A library's callback may pass over what was raised in it, and the run go on to its end.
    sys.exit(128 + _ended[0] if _ended and status == 0 else status)


def last_door(command: Callable[[], Any], words: Sequence[str]) -> int:
    """``run`` for people: what still escapes it is a defect, told in one line with how to report it, and exit status 70.

    ``words`` are those of the command line; ``--traceback`` among them shows where the error comes from.
    """
    # A message with a name that this terminal cannot write must not become an error of its own.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        return run(command)
    except Exception as error:
        if TRACEBACK in words:
            traceback.print_exc()
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}:{place.lineno}"
        asked = "the lines above" if TRACEBACK in words else f"what the same command says with {TRACEBACK}"
        click.echo(
            f"brmgeo: a defect of brmgeo {__version__} in {where}: {type(error).__name__}: {one_line(error)}; please report "
            f"this line, the command and {asked} to its maintainers",
            err=True,
        )
        return DEFECT


_INTERRUPTED = "brmgeo: interrupted; what was finished is kept, the next run goes on from there"


_ended: list[int] = []


def _end(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_DFL)  # a second one does not wait for what is tidied up
    _ended.append(number)
    raise SystemExit(128 + number)


def clean_up_when_told_to_end() -> None:
    """SIGTERM, and a terminal that closes, end the run as Ctrl-C does: its scratch and its workers go with it."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        # What runs under nohup is not to end with its terminal.
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


def run(command: Callable[[], Any]) -> int:
    """Exit status of a command: 0, 2 for a known error (one line on stderr), 130 when interrupted, 141 for a closed pipe.

    Any other exception is a defect, and passes.
    """
    try:
        command()
    except BrmgeoError as error:
        click.echo(f"brmgeo: {' '.join(str(error).split())}", err=True)
        return 2
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return error.exit_code
    except click.ClickException as error:
        own = getattr(error, "ctx", None)
        name = own.command_path if own else "brmgeo"
        click.echo(
            f"{name}: {' '.join(error.format_message().split()).rstrip('.')}; see {name} --help", err=True
        )
        return error.exit_code
    except (KeyboardInterrupt, click.Abort):
        click.echo(_INTERRUPTED, err=True)
        return 130
    except SystemExit as error:
        if error.code == 128 + signal.SIGTERM:  # after SIGHUP nobody is there to read it
            click.echo(_INTERRUPTED, err=True)
        raise
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except UnicodeEncodeError as error:
        # Python takes file names of any bytes, the libraries that read and write files take UTF-8.
        if error.reason != "surrogates not allowed":
            raise
        click.echo(
            f"brmgeo: {error.object!a} is no UTF-8, as the names of files must be: rename the file or folder",
            err=True,
        )
        return 2
    except MemoryError as error:
        click.echo(
            f"brmgeo: the memory of this machine is not enough ({one_line(error)}): give a smaller area or picture, "
            "or close other programs",
            err=True,
        )
        return 2
    except ModuleNotFoundError as error:
        line = extras.told(error, "this command")
        if line is None:
            raise
        click.echo(f"brmgeo: {line}", err=True)
        return 2
    except OSError as error:
        told = files.reason(error)
        if told is None:
            raise
        name = os.fsdecode(error.filename2 or error.filename or "a file")
        click.echo(f"brmgeo: {name} cannot be read or written: {told}", err=True)
        return 2
    return 0


if __name__ == "__main__":
    main()
