from __future__ import annotations

import pytest
from small_maps import SmallRegion, make_source

from pipelines.cli import cli, run


@pytest.fixture(autouse=True)
def serial(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCHEDULER", "serial")


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> SmallRegion:
    """The small region with all its maps; never change it, take a copy."""
    region = make_source(tmp_path_factory.mktemp("small"))
    words = ["maps", "small", "--data", str(region.data), "--scheduler", "serial"]
    assert run(lambda: cli(words, standalone_mode=False)) == 0
    return region
