"""Embedded odometry over seeds and conditions, written as a table to docs/odometry.md (between its markers).

    python benchmarks/odometry.py                      all conditions, five seeds
    python benchmarks/odometry.py --seeds 2 flat delay  some of them

The aircraft flies a rounded rectangle of 1 061 m at 150 m over the demo region's imagery (``brmgeo maps demo`` first) at
5 m/s; its IMU and altimeter have the simulator's errors. Flat ground is drawn by warping the imagery with the camera's
homography, buildings by the simulator's own renderer. Nothing is aligned before it is scored: the track starts at the true
position and yaw of the first frame. Frames a second are processor time of one core, drawing left out.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np

from brmgeo.flight.camera import ray_from_pixel
from brmgeo.flight.motion import MIN_STEP_NOISE_M
from brmgeo.flight.readings import Attitude, Camera
from brmgeo.flight.vio import VioResult, VioSettings, run_vio
from brmgeo.synth.flight import Course, Imagery, SimulationSettings, Simulator, fly, imu_of, rectangle

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "docs" / "odometry.md"
RATE = 100


@dataclass(frozen=True)
class Condition:
    """One row of the table: how it differs from the plain flight."""

    name: str
    says: str
    buildings: str = ""  # "", "town" or "towers": with the simulator's renderer
    hz: float = 5.0
    delay_s: float = 0.0
    boresight_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    agl_bias_m: float = 0.0
    contrast: float = 1.0
    rolling_s: float = 0.0
    hills_m: float = 0.0
    blind_s: tuple[float, float] | None = None
    flight: dict[str, Any] = field(default_factory=dict)
    vio: dict[str, Any] = field(default_factory=dict)


BENT = Camera(640, 480, 610.0, 610.0, 318.0, 241.5, (-0.12, 0.05, 0.0004, -0.0003, 0.0))
CONDITIONS = [
    Condition("flat", "flat ground, 10 Hz", hz=10.0),
    Condition("30 Hz", "thirty frames a second", hz=30.0),
    Condition("2 Hz", "two frames a second", hz=2.0),
    Condition("5 Hz", "five, as in all rows below"),
    Condition("distortion", "lens bends corners by 20 px", flight={"camera": BENT}),
    Condition("oblique", "camera 15 deg ahead of nadir", flight={"mount": Attitude(0.0, -math.radians(15.0))}),
    Condition("low texture", "contrast 1/8", contrast=0.125),
    Condition("blur", "shutter 1/30 s", flight={"exposure_s": 1.0 / 30.0}),
    Condition("fast", "15 m/s", flight={"speed_m_s": 15.0, "turn_radius_m": 40.0}),
    Condition("delay 50 ms", "camera late against the IMU", delay_s=0.05),
    Condition("delay 400 ms", "clocks 0.4 s apart", delay_s=0.4),
    Condition("delay not estimated", "50 ms, held at zero", delay_s=0.05, vio={"delay_sigma_s": 0.0}),
    Condition("boresight 1 deg", "in roll and pitch", boresight_deg=(1.0, 1.0, 0.0)),
    Condition("boresight yaw 2 deg", "camera turned in its mount", boresight_deg=(0.0, 0.0, 2.0)),
    Condition(
        "boresight not estimated", "1 deg, held at zero", boresight_deg=(1.0, 1.0, 0.0), vio={"boresight_sigma_rad": 0.0}
    ),
    Condition("AGL +5 m", "altimeter reads 5 m too high", agl_bias_m=5.0),
    Condition("blind 10 s", "no frames for 10 s", blind_s=(100.0, 110.0)),
    Condition("rolling shutter", "rows read over 20 ms", rolling_s=0.02),
    Condition("terrain", "hills of +-10 m, 300 m from top to top", hills_m=10.0),
    Condition("town", "buildings 3-20 m", buildings="town"),
    Condition("town, all points", "the same without slowest layer", buildings="town", vio={"slowest_layer": False}),
    Condition("towers", "a third 40-60 m high", buildings="towers"),
    Condition("towers, all points", "the same without slowest layer", buildings="towers", vio={"slowest_layer": False}),
]  # fmt: skip


def settings_of(condition: Condition) -> SimulationSettings:
    base = SimulationSettings(frame_interval_s=1.0 / condition.hz, turn_radius_m=12.0, exposure_s=0.0)
    return replace(base, **condition.flight)


def place_of(seed: int, extent: tuple[float, float, float, float]) -> Any:
    """A rectangle of 1 061 m (corners rounded) somewhere on the imagery, turned at random."""
    rng = np.random.default_rng([seed, 77])
    left, bottom, right, top = extent
    centre = rng.uniform([left + 420, bottom + 420], [right - 420, top - 420])
    return rectangle((float(centre[0]), float(centre[1])), float(rng.uniform(0, 360)), 1081.0)


def draw_flat(
    course: Course, settings: SimulationSettings, imagery: Imagery, condition: Condition, seed: int
) -> Iterator[Any]:
    """Grey frames of the imagery on flat ground (or on hills), through lens, shutter, contrast and noise."""
    camera = settings.camera
    rng = np.random.default_rng([seed, 5])
    grey = cv2.cvtColor(imagery.rgb, cv2.COLOR_RGB2GRAY)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = ray_from_pixel(camera, np.stack([u, v], -1)).astype(np.float32)
    # Noise is drawn once and shifted: drawing it anew would be most of the time.
    noise = (rng.standard_normal((camera.height + 64, camera.width + 64)) * settings.noise_levels).astype(
        np.float32
    )
    bore = Attitude(*(math.radians(a) for a in condition.boresight_deg)).matrix()
    shutter = np.linspace(-0.5, 0.5, 9) * settings.exposure_s if settings.exposure_s else [0.0]
    late = np.linspace(0.0, condition.rolling_s, camera.height) if condition.rolling_s else None
    for row in course.frame_index:
        light = np.zeros((camera.height, camera.width), dtype=np.float32)
        for dt in shutter:
            when = course.t_s[row] + dt
            if late is None and not settings.camera.is_distorted and not condition.hills_m:
                matrix = _homography(course, settings, imagery, bore, when)
                size = (camera.width, camera.height)
                flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
                seen = cv2.warpPerspective(grey, matrix, size, flags=flags, borderMode=cv2.BORDER_REFLECT)
                light += seen
                continue
            if late is None:
                columns, rows = _footpoints(course, settings, imagery, rays, bore, when, condition)
            else:
                # Rows between two poses: the footpoint is linear in time over 20 ms.
                a = _footpoints(course, settings, imagery, rays, bore, when, condition)
                b = _footpoints(course, settings, imagery, rays, bore, when + condition.rolling_s, condition)
                share = (late / condition.rolling_s).astype(np.float32)[:, None]
                columns, rows = (x + share * (y - x) for x, y in zip(a, b))
            light += cv2.remap(grey, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        gain = math.exp(settings.exposure_sigma * rng.standard_normal())
        r, c = rng.integers(0, 64, 2)
        grain = noise[r : r + camera.height, c : c + camera.width]
        scale = gain * condition.contrast / len(shutter)
        light = cv2.addWeighted(light, scale, grain, 1.0, 110.0 * gain * (1.0 - condition.contrast))
        yield np.asarray(cv2.convertScaleAbs(np.maximum(light, 0.0)), dtype=np.uint8)


def _camera_at(course: Course, settings: SimulationSettings, bore: Any, when: float) -> tuple[Any, Any]:
    place = np.array([np.interp(when, course.t_s, course.xyz_m[:, k]) for k in range(3)])
    roll, pitch, yaw = (np.interp(when, course.t_s, course.roll_pitch_yaw[:, k]) for k in range(3))
    return place, Attitude(roll, pitch, yaw).matrix() @ bore @ settings.mount.body_from_camera()


def _homography(
    course: Course, settings: SimulationSettings, imagery: Imagery, bore: Any, when: float
) -> Any:
    # Imagery pixel from frame pixel, both with whole numbers at centres.
    place, cam = _camera_at(course, settings, bore, when)
    lens = settings.camera
    inverse = np.linalg.inv(np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]]))
    ground = np.array([[place[2], 0, -place[0]], [0, place[2], -place[1]], [0, 0, -1.0]])
    to_image = np.array(
        [
            [1, 0, -imagery.left - imagery.gsd_m / 2],
            [0, -1, imagery.top - imagery.gsd_m / 2],
            [0, 0, imagery.gsd_m],
        ]
    )
    return to_image @ ground @ cam @ inverse


def _footpoints(
    course: Course,
    settings: SimulationSettings,
    imagery: Imagery,
    rays: Any,
    bore: Any,
    when: float,
    condition: Condition,
) -> tuple[Any, Any]:
    (x, y, z), cam = _camera_at(course, settings, bore, when)
    world = rays @ cam.T.astype(np.float32)
    reach = z / -np.minimum(world[..., 2], -0.05)
    for _ in range(4 if condition.hills_m else 0):
        ground = hill(condition, x + world[..., 0] * reach, y + world[..., 1] * reach)
        reach = (z - ground) / -world[..., 2]
    columns = (x - imagery.left + world[..., 0] * reach) / imagery.gsd_m - 0.5
    rows = (imagery.top - y - world[..., 1] * reach) / imagery.gsd_m - 0.5
    return columns.astype(np.float32), rows.astype(np.float32)


def hill(condition: Condition, x: Any, y: Any) -> Any:
    """Height of the ground, metres: waves of 300 m."""
    return (
        condition.hills_m
        * np.sin(np.asarray(x) * (2 * np.pi / 300.0))
        * np.cos(np.asarray(y) * (2 * np.pi / 300.0))
    )


def heights_of(n: int, kind: str) -> Any:
    """(n,) heights of the region's buildings: houses of 3-20 m, or towers of 40-60 m on a third of them."""
    rng = np.random.default_rng(11)
    low = rng.choice([3.0, 6.0, 9.0, 12.0, 20.0], n, p=[0.35, 0.3, 0.15, 0.12, 0.08])
    return np.where(rng.random(n) < 0.33, rng.uniform(40.0, 60.0, n), low) if kind == "towers" else low


