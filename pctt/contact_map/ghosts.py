"""The bodies that the contacts of a rank touch: its own bodies, and ghosts, copies of bodies that other ranks own."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.exchange import offsets


class Ghosts:
    """Local numbers of bodies: first the own bodies, then the ghosts, then one number, `nobody`, for no body.

    Values of bodies are arrays (nobody + 1, k), of single or double precision. They travel in double precision, as
    PETSc adds up no other. The last row, for `nobody`, is zero, or has values that nothing reads.

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
            owner = np.searchsorted(starts, names, side="right") - 1
            remote = np.stack([owner, names - starts[owner]], axis=1)
            self._sf = PETSc.SF().create(comm)
            self._sf.setGraph(own, np.arange(len(names), dtype=PETSc.IntType), remote.astype(PETSc.IntType).ravel())
            self._sf.setUp()

    def update(self, values: np.ndarray) -> None:
        """Copy the values of the owners to the ghosts."""
        self.begin_update(values)
        self.end_update(values)

    def begin_update(self, values: np.ndarray) -> None:
        if self._sf is not None:
            self._travelling = values.astype(float, copy=False)
            self._sf.bcastBegin(*self._ends(self._travelling), MPI.REPLACE)

    def end_update(self, values: np.ndarray) -> None:
        if self._sf is not None:
            unit, own, ghosts = self._ends(self._travelling)
            self._sf.bcastEnd(unit, own, ghosts, MPI.REPLACE)
            values[self.own : self.nobody] = ghosts

    def begin_add(self, values: np.ndarray) -> None:
        """Begin to add the values of the ghosts to those of the owners.

        Owners may still change their own values until `end_add`.
        """
        if self._sf is not None:
            unit, own, ghosts = self._ends(values)
            self._arriving, self._leaving = np.zeros(own.shape), ghosts.astype(float, copy=False)
            self._sf.reduceBegin(unit, self._leaving, self._arriving, MPI.SUM)

    def end_add(self, values: np.ndarray) -> None:
        if self._sf is not None:
            unit, own, _ = self._ends(values)
            self._sf.reduceEnd(unit, self._leaving, self._arriving, MPI.SUM)
            own += self._arriving

    def _ends(self, values: np.ndarray) -> tuple[MPI.Datatype, np.ndarray, np.ndarray]:
        width = values[0].size
        if width not in self._units:
            self._units[width] = MPI.DOUBLE.Create_contiguous(width).Commit()
        return self._units[width], values[: self.own], values[self.own : self.nobody]

    def destroy(self) -> None:
        if self._sf is not None:
            self._sf.destroy()
            self._sf = None
        for unit in self._units.values():
            unit.Free()
        self._units.clear()
