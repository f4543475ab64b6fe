"""Watching a solve: conjugate gradients without a preconditioner in turns, once a preconditioner breaks its promise."""

from __future__ import annotations

from math import log10

import numpy as np
from petsc4py import PETSc

from pctt.tt.conjugate import ConjugateGradients, Promise
from pctt.tt.train import Array


class Watch:
    """A solve by a KSP. `count` is called before each application of the preconditioner.

    Once the applications have cost as much as promised, conjugate gradients alone solve the same system in turns with
    the KSP, each as many products as the other. If they have the solution first, the KSP ends with its next test, and
    `solution` is theirs: all in all not more than twice what they take alone. Costs are counted, not measured, and all
    ranks decide by the same norms.

    solution : this rank's part; None as long as the KSP goes on
    products : of conjugate gradients alone so far
    """

    def __init__(self, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec, promise: Promise) -> None:
        self.ksp, self.promise = ksp, promise
        self.solution: Array | None = None
        self._most = ksp.max_it
        self._b, self._start = b, x.array_r.copy() if ksp.getInitialGuessNonzero() else None
        norm = b.norm()
        self._enough = max(ksp.rtol * norm, ksp.atol)
        digits = log10(norm / self._enough) if 0 < self._enough < norm else 16.0 if norm else 0.0
        self._patience, self._spent = promise.patience(digits), 0.0
        self._alone: ConjugateGradients | None = None

    @staticmethod
    def can(ksp: PETSc.KSP, pc: PETSc.PC) -> bool:
        """Whether the KSP solves with this PC until a residual is small."""
        return ksp.getPC().handle == pc.handle and ksp.getNormType() != PETSc.KSP.NormType.NONE

    @property
    def products(self) -> int:
        return len(self._alone.norms) - 1 if self._alone else 0

    def count(self) -> None:
        """Collective."""
        self._spent += 1 + self.promise.each
        if self._spent <= self._patience or self.solution is not None:
            return
        run = self._alone = self._alone or self._begin()
        while run.cost < self._spent and run.norms[-1] > self._enough and not run.failed:
            run.step()
        if run.norms[-1] <= self._enough:
            self.solution = run.x
            self.ksp.max_it = 1

    def _begin(self) -> ConjugateGradients:
        A = self.ksp.getOperators()[0]
        comm = A.comm.tompi4py()
        self._vecs = A.createVecs()

        def times(x: Array) -> Array:
            self._vecs[0].array_w[:] = x
            A.mult(*self._vecs)
            return self._vecs[1].array_r.copy()

        def dot(x: Array, y: Array) -> float:
            return comm.allreduce(float(np.dot(x, y)))

        return ConjugateGradients(times, self._b.array_r, dot=dot, x=self._start)

    def end(self) -> None:
        """Give the KSP its limit of iterations back; collective."""
        self.ksp.max_it = self._most
        if self._alone:
            for vec in self._vecs:
                vec.destroy()