def fly_once(condition: Condition, seed: int, imagery: Imagery, ground: Any) -> dict[str, float]:
    settings = settings_of(condition)
    extent = (
        imagery.left,
        imagery.top - imagery.rgb.shape[0] * imagery.gsd_m,
        imagery.left + imagery.rgb.shape[1] * imagery.gsd_m,
        imagery.top,
    )
    course = fly(place_of(seed, extent), settings, seed)
    if condition.buildings:
        raised = replace(ground, height_m=heights_of(len(ground.height_m), condition.buildings))
        simulator = Simulator(raised, settings, course, seed)
        images: Iterator[Any] = cached(
            f"{condition.buildings}-{condition.hz:g}-{seed}",
            len(course.frame_index),
            lambda i: cv2.cvtColor(simulator.picture(i, imagery), cv2.COLOR_RGB2GRAY),
        )
    else:
        images = draw_flat(course, settings, imagery, condition, seed)
    imu = imu_of(course, seed)
    imu = replace(imu, t_s=imu.t_s + condition.delay_s)
    rng = np.random.default_rng([seed, 6])
    truth = course.xyz_m[course.frame_index]
    times = course.frame_times_s
    agl = (
        truth[:, 2]
        - hill(condition, truth[:, 0], truth[:, 1])
        + settings.agl_error_m * (rng.normal() + rng.normal(size=len(times)))
        + condition.agl_bias_m
    )
    spent = [0.0]
    keep = np.ones(len(times), dtype=bool)
    if condition.blind_s is not None:
        keep = (times < condition.blind_s[0]) | (times > condition.blind_s[1])

    def watched() -> Iterator[Any]:
        for wanted, image in zip(keep, images):
            if wanted:
                begin = time.process_time()
                yield image
                spent[0] += time.process_time() - begin

    result = run_vio(
        times[keep],
        watched(),
        agl[keep],
        imu,
        settings.camera,
        settings.mount,
        replace(VioSettings(), **condition.vio),
    )
    return score(result, truth[keep], course.roll_pitch_yaw[course.frame_index][keep, 2], spent[0])


