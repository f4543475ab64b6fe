"""The result of a solver of the cone problem, and the options that all solvers share."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from pctt.ccp.cone import Array
from pctt.options import FRACTION, option

RELAXATION, COULOMB, FIXED_POINT = "relaxation", "Coulomb", "Coulomb by cone problems"


@dataclass(frozen=True)
class Limits:
    """Options of every solver: ``-ccp_tol``, ``-ccp_max_it``."""

    tol: float = option(1e-4, "natural residual at which a cone problem counts as solved", check=FRACTION)
    max_it: int = option(
        -1,
        "iterations before a solver gives up; -1: the solver's own default",
        check=("a whole number >= -1", lambda x: x >= -1),
    )


class Status(Enum):
    """How a solver ended; code looks at this, people at the ``reason`` beside it."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration limit"
    STALLED = "stalled"  #: no progress, or steps too short
    UNBOUNDED = "unbounded"  #: the problem has no solution
    BREAKDOWN = "breakdown"  #: something is no number
    GIVEN_UP = "given up"  #: its caller expects another method to be faster


@dataclass
class Result:
    """Impulses of a cone problem and how they were found.

    Attributes
    ----------
    impulse : (nc, 3) impulses of this rank's contacts (N s)
    status : CONVERGED where the natural residual fell below the tolerance, else why not
    reason : why the iteration ended, in words
    natural_residual : the solver's own last value
    iterations : Newton steps, or steps of a first-order method
    ksp_its : Krylov iterations in all Newton steps
    fallbacks : Newton systems that the user's KSP did not solve
    history : natural residual per iteration
    cone_problems : how many were solved for it: more than one for Coulomb's law
    solver : name of the method that found it, where that was chosen; "" otherwise
    law : RELAXATION, COULOMB or FIXED_POINT: the law of the impulses and of the residuals

    With FIXED_POINT ``history`` has one residual per cone problem.
    """

    impulse: Array
    status: Status
    reason: str
    natural_residual: float
    iterations: int
    ksp_its: int = 0
    fallbacks: int = 0
    history: list[float] = field(default_factory=list)
    cone_problems: int = 1
    solver: str = ""
    law: str = RELAXATION

    @property
    def converged(self) -> bool:
        return self.status is Status.CONVERGED

    @property
    def final(self) -> bool:
        """Whether no other solver would do better."""
        return self.status in (Status.CONVERGED, Status.UNBOUNDED)
