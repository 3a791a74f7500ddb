"""Fixtures of the workflow tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import workflow_toys as toys


@pytest.fixture(autouse=True)
def _no_calls() -> Iterator[None]:
    toys.CALLS.clear()
    yield
    toys.CALLS.clear()


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A source file that was written long ago."""
    path = tmp_path / "source.txt"
    path.write_text("a bridge over the river\n")
    os.utime(path, (1e9, 1e9))
    return path
