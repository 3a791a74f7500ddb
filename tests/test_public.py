"""The face of the library: its names, what importing it costs, and what a bare installation can do."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import brmgeo
from brmgeo.extras import EXTRAS, extra, told
from brmgeo.pictures import encode

ROOT = Path(__file__).resolve().parents[1]
#: Imported first, it makes this process one without the extras.
BARE = """
import importlib.abc, sys
from brmgeo.extras import EXTRAS
class Gone(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split(".")[0] in set().union(*EXTRAS.values()):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Gone())
"""


def _python(code: str, *, cwd: Path = ROOT, path: Path = ROOT) -> subprocess.CompletedProcess[str]:
    run = [sys.executable, "-c", code]
    return subprocess.run(run, capture_output=True, text=True, cwd=cwd, env={"PYTHONPATH": str(path)})


def test_every_public_name_is_there() -> None:
    assert sorted(brmgeo._ROOMS) == sorted(brmgeo.__all__)
    for name in brmgeo.__all__:
        assert getattr(brmgeo, name).__module__.startswith(brmgeo._ROOMS[name])
        assert name in dir(brmgeo)
    with pytest.raises(AttributeError, match="no attribute 'Localiser'"):
        brmgeo.Localiser  # noqa: B018


def test_importing_brmgeo_takes_nothing_with_it() -> None:
    done = _python("import sys, brmgeo; print(*sys.modules)")
    taken = {name.split(".")[0] for name in done.stdout.split()}
    assert not taken & {"numpy", "click", "cv2", "rasterio", "numba"}
    assert not taken & set().union(*EXTRAS.values())


def test_all_public_names_work_without_the_extras() -> None:
    done = _python(BARE + "import brmgeo\nprint([getattr(brmgeo, name) for name in brmgeo.__all__])")
    assert done.returncode == 0, done.stderr


def _bare_command(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command line of an installation without the extras."""
    argv = ["brmgeo", *arguments]
    return _python(f"{BARE}sys.argv = {argv!r}\nfrom brmgeo.__main__ import main\nmain()")


@pytest.mark.parametrize(
    ("command", "extra"), [(("maps", "demo"), "maps"), (("train", "data/recipes/short.toml"), "train")]
)
def test_what_is_not_installed_is_told_with_its_extra(
    tmp_path: Path, command: tuple[str, ...], extra: str
) -> None:
    done = _bare_command(*command, "--data", str(tmp_path))
    assert done.returncode == 2, done.stderr
    assert f"pip install 'brmgeo[{extra}]'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_masks_of_pictures_need_no_extra_and_those_of_a_raster_name_theirs(tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    (frames / "a.png").write_bytes(encode(np.full((40, 48, 3), 90, np.uint8)))
    done = _bare_command("segment", str(frames), "--out", str(tmp_path / "masks"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "masks" / "a.png").is_file()
    done = _bare_command("segment", str(frames / "a.png"), "--out", str(tmp_path / "mask.tif"))
    assert done.returncode == 2, done.stderr
    assert "pip install 'brmgeo[maps]'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_library_of_no_extra_is_no_matter_of_extras() -> None:
    with pytest.raises(ModuleNotFoundError, match="torch"), extra("logs", "reading logs"):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")
    assert told(ModuleNotFoundError("No module named 'odd'", name="odd"), "this") is None


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as pip makes it of the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, check=True, capture_output=True, cwd=ROOT)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as whole:
        whole.extractall(folder / "site")
    return folder / "site"


def test_the_wheel_installs_one_name(installed: Path) -> None:
    names = {path.name for path in installed.iterdir() if not path.name.endswith(".dist-info")}
    assert names == {"brmgeo"}
    assert (installed / "brmgeo" / "py.typed").is_file()


def test_the_installed_command_finds_regions_recipes_and_weights(installed: Path, tmp_path: Path) -> None:
    code = f"""
import sys
sys.path = [p for p in sys.path if p != {str(ROOT)!r}]
import brmgeo
assert brmgeo.__file__.startswith({str(installed)!r})
from brmgeo.pipelines.regions import recipe_named, region_named
from pathlib import Path
print(region_named("demo", Path("data"))[0].name, recipe_named("short", Path("data")).is_file())
print(brmgeo.Segmenter.load().card.sha256)
sys.argv = ["brmgeo", "status", "demo"]
from brmgeo.__main__ import main
main()
"""
    done = _python(code, cwd=tmp_path, path=installed)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("demo True\n")
    assert "buildings" in done.stdout


@pytest.mark.slow  # kernels are compiled anew where the wheel is unpacked
def test_the_installed_command_locates_as_the_checkout_does(
    installed: Path, maps: Path, whole: Path, results: Path, tmp_path: Path
) -> None:
    words = ["localize", "--maps", str(maps), "--flight", str(whole), "--out", str(tmp_path / "out")]
    code = f"""
import sys
sys.path = [p for p in sys.path if p != {str(ROOT)!r}]
sys.argv = ["brmgeo", *{words!r}]
from brmgeo.__main__ import main
main()
"""
    done = _python(code, cwd=tmp_path, path=installed)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "fixes.csv").read_bytes() == (results / "mask" / "fixes.csv").read_bytes()
