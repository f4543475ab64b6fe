"""Projected block Gauss-Seidel (with over-relaxation: SOR) over the colours of the contact graph.

Tasora and Anitescu, "A matrix-free cone complementarity approach for solving large-scale, nonsmooth, rigid
body dynamics", Comput. Methods Appl. Mech. Eng. 200 (2011), with coloured instead of sequential sweeps. A
contact takes a projected gradient step of its own 3 x 3 problem, of length omega over the largest eigenvalue of
its block. For omega < 2 every step lowers the objective (block coordinate descent, Beck and Tetruashvili, SIAM
J. Optim. 23, 2013), so the sweeps descend from any start, for semidefinite N too. For spheres the scaled blocks
are the identity, and the step with omega = 1 solves the contact's problem exactly.

Contacts of one colour share no body: updating them together is updating them one after the other. Colours and
sweeps are the same on any number of ranks; the new impulses of a colour go to the ranks whose contacts they
touch before the next colour's turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from dem.contact_map import Halo
from pctt.ccp import cone
from pctt.ccp.cone import Array
from pctt.ccp.delassus import HUB, rows_in_blocks
from pctt.ccp.first_order.compared.colouring import Adjacency, colours
from pctt.ccp.first_order.progress import FirstOrder, Progress
from pctt.ccp.first_order.scaled import ScaledProblem
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
    return progress.result()


@dataclass(frozen=True)
class Colour:
    """The contacts ``own`` of a colour, and its ghosts on this rank."""

    own: slice
    rows: sp.bsr_matrix  # block rows of A, their columns in the order of the sweep
    steps: Array  # (n, 3)
    b: Array  # (n, 3)
    mu: Array
    halo: Halo  # of the ghosts of this colour


class Sweep:
    """One pass over the colours; contacts and ghosts are kept in the order of their colours."""

    def __init__(self, problem: ScaledProblem, relaxation: float):
        comm = problem.problem.comm
        matrix = problem.matrix()
        rows = rows_in_blocks(matrix)
        matrix.destroy()
        graph = Adjacency(comm, rows.indptr, rows.indices)
        colour = colours(graph)
        own, ghost = colour[: graph.own], colour[graph.own :]
        self._order = np.argsort(own, kind="stable")
        ghost_order = np.argsort(ghost, kind="stable")
        place = np.empty(len(colour), int)
        place[np.concatenate([self._order, graph.own + ghost_order])] = np.arange(len(colour))
        kept = np.stack([np.full(graph.own, comm.rank), place[: graph.own]], axis=1)
        remote = graph.fetch(kept)[graph.own :][ghost_order]  # where the ghosts' owners keep them
        A = sp.bsr_matrix((rows.data, place[graph.columns], rows.indptr), shape=(rows.shape[0], 3 * len(colour)))
        self._x = np.zeros((len(colour), 3))
        self._colours = []
        count = comm.allreduce(int(colour.max(initial=-1)), op=MPI.MAX) + 1
        ends = np.searchsorted(own[self._order], np.arange(count + 1))
        ghost_ends = np.searchsorted(ghost[ghost_order], np.arange(count + 1))
        steps, b, mu = (array[self._order] for array in (relaxation * problem.block_steps(), problem.b, problem.mu))
        for k in range(count):
            part = slice(ends[k], ends[k + 1])
            away = slice(ghost_ends[k], ghost_ends[k + 1])
            ghosts = graph.own + np.arange(away.start, away.stop)
            halo = Halo(comm, graph.own, len(colour), ghosts, *remote[away].T)
            picked = _picked(A, self._order[part])
            self._colours.append(Colour(part, picked, steps[part], b[part], mu[part], halo))

    def __call__(self, x: Array) -> Array:
        """The point after the sweep, from x (nc, 3)."""
        self._x[: len(x)] = x[self._order]
        for colour in self._colours:
            colour.halo.update(self._x)
        for colour in self._colours:
            self._update(colour)
            colour.halo.update(self._x)
        out = np.empty_like(x)
        out[self._order] = self._x[: len(x)]
        return out

    def _update(self, colour: Colour) -> None:
        x = self._x[colour.own]
        y = (colour.rows @ self._x.ravel()).reshape(-1, 3)
        y += colour.b
        cone.project(x - colour.steps * y, colour.mu, out=x)


def _picked(A: sp.bsr_matrix, rows: np.ndarray) -> sp.bsr_matrix:
    """Some block rows of A (scipy's own indexing would turn them into another format)."""
    count = np.diff(A.indptr)[rows]
    indptr = np.concatenate([[0], np.cumsum(count)])
    pick = np.arange(indptr[-1]) + np.repeat(A.indptr[rows] - indptr[:-1], count)
    return sp.bsr_matrix((A.data[pick], A.indices[pick], indptr), shape=(3 * len(rows), A.shape[1]))
