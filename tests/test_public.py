"""The face of the library: its names, what importing it costs, and what a bare installation can do."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import brmgeo
from brmgeo.extras import EXTRAS

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


def test_what_is_not_installed_is_told_with_its_extra(tmp_path: Path) -> None:
    command = f"import sys; sys.argv = ['brmgeo', 'maps', 'demo', '--data', {str(tmp_path)!r}]"
    code = f"{BARE}{command}\nfrom brmgeo.__main__ import main\nmain()"
    done = _python(code)
    assert done.returncode == 2, done.stderr
    assert "pip install 'brmgeo[maps]'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


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
