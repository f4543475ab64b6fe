"""Nystrom's approximation as a preconditioner: some columns of a matrix and a diagonal.

It needs no grid. A randomly pivoted Cholesky factorisation (Chen, Epperly, Tropp & Webber, Comm. Pure Appl. Math. 78,
2025) takes columns of a positive definite matrix A where the diagonal of what is left of A is large: A = F F' + R with
R positive semidefinite. In place of R stands its diagonal D, or the mean of that: so M = D + F F', whose inverse is
Woodbury's, is right for noise that varies from point to point too. Each rank has its rows of F.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy import linalg

from dem.exchange import on_all, on_first, summed
from pctt.mat.entries import Entries, diagonal, diagonal_blocks
from pctt.pc.mat import conjugate_gradients
from pctt.tt.conjugate import DIGITS, ConjugateGradients, CostEstimate, iterations
from pctt.tt.train import Array
from pctt.tt.work import ENTRY, MULTIPLY

BLOCK = 64  # columns that are drawn at a time
PROBE, LEAST, PART = 12, 3, 0.15  # steps of a trial, at most and at least, and the part of a solution that ends it
FEW = 20  # iterations that need no trial
GAIN = 1.3  # of block Jacobi, in iterations, with which it is taken
MANY = 1e5  # iterations that are as bad as none
EASY = 40  # a solution with fewer iterations needs nothing better
OPENING, MOST = 0.08, 0.25  # parts of the operations of a solution, for the first columns and for as many again
LARGEST = 1024  # rank
NUMBERS = 1e8  # of F on all ranks


class PartialCholesky:
    """F of A = F F' + R for a Mat A with entries, whose rank grows. Collective.

    F : (n, k) rows of this rank
    left : (n,) diagonal of R, zero at the pivots, the k rows whose columns are known
    """

    def __init__(self, P: PETSc.Mat) -> None:
        self.comm, self.entries = P.comm.tompi4py(), Entries.of_mat(P)
        self.first, self.last = P.getOwnershipRange()
        self.rows = P.getSize()[0]
        self.left = diagonal(P)
        self.F = np.zeros((self.last - self.first, 0))
        self.pivots = np.zeros(0, np.int64)
        self._rng = np.random.default_rng(0)  # the same numbers on all ranks

    def grow(self, rank: int) -> bool:
        """Take columns until there are so many; False if A turns out not to be positive definite, or none is left."""
        while len(self.pivots) < rank:
            if not self._take(min(BLOCK, rank - len(self.pivots))):
                return False
        return True

    def _take(self, count: int) -> bool:
        """Draw rows, each with a probability in proportion to `left`, and take those that are no better known now."""
        drawn = self._draw(count)
        if len(drawn) == 0:
            return False
        mine = np.flatnonzero((drawn >= self.first) & (drawn < self.last))
        here = np.arange(self.first, self.last)
        i, j = np.repeat(here, len(drawn)), np.tile(drawn, len(here))
        known = self._gathered(self.F, drawn, mine)
        columns = self.entries.own(i, j).reshape(len(here), -1) - self.F @ known.T
        corner = self._gathered(columns, drawn, mine)
        before = self._gathered(self.left[:, None], drawn, mine)[:, 0]
        chance = self._rng.random(len(drawn))
        taken, root = on_first(self.comm, partial(_factor, corner, before, chance))
        if len(taken) == 0:
            return False
        new = linalg.solve_triangular(root, columns[:, taken].T, lower=True).T
        self.F = np.hstack((self.F, new))
        self.left = np.maximum(self.left - (new**2).sum(axis=1), 0.0)
        self.pivots = np.append(self.pivots, drawn[taken])
        own = self.pivots[(self.pivots >= self.first) & (self.pivots < self.last)]
        self.left[own - self.first] = 0.0
        return True

    def _draw(self, count: int) -> Array:
        """Different rows: those whose exponential clocks, which run as fast as `left` is large, ring first."""
        clock = self._rng.standard_exponential(self.rows)[self.first : self.last]
        with np.errstate(divide="ignore"):
            clock = np.where(self.left > 0, clock / self.left, np.inf)
        near = np.argsort(clock, kind="stable")[:count]
        found = self.comm.allgather((clock[near], near + self.first))
        clocks, rows = (np.concatenate(parts) for parts in zip(*found))
        first = np.argsort(clocks, kind="stable")[:count]
        return self.comm.bcast(rows[first][np.isfinite(clocks[first])])

    def _gathered(self, values: Array, rows: Array, mine: Array) -> Array:
        """The values (n, m) of these rows of all ranks."""
        out = np.zeros((len(rows), values.shape[1]))
        out[mine] = values[rows[mine] - self.first]
        return summed(self.comm, out)

    def diagonals(self) -> list[Array]:
        """Two diagonals (n,) in place of R: its mean everywhere, and its own; at pivots what the other pivots leave."""
        own = np.flatnonzero((self.pivots >= self.first) & (self.pivots < self.last))
        corner = self._gathered(self.F, self.pivots, own)
        inverse = linalg.solve_triangular(corner, np.eye(len(corner)), lower=True)
        leave_one_out = 1.0 / np.maximum((inverse**2).sum(axis=0), 1e-300)
        by_point = self.left.copy()
        by_point[self.pivots[own] - self.first] = leave_one_out[own]
        total = self.comm.allreduce(float(self.left.sum()))
        largest = self.comm.allreduce(float(by_point.max(initial=0.0)), op=MPI.MAX)
        floor = 1e-12 * max(largest, 1e-300)
        mean = max(total / max(self.rows - len(self.pivots), 1), floor)
        return [np.full(len(by_point), mean), np.maximum(by_point, floor)]


def _factor(corner: Array, before: Array, chance: Array) -> tuple[Array, Array]:
    """Which of the drawn rows are taken, and the Cholesky factor of their part of ``corner``.

    A row is taken with the probability that the part of its diagonal entry has which the rows before it leave; so the
    rows have the distribution of those that are drawn one by one (Epperly, Tropp & Webber, arXiv:2410.03969).
    """
    S, taken, rows = 0.5 * (corner + corner.T), [], []
    for k in range(len(S)):
        if S[k, k] > 1e-14 * before[k] and S[k, k] >= chance[k] * before[k]:
            row = S[k] / S[k, k] ** 0.5
            S = S - np.outer(row, row)
            taken.append(k)
            rows.append(row)
    chosen = np.array(taken, np.int64)
    return chosen, np.tril(np.array(rows).T[chosen]) if taken else np.zeros((0, 0))


class Identity:
    """No preconditioner."""

    name = words = "no preconditioner"
    flops = 0

    def __call__(self, x: Array) -> Array:
        return x


class Nystrom:
    """x -> (D + F F')^-1 x for this rank's rows.

    D : (n,) positive
    F : (n, k)
    """

    def __init__(self, comm: MPI.Comm, F: Array, D: Array) -> None:
        self.comm, self.rank = comm, F.shape[1]
        self._inverse, self._scaled = 1.0 / D, F / D[:, None]
        gram = summed(comm, F.T @ self._scaled)
        gram[np.diag_indices_from(gram)] += 1.0
        self._root = on_first(comm, lambda: linalg.cholesky(gram, lower=True))

    name = "Nystrom's approximation"

    @property
    def words(self) -> str:
        """For the view."""
        return f"{self.name} of rank {self.rank}"

    @property
    def flops(self) -> int:
        """Operations of this rank in a product."""
        return 4 * self._scaled.size

    def __call__(self, x: Array) -> Array:
        """This rank's part of the product, from its part of x, (n,) or (k, n)."""
        inner = linalg.cho_solve((self._root, True), summed(self.comm, self._scaled.T @ x.T))
        return x * self._inverse - (self._scaled @ inner).T


class Trial(NamedTuple):
    """About how many iterations solutions to 1e-8 take, and what the trial has cost in products."""

    iterations: list[float]
    spent: float


@dataclass(frozen=True)
class Chosen:
    """A preconditioner, and what a trial has shown of it.

    inverse : Nystrom's approximation, or None
    scaled : without one, whether there is block Jacobi
    each : the cost of an application, that of a product with the matrix is 1
    iterations : of conjugate gradients to 1e-8, an estimate
    unpreconditioned : of those without a preconditioner
    spent : what all trials have cost, in products
    """

    inverse: Nystrom | None
    scaled: bool
    each: float
    iterations: float
    unpreconditioned: float
    spent: float = 0.0

    @property
    def cost(self) -> float:
        """Of a solution, in products."""
        return self.iterations * (1 + self.each)

    @property
    def cost_estimate(self) -> CostEstimate | None:
        """What a solve may take; None if conjugate gradients have no preconditioner, or one that makes no difference.

        Half of the estimate for none was at most what they took, in all kernels tried with a random right side.
        """
        if (self.inverse is None and not self.scaled) or self.iterations == self.unpreconditioned:
            return None
        least = int(min(0.5 * self.unpreconditioned, MANY))
        return CostEstimate(self.each, [1.0, 10 ** (-DIGITS / self.iterations)], [1.0] * (least + 1), self.spent)


def estimate(run: ConjugateGradients) -> float:
    """About how many iterations to 1e-8 a run takes.

    The smaller of two estimates from its steps, both of which are mostly too large: by the norms of the residuals, and
    by the spread of the eigenvalues of the tridiagonal matrix of the method (Golub & Van Loan, Matrix Computations,
    11.3). Infinite if the matrix or the preconditioner is not positive.
    """
    steps = len(run.lengths)
    if run.failed:
        return np.inf
    if run.norms[-1] <= 10.0**-DIGITS * run.norms[0]:
        return float(steps)
    steep, more = 1 / np.array(run.lengths), np.array(run.growths[1:])
    beside = np.diag(np.sqrt(more) * steep[:-1], 1)
    values = np.linalg.eigvalsh(np.diag(steep + np.append(0.0, more * steep[:-1])) + beside + beside.T)
    root = (values[-1] / max(values[0], 1e-16 * values[-1])) ** 0.5
    by_values = np.log(2 * 10.0**DIGITS) / np.log((root + 1) / max(root - 1, 1e-3))
    return float(max(min(by_values, iterations(run.norms)), steps))


def trial(A: PETSc.Mat, solves: Sequence[Callable[[Array], Array] | None], each: float = 0.0) -> Trial:
    """A few steps of conjugate gradients for A with each of these preconditioners, until they have cost PART of a
    solution; without one no further if that takes a FEW iterations. Collective.

    each : the cost of an application of a preconditioner, that of a product is 1
    """
    first, last = A.getOwnershipRange()
    b, comm = np.random.default_rng(0).standard_normal(A.getSize()[0])[first:last], A.comm.tompi4py()
    runs = [conjugate_gradients(A, b, solve, 0.0 if solve is None else each) for solve in solves]
    found, spent = [], 0.0
    for k in range(PROBE):
        for run in runs:
            run.step()
            if run.solve is None and k < LEAST and iterations(run.norms) <= FEW:
                return Trial([iterations(run.norms), np.inf], spent + 1)
        spent = sum(run.cost for run in runs)
        found = comm.bcast([estimate(run) for run in runs])
        if k >= LEAST - 1 and spent >= PART * min(found):
            break
    return Trial(found, spent)


def block_jacobi(P: PETSc.Mat) -> Callable[[Array], Array] | None:
    """The product with the inverses of the diagonal blocks of a Mat with entries. Collective.

    None if the blocks are all equal, so that it is as good as no preconditioner, or if some are singular.
    """
    blocks, comm = diagonal_blocks(P), P.comm.tompi4py()
    first = next((one for one in comm.allgather(blocks[:1]) if len(one)), np.zeros((1, 1, 1)))
    if on_all(comm, (np.abs(blocks - first) <= 1e-12 * np.abs(first)).all()):
        return None
    try:
        inverses = np.linalg.inv(blocks)
    except np.linalg.LinAlgError:
        inverses = np.full_like(blocks, np.nan)
    if not on_all(comm, np.isfinite(inverses).all()):
        return None
    return lambda x: (inverses @ x.reshape(len(blocks), -1, 1)).ravel()


def choose(P: PETSc.Mat, A: PETSc.Mat, product: float) -> Chosen:
    """The best of none, block Jacobi and Nystrom's approximation, by trials with products of A. Collective.

    The first columns cost a twelfth of a solution. The rank is doubled while as many columns again cost less than a
    fourth of the solution that it leaves, and the last ones have gained a tenth.

    P : with entries
    product : operations of a product with A
    """
    jacobi = block_jacobi(P)
    shown = trial(A, [None] if jacobi is None else [None, jacobi])
    unpreconditioned, scaled, spent = shown.iterations[0], shown.iterations[-1], shown.spent
    gains = jacobi is None or GAIN * scaled <= unpreconditioned
    best = Chosen(None, gains, 0.0, scaled if gains and jacobi is not None else unpreconditioned, unpreconditioned)
    rows = P.getSize()[0]
    most = int(min(LARGEST, rows // 4, NUMBERS // rows))
    budget = OPENING * best.cost * product / (ENTRY * rows)
    rank, known, before, factor = int(min(max(budget, BLOCK // 4), most)), 0, np.inf, None
    while EASY < best.iterations < np.inf and known < rank and best.cost < 0.9 * before:
        setup = rows * (rank - known) * ENTRY + MULTIPLY * rows * (rank**2 - known**2) + 2 * PROBE * product
        if setup > MOST * best.cost * product:
            break
        factor = PartialCholesky(P) if factor is None else factor
        if not factor.grow(rank):
            break
        before, each = best.cost if known else np.inf, rows * rank / product
        inverses = [Nystrom(factor.comm, factor.F, D) for D in factor.diagonals()]
        shown = trial(A, inverses, each)
        spent += shown.spent
        for inverse, found in zip(inverses, shown.iterations):
            new = Chosen(inverse, False, each, found, unpreconditioned)
            best = new if new.cost < best.cost else best
        known, rank = rank, min(2 * rank, most)
    return replace(best, spent=spent)
