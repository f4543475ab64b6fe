"""Solvers of the cone problem, and laws of friction, beside each other:

    run/study compare solvers [N ...] [options]     default 4 8 16
    run/study compare laws [N ...]                  default 4

`solvers`: every solver of the cone problem on settled mixer steps and on harder variants. Peers (Siconos, Clarabel) are
in it where they are installed: apt-get install python3-siconos, .venv/bin/pip install -e '.[peers]'. A solver starts
cold. Its seconds are those until it first looked at a natural residual below the tolerance, in a process of its own on
one core; what has not got there after --seconds is printed as such, with where it stood.

`laws`: Coulomb's law beside its relaxation, steps from settled states: seconds, iterations, overlap, Coulomb residual;
and how high a sliding box and a sphere on a turning table fly.

Writes results/compare_solvers.json and .png, or results/compare_laws.json.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import solve_one
from mpi4py import MPI
from peers import PEERS
from shared import figure, record, results, say_machine

from dem.contact import find_contacts
from dem.motion import Rotation
from dem.scene import Scene
from dem.scenes import Mixer
from dem.shapes import Box
from dem.system import ContactSystem
from pctt import ccp
from pctt.run.stepper import cone_problem
from pctt.simulation import Simulation

COMM = MPI.COMM_SELF
TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8)
HEAVIER = 1000.0
COURSE_DEPENDS_ON_TOL = ("pdip", "auto")  # the others pass 1e-2 and 1e-4 on the way to 1e-8
COULOMB = ("coulomb apgd", "coulomb conic", "coulomb auto")
SCENES = ("mixer", "blade", "shear")
METHODS = {("apgd", "1e-4"): 20, ("conic", "1e-6"): 5}  # and how many steps
MOST = 10  # cone problems where a method's own way to the law ends early
VARIANTS = {
    "settled": "a step of the settled packing",
    "friction": "the same with a friction coefficient of 0.8",
    "heavy": "the same with the uppermost grain 1000 times heavier",
    "loose": "the packing stretched by 1 % in height, grains at random velocities of 0.5 m/s and falling",
}


def step_problem(n: int, variant: str, stiffness: float) -> ccp.ConeProblem:
    """The cone problem of the first step after the settled state of a mixer."""
    sim = Simulation(Mixer(n=n), restart="settled", comm=COMM)
    world, settings, grains = sim.world, sim.settings, sim.world.grains
    if variant == "loose":
        rng = np.random.default_rng(0)
        grains.position[:, 2] *= 1.01
        grains.velocity[:, :3] += 0.5 * rng.normal(size=(len(grains), 3)) - np.array([0, 0, 0.5])
    world.stiffness[:] = stiffness
    contacts = find_contacts(world, settings.delta, settings.dt)
    if variant == "friction":
        contacts.friction[:] = 0.8
    if variant == "heavy":
        touched = np.unique(contacts.body)
        top = touched[np.argmax(grains.position[touched[touched < len(grains)], 2])]
        grains.mass[top] *= HEAVIER
        grains.inertia[top] *= HEAVIER
        contacts = find_contacts(world, settings.delta, settings.dt)
    system = ContactSystem(world, contacts, settings.dt, settings.recovery_speed)
    return cone_problem(system, COMM)


def run(path: Path, method: str, tol: float, seconds: float) -> dict[str, Any]:
    """What solve_one.py says; {"reason": ...} alone where it was ended or failed."""
    words = [str(path), method, str(tol), str(seconds)]
    command = [sys.executable, str(Path(__file__).with_name("solve_one.py")), *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=2 * seconds + 15, check=True)
        return json.loads(done.stdout.splitlines()[-1])
    except subprocess.TimeoutExpired:
        return {"reason": f"{seconds:g} s"}
    except (subprocess.CalledProcessError, ValueError, IndexError) as error:
        said = (getattr(error, "stderr", "") or str(error)).strip().splitlines()
        return {"reason": f"failed: {said[-1] if said else error}"}


def own_rows(path: Path, method: str, seconds: float) -> list[dict[str, Any]]:
    """A row per tolerance, of one run or of as many."""
    several = method in COURSE_DEPENDS_ON_TOL or method in COULOMB
    runs = {tol: run(path, method, tol, seconds) for tol in (TOLERANCES if several else TOLERANCES[-1:])}
    rows = []
    for tol in TOLERANCES:
        found = runs.get(tol, runs[TOLERANCES[-1]])
        row = {"tol": tol, "reason": found["reason"], "memory_mb": found.get("memory_mb")}
        course = found.get("course", [])
        if method in COULOMB:
            if found.get("coulomb_residual", np.inf) <= 1.01 * tol:
                row |= {name: found[name] for name in ("seconds", "products", "ksp_its")}
        else:
            reached = next((look for look in course if look[1] <= tol), None)
            if reached and "unbounded" not in found["reason"]:
                row |= dict(zip(("seconds", "residual", "products", "ksp_its"), reached))
        row["best"] = found.get("coulomb_residual") if method in COULOMB else min((c[1] for c in course), default=None)
        row["solver"] = found.get("solver", method)
        rows.append(row)
    longest = max(runs.values(), key=lambda found: len(found.get("course", [])))
    rows[-1]["course"] = [look[:2] for look in longest.get("course", [])] if method not in COULOMB else []
    return rows


def peer_rows(path: Path, method: str, seconds: float) -> list[dict[str, Any]]:
    """The same for a peer: its own tolerance is tightened until our residual is below ours."""
    name = "coulomb_residual" if PEERS[method].coulomb else "natural_residual"
    rows: list[dict[str, Any]] = []
    theirs, found, course = 1e-1, {}, []
    for tol in TOLERANCES:
        while found.get(name, np.inf) > tol and theirs > 1e-12 and not found.get("reason", "").endswith(" s"):
            theirs *= 0.1
            found = run(path, method, theirs, seconds)
            course.append((found.get("seconds"), found.get(name)))
        reached = found.get(name, np.inf) <= tol
        row = {"tol": tol, "reason": found["reason"], "memory_mb": found.get("memory_mb"), "solver": method}
        rows.append(row | {"best": found.get(name)} | ({"seconds": found["seconds"]} if reached else {}))
    rows[-1]["course"] = [look for look in course if None not in look]
    return rows


def show(method: str, rows: list[dict[str, Any]]) -> None:
    """Seconds to each tolerance, then what the last one that was reached took."""
    cells = []
    for row in rows:
        marks = f" {row['solver'][0]}" if method.endswith("auto") and "seconds" in row else ""
        cells.append(f"{row['seconds']:9.2f}{marks}" if "seconds" in row else f"{'-':>9}")
    last = next((row for row in reversed(rows) if "seconds" in row), rows[-1])
    counts = f"{last.get('products', '')!s:>8} {last.get('ksp_its', '')!s:>8} {last['memory_mb'] or 0:8.0f}"
    best = rows[-1]["best"]
    remark = "" if "seconds" in rows[-1] else f"at {best:.1e}: {rows[-1]['reason']}" if best else rows[-1]["reason"]
    print(f"{method:18} {' '.join(cells)} {counts}  {remark}", flush=True)


def plot(name: str, title: str, table: dict[str, list[dict[str, Any]]]) -> None:
    with figure(name, 1) as panels:
        for axes in panels:
            for method, rows in table.items():
                course = np.array(rows[-1].get("course", []), dtype=float).reshape(-1, 2)
                course = course[np.isfinite(course).all(axis=1)]
                if len(course):
                    best = np.minimum.accumulate(course[:, 1])
                    axes.loglog(course[:, 0], best, label=method, ls="--" if method in PEERS else "-", lw=1.2)
            axes.set(xlabel="seconds", ylabel="natural residual", title=title, ylim=(1e-9, 2))
            axes.grid(alpha=0.3)
            axes.legend(fontsize=8)


def solvers(parser: argparse.ArgumentParser, words: argparse.Namespace) -> None:
    """Every solver of the cone problem on settled mixer steps and on harder variants."""
    everything = [*ccp.SOLVERS, *COULOMB, *(name for name, peer in PEERS.items() if peer.installed)]
    methods = words.methods.split(",") if words.methods else everything
    variants = words.variants.split(",")
    for kind, given, allowed in (("--methods", methods, everything), ("--variants", variants, VARIANTS)):
        for name in given:
            if name not in allowed:
                parser.error(f"{kind} {name}: allowed is {', '.join(allowed)}")
    about = say_machine()
    record_rows: list[dict[str, Any]] = []
    stiffnesses = [float(word) for word in words.stiffness.split(",")]
    cases = [(n, v, k) for n in words.n for k in stiffnesses for v in variants if v == "settled" or k == stiffnesses[0]]
    for n, variant, stiffness in cases:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "problem.npz"
            problem = step_problem(n, variant, stiffness)
            solve_one.write(path, problem)
            title = f"mixer n = {n}, {problem.size} contacts, {VARIANTS[variant]}, stiffness {stiffness:g} N/m"
            heads = " ".join(f"{tol:9.0e}" for tol in TOLERANCES)
            print(f"\n{title}; limit {words.seconds:g} s\n{'seconds to':18} {heads} products   Krylov       MB")
            table = {}
            for method in methods:
                if method in PEERS and n > words.peers_up_to:
                    continue
                rows = table[method] = (peer_rows if method in PEERS else own_rows)(path, method, words.seconds)
                case = {"n": n, "variant": variant, "stiffness": stiffness, "contacts": problem.size}
                record_rows += [case | {"method": method} | row for row in rows]
                show(method, rows)
        record("compare_solvers", about, record_rows)
        plot(f"compare_solvers_n{n}_{variant}_{stiffness:g}", title, table)


# -- laws of friction ---------------------------------------------------------------------------------------


def laws(sizes: list[int]) -> None:
    """Coulomb's law beside its relaxation: steps from settled states, and how high grains fly that slide."""
    about = say_machine()
    rows: list[dict] = []
    print("scene   n  method      law         seconds  solve s  iterations  overlap mm  Coulomb residual", end="")
    print("  not converged")
    for n in sizes:
        for scene in SCENES:
            for (method, tol), count in METHODS.items():
                rows += _both_laws(scene, n, method, tol, count)
    for law in ("relaxation", "Coulomb"):
        lifts = {name: 1e3 * lift(scene, law == "Coulomb") for name, scene in (("box", box()), ("sphere", sphere()))}
        print(f"{law:11} lift of the sliding box {lifts['box']:.3f} mm, of the sphere {lifts['sphere']:.3f} mm")
        rows.append({"law": law, **{f"lift_{name} [mm]": value for name, value in lifts.items()}})
    record("compare_laws", about, rows)


