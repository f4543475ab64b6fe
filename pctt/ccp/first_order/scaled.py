"""What all first-order methods share: the cone problem in unknowns of equal size, and the course of a method on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dem.compiled import loop
from dem.contact_map import ContactMap
from pctt.arrays import Array
from pctt.ccp.cones import Cones
from pctt.ccp.delassus import GivenOperator
from pctt.ccp.problem import ConeProblem, Errors
from pctt.ccp.result import Limits, Result, Status
from pctt.ccp.unbounded import ROUNDED, why_unbounded
from pctt.options import number

MANY = 0.9  # of the contacts active: to put these side by side would take as long as all take until the next look
RATIO = 0.4  # of the natural residual to |L step| / |x|: 0.3 to 0.5 from the second step on, all scenes, both laws


Rows = NDArray[np.intp]


class Iterate(NamedTuple):
    """A point x, and its image: what it does to the bodies (`ContactMap.image`)."""

    x: Array  #: (n, 3) of the active set
    image: Array
    room: Array  #: (nc, 3) the memory of x, for all contacts

    def copy(self) -> Iterate:
        x = self.x.copy()
        return Iterate(x, self.image.copy(), x)


class ActiveSet(NamedTuple):
    """The contacts that iterations work on: all, or an active set of them."""

    rows: Rows | None  #: (n,) of the arrays (nc, 3); None: all
    operator: ContactMap | GivenOperator
    cones: Cones
    b: Array  #: (n, 3)
    compliance: Array  #: (n, 3), or no row for zero


class ScaledProblem:
    """min 1/2 x'Ax + b'x over friction cones, where the diagonal of A and the largest r are about one.

    x = S g / u, A = S^-1 N S^-1, b = S^-1 r / u. The diagonal S has two values per contact, the roots of its normal and
    of its mean tangential entry of diag N: the cones stay friction cones, of friction mu s_t / s_n. This is
    diagonal preconditioning by a metric in which the projection is still exact. The unit u is a power of two about the
    largest number of r: squares of small velocities are no numbers of single precision.

    With ``coulomb`` it is Coulomb's law, in the same variables: x is a solution if the projected step from x along the
    gradient *with its De Saxce term* (mu |y_t|, 0, 0) leads back to x.

    In single ``precision`` products with a contact map move half of the bytes.
    """

    def __init__(self, problem: ConeProblem, coulomb: bool = False, precision: type[np.floating] = np.float64):
        self.problem, self.coulomb, self.precision = problem, coulomb, precision
        shape = problem.r.shape
        self.unit = 2.0 ** math.frexp(problem.max(_largest(problem.r)))[1]
        self.size = np.empty(shape)  # the diagonal of S
        self.b, self._compliance = np.empty((2, *shape), precision)
        given = problem.diagonal, problem.mean_diagonal, self.unit, problem.r, problem.compliance
        _scale(*given, self.size, self.b, self._compliance)
        self.cones = problem.cones.scaled(self.size, precision)
        self._operator = problem.operator.scaled(self.shrink, precision)
        soft = self._compliance[: None if problem.yields else 0]
        self._all = self._active = ActiveSet(None, self._operator, self.cones, self.b, soft)

    @property
    def shrink(self) -> Array:
        """The diagonal of S^-1 (nc, 3)."""
        return 1.0 / self.size

    def _rounded(self, x: Array) -> Array:
        return x.astype(self.precision, copy=False)

    def start(self, guess: Array) -> Array:
        """The scaled point of a first guess of the impulses (nc, 3), in the cones."""
        return self.project(self._rounded(guess / (self.unit / self.size)))

    def impulse(self, x: Array) -> Array:
        """The impulses (nc, 3) of x, in the cones in double precision too."""
        g = self.unit / self.size
        g *= x
        return g if self.precision is np.float64 else self.problem.cones.project(g, g)

    def product(self, x: Array) -> Array:
        """A x (nc, 3)."""
        out: Array = self._compliance * x
        self._operator.add_delassus(x, out)
        return out

    def gradient(self, x: Array, out: Array | None = None) -> Array:
        """A x + b (nc, 3)."""
        out = np.empty_like(x) if out is None else out
        out[:] = self.b
        if self.problem.yields:
            out += self._compliance * x
        self._operator.add_delassus(x, out)
        return out

    # -- accelerated steps --------------------------------------------------------------------------------------

    def iterate(self, x: Array) -> Iterate:
        """The iterate at x (nc, 3), which is kept."""
        found = Iterate(x, self._operator.image(), x)
        self._operator.find_image(x, found.image)
        return found

    def rigid_gradient(self, now: Iterate, last: Iterate, beta: float, out: Array) -> Array:
        """(A - C) z + b at z = x + beta (x - last_x), into ``out``, from images alone: half a product."""
        self._active.operator.find_velocities(now.image, last.image, beta, self._active.b, out)
        return out

    def look(self, now: Iterate, y: Array) -> Array:
        """A x + b (nc, 3) where all contacts are active, and ``y`` its rigid part."""
        self.rigid_gradient(now, now, 0.0, y)
        slope: Array = self._compliance * now.x
        slope += y
        return slope

    def restore(self, *iterates: Iterate) -> Sequence[Iterate]:
        """The iterates with all contacts, of which the last is memory for a new one."""
        rows, self._active = self._active.rows, self._all
        if rows is None:
            return iterates
        for iterate in iterates[:-1]:
            _spread(rows, iterate.room)
        return [Iterate(room, image, room) for _, image, room in iterates]

    def restrict(
        self, now: Iterate, last: Iterate, new: Iterate, y: Array, length: float
    ) -> tuple[Iterate, Iterate, Iterate, Array]:
        """Leave out contacts that will stay open until the next look, as far as one can see: they have no impulse, and
        open five times faster than steps change velocities, which is the root mean square of their ``length`` |L step|.
        A contact too many costs iterations, but no accuracy. ``y`` (nc, 3) is the rigid gradient of all contacts.
        Returns what `restore` does and this gradient, of the active set: fewer, side by side, move fewer bytes."""
        every = self._all
        if not every.operator.has_parts:
            return now, last, new, y
        faster = float(5 * length / np.sqrt(max(self.problem.size, 1)))
        contacts = self.cones.active(now.x, last.x, y, faster).nonzero()[0]
        if len(contacts) > MANY * self.cones.count:
            return now, last, new, y
        rows = self.cones.rows_of(contacts)

        def active(array: Array) -> Array:
            return np.take(array, rows, axis=0) if len(array) else array

        for room in (now.room, last.room, y):
            _gather(rows, room)
        assert isinstance(every.operator, ContactMap)
        operator, cones = every.operator.only(contacts), self.cones.only(contacts)
        self._active = ActiveSet(rows, operator, cones, active(every.b), active(every.compliance))
        here = slice(len(rows))
        now, last, new = (Iterate(room[here], image, room) for _, image, room in (now, last, new))
        return now, last, new, y[here]

    def step(self, now: Iterate, last: Iterate, beta: float, y: Array, length: float, new: Iterate) -> Sequence[float]:
        """The projected step of this length from z, where the rigid gradient is y, into ``new``; of the step d from z
        d'Ad and |d|^2, and y_z'(x_new - x), with y_z the gradient at z with the De Saxce term of Coulomb's law."""
        _, operator, cones, _, soft = self._active
        work, square, uphill = cones.accelerated_step(now.x, last.x, y, soft, beta, length, self.coulomb, new.x)
        operator.find_image(new.x, new.image)
        work += operator.energy_of_step(new.image, now.image, last.image, beta)
        work, square, uphill = self.problem.sums(work, square, uphill)
        if work < 0.0:  # maps have none such; of a matrix images differ by their rounding, too, where steps are tiny
            d = new.x - (now.x + beta * (now.x - last.x))
            work = self.dots((d, self.product(d)))[0]
        return work, square, uphill

    def project(self, x: Array) -> Array:
        """x moved to the nearest point of the cones, in place."""
        return self.cones.project(x, x)

    def dots(self, *pairs: tuple[Array, Array]) -> Array:
        """Scalar products of pairs of arrays over all contacts, in one reduction over the ranks."""
        return self.problem.sum(np.array([x.ravel().dot(y.ravel()) for x, y in pairs], dtype=float))

    def block_steps(self) -> Array:
        """1 over the largest eigenvalue of each contact's diagonal block of A, per unknown (nc, 3)."""
        shrink = self.shrink
        blocks = self.problem.diagonal_blocks * (shrink[:, :, None] * shrink[:, None, :])
        largest = np.linalg.eigvalsh(blocks)[:, -1]
        return np.repeat(1.0 / np.where(largest > 0, largest, 1.0), 3).reshape(-1, 3)

    def errors(self, x: Array, gradient: Array) -> Errors:
        """Of the impulses of x, but for rounding in the cones, and the velocities N g + r of its gradient A x + b."""
        return self.problem.errors(x, gradient, self.coulomb, (self.unit, self.size))

    def curvature(self, x: Array, gradient: Array, other: Array, there: Array) -> float:
        """d'Ad / d'd of the way d from another point to x, by the gradients (nc, 3) at both; inf where d is zero."""
        way = x - other
        work, square = self.dots((way, gradient - there), (way, way))
        return max(float(work / square), 0.0) if square > 0 else np.inf

    def largest_curvature(self, steps: int = 10) -> float:
        """Estimate from below of the largest eigenvalue of A: ``steps`` power iterations from b."""
        x = self.b
        curvature = 1.0
        for _ in range(steps):
            norm = np.sqrt(self.dots((x, x))[0])
            if not norm > 0:
                break
            Ax = self.product(x / norm)
            curvature = self.dots((x, Ax))[0] / norm
            x = Ax
        return max(curvature, 1.0)  # the mean of diag A is 1


