"""Random mixtures of features, simulated by the defaults, and what is wrong with them: run/study random_scenes.

    run/study random_scenes [FIRST [COUNT]] [--steps N] [--processes P]

Each seed is a scene: grains of some shapes, with a friction, a boundary, and perhaps restitution, cohesion, resistance
to rolling, a tool, springs, joints, motors, sources, loads. A scene gets a *note* for each fault: a step that is not
solved or takes very many iterations, a deep overlap, energy or momentum from nothing, a number that is none, a grain
that has left its box, an end before the last step. A note that the docs explain has a reason behind it; others are
faults of the program, and the exit status is then 1. Writes results/random_scenes.json. The seeds of a file of results
can be run again alone: run/study random_scenes 63 1.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import sys
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull
from shared import Row, Table, at_least_one, parser, record, say_machine

import pctt
from dem.measures import Block
from dem.mesh import Mesh
from dem.motion import Dynamic, Glide, Guided, Held, Hinged, Oscillation, Rotation
from dem.parts.sizes import Uniform
from dem.scene import Scene
from dem.shapes import Box, Capsule, Clump, Cylinder, Plane, Sphere, Superellipsoid
from dem.together import SceneError

G = 9.81
PITCH = 2.6  # from place to place, in radii: the largest grains reach 1
CLOSE = 2.4  # the same in a cell of given stress, which closes slowly
DEEP = 0.1  # an overlap worth a note, in radii of the smallest grain
MANY = 10_000  # iterations of a step worth a note
SUDDEN = 10.0  # a speed that ends a run, over the greatest one before, that no impact explains
FEW, NEAR = 0.1, 0.02  # steps that hard laws may leave unsolved, and up to which residual
GAIN = 0.05  # energy from nothing worth a note, as a part of what there is
CELLS = ("periodic", "sheared", "stress")
BOUNDARIES = ("walls", "walls", "mesh", "boxes", "free", "channel", *CELLS)


@dataclass
class Mixture:
    """A scene, and what is known of it.

    features : in words
    fed : what may feed energy and momentum in: drives, springs, loads, cells that deform, sources
    low, high : (3,) of the box that no grain leaves; None if there is none, or if it moves
    """

    scene: Scene
    radius: float
    features: list[str]
    rigid: bool = False  # whether contacts may be rigid: of infinite stiffness, or while they bounce
    pressed: bool = False  # whether springs or given forces press more than the stiffness that is chosen foresees
    squeezed: bool = False  # whether tools of prescribed motion, or joints to the world, may squeeze
    hard: bool = False  # whether no method always finds Coulomb's law: friction of 2 and more, with moments
    held: bool = False  # whether something is fixed to the world
    fed: list[str] = field(default_factory=list)
    low: Any = None
    high: Any = None


class Note(NamedTuple):
    """A fault; without a ``reason`` it is one of the program."""

    fault: str
    reason: str = ""


class Draw:
    """Random choices."""

    def __init__(self, seed: int):
        self.rng = np.random.default_rng(seed)

    def one(self, *values: Any) -> Any:
        return values[int(self.rng.integers(len(values)))]

    def chance(self, part: float) -> bool:
        return bool(self.rng.random() < part)

    def turns(self, count: int) -> np.ndarray:
        """Quaternions (count, 4)."""
        q = self.rng.normal(size=(count, 4))
        return q / np.linalg.norm(q, axis=1, keepdims=True)

    def rock(self) -> np.ndarray:
        """Corners (n, 3) of a convex polyhedron in the unit sphere that is not flat."""
        while True:
            corners = self.rng.normal(size=(int(self.rng.integers(5, 12)), 3))
            corners /= np.linalg.norm(corners, axis=1, keepdims=True)
            if ConvexHull(corners).volume > 0.4:
                return corners


# -- scenes -----------------------------------------------------------------------------------------------------


def mixture(seed: int) -> Mixture:
    """The scene of a seed."""
    draw = Draw(seed)
    radius = 10.0 ** draw.rng.uniform(-3.0, -0.5)
    boundary = draw.one(*BOUNDARIES)
    cell = boundary in CELLS
    count = np.array([5, 5, 5] if cell else [*draw.rng.integers(2, 4, 2), draw.rng.integers(1, 4)])
    if boundary == "channel":
        count[0] = 6
    pitch = CLOSE if boundary == "stress" else PITCH
    size = pitch * radius * count
    laws, more = laws_of(draw, radius), {}
    if boundary == "stress":
        laws.pop("stiffness", None)
        more["stress"] = (10.0 ** draw.rng.uniform(1.0, 4.0),) * 3
        if draw.chance(0.4):
            more["strain_rate"] = (None, None, draw.one(-0.5, 0.5))
    if boundary == "sheared":
        more |= {"shear_rate": draw.one(0.5, 5.0), "shear_gradient": draw.one("y", "z")}
    if cell or boundary == "channel":
        more["period"] = tuple(size) if cell else (size[0], None, None)
    weight = (0.0, 0.0, 0.0) if cell or boundary == "free" else draw.one((0, 0, -G), (0, 0, -G), (2.0, 1.0, -G))
    friction = draw.one(0.0, 0.2, 0.5, 1.0, 3.0)
    scene = Scene(friction, weight, **laws, **more)
    made = Mixture(scene, radius, [boundary, f"friction {friction:g}", *laws])
    made.rigid = "restitution" in laws or "stiffness" in laws
    made.hard = friction >= 2.0 and "rolling" in laws
    made.fed += [boundary] * (boundary in ("sheared", "stress"))
    density = 10.0 ** draw.rng.uniform(2.0, 4.0)
    places = add_grains(draw, made, count, pitch, density, more)
    walls(draw, made, boundary, size)
    if boundary in ("walls", "mesh", "boxes") and draw.chance(0.5):
        add_tool(draw, made, size, density, mesh=boundary == "mesh")
    if not cell and boundary != "channel" and draw.chance(0.3):
        add_springs(draw, made, len(places), density)
    rains = boundary in ("walls", "boxes", "mesh", "channel") and draw.chance(0.3)
    outlet = rains and add_source(draw, made, size, density)
    if boundary not in ("sheared", "stress") and not outlet and draw.chance(0.45):
        add_joints(draw, made, places, density)
    if boundary not in ("sheared", "stress") and draw.chance(0.15):
        scene.add_load("push", force=(5.0 * density * radius**3, 0, 0))
        made.fed.append("load")
    made.features += made.fed
    return made


def laws_of(draw: Draw, radius: float) -> dict[str, float]:
    """Laws of the contacts beside friction."""
    laws = {}
    if draw.chance(0.25):
        laws["restitution"] = draw.one(0.3, 0.8, 1.0)
    if draw.chance(0.25):
        laws |= {"cohesion": draw.one(0.1, 1, 30) * 1e4 * radius**3 * G, "cohesion_range": 0.02 * radius}
    if draw.chance(0.25):
        laws["rolling"] = draw.one(0.02, 0.3) * radius
        if draw.chance(0.5):
            laws["spinning"] = draw.one(0.02, 0.3) * radius
    if draw.chance(0.2):
        laws["stiffness"] = np.inf
    return laws


def add_grains(draw: Draw, made: Mixture, count: np.ndarray, pitch: float, density: float, more: Row) -> np.ndarray:
    """Grains of some shapes near the places of a lattice; their centres (n, 3) in the order of their ids."""
    radius, kinds = made.radius, ["spheres", "boxes", "capsules", "clumps", "rocks", "cylinders", "superellipsoids"]
    chosen = [kind for kind in kinds if draw.chance(0.4)] or ["spheres"]
    grid = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1).reshape(-1, 3) + 0.5
    places = pitch * radius * grid + draw.rng.uniform(-0.1, 0.1, grid.shape) * radius
    speed, spin = draw.one(0.0, 1.0, 3.0), draw.one(0.0, 1.0, 3.0)
    velocity = draw.rng.normal(size=places.shape) * np.sqrt(G * radius) * speed
    turning = draw.rng.normal(size=places.shape) * np.sqrt(G / radius) * spin
    if "shear_rate" in more:
        velocity[:, 0] += more["shear_rate"] * places[:, "xyz".index(more["shear_gradient"])]
    which, order = draw.rng.integers(len(chosen), size=len(places)), []
    for k, kind in enumerate(chosen):
        here = np.flatnonzero(which == k)
        if not len(here):
            continue
        order.append(here)
        made.features.append(kind)
        heavy, at, n = density * draw.one(1.0, 1.0, 30.0), places[here], len(here)
        given: Row = {"velocity": velocity[here], "angular_velocity": turning[here]}
        given["material"] = draw.one("default", "other")
        if kind == "spheres":
            made.scene.add_spheres(at, radius * draw.rng.uniform(0.6, 1.0, n), heavy, **given)
            continue
        given["quaternions"] = draw.turns(n)
        if kind == "boxes":
            made.scene.add_boxes(at, radius * draw.rng.uniform(0.3, 0.57, 3), heavy, **given)
        elif kind == "capsules":
            made.scene.add_capsules(at, 0.4 * radius, 0.55 * radius, heavy, **given)
        elif kind == "clumps":
            centres = np.array([[0, 0, 0], [0.5, 0, 0], [0.1, 0.4, 0.2]])
            clump = Clump(radius * centres, radius * np.array([0.45, 0.35, 0.3]))
            made.scene.add_clumps(at, clump, heavy, **given)
        elif kind == "cylinders":
            made.scene.add_grains(at, Cylinder(0.5 * radius, draw.one(0.2, 1.5) * radius), heavy, **given)
        elif kind == "superellipsoids":
            axes = radius * draw.rng.uniform(0.3, 0.57, 3)
            shape = Superellipsoid(tuple(axes), draw.one((2.0, 2.0), (4.0, 3.0), (8.0, 8.0)))
            made.scene.add_grains(at, shape, heavy, **given)
        else:
            made.scene.add_polyhedra(at, 0.95 * radius * draw.rock(), heavy, **given)
    return places[np.concatenate(order)]


def walls(draw: Draw, made: Mixture, boundary: str, size: np.ndarray) -> None:
    """What is around the grains."""
    margin = 0.1 * made.radius
    low, high = np.full(3, -margin), size + margin
    middle, motion = 0.5 * size, None
    if boundary == "walls":
        sides = [(k, s) for k in (0, 1) for s in (-1.0, 1.0)]
        planes = [Plane((0, 0, 1), low), *(Plane(-s * np.eye(3)[k], low if s < 0 else high) for k, s in sides)]
        shaken = Oscillation((0, 0, 1), 0.2 * made.radius, 0.2)
        turning = Rotation((0, 0, 3.0), center=tuple(middle * [1, 1, 0]))
        motion = draw.one(None, None, None, shaken, Glide((0.2, 0, 0)), turning)
        made.scene.add_body("box", planes, **({} if motion is None else {"motion": motion}))
    elif boundary == "mesh":
        around = float(np.hypot(*(0.5 * size[:2]))) + made.radius
        cup = Mesh.revolved([(0.0, 0.0), (around, 0.0), (around, 4.0 * size[2] + 8.0 * made.radius)], draw.one(6, 24))
        motion = draw.one(None, None, Rotation((0, 0, 2.0)), Oscillation((1, 0, 0), 0.3 * made.radius, 0.3))
        given = {} if motion is None else {"motion": motion}
        made.scene.add_body("box", [cup], position=(*middle[:2], low[2]), **given)
        low, high = np.array([*(middle[:2] - around), low[2]]), np.array([*(middle[:2] + around), np.inf])
    elif boundary == "boxes":
        shapes = []
        for k, s in ((2, -1.0), (0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):
            half = size + 4.0 * made.radius
            half[2] += 8.0 * made.radius  # above what rains
            half[k], centre = made.radius, middle.copy()
            centre[k] = low[k] - made.radius if s < 0 else high[k] + made.radius
            shapes.append(Box(tuple(half), tuple(centre)))
        made.scene.add_body("box", shapes)
    elif boundary == "channel":
        planes = [Plane((0, 0, 1), low), Plane((0, 1, 0), low), Plane((0, -1, 0), high)]
        made.scene.add_body("box", planes)
        low, high = np.array([-np.inf, *low[1:]]), np.array([np.inf, *high[1:]])
    else:
        return
    made.held = made.squeezed = True
    if motion is not None:
        made.fed.append(f"{type(motion).__name__} of the box")
    else:
        made.low, made.high = low, np.array([*high[:2], np.inf])


def add_tool(draw: Draw, made: Mixture, size: np.ndarray, density: float, mesh: bool) -> None:
    """A body above the grains that is driven, or falls."""
    radius, at = made.radius, size * [0.5, 0.5, 1.0] + [0, 0, 1.8 * made.radius]
    shapes = [Sphere(radius), Box((radius, 0.5 * radius, 0.7 * radius)), Capsule(0.5 * radius, 0.5 * radius)]
    shapes += [] if mesh else [wedge(radius)]  # two meshes do not touch
    force = density * radius**3 * 500.0
    motion = draw.one(
        Glide((0, 0, -0.5)),
        Guided((0, 0, 1), speed=-0.5, force=2.0 * force),
        Guided((0, 0, 1), force=-force),
        Hinged((0, 0, 1), torque=0.2 * force * radius, speed=5.0),
        Dynamic(),
        Held((None, 0, None), (0, 4.0, 0)),
        Rotation((0, 5.0, 0), center=tuple(at + [0, 0, radius])),
    )
    shape, given, heavy = draw.one(*shapes), {}, density * draw.one(0.1, 1.0, 100.0)
    if isinstance(motion, Dynamic):
        mass = 1.4 * heavy * radius**3
        given = {"density": heavy}
        if isinstance(shape, Mesh):  # whose own needs another package
            given = {"mass": mass, "inertia": (0.4 * mass * radius**2,) * 3}
    made.scene.add_body("tool", [shape], motion, position=at, **given)
    made.fed.append(f"{type(motion).__name__} tool")
    made.pressed |= isinstance(motion, Guided)


def wedge(radius: float) -> Mesh:
    """A closed solid of eight triangles."""
    corners = radius * np.array([(x, y, 0) for x in (-1, 1) for y in (-0.7, 0.7)] + [(-1, -0.7, 1), (-1, 0.7, 1)])
    faces = [(0, 1, 2), (1, 3, 2), (0, 4, 1), (1, 4, 5), (0, 2, 4), (1, 5, 3), (2, 3, 4), (3, 5, 4)]
    return Mesh(corners - corners.mean(axis=0), faces)


def add_springs(draw: Draw, made: Mixture, grains: int, density: float) -> None:
    mass = 4.0 * density * made.radius**3
    for k in range(int(draw.rng.integers(1, 4)) if grains > 1 else 0):
        one, other = map(int, draw.rng.choice(grains, 2, replace=False))
        made.scene.add_spring(
            f"spring {k}", one, draw.one(other, None), stiffness=mass * G / made.radius * draw.one(1.0, 10.0),
            damping=draw.one(0.0, 0.3) * mass * np.sqrt(G / made.radius), anchor=(0, 0, 0.2 * made.radius),
            length=draw.one(None, 0.0),
        )  # fmt: skip
        made.fed, made.pressed = [*made.fed, "spring"], True


def add_joints(draw: Draw, made: Mixture, places: np.ndarray, density: float) -> None:
    """Joints between neighbours, and to the world; some with motors and limits."""
    radius, force = made.radius, 50.0 * density * made.radius**3
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    near = np.argwhere(np.triu(apart < 1.15 * PITCH * radius, 1))
    joined = draw.rng.choice(len(near), min(len(near), int(draw.rng.integers(1, 5))), replace=False)
    for k, (one, other) in enumerate(near[joined].tolist()):
        kind, given = draw.one("hinge", "slider", "ball", "fixed"), {}
        unit, most = (1.0, force * radius) if kind == "hinge" else (radius, force)
        if kind in ("hinge", "slider") and draw.chance(0.6):
            if draw.chance(0.5):
                given = {"speed": draw.one(-1.0, 2.0) * unit, "strength": draw.one(np.inf, most)}
                made.fed.append("motor")
            else:
                given = {"limits": (-0.2 * unit, 0.2 * unit)}
        first = one if draw.chance(0.8) else None
        if first is None:
            made.held = made.squeezed = True
        anchor, axis = 0.5 * (places[one] + places[other]), draw.rng.normal(size=3)
        if kind in ("hinge", "slider"):
            given["axis"] = axis
        made.scene.add_joint(f"joint {k}", first, other, kind=kind, anchor=anchor, **given)
        made.features.append(f"{kind} {'to the world' if first is None else 'joint'}")


def one_of_each(draw: Draw, radius: float) -> list[Any]:
    """A shape of each kind of grains, in a ball of this radius."""
    centres, thick = radius * np.array([[0, 0, 0], [0.5, 0, 0], [0.1, 0.4, 0.2]]), 0.55 * radius
    balls = Sphere(radius), Capsule(0.4 * radius, thick), Clump(centres, radius * np.array([0.45, 0.35, 0.3]))
    axes = (thick, 0.4 * radius, 0.5 * radius)
    return [*balls, Box(axes), Cylinder(0.5 * radius, radius), Superellipsoid(axes, (4.0, 3.0)), radius * draw.rock()]


def add_source(draw: Draw, made: Mixture, size: np.ndarray, density: float) -> bool:
    """Grains that rain, and perhaps an outlet for some; whether there is one."""
    radius = made.radius
    above = size[2] + 5.0 * radius
    of, shape = draw.one(0.5, Uniform(0.3, 0.7)), draw.one(*one_of_each(draw, radius))
    of = 1.0 if isinstance(shape, Clump) else of
    made.scene.add_source(
        "rain", Block((0, 0, above), (*size[:2], above + 4.0 * radius)), radius=of, shape=shape, density=density,
        number_rate=20.0 * np.sqrt(G / radius), velocity=(0, 0, -np.sqrt(G * radius)),
    )  # fmt: skip
    made.fed.append("source")
    if "spring" in made.fed or not draw.chance(0.5):
        return False
    far = 1e3 * radius
    made.scene.add_outlet("drain", Block((-far, -far, -far), (0.5 * size[0], far, 0.8 * radius)))
    made.fed.append("outlet")
    return True


# -- faults -----------------------------------------------------------------------------------------------------

#: What ends runs by design: words of the message, and the reason.
ENDS = {
    "is too short": "grains that are so fast need a longer cell, as the message says",
    "too far in a time step": "a body so fast could pass through another one, as the message says",
}
STATES = ("kinetic_energy [J]", "potential_energy [J]", "spring_energy [J]")


def simulated(seed: int, steps: int) -> Row:
    """The row of a seed: its scene, its figures and its notes."""
    warnings.simplefilter("ignore")  # what they say is in the figures
    row: Row = {"seed": seed, "scene": "", "notes": []}
    notes: list[Note] = []
    try:
        made = mixture(seed)
        row["scene"] = ", ".join(made.features)
        sim = pctt.Simulation(made.scene, say=lambda text: None)
    except ValueError as error:
        return row | {"notes": [Note("refused before any work", str(error))._asdict()]}
    lines: list[Row] = []
    with sim:
        before = momentum(sim)
        try:
            lines.extend(sim.step() for _ in range(steps))
        except Exception as error:  # whatever it is, it is a note
            notes.append(end_of(made, fastest(sim), error))
        mass, slow = float(sim.local.mass.sum()), 1e-9 * made.radius / sim.settings.dt
        notes += [*solves(made, lines), *overlaps(made, sim, lines), *places(made, sim)]
        notes += energies(lines, bool(made.fed), mass * slow**2)
        if not (made.fed or made.held):
            now = momentum(sim)
            change = np.abs(now[0] - before[0]).max() / max(now[1], before[1], mass * slow)
            notes += [Note(f"the momentum of free bodies changes by {change:.1e} of itself")] * bool(change > 1e-9)
        grains = len(sim.positions)
    its = [line["iterations"] for line in lines] or [0]
    row |= {"steps": len(lines), "grains": grains, "iterations": float(np.mean(its)), "most": max(its)}
    row["solved"] = sum(line["converged"] for line in lines)
    return row | {"notes": [note._asdict() for note in notes]}


def end_of(made: Mixture, fastest: float, error: Exception) -> Note:
    """The note of a run that ended before its last step, and where no body was faster than ``fastest`` [m/s]."""
    words = str(error)
    fault, reason = f"{type(error).__name__}: {words}", ""
    if isinstance(error, SceneError):
        reason = next((why for part, why in ENDS.items() if part in words), "")
        told = re.search(r"moves at ([-+.e0-9]+) m/s", words)
        if told and float(told[1]) > SUDDEN * fastest:
            reason = ""
    if "unbounded" in words and made.rigid:
        reason = "rigid contacts that are squeezed or wedged have no solution, as the message says"
    return Note(fault, reason)


def solves(made: Mixture, lines: list[Row]) -> list[Note]:
    """Steps that are not solved, that claim what they are not, or that take too long."""
    notes = []
    for status, count in Counter(line["status"] for line in lines).items():
        if status == "squeezed":
            notes.append(Note(f"{count} steps squeezed", "rigid contacts, or tools, squeeze" if made.squeezed else ""))
        elif status != "converged":
            worst = max(line["coulomb_residual"] for line in lines if line["status"] == status)
            near = made.hard and count <= FEW * len(lines) and worst <= NEAR
            known = "with friction of 2 and more, and moments, no method finds every step"
            notes.append(Note(f"{count} steps {status}, with residuals up to {worst:.1e}", known if near else ""))
    for line in lines:
        residual = line["coulomb_residual"]
        if line["status"] == "converged" and not residual <= 1.0001 * line["tolerance"]:
            notes.append(Note(f"step {line['step']} is converged with a residual of {residual:.1e}"))
    most = max((line["iterations"] for line in lines), default=0)
    return notes + [Note(f"a step of {most} iterations")] * bool(most > MANY)


def overlaps(made: Mixture, sim: pctt.Simulation, lines: list[Row]) -> list[Note]:
    """Overlaps deeper than a tenth of a radius."""
    deepest = max((line["worst_overlap"] for line in lines), default=0.0) / (0.3 * made.radius)
    if deepest <= DEEP:
        return []
    reason, springs = "", sim.overlap_watch.cause == "stiffness"  # that forces have pressed so far
    if springs and made.pressed:
        reason = "springs or given forces press more than the chosen stiffness foresees, as the run says"
    elif springs and made.squeezed:
        reason = "tools of prescribed motion, or joints to the world, squeeze whatever forces that takes"
    elif np.abs(sim.local.velocity[:, 3:]).max(initial=0.0) * sim.settings.dt > 1.0:
        reason = "bodies turn by radians in a step, of which the run warns"
    return [Note(f"an overlap of {deepest:.2g} radii of the smallest grains", reason)]


def energies(lines: list[Row], fed: bool, still: float) -> list[Note]:
    """Energies that are no numbers, or come from nothing: more than that of what rounding moves, ``still`` [J]."""
    state = np.array([[line[name] for name in STATES] for line in lines]).reshape(-1, 3)
    if not np.isfinite(state).all():
        return [Note("an energy that is no number")]
    if fed or not len(state):
        return []
    kept = state[:, 0] + state[:, 1]
    scale = max(state[:, 0].max(), np.ptp(state[:, 1]), still)
    gain = float((kept - np.minimum.accumulate(kept)).max()) / scale
    return [Note(f"energy from nothing, {gain:.2g} of what there is")] * bool(gain > GAIN)


def places(made: Mixture, sim: pctt.Simulation) -> list[Note]:
    """Grains that are nowhere, or outside of their box."""
    if not (np.isfinite(sim.positions).all() and np.isfinite(sim.velocities).all()):
        return [Note("a place or a velocity that is no number")]
    if made.low is None:
        return []
    away = (sim.positions < made.low) | (sim.positions > made.high)
    return [Note(f"{int(away.any(axis=1).sum())} grains outside of their box")] * bool(away.any())


def fastest(sim: pctt.Simulation) -> float:
    """The greatest speed of a point of a body, about: of all grains and tools [m/s]."""
    large = sim.world.large.velocity if len(sim.world.large.velocity) else np.zeros((1, 6))
    speeds = [np.linalg.norm(each[:, :3], axis=1).max(initial=0.0) for each in (sim.velocities, large)]
    return float(max(speeds)) + np.sqrt(2.0 * G * 0.1)


def momentum(sim: pctt.Simulation) -> tuple[np.ndarray, float]:
    """That of all grains (3,), and the sum of their sizes [N s]."""
    each = sim.local.mass[:, None] * sim.local.velocity[:, :3]
    return each.sum(axis=0), float(np.abs(each).sum())


# -- the study --------------------------------------------------------------------------------------------------


def study(first: int, count: int, steps: int, processes: int) -> list[Row]:
    """The rows of so many seeds, each printed when it is there."""
    table = Table(seed=("seed", "4d"), steps=("steps", "5d"), solved=("solved", "6d"), its=("iterations", "7.1f"),
                  most=("most", "6d"))  # fmt: skip
    rows = []
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        for row in pool.map(partial(simulated, steps=steps), range(first, first + count)):
            rows.append({"steps": 0, "solved": 0, "iterations": 0.0, "most": 0} | row)
            said = [f"{note['fault']}" + (f" ({note['reason']})" if note["reason"] else "") for note in row["notes"]]
            table.add(rows[-1], f"{row['scene']}{': ' if said else ''}{'; '.join(said)}")
    return rows


def main(words: list[str] | None = None) -> int:
    read = parser("random_scenes", __doc__)
    read.add_argument("first", type=int, nargs="?", default=0, help="the first seed (0)")
    read.add_argument("count", type=at_least_one, nargs="?", default=200, help="how many seeds (200)")
    read.add_argument("--steps", type=at_least_one, default=60, help="of each scene (60)")
    read.add_argument("--processes", type=at_least_one, default=os.cpu_count(), help="at a time (as many as cores)")
    given = read.parse_args(words)
    about = say_machine()
    rows = study(given.first, given.count, given.steps, given.processes)
    record("random_scenes", about, rows)
    faults = [row for row in rows if any(not note["reason"] for note in row["notes"])]
    noted = sum(bool(row["notes"]) for row in rows)
    print(f"{len(rows)} scenes: {noted} with notes, {len(faults)} of them without a reason")
    for row in faults:
        print(f"seed {row['seed']}: {'; '.join(note['fault'] for note in row['notes'] if not note['reason'])}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
