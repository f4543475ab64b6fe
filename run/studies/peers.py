"""Solvers of other projects on our cone problems, where they are installed.

`siconos soclcp` is Siconos' Gauss-Seidel for the second-order cone complementarity problem: the same convex problem
as ours. `siconos nsgs` and `siconos admm` solve Coulomb's law itself, as `-law coulomb` does: compare them with
that, by the Coulomb residual. `clarabel` is an interior point method for any conic program; it gets the dual of
ours,

    min 1/2 v'v + 1/2 w'w    subject to    G v + C^1/2 w + r in the dual cones,

whose multipliers are the impulses, or, where the problem is given by N, ours as it is. One thread each; their own
stop tests, tightened until ours is met.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from pctt import ccp

Found = tuple[np.ndarray, str]


@dataclass(frozen=True)
class Peer:
    """``solve(problem, tol, seconds)`` gives impulses (nc, 3) and how it ended; ``coulomb``: of Coulomb's law."""

    package: str
    solve: Callable[[ccp.ConeProblem, float, float], Found]
    coulomb: bool = False

    @property
    def installed(self) -> bool:
        return importlib.util.find_spec(self.package) is not None


def _contact_rows(problem: ccp.ConeProblem) -> sp.csr_matrix:
    """G (3 nc x 6 M)."""
    G = problem.contact_map.block_rows
    assert G is not None
    return sp.bsr_matrix((G.blocks, G.indices, G.indptr), shape=(3 * problem.size, 6 * G.columns)).tocsr()


def _delassus(problem: ccp.ConeProblem) -> sp.csr_matrix:
    """All of N, which for bodies with many contacts is more than problem.N."""
    if problem.contact_map is None:
        indptr, indices, values = problem.N.getValuesCSR()
        return sp.csr_matrix((values, indices, indptr), shape=problem.N.getSize())
    G = _contact_rows(problem)
    return (G @ G.T + sp.diags(problem.compliance.ravel())).tocsr()


def _siconos(solver: str, internal: bool = False) -> Callable[[ccp.ConeProblem, float, float], Found]:
    def solve(problem: ccp.ConeProblem, tol: float, seconds: float) -> Found:
        import siconos.numerics as numerics

        W = _delassus(problem).tocoo()
        W.row, W.col = W.row.astype(np.int64), W.col.astype(np.int64)
        count = problem.size
        with warnings.catch_warnings(), _no_output():
            warnings.simplefilter("ignore")
            theirs = numerics.FrictionContactProblem(3, count, W, problem.r.ravel(), problem.mu)
            options = numerics.SolverOptions(getattr(numerics, f"SICONOS_FRICTION_3D_{solver}"))
            for each in [options] + ([numerics.solver_options_get_internal_solver(options, 0)] if internal else []):
                each.dparam[numerics.SICONOS_DPARAM_TOL] = tol
                each.iparam[numerics.SICONOS_IPARAM_MAX_ITER] = 10_000_000
            impulse, velocity = np.zeros(3 * count), np.zeros(3 * count)
            info = numerics.fc3d_driver(theirs, impulse, velocity, options)
        done = options.iparam[numerics.SICONOS_IPARAM_ITER_DONE]
        return impulse.reshape(-1, 3), f"info {info}, {done} iterations"

    return solve


@contextlib.contextmanager
def _no_output() -> Iterator[None]:
    """Siconos prints from C."""
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def _clarabel(problem: ccp.ConeProblem, tol: float, seconds: float) -> Found:
    import clarabel

    # its tolerances are absolute: velocities in units of rms(r), N in units of its mean diagonal
    speed, mean = float(np.sqrt(np.mean(problem.r**2))) or 1.0, problem.mean_diagonal
    scale = np.ones((problem.size, 3))
    scale[:, 1:] = problem.mu[:, None]  # (y_n, mu y_t) is in a second-order cone, (z_n, mu z_t) are the impulses
    S, r = sp.diags(scale.ravel()), (scale * problem.r / speed).ravel()
    if problem.contact_map is None:
        P, q, A, b = S @ _delassus(problem) @ S / mean, r, -sp.identity(len(r)), np.zeros(len(r))
    else:
        rows = _contact_rows(problem)
        if problem.yields:
            rows = sp.hstack([rows, sp.diags(np.sqrt(problem.compliance.ravel()))])
        P, q, A, b = sp.identity(rows.shape[1]), np.zeros(rows.shape[1]), -S @ rows / np.sqrt(mean), r
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads, settings.max_iter, settings.time_limit = False, 1, 1000, seconds
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tol
    cones = [clarabel.SecondOrderConeT(3)] * problem.size
    found = clarabel.DefaultSolver(sp.csc_matrix(sp.triu(P)), q, sp.csc_matrix(A), b, cones, settings).solve()
    impulse = np.array(found.x if problem.contact_map is None else found.z).reshape(-1, 3)
    return impulse * scale * (speed / mean), f"{found.status}, {found.iterations} iterations"


PEERS = {
    "siconos soclcp": Peer("siconos", _siconos("SOCLCP", internal=True)),
    "siconos nsgs": Peer("siconos", _siconos("NSGS"), coulomb=True),
    "siconos admm": Peer("siconos", _siconos("ADMM"), coulomb=True),
    "clarabel": Peer("clarabel", _clarabel),
}
