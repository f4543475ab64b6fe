"""Watching a solve: conjugate gradients without a preconditioner in turns, once a preconditioner costs too much."""

from __future__ import annotations

from math import log10

from petsc4py import PETSc

from pctt.pc.mat import conjugate_gradients
from pctt.tt.conjugate import PATIENCE, ConjugateGradients, Promise, at_least, iterations
from pctt.tt.train import Array

AT_LEAST = 24.0  # products of trials and a solution that are too few to be watched
PROBE = 6  # steps of conjugate gradients alone that show what they take for this right side


class Watch:
    """A solve by a KSP. `count` is called before each application of the preconditioner.

    Once trials and applications have cost as much as conjugate gradients alone are known to take, these solve the same
    system in turns with the KSP, each as many products as the other. If they have the solution first, the KSP ends with
    its next test, and `solution` is theirs: all in all not more than twice what they take alone, plus AT_LEAST. What
    they are known to take is the least of what they took on a part of the matrix, and what their first steps with this
    right side show; a preconditioner that has cost PATIENCE times what its trial has shown waits for neither. Costs are
    counted, not measured, and all ranks decide by the same norms.

    sign : -1 where the matrix is negative definite
    spent : what trials for this solve have cost, in products
    solution : this rank's part; None as long as the KSP goes on
    products : of conjugate gradients alone so far
    """

    def __init__(self, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec, promise: Promise, spent: float, sign: float) -> None:
        self.ksp, self.promise, self._sign = ksp, promise, sign
        self.solution: Array | None = None
        self._most = ksp.max_it
        self._b, self._start = b, x.array_r.copy() if ksp.getInitialGuessNonzero() else None
        norm = b.norm()
        self._enough = max(ksp.rtol * norm, ksp.atol)
        self._digits = log10(norm / self._enough) if 0 < self._enough < norm else 16.0 if norm else 0.0
        cost, alone = promise.cost(self._digits), at_least(promise.alone, self._digits)
        self._spent, self._expected = spent, max(AT_LEAST, min(spent + cost, alone))
        self._patience = max(AT_LEAST, min(PATIENCE * cost, alone))
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
        if self._spent <= self._expected or self.solution is not None:
            return
        if self._alone is None:
            A = self.ksp.getOperators()[0]
            self._alone = conjugate_gradients(A, self._b.array_r, x=self._start, sign=self._sign)
            self._go_on(PROBE)
            self._patience = min(self._patience, iterations(self._alone.norms, self._digits))
        if self._spent > self._patience:
            self._go_on(self._spent)
        if self._alone.norms[-1] <= self._enough:
            self.solution = self._alone.x
            self.ksp.max_it = 1

    def _go_on(self, products: float) -> None:
        """With conjugate gradients alone, until they have cost so many products."""
        run = self._alone
        assert run is not None
        while run.cost < products and run.norms[-1] > self._enough and not run.failed:
            run.step()

    def end(self) -> None:
        """Give the KSP its limit of iterations back."""
        self.ksp.max_it = self._most
