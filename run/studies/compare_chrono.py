"""One cold time step of settled spheres by Chrono and by this project, the same cone problem and one core:
run/study compare_chrono [N] [--solvers A,B] [--seconds S]. Writes results/compare_chrono.json.

Chrono is not part of this project. Its driver is built once, outside the repository:

    apt-get install cmake g++ libeigen3-dev libthrust-dev
    git clone https://github.com/projectchrono/chrono ~/chrono
    run/studies/chrono/build ~/chrono        # half an hour or more: it builds Chrono too

or $PCTT_CHRONO names a driver. The state is the settled mixer of size N.

Both solve min 1/2 g'Ng + r'g over the friction cones with r = gap/dt + D'v_free. What is set so that it is one problem:

- a contact is every pair within the contact distance (mixer: .02 m), without the margins for fast bodies that a run
  adds. Chrono's envelope is half that distance;
- Chrono lets an impulse act on the surface point of each of its two bodies, this project half-way between the two
  surfaces. Here the arms end on the surfaces, too;
- Chrono's planes are thick fixed boxes. The paddle has its velocity in both; Chrono's core, which takes no velocity
  of fixed bodies, has it as a body of 1e12 kg;
- in Multicore alpha is 0 (no Baumgarte damping), contact_recovery_speed is -1 (gap/dt without a bound), the mode is
  SLIDING (no rolling or spinning friction), and there are neither compliance, cohesion nor restitution. In the core
  the greatest recovery speed is 1e30 m/s, and nothing is taken from earlier steps;
- Chrono's own tolerances are zero. It is asked for more and more iterations until OUR natural residual of its
  impulses is below the tolerance, then for the least number that does (to a tenth), and that run is timed.

Seconds are medians of three, on one core. `solve` has the solver with its set-up, `step` the search for contacts and
the assembly as well.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from shared import Row, Table, keep_to_one_core, listed, medians, parser, record, say_machine, settled, settled_steps

from dem import quaternion
from dem.bodies import SPHERE
from dem.contact import Contacts, find_contacts
from dem.contact.search import contact_frames
from dem.contact_map import ContactMap
from dem.model.world import World
from dem.motion import Fixed
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.start import new_world
from dem.step.system import ContactSystem, gap_velocities
from dem.unconstrained import unconstrained
from pctt import ccp
from pctt.scenes import Mixer

COMM = MPI.COMM_SELF
TOLERANCES = (1e-4, 1e-6)
SOLVERS = ("multicore apgd", "multicore bb", "core psor", "core bb")
REPEATS = 3
PHASES = ("collision", "setup", "solve", "step")
CLOSE_ENOUGH = 1.1  # between the least number of iterations and the one that is timed
CONTACT = np.dtype(
    [("body", "f8", 2), ("impulse", "f8", 3), ("normal", "f8", 3), ("on_first", "f8", 3), ("on_second", "f8", 3)]
)


class DriverError(Exception):
    """Chrono's driver is missing, has failed, or has other contacts."""


class State(NamedTuple):
    """A step to be made."""

    name: str
    world: World  #: whose large bodies have one part each
    dt: float  #: [s]
    delta: float  #: contact distance [m]


def settled_mixer(n: int) -> State:
    """The settled mixer, with a body for each of its walls: so two bodies have one contact at most."""
    mixer = Mixer(n=n)
    sim = settled(mixer, dt=0.025)
    found, grains = sim.world, sim.world.grains
    scene = Scene(mixer.friction, found.gravity.tolist())
    speeds = {"velocity": grains.velocity[:, :3], "angular_velocity": grains.velocity[:, 3:]}
    scene.add_spheres(grains.position, grains.size[:, 0], mixer.density, **speeds)
    for row, body in enumerate(found.large_bodies):
        place = {"position": found.large.position[row], "quaternion": found.large.quaternion[row]}
        for number, part in enumerate(body.shapes):
            scene.add_body(f"{body.name} {number}", [part], body.motion, **place)
    return State(f"mixer n = {n}", new_world(scene, COMM, np.inf), sim.settings.dt, sim.settings.delta)


class Step(NamedTuple):
    """Our side of the comparison."""

    problem: ccp.ConeProblem
    frame: np.ndarray  #: (nc, 3, 3)
    body: np.ndarray  #: (nc, 2) global indices: spheres, then large bodies
    floor_force: Callable[[np.ndarray], float]  #: of impulses [N]


