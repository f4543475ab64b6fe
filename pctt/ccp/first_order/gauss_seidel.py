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

from pctt.blocks import HUB
from pctt.ccp import cone
from pctt.ccp.cone import Array
from pctt.ccp.delassus import rows_in_blocks
from pctt.ccp.first_order.scaled import FirstOrder, Progress, ScaledProblem
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result
from pctt.contact_map import Ghosts
from pctt.exchange import offsets
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
    if problem.has_hubs:
        raise OptionError(
            f"-ccp_type gauss_seidel: a body has more than {HUB} contacts, whose rows of N would be full; "
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
    sweep.destroy()
    return progress.result()


class Sweep:
    """One pass over the colours."""

    def __init__(self, problem: ScaledProblem, relaxation: float):
        comm, rows = problem.problem.comm, rows_in_blocks(problem.problem.N)
        self._neighbours = neighbours = Neighbours(comm, rows.indptr, rows.indices)
        shrink = neighbours.fetch(problem.shrink)
        left, right = np.repeat(shrink[: neighbours.own], np.diff(rows.indptr), axis=0), shrink[neighbours.columns]
        A = sp.bsr_matrix(
            (left[:, :, None] * rows.data * right[:, None, :], neighbours.columns, rows.indptr),
            shape=(rows.shape[0], 3 * len(shrink)),
        )
        colour, steps = colours(neighbours)[: neighbours.own], relaxation * problem.block_steps()
        self._colours = []
        for k in range(comm.allreduce(int(colour.max(initial=-1)), op=MPI.MAX) + 1):
            own = np.flatnonzero(colour == k)
            self._colours.append((own, _picked(A, own), steps[own], problem.b[own], problem.mu[own]))

    def __call__(self, x: Array) -> Array:
        """The point after the sweep, from x (nc, 3)."""
        x = self._neighbours.fetch(x)
        for own, rows, steps, b, mu in self._colours:
            y = (rows @ x.ravel()).reshape(-1, 3) + b
            x[own] = cone.project(x[own] - steps * y, mu)
            self._neighbours.update(x)
        return x[: self._neighbours.own]

    def destroy(self) -> None:
        self._neighbours.destroy()


def _picked(A: sp.bsr_matrix, rows: np.ndarray) -> sp.bsr_matrix:
    """Some block rows of A (scipy's own indexing would turn them into another format)."""
    count = np.diff(A.indptr)[rows]
    indptr = np.concatenate([[0], np.cumsum(count)])
    pick = np.arange(indptr[-1]) + np.repeat(A.indptr[rows] - indptr[:-1], count)
    return sp.bsr_matrix((A.data[pick], A.indices[pick], indptr), shape=(3 * len(rows), A.shape[1]))


class Neighbours:
    """This rank's contacts and the contacts of other ranks (ghosts) that share a body with them.

    ``indptr``, ``columns``: block rows of N, columns local: below ``own`` this rank's contacts, then the ghosts.
    """

    def __init__(self, comm: MPI.Comm, indptr: np.ndarray, columns: np.ndarray):
        self.comm, self.indptr, self.own = comm, indptr, len(indptr) - 1
        self._ghosts = Ghosts(comm, self.own, columns)
        self.columns = self._ghosts.body

    def fetch(self, own: np.ndarray) -> np.ndarray:
        """Numbers (n, k) of own contacts and ghosts, from those of own contacts; collective."""
        values = np.zeros((self._ghosts.nobody + 1, *own.shape[1:]))
        values[: self.own] = own
        self._ghosts.update(values)
        return values

    def update(self, values: np.ndarray) -> None:
        """Renew those of the ghosts; collective."""
        self._ghosts.update(values)

    def destroy(self) -> None:
        self._ghosts.destroy()


def colours(graph: Neighbours) -> np.ndarray:
    """Colour of each own contact and ghost, of contacts that share a body different ones; collective.

    Jones and Plassmann, "A parallel graph coloring heuristic", SIAM J. Sci. Comput. 14 (1993): a contact takes the
    smallest colour that its neighbours of higher priority have left, and all contacts that wait for nobody choose at
    once. Priorities are a hash of the global index, so the colours do not depend on the number of ranks. PETSc has the
    method as MatColoring, which petsc4py does not offer.
    """
    first = offsets(graph.comm, graph.own)[graph.comm.rank]
    priority = _hash(graph.fetch(first + np.arange(graph.own)))
    row = np.repeat(np.arange(graph.own), np.diff(graph.indptr))
    waits = priority[graph.columns] > priority[row]  # edges to neighbours that choose before
    row, before = row[waits], graph.columns[waits]
    colour = graph.fetch(np.full(graph.own, -1)).astype(int)
    while graph.comm.allreduce(int((colour[: graph.own] < 0).sum())):
        ready = colour[: graph.own] < 0
        ready[row[colour[before] < 0]] = False
        edge = ready[row]
        taken = np.zeros((int(ready.sum()), int(colour.max(initial=-1)) + 2), bool)
        taken[(np.cumsum(ready) - 1)[row[edge]], colour[before[edge]]] = True
        own = colour[: graph.own].copy()
        own[ready] = np.argmin(taken, axis=1)
        colour = graph.fetch(own).astype(int)
        left = ~edge & (colour[row] < 0)
        row, before = row[left], before[left]
    return colour


def _hash(index: np.ndarray) -> np.ndarray:
    """SplitMix64 (Steele, Lea, Flood, OOPSLA 2014): one to one, so that no two priorities are equal."""
    x = index.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
