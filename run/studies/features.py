"""What each feature of a scene costs: a step with it over a step without, and what of its code runs without it.

    run/study features [NAME ...] [--side N] [--steps N] [--rounds M]

Each feature has two simulations that differ in nothing else: a bed of N^3 (4,096) grains that have fallen into a box,
which shakes them, or, for cells, a flow of as many spheres. After 100 steps they take turns, M (8) times N (5) steps
each, which is a period, with one tolerance. Seconds are those of the processor; printed are the medians of the steps,
their contacts and iterations, the ratio of the seconds, and that for a contact and an iteration. `unused` is how many
calls of functions of the feature's modules a step without it makes, by cProfile. Writes results/features.json; all
features write their section of docs/measurements.md too.
"""

from __future__ import annotations

import cProfile
import dataclasses
import pstats
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shared
from shared import Row

import pctt
from dem import measures
from dem.measures import Block
from dem.motion import Dynamic, Oscillation
from dem.packing import perturbed
from dem.scene import Scene
from dem.shapes import Box, Clump, Plane
from pctt.scenes import PlaneShear

RADIUS, PITCH, FIRST = 0.005, 0.0125, 100
PERIOD = 0.08  #: in which the box goes to and fro, with half of gravity at most [s]
PHI = 0.5 * (1.0 + 5.0**0.5)
EDGES = [(0, y, z * PHI) for y in (-1, 1) for z in (-1, 1)]
ICOSAHEDRON = np.concatenate([np.roll(EDGES, k, axis=1) for k in range(3)])
PAGE, HEAD = shared.ROOT / "docs/measurements.md", "## What features cost\n"


def bed(side: int, walls: bool = True, grains: str = "spheres", **laws: Any) -> Scene:
    """A bed of grains in a box, or in a cell that is periodic along x and y; laws of the contacts."""
    wide = PITCH * side
    scene = Scene(0.3, stiffness=1e4, period=None if walls else (wide, wide, None), **laws)
    points = (np.arange(side) + 0.5) * PITCH
    places = perturbed(points, points, points, 0.49 * (PITCH - 2.0 * RADIUS), 1)
    turns = np.random.default_rng(2).normal(size=(side**3, 4))
    if grains == "clumps":
        pair = Clump(centres=[(-0.2 * RADIUS, 0, 0), (0.2 * RADIUS, 0, 0)], radii=[0.8 * RADIUS] * 2)
        scene.add_clumps(places, pair, 2500.0, quaternions=turns)
    elif grains == "boxes":
        scene.add_boxes(places, [RADIUS / 3**0.5] * 3, 2500.0, quaternions=turns)
    elif grains == "polyhedra":
        corners = ICOSAHEDRON * (RADIUS / np.linalg.norm(ICOSAHEDRON[0]))
        scene.add_polyhedra(places, corners, 2500.0, quaternions=turns)
    else:
        scene.add_spheres(places, RADIUS, 2500.0)
    shaken = Oscillation((1, 0, 0), 0.5 * 9.81 * (0.5 * PERIOD / np.pi) ** 2, PERIOD)
    scene.add_body("floor", [Plane((0, 0, 1))], shaken)
    if walls:
        half = 0.5 * wide
        around = [Plane(s * np.eye(3)[k], (half - half * s) * np.eye(3)[k]) for k in (0, 1) for s in (-1, 1)]
        scene.add_body("box", around, shaken)
    return scene


def with_body(side: int, what: str = "") -> Scene:
    """The bed, and a block on it that forces move; alone, on a spring, or on the slider of a joint."""
    scene, wide = bed(side), PITCH * side
    place = np.array([0.5 * wide, 0.5 * wide, wide + 2.2 * RADIUS])
    scene.add_body("block", [Box((2.0 * RADIUS,) * 3)], Dynamic(), density=2500.0, position=place)
    if what == "spring":
        scene.add_spring("rope", None, "block", anchor=place, stiffness=10.0, damping=0.1, length=0.0)
    if what == "joint":
        scene.add_joint("guide", None, "block", kind="slider", anchor=place, axis=(0, 0, 1))
    return scene


def loaded(side: int) -> Scene:
    """The bed with a drag on all grains."""
    scene = bed(side)
    scene.add_load("drag", force=lambda time, table: -1e-4 * table.velocity[:, :3])
    return scene


