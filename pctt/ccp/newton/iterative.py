"""What the solvers of Newton systems by Krylov methods share: where a solve begins, and what it has cost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.arrays import TINY, Array
from pctt.ccp.newton.defaults import UNSYMMETRIC, Options
from pctt.ccp.newton.factor import Factor, Room
from pctt.ccp.newton.krylov import Krylov, Solve
from pctt.ksp_options import OWN
from pctt.petsc import options_database

if TYPE_CHECKING:
    from pctt.ccp.newton.forms import System


class Iterative:
    """A solver of Newton systems: `factor` takes the values of a matrix, `solve` a right-hand side.

    takes_unsymmetric : whether it takes systems that are not symmetric

    Attributes
    ----------
    iterations, fallbacks : of the present problem: Krylov iterations, systems that were not solved as planned
    systems : the number of systems that a KSP was to solve so far
    """

    takes_unsymmetric = False
    system: System

    def __init__(self, comm: MPI.Comm, room: Room, defaults: Options):
        self.comm, self.room, self.defaults = comm, room, defaults
        self.factors = Factor(comm, room)
        self.systems, self._symmetric = 0, True
        self._made: dict[tuple[str, bool], Krylov] = {}
        self._vectors: tuple[PETSc.Vec, ...] = ()

    def begin(self) -> None:
        """Another problem."""
        self.iterations = self.fallbacks = 0
        self.room.refused = False
        self.factors.begin()
        self._rtol_is_given = OWN + "ksp_rtol" in options_database()

    def factor(self, system: System) -> None:
        """The system has new values."""
        self.system, self._symmetric = system, system.symmetric
        self.factors.renew()

    def start(self, b: Array, wanted: float, earlier: Sequence[Array]) -> tuple[Array, float]:
        """Where to begin from, with the residual of it in ``_b``, and the part of the residual to which it is to be
        solved; 0 where nothing is left to do.

        It is the earlier solution, or zero. Of several it is the combination x with the least energy 1/2 x'Ax - b'x, if
        A is symmetric: in the norm of A no other one is nearer to the solution; else that with the least residual."""
        if not self._vectors:
            self._vectors = self.system.matrix.createVecs()
        self._x, self._b = self._vectors
        xs = np.array(earlier).reshape(len(earlier), len(b))
        products = np.empty_like(xs)
        for each, product in zip(xs, products):
            self._x.array[:] = each
            self.system.matrix.mult(self._x, self._b)
            product[:] = self._b.array
        left = xs if self.system.symmetric else products
        share = self._least(left, products, b) if len(xs) > 1 else np.ones(len(xs))
        x = share @ xs
        self._b.array[:] = b - share @ products
        norm = self._b.norm()
        if self._rtol_is_given:
            wanted = min(wanted, 0.5 * norm)
        if not wanted < norm < np.inf:  # the caller finds no step in a direction that is no number
            return x, 0.0
        self.systems += 1
        return x, max(wanted / norm, 1e-14)

    def end(self, x: Array, first: Solve | None, last: Solve | None, before: Array) -> Array:
        """x, with the better of two solves after it: the ``last`` one, which has left its own in ``_x``, or the first
        with the solution ``before``. Neither counts that leaves 1 or more."""
        if first and (last is None or first.true_residual < last.true_residual):
            last, self._x.array[:] = first, before
        if last is None or last.true_residual >= 1.0:
            self._x.zeroEntries()
        return x + self._x.array

    def _least(self, left: Array, products: Array, b: Array) -> Array:
        """The coefficients of the combination of ``products`` (k, rows) whose difference from b is orthogonal to all of
        ``left``; zeros if the sums are no numbers, or the matrix is not positive."""
        sums = self.system.problem.sum(np.column_stack([left @ products.T, left @ b]))
        energies, works = sums[:, :-1], sums[:, -1]
        if not np.isfinite(sums).all() or (np.diagonal(energies) < 0.0).any():
            return np.zeros(len(products))
        size = np.sqrt(np.maximum(np.diagonal(energies), TINY))
        # scaled, as solutions shrink from one Newton step to the next; of nearly parallel ones only the sum counts
        return np.linalg.lstsq(energies / np.outer(size, size), works / size, rcond=1e-10)[0] / size

    def krylov(self, name: str, options: Options) -> Krylov:
        """A Krylov method by its name, made when it is first needed. Systems that are not symmetric have others."""
        symmetric = self._symmetric
        if (name, symmetric) not in self._made:
            own = self.defaults if symmetric else {**self.defaults, **UNSYMMETRIC[self.defaults["pc_type"]]}
            self._made[name, symmetric] = Krylov(self.comm, OWN, {**own, **options})
        return self._made[name, symmetric]

    @property
    def _solvers(self) -> list[Krylov]:
        return [*self._made.values(), *self.factors.solvers]

    @property
    def readers(self) -> list[str]:
        """The preconditioners that read entries beside the diagonal blocks."""
        return []

    @property
    def remark(self) -> str:
        """In words, what of the machine has changed the choice of solvers; else ""."""
        return self.room.remark

    def report(self) -> list[str]:
        """Lines about the preconditioner, if it is one of this package."""
        return [line for solver in self._solvers for line in solver.report()]

    def what(self) -> str:
        """What a preconditioner of this package really was; empty for others."""
        owns = [solver.own for solver in self._solvers]
        return "; ".join(f"{own.name} was {own.what()}" for own in owns if own and own.what())

    def forget(self) -> None:
        """The next matrix has another structure."""
        for solver in self._made.values():
            solver.forget()
        self.factors.forget()
        for vector in self._vectors:
            vector.destroy()
        self._vectors = ()

    def destroy(self) -> None:
        self.forget()
        for solver in self._made.values():
            solver.destroy()
        self._made.clear()
        self.factors.destroy()
