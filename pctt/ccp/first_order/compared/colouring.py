"""Colours of the contact graph: contacts of one colour share no body and can be updated together.

Jones and Plassmann, "A parallel graph coloring heuristic", SIAM J. Sci. Comput. 14 (1993): a contact takes the
smallest colour that its neighbours of higher priority have left, and all contacts that wait for nobody choose at
once. Priorities are a hash of the global index, so the colours do not depend on the number of ranks. PETSc has
the method as MatColoring, which petsc4py does not offer.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.ccp.delassus import offsets


class Adjacency:
    """This rank's contacts and the contacts of other ranks (ghosts) that share a body with them.

    ``indptr``, ``columns``: block rows of N, columns local: below ``own`` this rank's contacts, then the ghosts;
    ``names`` their global indices; ``remote`` (ghosts, 2) owner and index there.
    """

    def __init__(self, comm: MPI.Comm, indptr: np.ndarray, columns: np.ndarray):
        starts = offsets(comm, len(indptr) - 1)
        first, last = starts[comm.rank], starts[comm.rank + 1]
        away = (columns < first) | (columns >= last)
        ghosts, position = np.unique(columns[away], return_inverse=True)
        self.comm, self.indptr, self.own = comm, indptr, int(last - first)
        self.columns = columns - first
        self.columns[away] = self.own + position
        self.names = np.concatenate([np.arange(first, last), ghosts])
        owner = np.searchsorted(starts, ghosts, side="right") - 1
        self.remote = np.stack([owner, ghosts - starts[owner]], axis=1)

    def fetch(self, own: np.ndarray) -> np.ndarray:
        """Values of own contacts and ghosts, from those of own contacts."""
        out = np.concatenate([own, np.empty(len(self.remote), own.dtype)])
        send = Halo(self.comm, self.own, np.arange(len(self.remote)), self.remote)
        send(own, out[self.own :], MPI._typedict[own.dtype.char])
        send.destroy()
        return out


class Halo:
    """Copies values of owners to the ghosts ``leaves``, whose owners and positions there are ``remote``."""

    def __init__(self, comm: MPI.Comm, roots: int, leaves: np.ndarray, remote: np.ndarray):
        self._sf = PETSc.SF().create(comm)
        self._sf.setGraph(roots, leaves.astype(PETSc.IntType), remote.astype(PETSc.IntType).ravel())
        self._sf.setUp()

    def __call__(self, own: np.ndarray, ghosts: np.ndarray, unit: MPI.Datatype) -> None:
        self._sf.bcastBegin(unit, own, ghosts, MPI.REPLACE)
        self._sf.bcastEnd(unit, own, ghosts, MPI.REPLACE)

    def destroy(self) -> None:
        self._sf.destroy()


_last: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None  # indptr, columns, colours


def colours(graph: Adjacency) -> np.ndarray:
    """Colour of each own contact and ghost; that of the last call while the graph is the same on all ranks."""
    global _last
    same = _last is not None and np.array_equal(_last[0], graph.indptr) and np.array_equal(_last[1], graph.columns)
    if graph.comm.allreduce(bool(same), op=MPI.LAND):
        assert _last is not None
        return _last[2]
    found = _jones_plassmann(graph)
    _last = (graph.indptr, graph.columns, found)
    return found


def _jones_plassmann(graph: Adjacency) -> np.ndarray:
    priority = _hash(graph.names)
    row = np.repeat(np.arange(graph.own), np.diff(graph.indptr))
    waits = priority[graph.columns] > priority[row]  # edges to neighbours that choose before
    row, before = row[waits], graph.columns[waits]
    colour = np.full(len(graph.names), -1)
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
        colour = graph.fetch(own) if graph.comm.size > 1 else own
        open_ = ~edge & (colour[row] < 0)
        row, before = row[open_], before[open_]
    return colour


def _hash(index: np.ndarray) -> np.ndarray:
    """SplitMix64 (Steele, Lea, Flood, OOPSLA 2014): one to one, so that no two priorities are equal."""
    x = index.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