def assembled(state: State, contacts: Contacts) -> Step:
    """The cone problem of the step, with arms that end on the surfaces of the bodies."""
    world, dt = state.world, state.dt
    system = ContactSystem(world, contacts, unconstrained(world, dt))
    half = 0.5 * contacts.gap[:, None] * contacts.normal
    position = contacts.near.bodies.position
    arms = [contacts.point - half - position[contacts.a], contacts.point + half - position[contacts.b]]
    arm = np.ascontiguousarray(np.hstack(arms))
    G = ContactMap(COMM, replace(system.contact_map.source, arm=arm))
    r = G.relative_velocities(np.vstack([system.free_velocity, np.zeros(6)]))
    r[:, 0] += gap_velocities(world, contacts, dt, np.inf)[2]
    on_floor = contacts.body[:, 1] == world.slabs[-1] + _floor(world)

    def floor_force(impulse: np.ndarray) -> float:
        return -float(np.einsum("ci,ci->", impulse[on_floor], system.frame[on_floor, :, 2])) / dt

    problem = ccp.ConeProblem(COMM, r, system.mu, G=G, point=system.point)
    return Step(problem, system.frame, contacts.body, floor_force)


def _floor(world: World) -> int:
    """The row of the plane that looks upwards."""
    parts = [body.shapes[0] for body in world.large_bodies]
    return next(row for row, part in enumerate(parts) if isinstance(part, Plane) and part.normal[2] > 0.99)


# -- Chrono -----------------------------------------------------------------------------------------------------


def driver() -> Path:
    """The program of chrono/driver.cpp; DriverError if it is not built."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    path = Path(os.environ.get("PCTT_CHRONO") or Path(cache) / "pctt" / "chrono" / "driver")
    if not os.access(path, os.X_OK):
        raise DriverError(
            f"Chrono's driver {path} is not built. Install cmake, g++, libeigen3-dev and libthrust-dev, get the source "
            "of Chrono (git clone https://github.com/projectchrono/chrono) and call run/studies/chrono/build SOURCE, "
            "or let PCTT_CHRONO name a driver"
        )
    return path


def scene_text(state: State) -> str:
    """The state as chrono/driver.cpp reads it. ValueError if it has other shapes than spheres, planes and boxes."""
    world = state.world
    grains, friction = world.grains, np.unique(world.pairs.friction)
    if (grains.shape != SPHERE).any() or len(friction) > 1:
        raise ValueError("Chrono's driver has spheres of one material")
    spheres = np.column_stack([grains.position, grains.velocity, grains.size[:, 0], grains.mass, grains.inertia[:, 0]])
    boxes = _boxes(world, state.dt)
    head = [*world.gravity, state.dt, state.delta, friction[0]]
    lines = [" ".join(map(repr, map(float, head))), f"{len(spheres)} {len(boxes)}"]
    lines += [" ".join(map(repr, row)) for row in [*spheres.tolist(), *boxes.tolist()]]
    return "\n".join(lines) + "\n"


def _boxes(world: World, dt: float) -> np.ndarray:
    """Position, quaternion, velocity and half extents (large bodies, 16) of the large bodies; planes as thick boxes."""
    low, high = world.grains.position.min(axis=0), world.grains.position.max(axis=0)
    middle, reach = (low + high) / 2, float(np.linalg.norm(high - low)) + 1.0
    rows = []
    for row, velocity in enumerate(unconstrained(world, dt).prescribed):
        body = world.large_bodies[row]
        (part,) = body.shapes
        place, turn = world.large.position[row], world.large.quaternion[row]
        center = place + quaternion.rotate(turn, np.array(part.center))
        if isinstance(part, Plane) and isinstance(body.motion, Fixed):
            normal = quaternion.rotate(turn, np.array(part.normal))
            across = contact_frames(normal[None])[0]
            turn = quaternion.from_matrix(np.stack([across[1], across[2], normal], axis=1))
            foot = middle - (middle - center) @ normal * normal
            center, half = foot - reach * normal, np.full(3, reach)
        elif isinstance(part, Box):
            turn, half = quaternion.multiply(turn, np.array(part.quaternion)), np.array(part.half_extents)
            velocity = velocity.copy()
            velocity[:3] += np.cross(velocity[3:], center - place)
        else:
            raise ValueError(f"Chrono's driver has fixed planes and boxes, body {body.name!r} is neither")
        rows.append(np.concatenate([center, turn, velocity, half]))
    return np.array(rows).reshape(-1, 16)


def mapped(body: np.ndarray, frame: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Impulses (nc, 3) in our frames (nc, 3, 3) of contacts between the bodies (nc, 2), from Chrono's contacts, an
    array of CONTACT in any order. DriverError unless these are between the same pairs of bodies."""

    def names(pairs: np.ndarray) -> np.ndarray:
        ordered = np.sort(pairs.astype(np.int64), axis=1)
        return ordered[:, 0] << 32 | ordered[:, 1]

    ours, other = names(body), names(theirs["body"])
    if len(np.unique(ours)) != len(ours) or not np.array_equal(np.sort(ours), np.sort(other)):
        alone = len(np.setdiff1d(ours, other)), len(np.setdiff1d(other, ours))
        raise DriverError(
            f"not the same contacts: {len(ours)} here and {len(other)} in Chrono; "
            f"{alone[0]} are only here, {alone[1]} only there"
        )
    found = np.empty(len(ours), dtype=theirs.dtype)
    found[np.argsort(ours)] = theirs[np.argsort(other)]
    same_way = found["body"][:, 0] == body[:, 0]
    impulse = np.where(same_way[:, None], 1.0, -1.0) * found["impulse"]
    return np.einsum("cij,cj->ci", frame, impulse)


