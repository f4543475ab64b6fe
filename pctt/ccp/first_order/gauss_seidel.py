"""Projected block Gauss-Seidel (with over-relaxation: SOR) over the colours of the contact graph.

Tasora and Anitescu, "A matrix-free cone complementarity approach for solving large-scale, nonsmooth, rigid
body dynamics", Comput. Methods Appl. Mech. Eng. 200 (2011), with coloured instead of sequential sweeps. A
contact takes a projected gradient step of its own 3 x 3 problem, of length omega over the largest eigenvalue of
its block. For omega < 2 every step lowers the objective (block coordinate descent, Beck and Tetruashvili, SIAM
J. Optim. 23, 2013), so the sweeps descend from any start, for semidefinite N too. For spheres the scaled blocks
are the identity, and the step with omega = 1 solves the contact's problem exactly.

Contacts of one colour share no body: updating them together is updating them one after the other. Colours and
sweeps are the same on any number of ranks; after each colour the new impulses go to the ranks whose contacts they
touch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from dem.contact_map import Halo, find_halo
from dem.exchange import offsets
from pctt.arrays import Array
from pctt.ccp.cones.friction import project
from pctt.ccp.delassus import DENSE, rows_in_blocks
from pctt.ccp.first_order.scaled import FirstOrder, Progress, ScaledProblem
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result
from pctt.log import phase
from pctt.options import OptionError, option


@dataclass(frozen=True)
class GaussSeidel(FirstOrder):
    """Options ``-ccp_gauss_seidel_*``."""

    relaxation: float = option(
        1.4,
        "omega, the length of a contact's step in units of 1 / largest eigenvalue of its block",
        check=("a number between 0 and 2, both excluded", lambda x: 0 < x < 2),
    )


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: GaussSeidel) -> Result:
    """Impulses from a first guess (nc, 3)."""
    if problem.has_dense_columns:
        raise OptionError(
            f"solver gauss_seidel: a body has more than {DENSE} contacts, whose rows of N would be full; "
            "allowed are the others"
        )
    scaled = ScaledProblem(problem)
    progress = Progress(scaled, limits, options)
    with phase("CCPColour"):
        sweep = Sweep(scaled, options.relaxation)
    x = scaled.start(guess)
    while progress.goes_on(x):
        x = sweep(x)
        progress.iterations += 1
    return progress.result()


class Sweep:
    """One pass over the colours."""

    def __init__(self, problem: ScaledProblem, relaxation: float):
        comm, N = problem.problem.comm, rows_in_blocks(problem.problem.N)
        halo, columns = find_halo(comm, len(N.indptr) - 1, N.indices)
        self._halo = halo
        left, right = np.repeat(problem.shrink, np.diff(N.indptr), axis=0), spread(halo, problem.shrink)
        blocks = left[:, :, None] * N.data * right[columns][:, None, :]
        A = sp.bsr_matrix((blocks, columns, N.indptr), shape=(N.shape[0], right.size)).tocsr()
        colour = colours(halo, N.indptr, columns)[: halo.own]
        steps = relaxation * problem.block_steps()
        self._colours = []
        for k in range(comm.allreduce(int(colour.max(initial=-1)), op=MPI.MAX) + 1):
            own = np.flatnonzero(colour == k)
            rows = A[(3 * own[:, None] + np.arange(3)).ravel()].tobsr((3, 3))
            self._colours.append((own, rows, steps[own], problem.b[own], problem.cones.mu[own]))

    def __call__(self, x: Array) -> Array:
        """The point after the sweep, from x (nc, 3)."""
        x = spread(self._halo, x)
        for own, rows, steps, b, mu in self._colours:
            y = (rows @ x.ravel()).reshape(-1, 3) + b
            x[own] = project(x[own] - steps * y, mu)
            self._halo.update(x)
        return x[: self._halo.own]


def spread(halo: Halo, own: np.ndarray) -> np.ndarray:
    """Numbers of own contacts, then of the contacts of other ranks that share a body with them, then of none;
    collective."""
    values = np.zeros((halo.rows, *own.shape[1:]))
    values[: halo.own] = own
    halo.update(values)
    return values


def colours(halo: Halo, indptr: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Colour of each contact of `spread`, of contacts that share a body different ones; ``indptr`` and ``columns`` (its
    rows) are the pattern of N. Collective.

    Jones and Plassmann, "A parallel graph coloring heuristic", SIAM J. Sci. Comput. 14 (1993): a contact takes the
    smallest colour that its neighbours of higher priority have left, and all contacts that wait for nobody choose at
    once. Priorities are a hash of the global index, so the colours do not depend on the number of ranks. PETSc has the
    method as MatColoring, which petsc4py does not offer.
    """
    comm, own = halo.comm, halo.own
    priority = _hash(spread(halo, offsets(comm, own)[comm.rank] + np.arange(own)))
    row = np.repeat(np.arange(own), np.diff(indptr))
    waits = priority[columns] > priority[row]  # edges to neighbours that choose before
    row, before = row[waits], columns[waits]
    colour = spread(halo, np.full(own, -1)).astype(int)
    while comm.allreduce(int((colour[:own] < 0).sum())):
        ready = colour[:own] < 0
        ready[row[colour[before] < 0]] = False
        edge = ready[row]
        taken = np.zeros((int(ready.sum()), int(colour.max(initial=-1)) + 2), bool)
        taken[(np.cumsum(ready) - 1)[row[edge]], colour[before[edge]]] = True
        colour[:own][ready] = np.argmin(taken, axis=1)
        colour = spread(halo, colour[:own]).astype(int)
        left = ~edge & (colour[row] < 0)
        row, before = row[left], before[left]
    return colour


def _hash(index: np.ndarray) -> np.ndarray:
    """SplitMix64 (Steele, Lea, Flood, OOPSLA 2014): one to one, so that no two priorities are equal."""
    x = index.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
