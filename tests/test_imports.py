"""Who imports whom: no circles, and what each package may know of."""

from __future__ import annotations

import ast
import functools
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@functools.cache
def modules():
    """The files of dem and pctt by the names of their modules."""
    found = {}
    for path in sorted([*ROOT.glob("dem/**/*.py"), *ROOT.glob("pctt/**/*.py")]):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def names_in(node, when_it_runs=False):
    """All names that a piece of code imports: anywhere in it, also in functions and for type checkers only; or those
    alone that are imported when it runs, none for type checkers."""
    if when_it_runs and isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return
    for below in ast.iter_child_nodes(node):
        if isinstance(below, ast.Import):
            yield from (alias.name for alias in below.names)
        elif isinstance(below, ast.ImportFrom):
            assert below.level == 0, "relative import"
            yield from (f"{below.module}.{alias.name}" for alias in below.names)
        elif isinstance(below, ast.stmt | ast.excepthandler | ast.match_case):  # no expression imports
            yield from names_in(below, when_it_runs)


@functools.cache
def tree(path):
    return ast.parse(path.read_text())


@functools.cache
def imported(path, when_it_runs=False):
    return {*names_in(tree(path), when_it_runs)}


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
    assert order.index("dem.model.world") < order.index("dem.contact") < order.index("dem.start")


@pytest.mark.parametrize(("package", "most"), [("dem", 15), ("pctt", 20), ("", 27)])
def test_a_chain_of_imports_is_no_longer_than_it_was(package, most):
    known = {name: path for name, path in modules().items() if within(name, package or name)}
    names = {name: imported(path, when_it_runs=True) for name, path in known.items()}
    graph = {name: {longest_known(n, known) for n in names[name]} - {None, name} for name in known}
    floors = {}
    for name in TopologicalSorter(graph).static_order():
        floors[name] = 1 + max((floors[other] for other in graph[name]), default=0)
    assert max(floors.values()) <= most, max(floors, key=floors.get)


#: The packages of dem, each above those before it; what lies flat in dem is below them or a door to them.
PACKAGES = (
    "geometry", "contact_map", "shapes", "measures", "parts", "model", "unconstrained", "contact", "start", "step",
    "record",
)  # fmt: skip


def test_a_package_of_dem_imports_those_below_it_alone(graph):
    floor = {f"dem.{name}": n for n, name in enumerate(PACKAGES)}
    for name, others in graph.items():
        for other in others:
            here, there = (floor.get(".".join(each.split(".")[:2])) for each in (name, other))
            assert here is None or there is None or there <= here, f"{name} imports {other}"


#: The parts of the house, each with those whose modules it may import.
BELOW = {
    "dem": {},
    "pctt.tt": {},
    "dem.contact_map": {"dem.arrays", "dem.compiled", "dem.exchange"},
    "pctt.body_matrix": {"pctt.blocks", "dem.compiled", "dem.contact_map", "dem.exchange"},
    "pctt.mat": {
        "pctt.blocks", "pctt.disk", "dem.exchange", "dem.geometry.morton", "pctt.options", "pctt.petsc", "pctt.tt",
    },
    "pctt.folder": {"dem", "pctt.disk", "pctt.json_text"},
    "pctt.scenes": {"dem"},
    "pctt.analysis": {"dem", "pctt.disk", "pctt.folder"},
    "pctt.look": {"dem", "pctt.disk", "pctt.folder", "pctt.options", "pctt.petsc"},
}


#: What the parts above dem may use of it, though they know of no scene.
SHARED = ("dem.compiled", "dem.contact_map", "dem.exchange", "dem.geometry.morton")


def within(name, part):
    return name == part or name.startswith(part + ".")


@pytest.mark.parametrize("part", BELOW)
def test_a_part_knows_only_of_those_below_it(graph, part):
    for name in graph:
        if within(name, part):
            others = {other for other in graph[name] if not any(within(other, low) for low in {part, *BELOW[part]})}
            assert others <= {"pctt"}, name


@pytest.mark.parametrize(("part", "above"), [
    ("pctt.pc", ("dem", "pctt.ccp", "pctt.run", "pctt.look")),
    ("pctt.ccp", ("dem", "pctt.run", "pctt.look")),
    ("pctt.run", ("pctt.look", "pctt.plot", "pctt.render", "pctt.export")),
])  # fmt: skip
def test_a_part_does_not_know_of_those_above_it(graph, part, above):
    for name in graph:
        if within(name, part):
            known = {other for other in graph[name] if not any(within(other, low) for low in SHARED)}
            assert not {other for other in known if any(within(other, high) for high in above)}, name


def test_mechanics_and_trains_know_nothing_of_petsc():
    for name, path in modules().items():
        if name.startswith(("dem", "pctt.tt")):
            assert not any(other.startswith("petsc4py") for other in imported(path)), name

