"""Nothing phones home, and nothing is written outside of the project but into the user's cache folder.

Python's own sockets are forbidden in every test (tests/conftest.py). What compiled libraries do is seen from outside: each
command runs in processes that strace watches, with a home and a temporary folder that are empty.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyproj.network
import pytest
from small_maps import SmallRegion
from small_recipes import TINY

from brmgeo import files
from pipelines.cli import cli

ROOT = Path(__file__).resolve().parents[2]
#: What every command is watched doing; words in braces are of ``Ground``.
COMMANDS = {
    "evaluate": "--maps {maps} --flights 1 --path {waypoints} --methods mask --masks true,network --out out",
    "export": "{results}/mask --out path.gpkg --crs EPSG:4326",
    "export-onnx": "--out net.onnx",
    "import": "{pictured}/odometry.tum --out imported --rate 2",
    "inspect": "{pictured}",
    "localize": "--maps {maps} --flight {pictured} --sift --out out",
    "maps": "small --data {data} --scheduler local",
    "new-region": "there --data {data} --sheets 37807039",
    "odometry": "{filmed}",
    "segment": "{pictured} --out masks",
    "simulate": "--maps {maps} --path {waypoints} --mode frames --interval 5 --out flight",
    "status": "small --data {data} --verify",
    "tiles": "small --data {data} --gsd 1",
    "train": "--data {data} --recipe tiny.toml --out trained",
    "why": "small ratio --data {data}",
}
#: System calls that reach out or leave something behind.
_NET = ("connect", "sendto", "sendmsg", "sendmmsg")
_MAKE = ("open", "openat", "creat", "mkdir", "mkdirat", "rename", "renameat", "renameat2", "symlink", "link")


@dataclass(frozen=True)
class Seen:
    """What a watched run did: its status and messages, hosts that it turned to, paths that it made or opened to write."""

    status: int
    said: str
    hosts: set[str]
    written: set[str]


def _environment(home: Path) -> dict[str, str]:
    """A first day: an empty home with an empty temporary folder, and no word to any library (`CI` alone silences some)."""
    (home / "tmp").mkdir(parents=True)
    return {
        "HOME": str(home),
        "TMPDIR": str(home / "tmp"),
        "PYTHONPATH": str(ROOT),
        "PATH": os.environ["PATH"],
    }


def _left(home: Path) -> list[str]:
    return sorted(str(path.relative_to(home)) for path in home.rglob("*") if path != home / "tmp")


@pytest.fixture(scope="session")
def strace() -> str:
    tool = shutil.which("strace")
    if tool is None:
        pytest.skip("no strace to watch with (apt-get install strace)")
    tried = subprocess.run([tool, "-f", "-qq", "-o", os.devnull, "true"], capture_output=True, text=True)
    if tried.returncode:
        pytest.skip(f"strace may not watch here: {tried.stderr.strip()}")
    return tool


def watch(strace: str, words: list[str], folder: Path, home: Path) -> Seen:
    """Runs ``words`` in ``folder`` under strace."""
    log = folder.parent / f"{folder.name}.strace"
    calls = "trace=" + ",".join((*_NET, *_MAKE))
    done = subprocess.run(
        [strace, "-f", "-qq", "-y", "--seccomp-bpf", "-o", log, "-e", calls, *words],
        capture_output=True, text=True, cwd=folder, env=_environment(home),
    )  # fmt: skip
    hosts, written = set[str](), set[str]()
    for line in log.read_text(errors="replace").splitlines():
        call = re.match(r"\d+ +(\w+)\(", line)
        if call is None:
            continue
        if call[1] in _NET:
            hosts |= set(re.findall(r'(?:inet_addr\(|inet_pton\(AF_INET6, )"([^"]*)"', line))
        elif call[1] not in ("open", "openat") or re.search(r"O_(CREAT|WRONLY|RDWR|TMPFILE)", line):
            base = re.search(r"\(\w+<([^>]*)>, ", line)
            name = re.findall(r'"([^"]*)"', line)[-1]
            written.add(os.path.normpath(os.path.join(base[1] if base else folder, name)))
    return Seen(done.returncode, done.stdout + done.stderr, hosts, written)


@dataclass(frozen=True)
class Ground:
    """What the commands work on; ``data`` and ``filmed`` are written into."""

    maps: Path
    waypoints: Path
    pictured: Path
    results: Path
    data: Path
    filmed: Path


@pytest.fixture
def ground(
    maps: Path,
    waypoints: Path,
    pictured: Path,
    results: Path,
    filmed: Path,
    built: SmallRegion,
    request: pytest.FixtureRequest,
    tmp_path: Path,
) -> Iterator[Ground]:
    project = tmp_path / "project"
    region = built.copied_to(project / "data", store=request.node.callspec.params["name"] != "maps")
    shutil.copytree(filmed, project / "filmed")
    (project / "tiny.toml").write_text(TINY.split('[[source]]\nname = "flown"')[0])
    given = (maps, pictured, results)
    before = [sorted(files.files_below(folder)) for folder in given]
    yield Ground(maps, waypoints, pictured, results, region.data, project / "filmed")
    # A folder that is read from is left as it was: no statistics, journals or overviews beside a user's files.
    assert [sorted(files.files_below(folder)) for folder in given] == before


def test_every_command_is_watched() -> None:
    assert COMMANDS.keys() == cli.commands.keys()


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_turns_to_nobody_and_writes_in_its_places(
    strace: str, ground: Ground, name: str, tmp_path: Path
) -> None:
    project, home = tmp_path / "project", tmp_path / "home"
    words = [word.format_map(vars(ground)) for word in COMMANDS[name].split()]
    seen = watch(strace, [sys.executable, "-m", "brmgeo", name, *words], project, home)
    assert seen.status == 0, seen.said
    assert {host for host in seen.hosts if not host.startswith("127.") and host != "::1"} == set()
    # Compiled kernels stand beside the code where that may be written, as Python's own do.
    own = (
        str(project),
        str(home / ".cache" / "brmgeo"),
        str(home / "tmp"),
        "/dev/",
        "/proc/",
        "/var/lib/libuuid/",
    )
    astray = {path for path in seen.written if not path.startswith(own) and "/__pycache__" not in path}
    assert astray <= {str(home / ".cache")}
    assert all(left.startswith(".cache/brmgeo") or left == ".cache" for left in _left(home))


@pytest.mark.slow
def test_the_watch_sees_a_query_and_a_file(strace: str, tmp_path: Path) -> None:
    """A library that does what is forbidden, in compiled code, is found out."""
    (tmp_path / "project").mkdir()
    code = "import ctypes; ctypes.CDLL(None).getaddrinfo(b'telemetry.invalid', None, None, ctypes.byref(ctypes.c_void_p()))"
    code += "; from pathlib import Path; (Path.home() / 'id').touch()"
    words = [sys.executable, "-c", code]
    seen = watch(strace, words, tmp_path / "project", tmp_path / "home")
    assert seen.status == 0, seen.said
    assert str(tmp_path / "home" / "id") in seen.written
    resolver = re.findall(r"^nameserver +(\S+)", Path("/etc/resolv.conf").read_text(), re.MULTILINE)
    assert seen.hosts & set(resolver or ["127.0.0.1"])


def test_a_network_that_is_loaded_leaves_nothing_behind(tmp_path: Path) -> None:
    """ONNX Runtime writes a device id as soon as it is imported, and looks for its host soon after, unless told not to."""
    code = "import brmgeo; brmgeo.Segmenter.load()"
    environment = _environment(tmp_path / "home")
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env=environment)
    assert _left(tmp_path / "home") == []


def test_transformations_take_no_grids_from_the_network() -> None:
    if os.environ.get("PROJ_NETWORK", "").upper() in ("", "OFF"):
        assert not pyproj.network.is_network_enabled()


@pytest.mark.parametrize(
    ("system", "environment", "place"),
    [
        ("linux", {}, "home/.cache/brmgeo"),
        ("linux", {"XDG_CACHE_HOME": "relative"}, "home/.cache/brmgeo"),
        ("linux", {"XDG_CACHE_HOME": "/caches"}, "/caches/brmgeo"),
        ("darwin", {"XDG_CACHE_HOME": "/caches"}, "home/Library/Caches/brmgeo"),
        ("win32", {}, "home/AppData/Local/brmgeo"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/brmgeo"),
    ],
)
def test_caches_are_where_the_system_keeps_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, system: str, environment: dict[str, str], place: str
) -> None:
    monkeypatch.setattr("sys.platform", system)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert files.user_cache() == tmp_path / place


def test_tests_reach_this_machine_alone() -> None:
    with pytest.raises(AssertionError, match=r"telemetry\.invalid: tests never leave this machine"):
        socket.getaddrinfo("telemetry.invalid", 443)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        with pytest.raises(AssertionError, match="never leave"):
            own.sendto(b"", ("192.0.2.1", 53))
        with pytest.raises(AssertionError, match="never leave"):
            own.connect(("192.0.2.1", 53))
