"""The ``brmgeo`` command. A known error is one line on stderr and exit status 2."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from brmgeo import __version__
from brmgeo.errors import BrmgeoError, SettingsError

DATA = click.Path(file_okay=False, path_type=Path)
FILE = click.Path(dir_okay=True, path_type=Path)
METHODS = ("mask", "ratio", "paper")
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


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="brmgeo")
def cli() -> None:
    """Tell a drone where it is, without GNSS, from free building maps."""


@cli.command()
@click.argument("region", required=False)
@data_option
@scheduler_option
@click.option(
    "--footprints",
    type=FILE,
    multiple=True,
    help="Build from these files, without a region file; repeatable.",
)
@click.option("--crs", help="With --footprints: the region's CRS, projected in metres, such as EPSG:5187.")
@click.option("--out", type=DATA, help="Where results go (default data/out/REGION).")
@click.option("--imagery", type=FILE, help="With --footprints: a GeoTIFF, or a folder or pattern of them.")
@click.option("--sheets", help="With --footprints: NGII sheets that the files cover; the map is known there.")
@click.option(
    "--bounds", type=_Numbers(4), help="With --footprints: left,bottom,right,top where the map is known."
)
@click.option(
    "--gsd", "gsd_m", type=float, default=0.5, show_default=True, help="With --footprints: metres per pixel."
)
@click.option(
    "--radii",
    "radii_m",
    type=_Numbers(),
    help="With --footprints: radii in metres (default: eq. 3, 150 m, 43 deg).",
)
@click.option("--layer", help="With --footprints: the layer to read of files that hold several.")
@click.option("--encoding", help="With --footprints: text encoding of shapefiles without .cpg.")
@click.option("--repairs", is_flag=True, help="Also write what was repaired as a layer of footprints.gpkg.")
def maps(
    region: str | None,
    data: Path,
    scheduler: str | None,
    footprints: tuple[Path, ...],
    crs: str | None,
    out: Path | None,
    imagery: Path | None,
    sheets: str | None,
    bounds: tuple[float, ...] | None,
    gsd_m: float,
    radii_m: tuple[float, ...] | None,
    layer: str | None,
    encoding: str | None,
    repairs: bool,
) -> None:
    """Build all maps of REGION: footprints, imagery, building mask, ratio maps, preview, QGIS project."""
    from pipelines import maps as job

    if footprints:
        if region is not None:
            raise SettingsError(f"maps: give either REGION ({region}) or --footprints, not both")
        if crs is None or out is None:
            raise SettingsError(
                "maps --footprints: give --crs (such as EPSG:5187) and --out (a folder for the results)"
            )
        spec = job.region_of_files(
            out, footprints, crs, imagery, sheets, bounds, gsd_m, radii_m, layer, encoding, repairs
        )
        job.build_maps(spec, out / ".brmgeo", out, Path.cwd(), scheduler)
        return
    if region is None:
        raise SettingsError(
            "maps: give a REGION (such as demo), or --footprints FILE --crs EPSG:... --out DIR"
        )
    given = {"--crs": crs, "--imagery": imagery, "--sheets": sheets, "--bounds": bounds, "--radii": radii_m}
    for option, value in given.items():
        if value is not None:
            raise SettingsError(
                f"maps {region}: {option} goes with --footprints; a region's own settings are in its TOML file"
            )
    job.build_region(region, data, out, repairs, scheduler)


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
    from pipelines.maps import missing_sources
    from pipelines.regions import new_region as write

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
    from pipelines import maps as job

    for line in job.status_lines(region, data, verify):
        click.echo(line)


@cli.command()
@click.argument("region")
@click.argument("stage")
@data_option
def why(region: str, stage: str, data: Path) -> None:
    """Explain why STAGE of REGION would run again: which setting or input changed."""
    from pipelines import maps as job

    for line in job.why_lines(region, stage, data):
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
    "--scale-bias", type=float, help="Scale bias of the odometry, such as 0.05 (default: drawn, sigma 5 %)."
)
@click.option("--no-odometry", is_flag=True, help="Fly without odometry.")
@click.option("--compass", is_flag=True, help="Write a compass heading (3 deg) into frames.csv.")
def simulate(
    region: str | None,
    data: Path,
    scheduler: str | None,
    maps_dir: Path | None,
    out: Path | None,
    name: str | None,
    seed: int,
    path: str,
    mode: str,
    scale_bias: float | None,
    no_odometry: bool,
    compass: bool,
) -> None:
    """Simulate a flight over REGION: frames, masks, odometry, IMU, altimeter and reference in one folder."""
    from pipelines import flights as job

    own, folder, _ = job.maps_for("simulate", region, maps_dir, data, scheduler)
    name = name or f"simulated-{seed}"
    if out is None:
        if region is None:
            raise SettingsError("simulate --maps: give --out, the flight folder to write")
        out = data / "source" / own.name / "flights" / name
    job.simulate_flight(
        job.read_maps(folder.absolute()),
        out,
        own.flight,
        seed,
        path,
        mode,
        scale_bias,
        no_odometry,
        compass,
        name,
    )
    click.echo(f"wrote {out}")


@cli.command()
@click.argument("region", required=False)
@data_option
@scheduler_option
@click.option(
    "--maps",
    "maps_dir",
    type=DATA,
    help="Folder of built maps (ratio.tif, buildings.tif), in place of REGION.",
)
@click.option(
    "--flight", type=DATA, help="The flight folder; with a REGION, a simulated flight where not given."
)
@click.option("--method", type=click.Choice(METHODS), default="mask", show_default=True)
@click.option("--out", type=DATA, help="Where results go (default data/out/REGION/flights/NAME/METHOD).")
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the simulated flight."
)
@click.option("--compass", is_flag=True, help="Trust yaw_deg of frames.csv as a compass heading.")
@click.option(
    "--sift", is_flag=True, help="Also match the frames to the imagery by SIFT, the paper's Fig. 1."
)
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
    sift: bool,
) -> None:
    """Locate a flight over REGION (or over --maps) and write fixes, paths, candidates, scores and a report."""
    from pipelines import flights as job

    own, folder, attribution = job.maps_for("localize", region, maps_dir, data, scheduler)
    if flight is None:
        if region is None:
            raise SettingsError("localize --maps: give --flight, the folder of the flight")
        flight = job.default_flight(own, folder, data, seed)
    if out is None:
        if region is None:
            raise SettingsError("localize --maps: give --out, the folder for the results")
        out = data / "out" / own.name / "flights" / job.flight_name(flight) / method
    job.localize(
        folder,
        flight,
        method,
        out,
        flight_settings=own.flight,
        compass=compass,
        sift=sift,
        attribution=attribution,
    )


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
    "--flights", type=click.IntRange(min=1), default=50, show_default=True, help="Simulated flights."
)
@click.option("--first-seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--methods", default=",".join(METHODS), show_default=True)
@click.option(
    "--path", default="rectangle", show_default=True, help="rectangle, lawnmower, random, or a GeoJSON file."
)
@click.option(
    "--scale-bias",
    type=float,
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
    out: Path | None,
) -> None:
    """Fly many simulated flights over REGION through the matchers, or compare --results, side by side."""
    from pipelines import flights as job

    if results:
        click.echo(job.compare_results(results, out))
        return
    own, folder, _ = job.maps_for("evaluate", region, maps_dir, data, scheduler)
    if out is None:
        if region is None:
            raise SettingsError("evaluate --maps: give --out, the folder for the table")
        out = (
            data
            / "out"
            / own.name
            / "evaluation"
            / (f"hidden-{hide}" if hide else path if path in job.PATHS else "waypoints")
        )
    chosen = tuple(m.strip() for m in methods.split(",") if m.strip())
    click.echo(
        job.evaluate(folder, own.flight, flights, first_seed, chosen, path, scale_bias, hide, out, scheduler)
    )


def main() -> None:
    """Entry point of the ``brmgeo`` command."""
    sys.exit(run(lambda: cli(standalone_mode=False)))


def run(command: Callable[[], Any]) -> int:
    """Exit status of a command: 0, 2 for a known error (one line on stderr), 130 when interrupted."""
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
        click.echo(f"{name}: {' '.join(error.format_message().split()).rstrip('.')}; see {name} --help", err=True)
        return error.exit_code
    except (KeyboardInterrupt, click.Abort):
        click.echo(
            "brmgeo: interrupted; what was finished is kept, the next run goes on from there", err=True
        )
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EACCES, errno.EROFS, errno.EDQUOT, errno.EPERM):
            raise
        click.echo(
            f"brmgeo: {error.filename or 'a file'} cannot be written: {error.strerror}; make room or choose another place",
            err=True,
        )
        return 2
    return 0


if __name__ == "__main__":
    main()
