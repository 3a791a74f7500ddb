"""Who may know whom: the imports between the rooms of the house are held against the picture in docs/ARCHITECTURE.md."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# Floor 1: what every room stands on.
FOUNDATION = {
    "brmgeo.errors",
    "brmgeo.codes",
    "brmgeo.files",
    "brmgeo.settings",
    "brmgeo.pictures",
    "brmgeo.extras",
    "brmgeo.memory",
}
VALUES = FOUNDATION | {
    "brmgeo.region",
    "brmgeo.geo",
    "brmgeo.flight.values",
    "brmgeo.flight.readings",
    "brmgeo.flight.frames",
    "brmgeo.flight.camera",
}
KERNELS = {
    "brmgeo.maps.ratio",
    "brmgeo.match",
    "brmgeo.flight.view",
    "brmgeo.flight.motion",
    "brmgeo.flight.checks",
    "brmgeo.flight.vio",
    "brmgeo.flight.klt",
    "brmgeo.flight.planar",
    "brmgeo.segment.unet",
    "brmgeo.segment.encoder",
    "brmgeo.segment.augment",
    "brmgeo.segment.metrics",
    "brmgeo.segment.tiles",
    "brmgeo.segment.alignment",
}
ADAPTERS = {
    "brmgeo.geo.raster",
    "brmgeo.ingest",
    "brmgeo.export",
    "brmgeo.flight.folder",
    *(
        f"brmgeo.flight.logs.{name}"
        for name in ("ardupilot", "mavlink", "photos", "rosbag", "text", "ulog", "values")
    ),
    "brmgeo.flight.odometry",
    "brmgeo.flight.poses",
    "brmgeo.flight.tables",
    "brmgeo.flight.video",
    "brmgeo.flight.write",
    "brmgeo.segment.pairs",
    "brmgeo.segment.shards",
}
# What each room may import besides itself and plain values; everything not named here may not be known.
MAY_KNOW = {
    "brmgeo.errors": set[str](),
    "brmgeo.codes": set[str](),
    "brmgeo.files": {"brmgeo.errors"},
    "brmgeo.settings": {"brmgeo.errors", "brmgeo.files"},
    "brmgeo.pictures": {"brmgeo.errors", "brmgeo.files"},
    "brmgeo.extras": {"brmgeo.errors"},
    "brmgeo.memory": {"brmgeo.errors"},
    "brmgeo.region": FOUNDATION,
    "brmgeo.geo": FOUNDATION,
    "brmgeo.geo.raster": {"brmgeo.codes", "brmgeo.errors", "brmgeo.geo.grid", "brmgeo.geo.formats"},
    "brmgeo.flight.values": set[str](),
    "brmgeo.maps": VALUES,
    "brmgeo.match": VALUES | {"brmgeo.maps.ratio", "brmgeo.flight.view"},
    "brmgeo.flight": VALUES | {"brmgeo.maps.ratio"},
    "brmgeo.ingest": VALUES,
    "brmgeo.export": VALUES,
    "brmgeo.evaluate": VALUES | {"brmgeo.flight", "brmgeo.match", "brmgeo.locate", "brmgeo.synth"},
    "brmgeo.synth": VALUES | {"brmgeo.flight", "brmgeo.maps", "brmgeo.ingest"},
    "brmgeo.segment": VALUES | {"brmgeo.maps"},
    "brmgeo.segment.ground": VALUES | {"brmgeo.segment", "brmgeo.maps", "brmgeo.flight", "brmgeo.synth"},
    "brmgeo.locate": VALUES | {"brmgeo.flight", "brmgeo.match", "brmgeo.segment"},
    "brmgeo.workflow": FOUNDATION | {"brmgeo"},
}
# Libraries that live in one room only.
ONLY_IN = {
    "dask": {"brmgeo.workflow"},
    "distributed": {"brmgeo.workflow"},
    "torch": {"brmgeo.segment"},
    "safetensors": {"brmgeo.segment"},
    "onnx": {"brmgeo.segment"},
    "onnxscript": {"brmgeo.segment"},
    "onnxruntime": {"brmgeo.segment"},
    "ezdxf": {"brmgeo.ingest.dxf", "brmgeo.synth"},
    "httpx": {"brmgeo.ingest"},
    "rosbags": {"brmgeo.flight.logs"},
    "pyulog": {"brmgeo.flight.logs"},
    "pymavlink": {"brmgeo.flight.logs"},
}
FORBIDDEN_IN_KERNELS = {"pathlib", "rasterio", "pyproj", "geopandas", "pyogrio", "logging"}


def modules() -> dict[str, Path]:
    found = {}
    for folder in ("brmgeo", "pipelines"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def origin(node: ast.ImportFrom, path: Path) -> str:
    """What names are imported from; a relative import counts from the module's own package."""
    package = path.relative_to(ROOT).parent.parts
    above = package[: len(package) - node.level + 1] if node.level else ()
    return ".".join([*above, *([node.module] if node.module else [])])