def cached(name: str, count: int, draw: Any) -> Iterator[Any]:
    """Frames of a flight with buildings, kept as a file below the system's temporary folder: they take minutes to draw."""
    import tempfile

    folder = Path(tempfile.gettempdir()) / "brmgeo-bench-odometry"
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.npy"
    if path.exists():
        yield from np.load(path, mmap_mode="r")
        return
    first = draw(0)
    part = path.with_suffix(f".{os.getpid()}.part")
    frames = np.lib.format.open_memmap(part, mode="w+", dtype=np.uint8, shape=(count, *first.shape))
    for i in range(count):
        frames[i] = draw(i)
        yield frames[i]
    frames.flush()
    part.rename(path)


def score(result: VioResult, truth: Any, yaw: Any, seconds: float) -> dict[str, float]:
    """Errors of a track that starts at the true position and yaw; nothing else is aligned."""
    w, x, y, z = result.odometry.wxyz.T
    own = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    turn = yaw[0] - own[0]
    c, s = math.cos(turn), math.sin(turn)
    xy = (result.odometry.xyz_m[:, :2] - result.odometry.xyz_m[0, :2]) @ np.array([[c, s], [-s, c]]) + truth[
        0, :2
    ]
    error = np.hypot(*(xy - truth[:, :2]).T)
    heading = np.degrees(np.angle(np.exp(1j * (own + turn - yaw))))
    steps = np.linalg.norm(np.diff(truth[:, :2], axis=0), axis=1)
    flown = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    # Steps of five seconds, as the matcher takes them, against what the filter says of them; scale and heading taken out.
    stride = max(1, round(5.0 / float(np.median(np.diff(result.odometry.t_s)))))
    a, b = (p[stride::stride] - p[:-stride:stride] for p in (xy, truth[:, :2]))
    m = min(len(a), len(b))
    za, zb = a[:m] @ [1, 1j], b[:m] @ [1, 1j]
    fit = np.vdot(za, zb) / np.vdot(za, za)
    # As motions() hands it to the matchers: not better than 2 cm.
    sigma = np.sqrt(np.maximum(np.diff(result.walk_m2[::stride])[:m], MIN_STEP_NOISE_M**2))
    miss = np.abs(za * fit - zb)
    return {
        "rmse": float(np.sqrt((error**2).mean())),
        "end": float(error[-1]),
        "heading": float(np.sqrt((heading**2).mean())),
        "scale": float(flown.sum() / steps.sum() - 1.0),
        "step_error": float(np.sqrt((miss**2).mean() / 2)),
        "step_sigma": float(np.sqrt((sigma**2).mean())),
        "step_nees": float((miss**2 / sigma**2).mean() / 2),
        "delay_ms": 1000.0 * result.delay_s,
        "boresight_roll": math.degrees(result.boresight_rad[0]),
        "boresight_pitch": math.degrees(result.boresight_rad[1]),
        "boresight_yaw": math.degrees(result.boresight_rad[2]),
        "boresight_yaw_sigma": math.degrees(result.boresight_sigma_rad[2]),
        "blind": float(result.blind.mean()),
        "high": result.high_share,
        "tracks": float(result.tracks.mean()),
        "fps": len(xy) / seconds,
        "length": float(steps.sum()),
    }


