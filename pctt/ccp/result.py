"""The result of a solver of the cone problem, and the options that all solvers share."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, Optional

import numpy as np
from numpy.typing import NDArray

from pctt.arrays import Array
from pctt.options import COUNT, FRACTION, PART, number, option

if TYPE_CHECKING:
    from pctt.ccp.accuracy import Accuracy
    from pctt.ccp.problem import Errors

#: The laws of contact, and how a law is named that a sequence of cone problems has found.
RELAXATION, COULOMB, FIXED_POINT = "relaxation", "coulomb", "coulomb by cone problems"
LAWS = (COULOMB, RELAXATION)
ENOUGH = 1000.0  # accuracy of the natural residual, over the tolerance, at which a wrong closing work is no lack of it


@dataclass(frozen=True)
class Limits:
    """Limits say when a solver stops; they are options of every solver: ``-ccp_tol``, ``-ccp_max_it`` and so on."""

    tol: float = option(1e-4, "natural residual at which a cone problem counts as solved", check=FRACTION)
    max_it: int = option(
        -1,
        "iterations before a solver gives up; -1: the solver's own default",
        check=("a whole number >= -1", lambda x: x >= -1),
    )
    closing_work: float = option(
        0.05,
        "closing and opening work at which a cone problem counts as solved; inf: any",
        check=("a positive number, or inf", lambda x: x > 0),
    )
    closing_speed: float = option(
        math.inf, "speed at which a contact may still close where a cone problem counts as solved; inf: any",
        unit="m/s", check=("a positive number, or inf", lambda x: x > 0),
    )  # fmt: skip
    aim: float = number(
        1.0, "where that pays, a method goes on to this part of the limits, for as many iterations as are spare",
        check=PART,
    )  # fmt: skip
    spare: int = number(0, "the iterations for it; the conic method, which takes a few, needs none", check=COUNT)
    fallback: bool = option(True, "where the solver does not converge, another one goes on from its impulses")
    monitor: bool = option(False, "print the iterations and the residual wherever a solver looks at it")
    watch: Optional[Callable[[int, float], None]] = number(None, "it is told both, too, on every rank")

    def but(self, **changes: Any) -> Limits:
        """The same with other values. (As `dataclasses.replace`, which takes ten times as long.)"""
        other = object.__new__(type(self))
        vars(other).update(vars(self), **changes)
        return other

    def residual(self, errors: Errors) -> float:
        """What ``tol`` is for: the natural residual, or the closing or opening work, or the closing speed, each in
        units in which its limit is ``tol``, whichever is largest. It is at most ENOUGH times the natural residual:
        where bodies are squeezed no accuracy may bring the others below their limits. What passes so is `squeezed`."""
        return min(max(errors.natural, self.excess(errors.work, errors.speed)), ENOUGH * errors.natural)

    def excess(self, work: float, speed: float) -> float:
        """A closing or opening work and a closing speed, as parts of their limits, in units of ``tol``."""
        worst = 0.0
        for error, limit in (work, self.closing_work), (speed, self.closing_speed):
            if limit < math.inf:
                worst = max(worst, self.tol / limit * error)
        return worst

    def squeezed(self, found: Accuracy, coulomb: bool) -> str:
        """The reason, in words, if impulses of this accuracy meet the limits although their closing or opening work, or
        their closing speed, is above its own; else ""."""
        work, speed = max(found.closing_work, found.opening_work), found.closing_speed
        natural = found.coulomb_residual if coulomb else found.natural_residual
        if ENOUGH * natural > self.tol or (work <= self.closing_work and speed <= self.closing_speed):
            return ""
        above = f"closing or opening work {work:.2g}, above {self.closing_work:g}"
        if work <= self.closing_work:
            above = f"closing speed {speed:.2g} m/s, above {self.closing_speed:g}"
        return f"squeezed: {above}, at a natural residual of {natural:.1e}, {ENOUGH:g} times below the tolerance"

    def report(self, iterations: int, residual: float) -> None:
        """Tell who watches."""
        if self.watch is not None:
            self.watch(iterations, residual)

    def after(self, iterations: int) -> Limits:
        """For a method that goes on after so many iterations of others."""
        watch = self.watch
        if watch is None:
            return self
        return dataclasses.replace(self, watch=lambda more, residual: watch(iterations + more, residual))

    @property
    def unwatched(self) -> Limits:
        """For a method whose residual is not that of the problem."""
        return dataclasses.replace(self, watch=None)

    @property
    def aimed(self) -> float:
        """The residual to go on to."""
        return self.aim * self.tol

    @property
    def met(self) -> str:
        """The reason of a result that meets them."""
        return _met(self.closing_work < math.inf, self.closing_speed < math.inf)

    def to(self, tol: float) -> Limits:
        """For another tolerance of the same residual, and no aim beyond it."""
        work, speed = (limit / self.tol * tol for limit in (self.closing_work, self.closing_speed))
        return dataclasses.replace(self, tol=tol, closing_work=work, closing_speed=speed, aim=1.0)


@cache
def _met(work: bool, speed: bool) -> str:
    names = ["natural residual", *["closing work"] * work, *["closing speed"] * speed]
    return " and ".join([", ".join(names[:-1]), names[-1]][len(names) < 2 :]) + " below the tolerance"


class Status(Enum):
    """A status says how a solver ended; code looks at this, people at the ``reason`` beside it."""

    CONVERGED = "converged"
    SQUEEZED = "squeezed"  #: the natural residual is far below the tolerance, the closing work is not
    ITERATION_LIMIT = "iteration limit"
    STALLED = "stalled"  #: no progress, or steps too short
    UNBOUNDED = "unbounded"  #: the cone problem has no solution, and none of the law was found
    BREAKDOWN = "breakdown"  #: something is no number
    GIVEN_UP = "given up"  #: the method does not apply


class Counts(NamedTuple):
    """Contacts of all ranks by what they do."""

    open: int
    sliding: int
    sticking: int


@dataclass
class Result:
    """A result has the impulses of a cone problem, and says how they were found.

    Attributes
    ----------
    impulse : (nc, 3) impulses of this rank's contacts (N s); (nc, 2) in the plane
    velocity : the velocities y = N g + r of that shape (m/s); set by `pctt.ccp.solve`
    status : CONVERGED where the residual and the closing work of `Limits` are below theirs, else why not. SQUEEZED:
        bodies are pressed so hard, or have masses so far apart, that the closing work says nothing, or that forces on
        light bodies are wrong. No other method would do better; with few contacts `auto` has tried that
    reason : what ran and why it ended, in words
    residual : the solver's own last value: the natural residual if the closing work has no limit
    iterations : Newton steps, or steps of first-order methods, of all methods tried
    ksp_its : Krylov iterations in all Newton steps
    fallbacks : Newton systems that the user's KSP did not solve
    history : residual per iteration of ``solver``; of Coulomb's law by cone problems, one per cone problem
    cone_problems : how many were solved for it: more than one for Coulomb's law
    solver : name of the method that found the impulses
    newton_its : the Newton steps among the iterations
    law : RELAXATION, COULOMB or FIXED_POINT: the law of the impulses and of the residuals
    accuracy : the figures of the impulses; set by `pctt.ccp.solve`
    momentum : (6m,) G' g, or g where the problem is given by N, in the units of the cones; set by `pctt.ccp.solve`
    states : (nc,) of this rank's contacts: 0 open, 1 sliding, 2 sticking; set by `pctt.ccp.solve`
    counts : the open, sliding and sticking contacts of all ranks
    beyond : iterations among them after the limits were met, towards the aim beyond these
    asked : what the asked method made of it, where another one had to follow; else None
    exhausted : whether no other method is to be tried
    """

    impulse: Array
    status: Status
    reason: str
    residual: float
    iterations: int
    ksp_its: int = 0
    fallbacks: int = 0
    history: list[float] = field(default_factory=list)
    cone_problems: int = 1
    solver: str = ""
    newton_its: int = 0
    law: str = RELAXATION
    accuracy: Accuracy | None = None
    momentum: Array = field(default_factory=lambda: np.zeros(0))
    velocity: Array = field(default_factory=lambda: np.zeros((0, 3)))
    states: NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, np.int8))
    counts: Counts = Counts(0, 0, 0)
    beyond: int = 0
    asked: Result | None = None
    exhausted: bool = False

    def __str__(self) -> str:
        """A table of how it was found; the impulses are not in it."""
        law = "Coulomb's law" if self.law != RELAXATION else "relaxation of Coulomb's law"
        work = f"{self.newton_its} Newton steps, {self.ksp_its} Krylov iterations" if self.newton_its else ""
        rows = {
            "status": f"{self.status.value} ({self.reason})",
            "solver": f"{self.solver}, {law}",
            "iterations": f"{self.iterations}" + f" ({work})" * bool(work),
            "residual": f"{self.residual:.2e}",
        }
        if (found := self.accuracy) is not None:
            natural = self.residual_of(found)
            name = "natural" if self.law == RELAXATION else "Coulomb"
            works = f"closing work {found.closing_work:.1e}, opening work {found.opening_work:.1e}"
            rows["residual"] += f" ({name} {natural:.1e}, {works})"
            parts = ", ".join(f"{count} {name}" for name, count in self.counts._asdict().items())
            rows["contacts"] = f"{sum(self.counts)} ({parts})"
        return "\n".join(f"{name:10}  {value}" for name, value in rows.items())

    @property
    def converged(self) -> bool:
        return self.status is Status.CONVERGED

    @property
    def final(self) -> bool:
        """Whether no other solver would do better."""
        return self.status in (Status.CONVERGED, Status.SQUEEZED, Status.UNBOUNDED)

    def residual_of(self, found: Accuracy) -> float:
        """The residual that the law of the result stands for."""
        return found.natural_residual if self.law == RELAXATION else found.coulomb_residual

    @property
    def cost(self) -> Result:
        """The result without what it has found: enough for `after`."""
        none = np.zeros((0, 3))
        return dataclasses.replace(
            self, impulse=none, velocity=none, momentum=none, states=np.zeros(0, np.int8), asked=None
        )

    def after(self, *earlier: Result) -> Result:
        """This result, with what the results before it have cost."""
        for result in earlier:
            self.iterations, self.beyond = self.iterations + result.iterations, self.beyond + result.beyond
            self.ksp_its, self.fallbacks = self.ksp_its + result.ksp_its, self.fallbacks + result.fallbacks
            self.newton_its += result.newton_its
        return self
