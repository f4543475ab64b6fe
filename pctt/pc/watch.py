"""Watching a solve: conjugate gradients without a preconditioner in turns, once a preconditioner costs too much."""

from __future__ import annotations

from math import inf, log10

from petsc4py import PETSc

from pctt.pc.mat import conjugate_gradients
from pctt.tt.conjugate import ConjugateGradients, CostEstimate, at_least, iterations
from pctt.tt.train import Array

AT_LEAST = 24.0  # products of trials and a solution that are too few to be watched
PROBE = 6  # steps of conjugate gradients alone that show what they take for this right side
GROWTH = 2.0  # the whole may take so many times what a part of it did
PATIENCE = 8.0  # what a preconditioner may cost, in costs that its trial has shown
HOPELESS = 1.2  # times what the KSP takes


class Watch:
    """A solve by a KSP. `count` is called before each application of the preconditioner.

    Once trials and applications have cost GROWTH times what a trial has promised, or AT_LEAST more than conjugate
    gradients alone are known to take, these solve the same system in turns with the KSP, as long as they have cost less
    than it. They wait where residuals show that they need HOPELESS times what the KSP does, and that this is PATIENCE
    times its estimate at most. If they have the solution first, the KSP ends with its next test, and `solution` is
    theirs: if they never waited, all is not more than twice what they take alone, plus AT_LEAST. Costs are counted, not
    measured, and all ranks decide by the same norms.

    sign : -1 where the matrix is negative definite
    spent : what trials for this solve have cost, in products
    solution : this rank's part; None as long as the KSP goes on
    products : of conjugate gradients alone so far
    """

    def __init__(
        self, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec, cost_estimate: CostEstimate, spent: float, sign: float
    ) -> None:
        self.ksp, self.cost_estimate, self._sign = ksp, cost_estimate, sign
        self.solution: Array | None = None
        self._most = ksp.max_it
        self._b, self._start = b, x.array_r.copy() if ksp.getInitialGuessNonzero() else None
        norm = b.norm()
        self._enough = max(ksp.rtol * norm, ksp.atol)
        self._digits = log10(norm / self._enough) if 0 < self._enough < norm else 16.0 if norm else 0.0
        cost, alone = cost_estimate.cost(self._digits), at_least(cost_estimate.alone, self._digits)
        self._trials, self._norms = spent, [0.0]
        self._expected = max(AT_LEAST, min(spent + GROWTH * cost, alone + AT_LEAST))
        self._alone: ConjugateGradients | None = None

    @staticmethod
    def can(ksp: PETSc.KSP, pc: PETSc.PC) -> bool:
        """Whether the KSP solves with this PC until a residual is small."""
        return ksp.getPC().handle == pc.handle and ksp.getNormType() != PETSc.KSP.NormType.NONE

    @property
    def products(self) -> int:
        return len(self._alone.norms) - 1 if self._alone else 0

    def count(self) -> None:
        """Collective. PETSc has no norm of this solve before the second application."""
        self._norms.append(self.ksp.getResidualNorm())
        cost = (len(self._norms) - 1) * (1 + self.cost_estimate.each)
        if len(self._norms) < 3 or self._trials + cost <= self._expected or self.solution is not None:
            return
        if self._alone is None:
            A = self.ksp.getOperators()[0]
            self._alone = conjugate_gradients(A, self._b.array_r, x=self._start, sign=self._sign)
        run, first, last = self._alone, *(self._norms[k] for k in (2, -1))
        gained = log10(first / last) if first > last > 0 else 0.0
        needs = cost * self._digits / gained if gained > 0 else inf
        lost = HOPELESS * needs if needs <= PATIENCE * self.cost_estimate.cost(self._digits) else inf
        while run.cost < self._trials + cost and run.norms[-1] > self._enough and not run.failed:
            if self.products >= PROBE and iterations(run.norms, self._digits) > lost:
                break
            run.step()
        if run.norms[-1] <= self._enough:
            self.solution = run.x
            self.ksp.max_it = 1

    def end(self) -> None:
        """Give the KSP its limit of iterations back."""
        self.ksp.max_it = self._most