@loop
def _largest(r):
    """The greatest size of a number of r (nc, 3)."""
    largest = 0.0
    for c in range(len(r)):
        for k in range(3):
            largest = max(largest, abs(r[c, k]))
    return largest


@loop
def _scale(diagonal, mean, unit, r, compliance, sizes, b, soft):
    """Fill in three arrays (nc, 3) of a `ScaledProblem`, for the diagonal of N, its mean, and the unit."""
    for c in range(len(r)):
        normal, tangential = diagonal[c, 0], 0.5 * (diagonal[c, 1] + diagonal[c, 2])
        normal = np.sqrt(normal if normal > 0.0 else mean)
        tangential = np.sqrt(tangential if tangential > 0.0 else mean)
        for k in range(3):
            size = tangential if k else normal
            sizes[c, k], shrink = size, 1.0 / size
            b[c, k], soft[c, k] = r[c, k] / (unit * size), compliance[c, k] * (shrink * shrink)


@loop
def _gather(rows, x):
    """Move the rows (n,) of x (nc, 3), which ascend, to its first rows."""
    for k in range(len(rows)):
        c = rows[k]
        x[k, 0], x[k, 1], x[k, 2] = x[c, 0], x[c, 1], x[c, 2]


@loop
def _spread(rows, x):
    """Move the first rows of x (nc, 3) to the rows (n,), which ascend; the others become zero."""
    k = len(rows) - 1
    for c in range(len(x) - 1, -1, -1):
        here = k >= 0 and rows[k] == c
        for i in range(3):
            x[c, i] = x[k, i] if here else 0.0
        k -= here