def read_demo() -> tuple[Imagery, Any]:
    from brmgeo.geo.raster import read_raster
    from brmgeo.synth.mission import read_ground

    folder = ROOT / "data" / "out" / "demo"
    if not (folder / "imagery.tif").is_file():
        sys.exit("data/out/demo is not there: run `make maps` first")
    drawn = read_raster(folder / "imagery.tif")
    rgb = np.ascontiguousarray(np.moveaxis(drawn.pixels, 0, -1))
    return Imagery(rgb, drawn.left, drawn.top, drawn.gsd_m), read_ground(folder / "footprints.gpkg")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="conditions (default: all)")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument(
        "--results", type=Path, help="JSON lines: what is there is not flown again, new rows are added."
    )
    parser.add_argument(
        "--done-only", action="store_true", help="Fly nothing: the table of what --results holds."
    )
    parser.add_argument("--write", action="store_true", help="Write the table to docs/odometry.md.")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    imagery, ground = read_demo()
    done: dict[tuple[str, int], dict[str, float]] = {}
    if given.results is not None and given.results.exists():
        for line in given.results.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            done[row.pop("condition"), row.pop("seed")] = row
    unknown = set(given.names) - {c.name for c in CONDITIONS}
    if unknown:
        sys.exit(f"no such condition: {', '.join(sorted(unknown))}")
    chosen = sorted(CONDITIONS, key=lambda c: given.names.index(c.name) if c.name in given.names else 99)
    chosen = [c for c in chosen if not given.names or c.name in given.names]
    # All conditions once, then all of them again: what is stopped early still has every row.
    for seed in range(given.first, given.first + given.seeds):
        for condition in chosen:
            if (condition.name, seed) in done or given.done_only:
                continue
            row = done[condition.name, seed] = fly_once(condition, seed, imagery, ground)
            if given.results is not None:
                with given.results.open("a", encoding="utf-8") as out:
                    out.write(json.dumps({"condition": condition.name, "seed": seed} | row) + "\n")
            print(condition.name, seed, {k: round(v, 3) for k, v in row.items()}, flush=True)
    lines = []
    for condition in chosen:
        rows = [done[condition.name, s] for s in range(1, 100) if (condition.name, s) in done]
        if rows:
            lines.append(table_row(condition, rows))
            print(lines[-1], flush=True)
    if given.write:
        write(lines)