def _both_laws(scene: str, n: int, method: str, tol: str, count: int) -> list[dict]:
    """A row per law: medians of the steps, and the worst of the run."""
    rows = []
    for law, flags in (("relaxation", ("false",)), ("Coulomb", ("true", "-ccp_coulomb_max_it", MOST))):
        options = ("-scene", scene, "-scene_n", n, "-restart", "settled", "-steps", count, "-output_every", 0)
        options += ("-ccp_closing_work", "inf")
        _, steps = results(1, *options, "-ccp_type", method, "-ccp_tol", tol, "-ccp_coulomb", *flags)
        row = {
            "scene": scene,
            "n": n,
            "method": f"{method} {tol}",
            "law": law,
            "seconds": statistics.median(line["seconds"] for line in steps),
            "solve": statistics.median(line["phases"]["solve"] for line in steps),
            "iterations": statistics.mean(line["iterations"] for line in steps),
            "overlap [mm]": 1e3 * max(line["worst_overlap"] for line in steps),
            "coulomb_residual": max(line["coulomb_residual"] for line in steps),
            "not_converged": sum(not line["converged"] for line in steps),
            "laws": sorted({line["law"] for line in steps}),
        }
        print(
            f"{scene:6} {n:2d}  {row['method']:10}  {law:10} {row['seconds']:8.3f} {row['solve']:8.3f}"
            f" {row['iterations']:11.0f} {row['overlap [mm]']:11.2f} {row['coulomb_residual']:17.1e}"
            f" {row['not_converged']:14d}",
            flush=True,
        )
        rows.append(row)
    return rows