@dataclass(frozen=True)
class FirstOrder:
    """Options of every first-order method."""

    check: int = number(20, "iterations between two looks at the natural residual, each of the cost of a product")
    patience: int = number(5000, "iterations without progress before it has stalled: there are plateaus of thousands")


class Progress:
    """Counts the iterations of a method (products with N), keeps its best point, and says when to stop.

    The objective of these methods need not fall in every step, and the natural residual falls steadily in none of them.
    So the result is the best of all points that were looked at.
    """

    def __init__(self, problem: ScaledProblem, limits: Limits, options: FirstOrder, before: Progress | None = None):
        """``before`` is the progress in lower precision, whose iterations and history go on."""
        self.problem, self.limits, self.check, self.patience = problem, limits, options.check, options.patience
        self._aimed = limits.aimed
        self.iterations: int = before.iterations if before else 0
        self.history: list[float] = before.history if before else []
        self.status, self.reason = Status.STALLED, ""
        self.best, self._point = np.inf, np.zeros((0, 3))  # residual and x
        self.looked = self._point  # the last x that was looked at
        self._looks = self._next_look = 0
        self._size, self._last_look = 0.0, (1.0, 0.0)  # of the last step; the residual and the size at the last look
        self._suspicious, self._unbounded = limits.tol, ""
        self._lowest = 0.0  # curvature of a step, over the greatest
        self._gain = (np.inf, self.iterations)  # residual and iteration of the last progress
        self._met: int | None = None  # the iteration at which the limits were met

    def is_due(self, size: float) -> bool:
        """Whether it is time for `goes_on`: after ``check`` iterations, or a few after the last look where the residual
        would be a little below the tolerance, as a look costs more than an iteration, if it had changed as the ``size``
        of steps has: |L step|, 0 before the first.

        Before there was a step it is taken for RATIO times |L step| / |x|."""
        residual, size_then = self._last_look
        wanted = self.limits.tol if self._met is None else self._aimed
        early = self._next_look - self.check + 3
        if self.iterations >= early and residual * size <= 0.9 * wanted * size_then:
            self._next_look = self.iterations
        self._size = size
        return self.iterations >= self._next_look

    def goes_on(self, x: Array, gradient: Array | None = None, exact: bool = False) -> bool:
        """Whether to iterate further from x. Every ``check`` iterations this computes the residual.

        ``gradient`` is A x + b if the method has it, ``exact`` in double precision where it comes from x itself."""
        if self.iterations < self._next_look:
            return True
        self._next_look = min(self.iterations + self.check, self.limits.max_it)
        residual = self._residual(x, gradient, exact and self.problem.precision is np.float64)
        self.history.append(residual)
        self.limits.report(self.iterations, residual)
        self.looked = x.copy()
        if residual < self.best or self._looks == 0:
            self.best, self._point = residual, self.looked
        self._looks += 1
        if self._size > 0:
            self._last_look = (residual, self._size)
        else:
            self._last_look = (RATIO, self.problem.problem.norm(x))
        self.status, self.reason = self._why_stop(residual)
        return not self.reason

    def watch(self, curvature: float, square: float, largest: float) -> None:
        """Note a negative d'Ad and |d|^2 of a step d, and an estimate of the largest eigenvalue of A, one at least."""
        if square > 0:
            self._lowest = min(self._lowest, curvature / (square * max(largest, 1.0)))

    @property
    def impulse(self) -> Array:
        """Of the best point (nc, 3)."""
        return self.problem.impulse(self._point)

    @property
    def beyond(self) -> int:
        """The iterations since the limits were met."""
        return 0 if self._met is None else self.iterations - self._met

    def result(self) -> Result:
        indefinite = self._lowest < -ROUNDED
        status = Status.CONVERGED if self.best <= self.limits.tol and not indefinite else self.status
        given = self.impulse, status, self.reason, self.best, self.iterations
        return Result(*given, beyond=self.beyond, history=self.history, exhausted=indefinite)

    def _residual(self, x: Array, gradient: Array | None, exact: bool) -> float:
        """The residual that the tolerance is for; nan where x or its gradient is no number."""
        if gradient is not None:
            residual = self._judge(self.problem.errors(x, gradient), x)
            # inf where x = 0, or x is no number; methods that update the gradient collect rounding: look twice
            if (exact or self.limits.tol < residual) and residual < np.inf:
                return residual
        g, problem = self.problem.impulse(x), self.problem.problem
        y = problem.product(g)  # in double precision
        y += problem.r
        if not math.isfinite(problem.dot(g, y)):
            return math.nan
        return self._judge(problem.errors(g, y, self.problem.coulomb), x)

    def _judge(self, errors: Errors, x: Array) -> float:
        """The residual that the tolerance is for. Where only the closing work is too large, the problem may have no
        solution: this is found out at the point x whenever the natural residual has fallen to a tenth."""
        residual = self.limits.residual(errors)
        if errors.natural <= self._suspicious and residual > self.limits.tol:
            self._suspicious = 0.1 * errors.natural
            self._unbounded = why_unbounded(self.problem.problem, self.problem.impulse(x))
        return residual

    def _why_stop(self, residual: float) -> tuple[Status, str]:
        """The reason is empty as long as there is none."""
        if self._met is None and residual <= self.limits.tol:
            self._met = self.iterations
        if self._lowest < -ROUNDED and not self._unbounded:
            words = f"N is indefinite: d'Nd / d'd is {self._lowest:.1g} of the greatest for a step d"
            return Status.BREAKDOWN, words
        if residual <= self._aimed or (self._met is not None and self.beyond >= self.limits.spare):
            return Status.CONVERGED, self.limits.met
        if self._unbounded:
            return Status.UNBOUNDED, self._unbounded
        if residual != residual:
            return Status.BREAKDOWN, f"not a number after {self.iterations} iterations"
        if self.iterations >= self.limits.max_it:
            return Status.ITERATION_LIMIT, f"{self.iterations} iterations"
        if residual < 0.99 * self._gain[0]:  # rounding alone is no progress
            self._gain = (residual, self.iterations)
        if self.iterations - self._gain[1] >= self.patience:
            return Status.STALLED, f"no progress in the last {self.patience} of {self.iterations} iterations"
        return Status.STALLED, ""


def begin(
    problem: ConeProblem, guess: Array, limits: Limits, options: FirstOrder
) -> tuple[ScaledProblem, Progress, Array, Array]:
    """What a method begins with: the problem in its unknowns, its progress, the point of the guess, and the gradient
    there."""
    scaled = ScaledProblem(problem)
    x = scaled.start(guess)
    return scaled, Progress(scaled, limits, options), x, scaled.gradient(x)
