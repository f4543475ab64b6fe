"""One solver on one cone problem, in a process of its own so that its time and memory can be limited and measured:
run/solve_one.py FILE METHOD TOL SECONDS prints a JSON object. METHOD is of pctt.ccp.SOLVERS, `coulomb NAME` for one of
them within -ccp_coulomb, or of peers.PEERS."""

from __future__ import annotations

import json
import resource
import sys
import time
from typing import Any

import numpy as np
import peers
from mpi4py import MPI

from pctt import ccp
from pctt.ccp import fclib


class OutOfTimeError(Exception):
    """The solver has had its seconds."""


class Watch:
    """The course of a solver: what every look at the natural residual found, and what had been done until then."""

    def __init__(self, problem: ccp.ConeProblem, newton: ccp.Newton | None, seconds: float):
        self.newton, self.seconds = newton, seconds
        self.course: list[tuple[float, float, int, int]] = []
        self.products = 0
        self._look, self._product = problem.natural_residual, problem.product
        problem.natural_residual, problem.product = self.look, self.product  # type: ignore[method-assign]
        self.start = time.perf_counter()

    def look(self, g: np.ndarray, y: np.ndarray) -> float:
        residual = self._look(g, y)
        spent = time.perf_counter() - self.start
        self.course.append((spent, residual, self.products, self.newton.ksp_its if self.newton else 0))
        if spent > self.seconds:
            raise OutOfTimeError
        return residual

    def product(self, g: np.ndarray) -> np.ndarray:
        self.products += 1
        return self._product(g)


def own(problem: ccp.ConeProblem, name: str, tol: float, seconds: float, coulomb: bool) -> dict[str, Any]:
    """A solver of the registry from a cold start."""
    newton = ccp.newton_for(problem.comm, name) if ccp.SOLVERS[name].newton else None
    watch = Watch(problem, newton, seconds)
    limits = ccp.Limits(tol, 10_000_000 if not newton else -1)
    law = ccp.Coulomb() if coulomb else None
    impulse = None
    try:
        result = ccp.solve(problem, None, name, limits, None, newton, law)
        impulse, reason, solver = result.impulse, result.reason, result.solver or name
    except OutOfTimeError:
        reason, solver = f"{seconds:g} s", name
    spent = time.perf_counter() - watch.start
    del problem.natural_residual, problem.product
    ksp_its = newton.ksp_its if newton else 0
    found = {"seconds": spent, "reason": reason, "solver": solver, "products": watch.products, "ksp_its": ksp_its}
    return {**found, "course": watch.course[1:], "impulse": impulse}


def main(path: str, method: str, tol: float, seconds: float) -> None:
    problem = fclib.read(path, MPI.COMM_SELF)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if method in peers.PEERS:
        start = time.perf_counter()
        impulse, reason = peers.PEERS[method].solve(problem, tol, seconds)
        found: dict[str, Any] = {"seconds": time.perf_counter() - start, "reason": reason, "impulse": impulse}
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