def rained(side: int) -> Scene:
    """The bed with a grain every second step, which falls on it."""
    scene, half = bed(side), 0.5 * PITCH * side
    above = Block((0.5 * half, 0.5 * half, 2.5 * half), (1.5 * half, 1.5 * half, 5.0 * half))
    scene.add_source("rain", above, radius=RADIUS, density=2500.0, number_rate=250.0)
    return scene


def drained(side: int) -> Scene:
    """The bed with an outlet far below it."""
    scene = bed(side)
    scene.add_outlet("below", Block((-1, -1, -2), (1, 1, -1)))
    return scene


def flow(side: int, at_rest: bool = False, constant: bool = False) -> pctt.Simulation:
    """A sheared cell of given stress; at rest, or of the size that it has come to."""
    sim = simulation(PlaneShear(n=max(side, 6), fraction=0.5, inertial=0.1, seed=3), dt=None)
    sim.run(steps=200)
    if at_rest:
        sim.change("cell", shear_rate=0.0)
    if constant:
        sim.world.cell = dataclasses.replace(sim.world.cell, deforms=False, rate=np.zeros(3))
    return sim


def simulation(scene: Any, dt: float | None = 0.002) -> pctt.Simulation:
    return pctt.Simulation(scene, dt=dt, solver="apgd")


def measured(sim: pctt.Simulation) -> None:
    """The measures of a step: the stress of a region, and forces and coordination of all grains."""
    wide = sim.sample.position.max()
    measures.stress(sim.sample, Block((0, 0, 0), (wide, wide, 0.5 * wide)))
    measures.per_grain(sim.sample)


class Feature(NamedTuple):
    """A feature in words; what makes both simulations of a side; the modules that are its own; what is called after a
    step."""

    words: str
    without: Callable[[int], Any]
    used: Callable[[int], Any]
    modules: tuple[str, ...] = ()
    call: Callable[[pctt.Simulation], None] | None = None


def law(name: str, words: str, *modules: str, **values: float) -> dict[str, Feature]:
    """A feature that is a law of contact."""
    return {name: Feature(words, bed, partial(bed, **values), modules)}


FEATURES = {
    "loads": Feature("a drag on all grains", bed, loaded, ("dem/parts/loads.py",)),
    "springs": Feature("a spring on a block", with_body, partial(with_body, what="spring"), ("dem/parts/springs.py",)),
    "joints": Feature("a joint that guides a block", with_body, partial(with_body, what="joint"),
    ("dem/parts/joints.py",)),
    "sources": Feature("a source", bed, rained,
    ("dem/parts/sources.py", "dem/record/passage.py", "dem/geometry/insertion.py")),
    "outlets": Feature("an outlet", bed, drained, ("dem/parts/passages.py", "dem/record/passage.py")),
    "clumps": Feature("clumps of two spheres for spheres", bed, partial(bed, grains="clumps"),
    ("contact/clumps.py", "dem/shapes/clumps.py")),
    "polyhedra": Feature("polyhedra of 20 faces for boxes", partial(bed, grains="boxes"),
    partial(bed, grains="polyhedra"), ("dem/shapes/polyhedra.py",)),
    "periodic": Feature("two periods for four walls", bed, partial(bed, walls=False),
    ("dem/parts/cell.py", "dem/model/images.py")),
    "shear": Feature("a flow in a cell of given stress, for one at rest", partial(flow, at_rest=True), flow),
    "servo": Feature("a sheared cell of given stress, for one of given size", partial(flow, constant=True), flow,
    ("dem/step/servo.py",)),
    **law("rolling", "resistance to rolling and spinning", "laws/rolling.py", "dem/step/resistance.py",
    "contact_map/turning.py", rolling=5e-4, spinning=1e-4),
    **law("cohesion", "cohesion", "laws/cohesion.py", cohesion=1e-3, cohesion_range=1e-4),
    **law("bridges", "liquid bridges", "laws/bridges.py", bridge_volume=1e-10, surface_tension=0.07),
    **law("static_friction", "static friction", "laws/static_friction.py", static_friction=0.5),
    **law("restitution", "restitution", "_bounce", restitution=0.5),
    "measures": Feature("stress, and forces of all grains, in each step", bed, bed, ("dem/measures",), measured),
}  # fmt: skip


def calls(sim: pctt.Simulation, modules: tuple[str, ...], steps: int = 5) -> float:
    """Python calls of functions of these files, or of these names, in a step."""
    profile = cProfile.Profile()
    profile.enable()
    for _ in range(steps):
        sim.step()
    profile.disable()
    stats = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    return sum(
        count for (file, _, name), (_, count, *_) in stats.items()
        if any(module in Path(file).as_posix() or module == name for module in modules)
    ) / steps  # fmt: skip


