"""The documentation site: `make docs` builds it, warnings are errors."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from brmgeo import __version__  # noqa: E402

project = "brmgeo"
author = "the brmgeo authors"
copyright = "the brmgeo authors, Apache-2.0"
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
templates_path = ["_templates"]
html_theme = "furo"
html_title = f"brmgeo {version}"
html_static_path: list[str] = []
myst_heading_anchors = 3
myst_enable_extensions = ["deflist"]

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "undoc-members": False, "show-inheritance": False}
# Arrays by their alias, not by the union that it stands for.
autodoc_type_aliases = {name: name for name in ("FloatArray", "F64", "F32", "U8", "Objects")}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
# Words of attributes, such as "cells", are no references.
suppress_warnings = ["ref.python"]
