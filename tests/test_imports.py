"""Who imports whom: no circles, and what each package may know of."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def modules():
    """The files of dem and pctt by the names of their modules."""
    found = {}
    for path in sorted([*ROOT.glob("dem/**/*.py"), *ROOT.glob("pctt/**/*.py")]):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(path):
    """All names that a file imports: anywhere in it, also in functions and for type checkers only."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def longest_known(name, known):
    """The module that a dotted name is, or lies in; None for those of others."""
    while name and name not in known:
        name = name.rpartition(".")[0]
    return name or None


@pytest.fixture(scope="module")
def graph():
    known = modules()
    return {name: {longest_known(n, known) for n in imported(path)} - {None, name} for name, path in known.items()}


def test_no_module_imports_itself_in_a_circle(graph):
    order = list(TopologicalSorter(graph).static_order())  # a CycleError names the circle
    assert order.index("dem.world") < order.index("dem.contact") < order.index("dem.start")


#: What the modules of each part may import of the project, beside those of the same part.
ALLOWED = {
    "dem": set(),
    "pctt.tt": {"pctt.compiled"},
}


@pytest.mark.parametrize("part", ALLOWED)
def test_a_part_knows_only_of_those_below_it(graph, part):
    own = {name for name in graph if name == part or name.startswith(part + ".")}
    others = {(name, other) for name in own for other in graph[name] - own - ALLOWED[part] - {"pctt"}}
    assert not others


def test_mechanics_and_trains_know_nothing_of_petsc():
    for name, path in modules().items():
        if name.startswith(("dem", "pctt.tt")):
            assert not any(other.startswith("petsc4py") for other in imported(path)), name

