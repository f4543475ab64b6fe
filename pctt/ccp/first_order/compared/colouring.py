"""Colours of the contact graph: contacts of one colour share no body and can be updated together.

Jones and Plassmann, "A parallel graph coloring heuristic", SIAM J. Sci. Comput. 14 (1993): a contact takes the
smallest colour that its neighbours of higher priority have left, and all contacts that wait for nobody choose at
once. Priorities are a hash of the global index, so the colours do not depend on the number of ranks. PETSc has
the method as MatColoring, which petsc4py does not offer.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dem.contact_map import find_halo
from dem.exchange import offsets


class Adjacency:
    """This rank's contacts and the contacts of other ranks (ghosts) that share a body with them.

    ``indptr``, ``columns``: block rows of N, columns local: below ``own`` this rank's contacts, then the ghosts.
    """

    def __init__(self, comm: MPI.Comm, indptr: np.ndarray, columns: np.ndarray):
        self.comm, self.indptr, self.own = comm, indptr, len(indptr) - 1
        self._halo, self.columns = find_halo(comm, self.own, columns)

    def fetch(self, own: np.ndarray) -> np.ndarray:
        """Whole numbers (n,) or (n, k) of own contacts and ghosts, from those of own contacts; collective."""
        values = np.zeros((self._halo.rows, *own.shape[1:]), np.int64)
        values[: self.own] = own
        self._halo.update(values)
        return values[:-1]


def colours(graph: Adjacency) -> np.ndarray:
    """Colour of each own contact and ghost; collective."""
    first = offsets(graph.comm, graph.own)[graph.comm.rank]
    priority = _hash(graph.fetch(first + np.arange(graph.own)))
    row = np.repeat(np.arange(graph.own), np.diff(graph.indptr))
    waits = priority[graph.columns] > priority[row]  # edges to neighbours that choose before
    row, before = row[waits], graph.columns[waits]
    colour = np.full(len(priority), -1)
    while graph.comm.allreduce(int((colour[: graph.own] < 0).sum())):
        undone = colour[before] < 0
        ready = colour[: graph.own] < 0
        ready[row[undone]] = False
        edge = ready[row]
        place = np.cumsum(ready) - 1
        taken = np.zeros((int(ready.sum()), int(colour.max(initial=-1)) + 2), bool)
        taken[place[row[edge]], colour[before[edge]]] = True
        own = colour[: graph.own].copy()
        own[ready] = np.argmin(taken, axis=1)
        colour = graph.fetch(own)
        open_ = ~edge & (colour[row] < 0)
        row, before = row[open_], before[open_]
    return colour


def _hash(index: np.ndarray) -> np.ndarray:
    """SplitMix64 (Steele, Lea, Flood, OOPSLA 2014): one to one, so that no two priorities are equal."""
    x = index.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
