"""One solver on one cone problem, in a process of its own so that its time and memory can be limited and measured:
run/studies/solve_one.py FILE METHOD TOL SECONDS prints a JSON object. METHOD is of pctt.ccp.SOLVERS, `coulomb
NAME` for one of them within -ccp_coulomb, or of peers.PEERS."""

from __future__ import annotations

import json
import math
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import peers
from mpi4py import MPI
from shared import Counter

from pctt import ccp
from pctt.ccp import fclib


class OutOfTimeError(Exception):
    """The solver has had its seconds."""


class Watch:
    """The course of a solver: what every look at the natural residual found, and what had been done until then."""

    def __init__(self, problem: ccp.ConeProblem, newton: ccp.Newton | None, products: Counter, seconds: float):
        self.newton, self.products, self.seconds = newton, products, seconds
        self.course: list[tuple[float, float, int, int]] = []
        self._look = problem.natural_residual
        problem.natural_residual = self.look  # type: ignore[method-assign]
        self.start = time.perf_counter()

    def look(self, g: np.ndarray, y: np.ndarray, coulomb: bool = False) -> float:
        residual = self._look(g, y, coulomb)
        spent = time.perf_counter() - self.start
        self.course.append((spent, residual, self.products.calls, self.newton.ksp_its if self.newton else 0))
        if spent > self.seconds:
            raise OutOfTimeError
        return residual


def own(problem: ccp.ConeProblem, name: str, tol: float, seconds: float, coulomb: bool) -> dict[str, Any]:
    """A solver of the registry from a cold start."""
    newton = ccp.newton_for(problem.comm, name) if ccp.SOLVERS[name].newton else None
    limits = ccp.Limits(tol, 10_000_000 if not newton else -1, math.inf, fallback=False)
    law = ccp.Coulomb() if coulomb else None
    impulse = None
    with Counter(type(problem.operator), "add_delassus", "find_image") as products:
        watch = Watch(problem, newton, products, seconds)
        try:
            result = ccp.solve(problem, None, name, limits, None, newton, law)
            impulse, reason, solver = result.impulse, result.reason, result.solver
        except OutOfTimeError:
            reason, solver = f"{seconds:g} s", name
        spent = time.perf_counter() - watch.start
    del problem.natural_residual
    ksp_its = newton.ksp_its if newton else 0
    found = {"seconds": spent, "reason": reason, "solver": solver, "products": products.calls, "ksp_its": ksp_its}
    return {**found, "course": watch.course[1:], "impulse": impulse}


def peer(problem: ccp.ConeProblem, name: str, tol: float, seconds: float) -> dict[str, Any]:
    """A solver of another project."""
    start = time.perf_counter()
    impulse, reason = peers.PEERS[name].solve(problem, tol, seconds)
    return {"seconds": time.perf_counter() - start, "reason": reason, "impulse": impulse}


def write(path: Path, problem: ccp.ConeProblem) -> None:
    """A problem of frames and arms on one rank, for `read`."""
    G = vars(problem.contact_map.given)
    np.savez(path, r=problem.r, mu=problem.mu, point=problem.point, compliance=problem.compliance[:, 0], **G)


def read(path: str) -> ccp.ConeProblem:
    """The problem in a file of `write`, or in an FCLIB file."""
    if not path.endswith(".npz"):
        return fclib.read(path, MPI.COMM_SELF)
    with np.load(path) as file:
        G = ccp.CompactRows(*(file[name] for name in ("frame", "arm", "body", "root")), int(file["columns"]))
        rest = {"point": file["point"], "compliance": file["compliance"]}
        return ccp.ConeProblem(MPI.COMM_SELF, file["r"], file["mu"], G=G, **rest)


def warm_up(method: str) -> None:
    """Have compiled loops come before the clock runs: solve a chain of five spheres."""
    name = method.rpartition(" ")[2]
    if name not in ccp.SOLVERS:
        return
    normal = np.tile(np.eye(3).ravel(), (4, 1))
    arm = np.tile([0.1, 0.0, 0.0, -0.1, 0.0, 0.0], (4, 1))
    pairs = np.arange(4)[:, None] + [0, 1]
    G = ccp.CompactRows(normal, arm, pairs, np.ones((5, 6)), 5)
    r = np.tile([-1.0, 0.1, 0.0], (4, 1))
    with ccp.ConeProblem(MPI.COMM_SELF, r, np.full(4, 0.3), G=G) as problem:
        ccp.solve(problem, None, name, ccp.Limits(1e-8))


def main(path: str, method: str, tol: float, seconds: float) -> None:
    problem = read(path)
    warm_up(method)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if method in peers.PEERS:
        found = peer(problem, method, tol, seconds)
    else:
        law, _, name = method.rpartition(" ")
        found = own(problem, name, tol, seconds, law == "coulomb")
    found["memory_mb"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    impulse = found.pop("impulse")
    if impulse is not None and np.isfinite(impulse).all():
        accuracy = ccp.measure(problem, impulse)
        found |= {name: getattr(accuracy, name) for name in ("natural_residual", "coulomb_residual", "objective")}
    print(json.dumps(found))


if __name__ == "__main__":
    path, method, tol, seconds = sys.argv[1:]
    main(path, method, float(tol), float(seconds))
