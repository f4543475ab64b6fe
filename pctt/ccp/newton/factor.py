"""The last resort of Newton systems: a Krylov method with a factor of the matrix, if the memory has room for one."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt import memory
from pctt.ccp.newton.krylov import Krylov, Solve
from pctt.ccp.newton.multifrontal import MultifrontalPC
from pctt.ksp_options import OWN

if TYPE_CHECKING:
    from pctt.ccp.newton.forms import System

#: Drop tolerance of a factor [mass]: entries of a block between bodies that it is better off without.
LEAST = 0.1
#: Iterations with block Jacobi / bodies^0.4 that cost less than a factor, which costs as much as 14 to 30.
EASY = 12.0
#: Iterations with factors of single precision, in units of the easy ones, after which the next are of double, which
#: cost 10 iterations more (n = 8), 30 (n = 16).
SINGLE = 0.01
#: Memory of a factor in double precision / rows^(4/3), the growth of nested dissection in space: 2.7e9 bytes at 35,939
#: bodies by fronts.
BYTES = 210.0
#: The part of the available memory that a factor may take.
SPARE = 0.9


def easy_iterations(comm: MPI.Comm, system: System) -> int:
    """How many iterations with block Jacobi cost less than a factor; the same on all ranks."""
    bodies = system.matrix.getSize()[0] / 6.0
    return comm.bcast(int(EASY * bodies**0.4))  # a last bit may differ between processors


class Room:
    """The memory for factors. It is looked up once, so that what else runs on the machine changes no later choice.

    refused : whether a factor had no room since this was last set to False
    """

    def __init__(self, comm: MPI.Comm):
        self.comm, self.refused = comm, False

    @cached_property
    def available(self) -> float:
        """What each rank could take when it was first asked for [bytes]; collective."""
        return memory.available(self.comm)

    def takes(self, rows: int, part: float = 1.0) -> bool:
        """Whether there is room for a factor of double precision, or for this part of it; collective."""
        needed = part * BYTES * rows ** (4.0 / 3.0) / self.comm.size
        return self.comm.bcast(needed < SPARE * self.available)

    @property
    def remark(self) -> str:
        """In words, that a factor had none."""
        return f"no room for a factor in {self.available / 1e9:.2g} GB of memory" if self.refused else ""


class Factor:
    """Factors of one matrix after another: our own of the part of the bodies' that is worth it, else PETSc's. A matrix
    keeps its factor for all right-hand sides."""

    def __init__(self, comm: MPI.Comm, room: Room):
        self.comm, self.room = comm, room
        self._made: dict[tuple[str, str], Krylov] = {}
        self.begin()

    def begin(self) -> None:
        """Another problem."""
        self._factored, self._double = False, False

    def renew(self) -> None:
        """The matrix has new values."""
        self._factored = False

    def solve(self, system: System, b: PETSc.Vec, x: PETSc.Vec, rtol: float) -> tuple[Solve | None, int]:
        """x = A^-1 b to a relative residual of rtol, and the iterations; None if the memory has no room."""
        options = system.factored_by
        kind = options["ksp_type"], options["pc_type"]
        if kind not in self._made:
            self._made[kind] = Krylov(self.comm, OWN + "fallback_", options)
        solver = self._made[kind]
        context = solver.ksp.pc.getPythonContext() if solver.kind == "python" else None
        if isinstance(context, MultifrontalPC):
            return self._by_fronts(solver, context, system, b, x, rtol)
        if not self._factored:
            solver.forget()  # first, as its memory counts as taken
            if not self._has_room(system):
                return None, 0
        done = solver.solve(system.matrix, b, x, rtol, system.entries, keep=self._factored)
        self._factored = self._factored or done.converged
        return done, done.iterations

    def _by_fronts(
        self, solver: Krylov, context: MultifrontalPC, system: Any, b: PETSc.Vec, x: PETSc.Vec, rtol: float
    ) -> tuple[Solve | None, int]:
        """Of single precision, until they take many iterations."""
        count = 0
        if self._factored:
            done = solver.solve(system.matrix, b, x, rtol, keep=True)
            count = done.iterations
            if done.converged or self._double:
                return done, count
            self._double = True
        solver.forget()
        if not self._has_room(system, 1.0 if self._double else 0.5):
            return None, count
        context.make = lambda: system.fronts(LEAST, np.float64 if self._double else np.float32)
        done = solver.solve(system.matrix, b, x, rtol, system.matrix)
        count += done.iterations
        if not self._double:
            many = done.iterations > SINGLE * easy_iterations(self.comm, system)
            self._double = many and self._has_room(system)
            if self._double and not done.converged:
                solver.forget()
                done = solver.solve(system.matrix, b, x, rtol, system.matrix)
                count += done.iterations
        self._factored = done.converged
        return done, count

    def _has_room(self, system: System, part: float = 1.0) -> bool:
        room = self.room.takes(system.matrix.getSize()[0], part if system.symmetric else 2.0 * part)
        self.room.refused = self.room.refused or not room
        return room

    @property
    def solvers(self) -> list[Krylov]:
        return list(self._made.values())

    def forget(self) -> None:
        """The next matrix has another structure."""
        self._factored = False
        for solver in self._made.values():
            solver.forget()

    def destroy(self) -> None:
        for solver in self._made.values():
            solver.destroy()
        self._made.clear()