@dataclass
class Chrono:
    """Runs of the driver on one scene; those with one number of iterations are kept."""

    scene: Path
    step: Step
    solver: str
    seconds: float  #: of a run, after which no longer one is begun
    kept: dict[int, Row] = field(default_factory=dict)

    def run(self, iterations: int, repeats: int = 1) -> Row:
        """Seconds, and the accuracy of the impulses as solutions of our problem."""
        if iterations in self.kept and repeats == 1:
            return self.kept[iterations]
        with tempfile.NamedTemporaryFile() as file:
            command = [driver(), self.scene, self.solver, iterations, repeats, file.name]
            done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
            if done.returncode:
                raise DriverError(f"Chrono's driver failed: {done.stderr.strip() or done.returncode}")
            theirs = np.fromfile(file.name, CONTACT)
        said = json.loads(done.stdout.splitlines()[-1])
        seconds = [dict(zip(PHASES, each)) for each in zip(*(said[name] for name in PHASES))]
        row = {"solver": f"Chrono {said['version']} {self.solver}", "iterations": iterations}
        impulse = mapped(self.step.body, self.step.frame, theirs)
        self.kept[iterations] = row | medians(seconds, *PHASES) | accuracy(self.step, impulse)
        return self.kept[iterations]

    def least(self, tol: float, start: int = 25) -> Row | None:
        """The run with the least iterations, to CLOSE_ENOUGH, that gets to the residual; None if none does in time."""
        below, above = 0, start
        while self.run(above)["residual"] > tol:
            if self.run(above)["solve"] > self.seconds / 2:
                return None
            below, above = above, 2 * above
        while above > CLOSE_ENOUGH * max(below, 1):
            middle = (below + above) // 2
            below, above = (below, middle) if self.run(middle)["residual"] <= tol else (middle, above)
        return self.run(above)


def accuracy(step: Step, impulse: np.ndarray) -> dict[str, float]:
    found = ccp.measure(step.problem, impulse)
    figures = {"residual": found.natural_residual, "objective": found.objective}
    return figures | {"floor_force": step.floor_force(impulse)}


# -- this project -----------------------------------------------------------------------------------------------


def warm_up() -> None:
    """Have the compiled loops of `apgd` come before the clock runs: solve a chain of five spheres."""
    normal = np.tile(np.eye(3).ravel(), (4, 1))
    arm = np.tile([0.1, 0.0, 0.0, -0.1, 0.0, 0.0], (4, 1))
    pairs = np.arange(4)[:, None] + [0, 1]
    G = ccp.CompactRows(normal, arm, pairs, np.ones((5, 6)), 5)
    r = np.tile([-1.0, 0.1, 0.0], (4, 1))
    with ccp.ConeProblem(COMM, r, np.full(4, 0.3), G=G) as problem:
        ccp.solve(problem, None, "apgd", ccp.Limits(1e-8), law=ccp.RELAXATION)


