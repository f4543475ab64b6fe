"""Products with the contact map, S and K, of frames and arms and of 3 x 6 blocks, on settled mixer steps:
run/study operators [N ...], default 8 16. Prints milliseconds, megabytes and GB/s; writes results/operators.json.

Megabytes are what a product has to bring from memory at least once and to write back: the storage of the map,
vectors of contacts and of bodies; what of it comes from a cache is not told apart. Medians of repetitions in turn.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import petsc4py

petsc4py.init([sys.argv[0]])

import numpy as np
from compare_solvers import COMM, step_problem
from measure import median_seconds, record, say_machine
from petsc4py import PETSc

from pctt import ccp
from pctt.block_diagonal import block_diagonal
from pctt.ccp.newton.body import BodyForm
from pctt.ccp.newton.contact import ContactForm

REPEAT = 41
NUMBER = 8.0  # bytes


def ways(problem: ccp.ConeProblem) -> dict[str, ccp.ConeProblem]:
    """The problem with its map in both storages."""
    G = problem.contact_map
    rest = {"point": problem.point, "compliance": problem.softness}
    return {
        "frames and arms": problem,
        "3 x 6 blocks": ccp.ConeProblem(COMM, problem.r, problem.mu, G=G.block_rows, **rest),
    }


def storage(problem: ccp.ConeProblem) -> float:
    """Bytes of the map's rows."""
    if not isinstance(problem.contact_map.given, ccp.CompactRows):
        G = problem.contact_map.block_rows
        return len(G.blocks) * (18 * NUMBER + 4) + 8 * G.rows
    given = problem.contact_map.given
    return given.rows * (15 * NUMBER + 8) + given.root.nbytes


def products(problem: ccp.ConeProblem) -> dict[str, tuple[Callable[[], Any], float]]:
    """By name: a product, and its bytes."""
    rng = np.random.default_rng(0)
    G = problem.contact_map
    g, v = rng.standard_normal((problem.size, 3)), rng.standard_normal((G.columns, 6))
    root = rng.standard_normal((problem.size, 3, 3))
    barrier = root @ root.transpose(0, 2, 1) + np.eye(3)
    contact, body = ContactForm(problem), BodyForm(problem)
    contact.update(barrier)
    body.update(barrier)
    of_contacts, of_bodies = contact.matrix.createVecs(), body.matrix.createVecs()
    of_contacts[0].array[:], of_bodies[0].array[:] = g.ravel(), v.ravel()
    rows, contacts, bodies = storage(problem), g.nbytes, v.nbytes
    return {
        "G v": (lambda: G.velocities(v), rows + bodies + 2 * contacts),
        "G'g": (lambda: G.momenta(g), rows + 2 * bodies + contacts),
        "S g": (
            lambda: contact.matrix.mult(*of_contacts),
            2 * rows + 6 * NUMBER * problem.size + 3 * contacts + 4 * bodies,
        ),
        "K v": (lambda: body.matrix.mult(*of_bodies), rows - 3 * NUMBER * problem.size + 5 * bodies),
        "S of a new barrier": (lambda: contact.update(barrier), 0.0),
        "K of a new barrier": (lambda: body.update(barrier), 0.0),
        "CG on K, block Jacobi": (iteration_of_cg(body, of_bodies), 0.0),
    }


def iteration_of_cg(body: BodyForm, vectors: tuple[PETSc.Vec, PETSc.Vec]) -> Callable[[], Any]:
    """Fifty iterations."""
    ksp = PETSc.KSP().create(COMM)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.pc.setType("pbjacobi")
    ksp.setOperators(body.matrix, block_diagonal(body.matrix))
    ksp.setTolerances(rtol=1e-300, atol=1e-300, max_it=50)
    b, x = vectors
    return lambda: ksp.solve(b, x)


def bandwidth() -> float:
    """GB/s of a = b + s c on arrays far larger than the caches."""
    b, c, a = np.random.default_rng(0).random((3, 20_000_000))
    return 5 * b.nbytes / median_seconds(lambda: np.add(np.multiply(c, 3.0, out=a), b, out=a), 7) / 1e9


def apgd_iteration(problem: ccp.ConeProblem) -> float:
    """Seconds of an iteration of APGD, of 200 from a cold start, less those of the first 20."""
    seconds = []
    for count in (20, 220):
        start = time.perf_counter()
        ccp.solve(problem, None, "apgd", ccp.Limits(1e-16, count, np.inf, fallback=False))
        seconds.append(time.perf_counter() - start)
    return (seconds[1] - seconds[0]) / 200


def main() -> None:
    parser = argparse.ArgumentParser(prog="run/study operators", description=__doc__)
    parser.add_argument("n", type=int, nargs="*", default=[8, 16], help="sizes of the mixer")
    words = parser.parse_args()
    about = say_machine()
    triad = bandwidth()
    print(f"memory: {triad:.1f} GB/s (a = b + s c in two passes)")
    rows: list[dict[str, Any]] = []
    for n in words.n:
        problem = step_problem(n, "settled", 0.0)
        print(f"\nmixer n = {n}, {problem.size} contacts, {problem.contact_map.columns} bodies")
        case = {"n": n, "contacts": problem.size}
        table = {way: products(p) for way, p in ways(problem).items()}
        seconds: dict[tuple[str, str], list[float]] = {}
        for _ in range(REPEAT):
            for way, calls in table.items():
                for name, (call, _) in calls.items():
                    start = time.perf_counter()
                    call()
                    seconds.setdefault((way, name), []).append(time.perf_counter() - start)
        for way, calls in table.items():
            print(f"{way}\n  {'':24} {'ms':>8} {'MB':>8} {'GB/s':>8}")
            for name, (_, size) in calls.items():
                median = statistics.median(seconds[way, name]) / (50 if name.startswith("CG") else 1)
                more = f" {size / 1e6:8.2f} {size / median / 1e9:8.1f}" if size else ""
                print(f"  {name:24} {1e3 * median:8.3f}{more}", flush=True)
                rows.append(case | {"way": way, "product": name, "seconds": median, "bytes": size})
        for way, p in ways(problem).items():
            median = statistics.median(apgd_iteration(p) for _ in range(3))
            print(f"iteration of APGD, {way:24} {1e3 * median:8.3f} ms", flush=True)
            rows.append(case | {"way": way, "product": "APGD", "seconds": median, "bytes": 0})
    record("operators", about | {"memory GB/s": triad}, rows)


if __name__ == "__main__":
    main()
