"""The bodies that the contacts of a rank touch: its own bodies, and ghosts, copies of bodies that other ranks own."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.exchange import offsets, send_rows


class Ghosts:
    """Local numbers of bodies: first the own bodies, then the ghosts, then one number, `nobody`, for no body.

    Values of bodies are arrays (nobody + 1, k), of single or double precision. They travel in double precision, as
    PETSc adds up no other; only those of bodies that are ghosts elsewhere are touched. The last row, for `nobody`, is
    zero, or has values that nothing reads.

    Attributes
    ----------
    own : number of own bodies
    nobody : the local number of no body
    body : local numbers, uint32, in the shape of the global ones
    """

    def __init__(self, comm: MPI.Comm, own: int, body: np.ndarray):
        """``own`` is the number of own bodies. ``body`` has global indices in any shape, -1 for no body. Collective."""
        starts = offsets(comm, own)
        first, last = starts[comm.rank], starts[comm.rank + 1]
        here = (body >= first) & (body < last)
        away = ~here & (body >= 0)
        names, place = np.unique(body[away], return_inverse=True)
        self.comm, self.own, self.nobody = comm, own, own + len(names)
        self.body = np.full(body.shape, self.nobody, np.uint32)
        self.body[here] = body[here] - first
        self.body[away] = own + place.ravel()
        self._sf: PETSc.SF | None = None
        self._units: dict[int, MPI.Datatype] = {}
        if comm.size > 1:
            self._sf = self._to_ghosts(starts, names)

    def _to_ghosts(self, starts: np.ndarray, names: np.ndarray) -> PETSc.SF:
        """From the own bodies that are ghosts elsewhere (`_shared`, in this order) to the ghosts on other ranks."""
        owner = np.searchsorted(starts, names, side="right") - 1
        asked, by = send_rows(self.comm, [names - starts[owner]], owner)
        self._shared = np.unique(asked[0])
        (place,), _ = send_rows(self.comm, [np.searchsorted(self._shared, asked[0])], by)  # in the order of the ghosts
        return star_forest(self.comm, len(self._shared), np.stack([owner, place], axis=1))

    def update(self, values: np.ndarray) -> None:
        """Copy the values of the owners to the ghosts."""
        self.begin_update(values)
        self.end_update(values)

    def begin_update(self, values: np.ndarray) -> None:
        if self._sf is not None:
            self._leaving = values[self._shared].astype(float, copy=False)
            self._arriving = np.empty((self.nobody - self.own, *values.shape[1:]))
            self._sf.bcastBegin(self._unit(values), self._leaving, self._arriving, MPI.REPLACE)

    def end_update(self, values: np.ndarray) -> None:
        if self._sf is not None:
            self._sf.bcastEnd(self._unit(values), self._leaving, self._arriving, MPI.REPLACE)
            values[self.own : self.nobody] = self._arriving

    def begin_add(self, values: np.ndarray) -> None:
        """Begin to add the values of the ghosts to those of the owners.

        Owners may still change their own values until `end_add`.
        """
        if self._sf is not None:
            self._leaving = values[self.own : self.nobody].astype(float)
            self._arriving = np.zeros((len(self._shared), *values.shape[1:]))
            self._sf.reduceBegin(self._unit(values), self._leaving, self._arriving, MPI.SUM)

    def end_add(self, values: np.ndarray) -> None:
        if self._sf is not None:
            self._sf.reduceEnd(self._unit(values), self._leaving, self._arriving, MPI.SUM)
            values[self._shared] += self._arriving

    def _unit(self, values: np.ndarray) -> MPI.Datatype:
        """A row of values, for MPI."""
        width = values[0].size
        if width not in self._units:
            self._units[width] = MPI.DOUBLE.Create_contiguous(width).Commit()
        return self._units[width]

    def destroy(self) -> None:
        if self._sf is not None:
            self._sf.destroy()
            self._sf = None
        for unit in self._units.values():
            unit.Free()
        self._units.clear()


def star_forest(comm: MPI.Comm, roots: int, remote: np.ndarray) -> PETSc.SF:
    """From this rank's roots to leaves; ``remote`` (leaves, 2) has the ranks of their roots and the places there."""
    sf = PETSc.SF().create(comm)
    sf.setGraph(roots, np.arange(len(remote), dtype=PETSc.IntType), remote.astype(PETSc.IntType).ravel())
    sf.setUp()
    return sf