def box() -> Scene:
    """A cube of half extent .1 m, flush on a floor, at 2 m/s."""
    scene = Scene(friction=0.5)
    scene.add_body("floor", [Box((2, 2, 0.1))], position=(0, 0, -0.1))
    scene.add_boxes([0, 0, 0.1], (0.1, 0.1, 0.1), 1000.0, velocity=(2, 0, 0))
    return scene


def sphere() -> Scene:
    """A sphere of .1 m at rest on a table that turns once a second, .5 m from its axis."""
    scene = Scene(friction=0.5)
    scene.add_body("table", [Box((2, 2, 0.1))], Rotation((0, 0, 6.2832)), position=(0, 0, -0.1))
    scene.add_spheres([0.5, 0, 0.1], 0.1, 1000.0)
    return scene


def lift(scene: Scene, coulomb: bool) -> float:
    """How high the only grain gets above z = .1 m in 30 steps [m]."""
    sim, highest = Simulation(scene, dt=0.01, solver="apgd", tol=1e-8, coulomb=coulomb, comm=COMM), 0.0
    for _ in range(30):
        sim.step()
        highest = max(highest, float(sim.positions[0, 2]) - 0.1)
    return highest


def main() -> None:
    words = argparse.ArgumentParser("run/study compare", description=__doc__,
                                    formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    kinds = words.add_subparsers(dest="what", required=True)
    kinds.add_parser("laws").add_argument("n", type=int, nargs="*", default=[4], help="sizes of the scenes (4)")
    of_solvers = kinds.add_parser("solvers")
    of_solvers.add_argument("n", type=int, nargs="*", default=[4, 8, 16], help="sizes of the mixer")
    of_solvers.add_argument("--seconds", type=float, default=60.0, help="limit of a run")
    of_solvers.add_argument("--variants", default=",".join(VARIANTS), help="with commas between")
    of_solvers.add_argument("--stiffness", default="inf,1e8", help="N/m; the later ones for `settled` only")
    of_solvers.add_argument("--methods", default="", help="instead of all, with commas between")
    of_solvers.add_argument("--peers-up-to", type=int, default=8, help="largest n that peers get")
    given = words.parse_args()
    laws(given.n) if given.what == "laws" else solvers(of_solvers, given)


if __name__ == "__main__":
    main()
