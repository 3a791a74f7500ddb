"""The ``brmgeo`` command, also as ``python -m brmgeo``.

The wiring stands beside the library in a checkout, and below it where a wheel was installed.
"""

from __future__ import annotations

import importlib


def main() -> None:
    """Run the command line; it exits with 0, 2 for a known error, 70 for a defect, 130 when interrupted."""
    try:
        cli = importlib.import_module("brmgeo.pipelines.cli")
    except ModuleNotFoundError as error:
        if error.name not in ("brmgeo.pipelines", "brmgeo.pipelines.cli"):
            raise
        cli = importlib.import_module("pipelines.cli")
    cli.main()


if __name__ == "__main__":
    main()