def own(state: State, tol: float, repeats: int) -> Row:
    """`apgd` from a cold start."""
    seconds: list[dict[str, float]] = []
    for _ in range(repeats):
        start = time.perf_counter()
        contacts = find_contacts(state.world, state.delta)
        searched = time.perf_counter()
        step = assembled(state, contacts)
        ready = time.perf_counter()
        found = ccp.solve(step.problem, None, "apgd", ccp.Limits(tol, 10_000_000, np.inf), law=ccp.RELAXATION)
        end = time.perf_counter()
        parts = (searched - start, ready - searched, end - ready, end - start)
        seconds.append(dict(zip(PHASES, parts)))
    row = {"solver": "pctt apgd", "iterations": found.iterations} | medians(seconds, *PHASES)
    return row | accuracy(step, found.impulse)


def warm(n: int, tol: float) -> Row:
    """Steps of a run of the mixer, each from the impulses of the last."""
    words = ("-output_every", 0, "-ccp_closing_work", "inf", "-ccp_type", "apgd", "-ccp_tol", tol, "-law", "relaxation")
    _, lines = settled_steps("mixer", n, 6, *words)
    lines = [line | {"solve": line["phases"]["solve"], "step": line["seconds"]} for line in lines[1:]]
    return {"solver": "pctt apgd, warm", **medians(lines, "iterations", "solve", "step")}


# -- the table ----------------------------------------------------------------------------------------------------


def compare(state: State, n: int, solvers: list[str], seconds: float, path: Path) -> list[Row]:
    step = assembled(state, find_contacts(state.world, state.delta))
    print(f"{state.name}, {step.problem.size} contacts, medians of {REPEATS}")
    table = Table(
        solver=("solver", "<28"), to=("tol", "7.0e"), iterations=("iterations", "10.0f"),
        residual=(lambda row: f"{row['residual']:.1e}" if "residual" in row else "", "9"), solve_s=("solve", "9.3f"),
        ms_each=(lambda row: 1e3 * row["solve"] / max(row["iterations"], 1), "7.2f"), step_s=("step", "9.3f"),
        solve_to_apgd=(lambda row: row["solve"] / ours["solve"], "13.2f"),
        step_to_apgd=(lambda row: row["step"] / ours["step"], "12.2f"),
    )  # fmt: skip
    rows: list[Row] = []
    theirs = [Chrono(path, step, solver, seconds) for solver in solvers]
    for tol in TOLERANCES:
        ours = own(state, tol, REPEATS)
        rows += [found | {"tol": tol} for found in (ours, warm(n, tol))]
        for row in rows[-2:]:
            table.add(row)
        for chrono in theirs:
            least = chrono.least(tol)
            if least is None:
                rows.append(min(chrono.kept.values(), key=lambda run: run["residual"]) | {"tol": tol, "reached": False})
                table.add(rows[-1], f"not within {seconds:g} s")
            else:
                rows.append(chrono.run(least["iterations"], REPEATS) | {"tol": tol})
                table.add(rows[-1])
    reference = own(state, 1e-9, 1) | {"tol": 1e-9}
    print("agreement: objective [J] and force on the floor [N]")
    for row in [reference, *(row for row in rows if "objective" in row)]:
        figures = f"{row['objective']:.9g} {row['floor_force']:.8g}"
        print(f"{row['solver']:28} residual {row['residual']:.1e}: {figures}")
    case = {"state": state.name, "contacts": step.problem.size, "repeats": REPEATS}
    return [case | row for row in [*rows, reference]]


def main() -> None:
    line = parser("compare_chrono", __doc__)
    line.add_argument("n", type=int, nargs="?", default=8, help="size of the mixer (8)")
    solvers, known = ",".join(SOLVERS[:3]), ", ".join(SOLVERS)
    line.add_argument("--solvers", type=listed(known=SOLVERS), default=solvers, help=f"of {known} (the first three)")
    line.add_argument("--seconds", type=float, default=100.0, help="limit of a run of Chrono (100)")
    words = line.parse_args()
    keep_to_one_core()
    try:
        driver()
        about = say_machine()
        warm_up()
        state = settled_mixer(words.n)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scene.txt"
            path.write_text(scene_text(state))
            record("compare_chrono", about, compare(state, words.n, words.solvers, words.seconds, path))
    except DriverError as error:
        line.exit(1, f"{error}\n")


if __name__ == "__main__":
    main()