def imports_of(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = origin(node, path)
            names |= {base} | {f"{base}.{alias.name}" for alias in node.names}
    return names


def inside(name: str, room: str) -> bool:
    return name == room or name.startswith(room + ".")


def room_of(module: str) -> str | None:
    rooms = [room for room in MAY_KNOW if inside(module, room)]
    return max(rooms, key=len) if rooms else None


@pytest.mark.parametrize("module", sorted(modules()))
def test_a_room_knows_only_what_the_picture_allows(module: str) -> None:
    known = set(modules())
    own = {name for name in imports_of(modules()[module]) if name in known and name != "brmgeo"}
    if inside(module, "pipelines"):
        return
    room = room_of(module)
    if room is None:
        # The face names what the rooms offer, and the entry point finds the wiring.
        assert module in ("brmgeo", "brmgeo.__main__"), (
            f"{module} belongs to no room: add it to docs/ARCHITECTURE.md and to this test"
        )
        return
    for name in own:
        allowed = inside(name, room) or any(inside(name, other) for other in MAY_KNOW[room])
        assert allowed, f"{module} imports {name}: a new arrow; {room} may know {sorted(MAY_KNOW[room])}"


@pytest.mark.parametrize("module", sorted(modules()))
def test_kernels_and_adapters_do_not_know_each_other(module: str) -> None:
    own = imports_of(modules()[module])
    kernel = any(inside(module, name) for name in KERNELS)
    adapter = any(inside(module, name) for name in ADAPTERS) and module not in VALUES
    if kernel:
        assert not {n for n in own for a in ADAPTERS if inside(n, a) and n not in VALUES}
        assert not {n for n in own if n.split(".")[0] in FORBIDDEN_IN_KERNELS}, (
            "a kernel takes arrays and numbers"
        )
    if adapter:
        assert not {n for n in own for k in KERNELS if inside(n, k)}


@pytest.mark.parametrize("module", sorted(modules()))
def test_libraries_stay_in_their_room(module: str) -> None:
    top = {name.split(".")[0] for name in imports_of(modules()[module])}
    for library, rooms in ONLY_IN.items():
        if library in top:
            assert any(inside(module, room) for room in rooms), f"{module} imports {library}"
    # The entry point finds the wiring by name, beside the library or below it.
    assert "pipelines" not in top or inside(module, "pipelines") or module == "brmgeo.__main__"


def graph() -> dict[str, set[str]]:
    """Every module and the modules that it imports, at its top or inside a function, by the names that it writes."""
    known = modules()
    found = {}
    for module, path in known.items():
        named = set[str]()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                named |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                base = origin(node, path)
                # ``from room import name`` is of the module ``room.name`` where there is one, else of the room's face.
                for alias in node.names:
                    inner = f"{base}.{alias.name}"
                    named.add(inner if inner in known else base)
        found[module] = {name for name in named if name in known and name != module}
    return found


def circles(arrows: dict[str, set[str]]) -> list[list[str]]:
    """The strongly connected components of more than one module, after Tarjan."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(arrows.get(node, ())):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            component = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(component) > 1:
                found.append(sorted(component))

    for node in sorted(arrows):
        if node not in index:
            visit(node)
    return found


def test_no_modules_import_each_other_in_a_circle() -> None:
    assert circles(graph()) == []


def test_a_circle_would_be_found() -> None:
    assert circles({"a": {"b"}, "b": {"c", "d"}, "c": {"a"}, "d": set()}) == [["a", "b", "c"]]


def test_json_and_toml_have_one_reader_each() -> None:
    """What people give may be nested without end, hold odd numbers or be no UTF-8: that is met in one place."""
    readers = {"json.load", "json.loads", "tomllib.load", "tomllib.loads"}
    found = set()
    for module, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and ast.unparse(node) in readers:
                found.add((module, ast.unparse(node)))
    assert found == {("brmgeo.files", "json.loads"), ("brmgeo.settings", "tomllib.loads")}


def test_gdal_opens_what_was_looked_at_first() -> None:
    """Rasters go through open_raster, and shapes through vector_file: GDAL follows whatever some formats point to."""
    readers = {
        "pyogrio.read_dataframe",
        "pyogrio.read_info",
        "pyogrio.list_layers",
        "gpd.read_file",
        "gpd.read_parquet",
    }
    # The store's own artifacts.
    own = {"pipelines.map_stages", "brmgeo.export.cog"}
    loose = []
    for module, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            called = ast.unparse(node.func)
            if called == "rasterio.open":
                written = len(node.args) > 1 and ast.unparse(node.args[1]) == "'w'"
                good = written or module in own or module == "brmgeo.geo.formats"
            else:
                good = (
                    called not in readers
                    or module in own
                    or ast.unparse(node.args[0]).startswith("vector_file(")
                )
            if not good:
                loose.append(f"{module}:{node.lineno} {called}")
    assert loose == []