def turn(sim: pctt.Simulation, steps: int, call: Callable[[pctt.Simulation], None] | None) -> list[Row]:
    """Milliseconds of the processor, contacts and iterations of some steps."""
    rows = []
    for _ in range(steps):
        start = time.process_time()
        sim.step()
        if call:
            call(sim)
        row = {name: sim.figures[name] for name in ("contacts", "iterations")}
        seconds = {f"{name} ms": 1e3 * value for name, value in sim.figures["phases"].items()}
        rows.append({"ms": 1e3 * (time.process_time() - start), **row, **seconds})
    return rows


def compare(name: str, side: int, steps: int, rounds: int) -> Row:
    """The row of a feature."""
    feature = FEATURES[name]
    made = [build(side) for build in (feature.without, feature.used)]
    pair = [sim if isinstance(sim, pctt.Simulation) else simulation(sim) for sim in made]
    for sim in pair:
        sim.run(steps=FIRST)
    rows: list[list[Row]] = [[], []]
    for number in range(rounds):
        for k in (0, 1) if number % 2 else (1, 0):
            rows[k] += turn(pair[k], steps, feature.call if k else None)
    without, used = (shared.medians(of, *of[0]) for of in rows)
    out = {"feature": name, "unused calls": calls(pair[0], feature.modules)}
    out |= {f"{key} {which}": of[key] for which, of in (("without", without), ("with", used)) for key in of}
    ratio, work = used["ms"] / without["ms"], [max(of["contacts"] * of["iterations"], 1) for of in (without, used)]
    return out | {"ratio": ratio, "ratio of an iteration": ratio * work[0] / work[1]}


def main() -> None:
    words = shared.parser("features", __doc__)
    words.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(FEATURES)}; none: all")
    words.add_argument("--side", type=shared.at_least_one, default=16, help="grains along each side (16)")
    words.add_argument("--steps", type=shared.at_least_one, default=5, help="of a turn (5)")
    words.add_argument("--rounds", type=shared.at_least_one, default=8, help="turns of each (8)")
    given = words.parse_args()
    if unknown := set(given.names) - set(FEATURES):
        words.error(f"{' '.join(sorted(unknown))}: allowed is {', '.join(FEATURES)}")
    about, rows = shared.say_machine(), []
    table = shared.Table(
        feature=("feature", "<15s"), contacts=("contacts without", "8.0f"), with_=("contacts with", "6.0f"),
        iterations=("iterations without", "10.0f"), then=("iterations with", "6.0f"), ms=("ms without", "7.1f"),
        used=("ms with", "7.1f"), ratio=("ratio", "6.2f"), per_iteration=("ratio of an iteration", "13.2f"),
        unused=("unused calls", "7.1f"),
    )  # fmt: skip
    for name in given.names or FEATURES:
        rows.append(compare(name, given.side, given.steps, given.rounds))
        table.add(rows[-1])
    shared.record("features", about, rows)
    if not given.names:
        write_page(rows, given.side, about)


def write_page(rows: list[Row], side: int, about: Row) -> None:
    """The section of docs/measurements.md."""
    lines = []
    for row in sorted(rows, key=lambda row: row["ratio"]):
        pairs = [" / ".join(f"{row[f'{name} {which}']:,.0f}" for which in ("without", "with")) for name in
                 ("contacts", "iterations", "ms")]  # fmt: skip
        ratios = f"**{row['ratio']:.2f}**", f"{row['ratio of an iteration']:.2f}"
        lines.append([FEATURES[row["feature"]].words, *pairs, *ratios])
    heads = ["without / with", "contacts", "iterations", "step, ms", "ratio", "of a contact and iteration"]
    most = max(row["unused calls"] for row in rows)
    words = {"grains": side**3, "cpu": about["cpu"], "commit": shared.commit(), "unused": most}
    shared.replace_section(PAGE, HEAD, TEXT.format(table=shared.markdown(heads, lines), **words))


TEXT = """`run/study features` writes this section: a step with a feature and one without, of two simulations that
differ in nothing else and take turns; a shaken bed of {grains:,} grains, or a flow in a cell of nearly as many. Medians
of processor time, one core of an {cpu}, commit {commit}. Tolerances are equal.

{table}

A feature that a scene does not use costs at most {unused:.0f} calls of its code in a step.

"""


if __name__ == "__main__":
    main()
