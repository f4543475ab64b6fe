"""Documentation site: `run/docs` builds it into results/site."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent), str(DOCS)]

import petsc4py
from docutils import nodes
from sphinx import addnodes
from sphinx.transforms import SphinxTransform

petsc4py.init([])  # before modules of pctt take what the command line of sphinx-build says

import index_words
import pages

import pctt

project = "pctt"
author = copyright = "The pctt developers"
release = version = pctt.__version__

extensions = ["myst_parser", "sphinx_copybutton", "sphinx_design"]
extensions += [f"sphinx.ext.{name}" for name in ("autodoc", "napoleon", "mathjax", "viewcode")]
exclude_patterns = ["examples/*", "made/*.md", "paper/*"]
myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

default_role = "code"
napoleon_google_docstring = False
napoleon_use_ivar = True

suppress_warnings = ["ref.python"]  # words of a description that are names of members too

html_theme = "furo"
html_title = f"pctt {release}"  # at the head of every page
# one file of MathJax, so that formulas show without a network
mathjax = Path(importlib.util.find_spec("sphinx-mathjax-offline").origin).parent / "static" / "mathjax" / "tex-svg.js"
html_static_path = ["_static", str(mathjax)]
html_search_scorer = str(DOCS / "scorer.js")
html_show_search_summary = False  # the search would need a server
html_css_files = ["tables.css"]
html_favicon = "_static/icon.svg"
mathjax_path = mathjax.name

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say shapes and units
autodoc_default_options = {"members": True}


COLON = "\ue000"  #: in the place of a colon


def as_text(app, what, name, obj, options, lines: list[str]) -> None:
    """Docstrings are text with formulas in it: |g| is no substitution and g* no emphasis, but within ``literals``.
    Where there are no sections of numpydoc, lines such as "name, other : meaning" become fields."""
    sections = any(line.startswith("---") for line in lines)
    if what in ("attribute", "property") and lines:
        lines[0] = lines[0].replace(":", COLON)  # else napoleon takes the words before it for a type
    if sections:  # a doctest after the last section is none of its parameters
        starts = [i for i, line in enumerate(lines) if line.startswith(">>>") and not lines[i - 1]]
        lines[:] = lines[: starts[0]] + ["Examples", "--------"] + lines[starts[0] :] if starts else lines
    if "Attributes" in lines:  # one line for each: napoleon takes the first one for a type, the others for a text
        start = lines.index("Attributes") + 2
        end = lines.index("", start) if "" in lines[start:] else len(lines)
        lines[start:end] = re.sub(r"\n +", " ", "\n".join(lines[start:end])).split("\n")
    for i, line in enumerate(lines):
        if line.startswith((">>>", "...")):
            continue
        line = line if sections else re.sub(r"^([a-z]\w*(?:, \w+)*) : ", r":\1: ", line)
        if "Attributes" in lines:  # else sphinx takes the first of several names for a type
            line = re.sub(r"^\w+(, \w+)+(?= : )", lambda names: names[0].replace(", ", ",\u2060"), line)
        parts = line.split("``")
        parts[::2] = [re.sub(r"([|*]|_(?=\W|$))", r"\\\1", part) for part in parts[::2]]
        lines[i] = "``".join(parts)


def colons_again(app, what, name, obj, options, lines: list[str]) -> None:
    lines[:] = [line.replace(COLON, ":") for line in lines]


def mark_long_cells(app, doctree, name: str) -> None:
    """Cells of tables with several words are not to be narrow, many columns are to be, and no line ends after the
    hyphen of an option: _static/tables.css."""
    for group in doctree.findall(nodes.tgroup):
        group.parent["classes"] += ["wide"] * (group["cols"] >= 12)
    for code in doctree.findall(nodes.literal):
        code["classes"] += ["option"] * (code.astext().startswith("-") and len(code.astext()) <= 24)
    for cell in doctree.findall(nodes.entry):
        words = len(cell.astext().split())
        cell["classes"] += ["long"] * (words > 10) or ["some"] * (words > 2)


class IndexWords(SphinxTransform):
    """The words of index_words.py become entries of the index, at their headings."""

    default_priority = 700  # before the index is made of the entries

    def apply(self, **kwargs) -> None:
        words = dict(index_words.WORDS.get(self.env.docname, {}))
        for k, section in enumerate(list(self.document.findall(nodes.section))):
            found = words.pop(section[0].astext(), "") if k else words.pop("", "")
            entries = [("single", word, section["ids"][0], "main", None) for word in found.split(", ") if word]
            if entries:
                section.insert(1, addnodes.index(entries=entries))
        if words:
            raise ValueError(f"index_words.py: {self.env.docname} has no headings {', '.join(words)}")


def setup(app) -> None:
    app.add_transform(IndexWords)
    app.connect("autodoc-process-docstring", as_text, priority=100)  # before napoleon
    app.connect("autodoc-process-docstring", colons_again, priority=900)  # after it
    app.connect("doctree-resolved", mark_long_cells)
    pages.write(Path(app.srcdir))
