"""What each feature of a scene costs: a step with it over a step without, and what of its code runs without it.

    run/study features [NAME ...] [--steps N] [--rounds M]

Each feature has two simulations that differ in nothing else: a bed of 512 spheres in a box or, for cells, a flow of
some 200 spheres. After 40 steps they take turns, M (8) times N (5) steps each. Seconds are those of the processor;
printed are the medians of the steps, their ratio, the iterations of both, and the ratio for one iteration. `unused` is
how many calls of functions of the feature's modules a step without it makes, by cProfile. Writes results/features.json.
"""

from __future__ import annotations

import cProfile
import dataclasses
import pstats
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from shared import Table, at_least_one, medians, parser, record, say_machine

import pctt
from dem import measures
from dem.measures import Block
from dem.motion import Dynamic
from dem.packing import perturbed
from dem.scene import Scene
from dem.shapes import Box, Clump, Plane
from pctt.scenes import PlaneShear

SIDE, RADIUS, FIRST = 8, 0.005, 40
WIDTH = 2.1 * RADIUS * SIDE


def bed(walls: bool = True, clumps: bool = False, **laws: Any) -> Scene:
    """A bed of spheres in a box, or in a cell that is periodic along x and y; laws of the contacts."""
    scene = Scene(0.3, stiffness=1e4, period=None if walls else (WIDTH, WIDTH, None), **laws)
    points = (np.arange(SIDE) + 0.5) * 2.1 * RADIUS
    places = perturbed(points, points, points, 0.04 * RADIUS, 1)
    if clumps:
        pair = Clump(centres=[(-0.2 * RADIUS, 0, 0), (0.2 * RADIUS, 0, 0)], radii=[0.8 * RADIUS] * 2)
        scene.add_clumps(places, pair, 2500.0)
    else:
        scene.add_spheres(places, RADIUS, 2500.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    if walls:
        half = 0.5 * WIDTH
        around = [Plane(s * np.eye(3)[k], (half - half * s) * np.eye(3)[k]) for k in (0, 1) for s in (-1, 1)]
        scene.add_body("box", around)
    return scene


def with_body(what: str = "") -> Scene:
    """The bed, and a block on it that forces move; alone, on a spring, or on the slider of a joint."""
    scene, place = bed(), np.array([0.5 * WIDTH, 0.5 * WIDTH, WIDTH + 2.2 * RADIUS])
    scene.add_body("block", [Box((2.0 * RADIUS,) * 3)], Dynamic(), density=2500.0, position=place)
    if what == "spring":
        scene.add_spring("rope", None, "block", anchor=place, stiffness=10.0, damping=0.1, length=0.0)
    if what == "joint":
        scene.add_joint("guide", None, "block", kind="slider", anchor=place, axis=(0, 0, 1))
    return scene


def loaded() -> Scene:
    """The bed with a drag on all grains."""
    scene = bed()
    scene.add_load("drag", force=lambda time, table: -1e-4 * table.velocity[:, :3])
    return scene


def rained() -> Scene:
    """The bed with a grain every second step, which falls on it."""
    scene, half = bed(), 0.5 * WIDTH
    above = Block((0.5 * half, 0.5 * half, 2.5 * half), (1.5 * half, 1.5 * half, 5.0 * half))
    scene.add_source("rain", above, radius=RADIUS, density=2500.0, number_rate=250.0)
    return scene


def drained() -> Scene:
    """The bed with an outlet far below it."""
    scene = bed()
    scene.add_outlet("below", Block((-1, -1, -2), (1, 1, -1)))
    return scene


def flow(at_rest: bool = False, constant: bool = False) -> pctt.Simulation:
    """A sheared cell of given stress; at rest, or of the size that it has come to."""
    sim = simulation(PlaneShear(n=6, fraction=0.5, inertial=0.1, seed=3), dt=None)
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
    measures.stress(sim.sample, Block((0, 0, 0), (WIDTH, WIDTH, 0.5 * WIDTH)))
    measures.per_grain(sim.sample)


class Feature(NamedTuple):
    """A feature: what makes both simulations, and the modules that are its own; what is called after a step."""

    without: Callable[[], Any]
    used: Callable[[], Any]
    modules: tuple[str, ...]
    call: Callable[[pctt.Simulation], None] | None = None


FEATURES = {
    "loads": Feature(bed, loaded, ("dem/parts/loads.py",)),
    "springs": Feature(with_body, lambda: with_body("spring"), ("dem/parts/springs.py",)),
    "joints": Feature(with_body, lambda: with_body("joint"), ("dem/parts/joints.py", "contact_map/mass.py")),
    "sources": Feature(bed, rained, ("dem/parts/sources.py", "dem/record/passage.py", "dem/geometry/insertion.py")),
    "outlets": Feature(bed, drained, ("dem/parts/passages.py", "dem/record/passage.py")),
    "clumps": Feature(bed, lambda: bed(clumps=True), ("contact/clumps.py", "dem/shapes/clumps.py")),
    "periodic": Feature(bed, lambda: bed(walls=False), ("dem/parts/cell.py", "dem/model/images.py")),
    "shear": Feature(lambda: flow(at_rest=True), flow, ()),
    "servo": Feature(lambda: flow(constant=True), flow, ("contact_map/mass.py", "dem/step/servo.py")),
    "rolling": Feature(bed, lambda: bed(rolling=5e-4, spinning=1e-4), ("laws/rolling.py", "dem/step/resistance.py",
    "contact_map/turning.py")),
    "cohesion": Feature(bed, lambda: bed(cohesion=1e-3, cohesion_range=1e-4), ("laws/cohesion.py",)),
    "bridges": Feature(bed, lambda: bed(bridge_volume=1e-10, surface_tension=0.07), ("laws/bridges.py",)),
    "static_friction": Feature(bed, lambda: bed(static_friction=0.5), ("laws/static_friction.py",)),
    "restitution": Feature(bed, lambda: bed(restitution=0.5), ("_bounce",)),
    "measures": Feature(bed, bed, ("dem/measures",), measured),
}


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


def turn(sim: pctt.Simulation, steps: int, call: Callable[[pctt.Simulation], None] | None) -> list[dict[str, float]]:
    """Milliseconds of the processor and iterations of some steps."""
    rows = []
    for _ in range(steps):
        start = time.process_time()
        sim.step()
        if call:
            call(sim)
        rows.append({"ms": 1e3 * (time.process_time() - start), "iterations": sim.figures["iterations"]})
    return rows


def compare(name: str, steps: int, rounds: int) -> dict[str, Any]:
    """The row of a feature."""
    feature = FEATURES[name]
    pair = [made if isinstance(made := build(), pctt.Simulation) else simulation(made) for build in feature[:2]]
    for sim in pair:
        sim.run(steps=FIRST)
    rows: list[list[dict[str, float]]] = [[], []]
    for number in range(rounds):
        for k in (0, 1) if number % 2 else (1, 0):
            rows[k] += turn(pair[k], steps, feature.call if k else None)
    without, used = (medians(of, "ms", "iterations") for of in rows)
    out = {"feature": name, "unused calls": calls(pair[0], feature.modules) if feature.modules else 0.0}
    out |= {f"{key} without": value for key, value in without.items()} | {f"{key} with": used[key] for key in used}
    ratio = used["ms"] / without["ms"]
    each = ratio * max(without["iterations"], 1) / max(used["iterations"], 1)
    return out | {"ratio": ratio, "ratio of an iteration": each}


def main() -> None:
    words = parser("features", __doc__)
    words.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(FEATURES)}; none: all")
    words.add_argument("--steps", type=at_least_one, default=5, help="of a turn (5)")
    words.add_argument("--rounds", type=at_least_one, default=8, help="turns of each (8)")
    given = words.parse_args()
    if unknown := set(given.names) - set(FEATURES):
        words.error(f"{' '.join(sorted(unknown))}: allowed is {', '.join(FEATURES)}")
    about, rows = say_machine(), []
    table = Table(feature=("feature", "<12s"), without=("ms without", "8.2f"), used=("ms with", "8.2f"),
                  ratio=("ratio", "6.2f"), iterations=("iterations without", "10.0f"), then=("iterations with", "6.0f"),
                  per_iteration=("ratio of an iteration", "13.2f"), unused=("unused calls", "7.1f"))  # fmt: skip
    for name in given.names or FEATURES:
        rows.append(compare(name, given.steps, given.rounds))
        table.add(rows[-1])
    record("features", about, rows)


if __name__ == "__main__":
    main()