def table_row(condition: Condition, rows: list[dict[str, float]]) -> str:
    def of(key: str) -> Any:
        return np.array([r[key] for r in rows])

    rmse = of("rmse")
    return (
        f"| {condition.name} | {condition.says} | {len(rows)} | {np.mean(rmse):.2f} ({rmse.min():.2f}-{rmse.max():.2f}) | "
        f"{of('end').mean():.2f} | {of('heading').mean():.2f} | {100 * np.abs(of('scale')).mean():.2f} | "
        f"{of('step_error').mean():.2f} / {of('step_sigma').mean():.2f} | "
        f"{of('step_nees').mean():.1f} | {of('delay_ms').mean():.1f} | "
        f"{of('boresight_roll').mean():+.2f}, {of('boresight_pitch').mean():+.2f}, {of('boresight_yaw').mean():+.2f} | "
        f"{of('fps').mean():.0f} |"
    )


HEAD = (
    "| condition | | seeds | RMSE m (range) | end m | heading deg | scale % | 5 s step m: error / sigma | squared | "
    "delay ms | boresight deg | frames/s |\n|---|---|---|---|---|---|---|---|---|---|---|---|"
)


def write(lines: list[str]) -> None:
    begin, end = "<!-- bench-odometry -->", "<!-- /bench-odometry -->"
    text = TABLE.read_text(encoding="utf-8")
    before, _, rest = text.partition(begin)
    _, _, after = rest.partition(end)
    table = f"{begin}\n{HEAD}\n" + "\n".join(lines) + f"\n{end}"
    TABLE.write_text(before + table + after, encoding="utf-8")


if __name__ == "__main__":
    main()
