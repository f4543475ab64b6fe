"""Every solver of the cone problem on settled mixer steps and on harder variants: run/study compare_solvers [N ...]
[options], default 4 8 16; --help lists the options. Peers (Siconos, Clarabel) are in it where they are installed:
apt-get install python3-siconos, .venv/bin/pip install -e '.[peers]'. Writes results/compare_solvers.json and
results/compare_solvers.png.

A solver starts cold. Its seconds are those until it first looked at a natural residual below the tolerance, in a
process of its own on one core; what has not got there after --seconds is printed as such, with where it stood.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import solve_one
from measure import figure, record, say_machine
from mpi4py import MPI
from peers import PEERS

from dem.contact import find_contacts
from dem.scenes import Mixer
from dem.system import ContactSystem
from pctt import ccp
from pctt.run.stepper import cone_problem
from pctt.simulation import Simulation

COMM = MPI.COMM_SELF
TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8)
HEAVIER = 1000.0
COURSE_DEPENDS_ON_TOL = ("pdip", "auto")  # the others pass 1e-2 and 1e-4 on the way to 1e-8
COULOMB = ("coulomb apgd", "coulomb conic", "coulomb auto")
VARIANTS = {
    "settled": "a step of the settled packing",
    "friction": "the same with a friction coefficient of 0.8",
    "heavy": "the same with the uppermost grain 1000 times heavier",
    "loose": "the packing stretched by 1 % in height, grains at random velocities of 0.5 m/s and falling",
}


def step_problem(n: int, variant: str, compliance: float) -> ccp.ConeProblem:
    """The cone problem of the first step after the settled state of a mixer."""
    sim = Simulation(Mixer(n=n), restart="settled")
    world, settings, grains = sim.world, sim.settings, sim.world.grains
    if variant == "loose":
        rng = np.random.default_rng(0)
        grains.position[:, 2] *= 1.01
        grains.velocity[:, :3] += 0.5 * rng.normal(size=(len(grains), 3)) - np.array([0, 0, 0.5])
    contacts = find_contacts(world, settings.delta, settings.dt)
    system = ContactSystem(world, contacts, settings.dt, settings.recovery_speed)
    problem = cone_problem(system, COMM, compliance)
    mu, G = problem.mu, problem.contact_map.given
    if variant == "friction":
        mu = np.full_like(mu, 0.8)
    if variant == "heavy":
        touched = np.unique(G.body[G.body >= 0])
        top = touched[np.argmax(grains.position[touched[touched < len(grains)], 2])]
        root = G.root.copy()
        root[top] /= np.sqrt(HEAVIER)
        G = dataclasses.replace(G, root=root)
    return ccp.ConeProblem(COMM, problem.r, mu, G=G, point=problem.point, compliance=compliance)


def copied(problem: ccp.ConeProblem, count: int) -> ccp.ConeProblem:
    """Copies of a problem side by side, without contact between them."""
    if count == 1:
        return problem
    G = problem.contact_map.given
    which = np.repeat(np.arange(count), G.rows)[:, None]
    body = np.tile(G.body, (count, 1))
    body = np.where(body >= 0, body + which * G.columns, -1)
    many = [np.tile(column, (count, 1)) for column in (G.frame, G.arm)]
    G = ccp.CompactRows(*many, body, np.tile(G.root, (count, 1)), count * G.columns)
    points = np.tile(problem.point, (count, 1))
    points[:, 0] += which[:, 0] * np.ptp(problem.point[:, 0])
    r, mu = np.tile(problem.r, (count, 1)), np.tile(problem.mu, count)
    return ccp.ConeProblem(COMM, r, mu, G=G, point=points, compliance=problem.softness)


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


def main() -> None:
    parser = argparse.ArgumentParser(prog="run/study compare_solvers", description=__doc__)
    parser.add_argument("n", type=int, nargs="*", default=[4, 8, 16], help="sizes of the mixer")
    parser.add_argument("--seconds", type=float, default=60.0, help="limit of a run")
    parser.add_argument("--variants", default=",".join(VARIANTS), help="with commas between")
    parser.add_argument("--compliance", default="0,1e-5", help="the later ones for `settled` only")
    parser.add_argument("--methods", default="", help="instead of all, with commas between")
    parser.add_argument("--peers-up-to", type=int, default=8, help="largest n that peers get")
    parser.add_argument("--copies", type=int, default=1, help="of the problem, side by side: n = 32 has 8 of n = 16")
    words = parser.parse_args()
    everything = [*ccp.SOLVERS, *COULOMB, *(name for name, peer in PEERS.items() if peer.installed)]
    methods = words.methods.split(",") if words.methods else everything
    variants = words.variants.split(",")
    for kind, given, allowed in (("--methods", methods, everything), ("--variants", variants, VARIANTS)):
        for name in given:
            if name not in allowed:
                parser.error(f"{kind} {name}: allowed is {', '.join(allowed)}")
    about = say_machine()
    record_rows: list[dict[str, Any]] = []
    compliances = [float(word) for word in words.compliance.split(",")]
    cases = [(n, v, e) for n in words.n for e in compliances for v in variants if v == "settled" or e == compliances[0]]
    for n, variant, compliance in cases:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "problem.npz"
            problem = copied(step_problem(n, variant, compliance), words.copies)
            solve_one.write(path, problem)
            title = f"mixer n = {n}, {problem.size} contacts, {VARIANTS[variant]}, compliance {compliance:g}"
            title += f", {words.copies} copies" * (words.copies > 1)
            heads = " ".join(f"{tol:9.0e}" for tol in TOLERANCES)
            print(f"\n{title}; limit {words.seconds:g} s\n{'seconds to':18} {heads} products   Krylov       MB")
            table = {}
            for method in methods:
                if method in PEERS and n > words.peers_up_to:
                    continue
                rows = table[method] = (peer_rows if method in PEERS else own_rows)(path, method, words.seconds)
                case = {"n": n, "variant": variant, "compliance": compliance, "contacts": problem.size}
                case |= {"method": method, "copies": words.copies}
                record_rows += [case | row for row in rows]
                show(method, rows)
        record("compare_solvers", about, record_rows)
        plot(f"compare_solvers_n{n}_{variant}_{compliance:g}", title, table)


if __name__ == "__main__":
    main()
