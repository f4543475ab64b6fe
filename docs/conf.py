"""Documentation site: `run/docs` builds it into results/site."""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import petsc4py

petsc4py.init([])  # before modules of pctt take what the command line of sphinx-build says

import pctt
from pctt.run.help import help_text

project = "pctt"
author = copyright = "The pctt developers"
release = version = pctt.__version__

extensions = ["myst_parser", "sphinx_copybutton"]
extensions += [f"sphinx.ext.{name}" for name in ("autodoc", "napoleon", "mathjax", "viewcode")]
exclude_patterns = ["examples/*"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3

default_role = "code"
napoleon_google_docstring = False

suppress_warnings = ["ref.python"]  # words of a description that are names of members too

html_theme = "furo"
html_title = f"pctt {release}"

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say shapes and units
autodoc_default_options = {"members": True, "show-inheritance": False}


def as_text(app, what, name, obj, options, lines: list[str]) -> None:
    """Docstrings are text with formulas in it: |g| is no substitution and g* no emphasis, but within ``literals``."""
    for i, line in enumerate(lines):
        parts = line.split("``")
        parts[::2] = [re.sub(r"([|*]|_(?=\W|$))", r"\\\1", part) for part in parts[::2]]
        lines[i] = "``".join(parts)


def setup(app) -> None:
    app.connect("autodoc-process-docstring", as_text, priority=100)  # before napoleon
    text = help_text({})
    (Path(app.srcdir) / "options.txt").write_text(text + "\n")
