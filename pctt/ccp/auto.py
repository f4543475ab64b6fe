"""APGD for as many iterations as about half of the conic interior point method costs; then that method, from there.

What the conic method costs is regular: as many iterations of APGD as 48 for each digit of the tolerance, times the cube
root of the number of contacts, within a quarter of what was measured on settled mixers of 18,483 and 142,175 contacts
(docs/methods.md). So a problem that is hard for APGD costs one and a half times what the conic method alone would, and
one that is easy costs nothing more.

For Coulomb's law the conic method stalls often, but the path that it follows leads to the neighbourhood of a solution.
So it begins at the first guess, is stopped at a residual of 3e-4, and APGD goes on from the end of its path.

Small problems are the exception: there it goes on to the end, and to an aim beyond the limits that APGD does not reach
soon. Where friction is large, from 2 on, both may fail: APGD circles about the law, and the path of the conic method
ends at a wall of its cones. So it begins once more without a guess; then plain projected steps, which do not circle,
and the conic method with shorter steps take turns. At last there are cone problems for given De Saxce terms
(`pctt.ccp.coulomb`), from the relaxation and from the best impulses. Where the relaxation has no solution, nothing says
that Coulomb's law has one; if none is found the problem counts as unbounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from dem.exchange import broadcast
from pctt.arrays import Array
from pctt.ccp import gathered
from pctt.ccp.accuracy import figures
from pctt.ccp.coulomb import fixed_point
from pctt.ccp.first_order import apgd
from pctt.ccp.interior import conic
from pctt.ccp.newton import Newton, by_elimination
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result, Status
from pctt.ccp.unbounded import why_unbounded
from pctt.options import number

CONIC_ITERATIONS = 60  # of the conic method at most, as in the registry
USUAL = apgd.APGD()
USUAL_CONIC = conic.Conic()
PLAIN = apgd.APGD(damping=1.0, near=1.0)  # without momentum
SHORT = conic.Conic(start=1.0, boundary_with_law=0.5)
TERMS = {"most": 60, "depth": 2}  # cone problems for given De Saxce terms, where all else has failed
GREAT = (Status.UNBOUNDED, Status.SQUEEZED)  # of impulses that may have grown
GROWN = 1e9  # of the impulses that the data suggest: no mass ratio that is solved asks for as much


@dataclass(frozen=True)
class Auto:
    """Settings of `auto`."""

    patience: float = number(25.0, "APGD's iterations per digit of the tolerance and cube root of the contacts")
    elimination: float = number(4.0, "the same of few contacts (`newton.elimination`): `conic` takes 1 to 9 times that")
    law: float = number(5.0, "factor on it for Coulomb's law: more systems, and unsymmetric; docs/notebook_ccp.md")
    law_of_few: float = number(2.5, "the same of few contacts: `conic` takes 1.4 to 1.9 times as long")
    start: float = number(3e4, "complementarity of the conic method's start, at most, by APGD's residual")
    basin: float = number(3e-4, "Coulomb residual at which the conic method's path is near enough for APGD")
    turns: int = number(4, "of plain steps and the conic method, where it fails in a small problem of Coulomb's law")
    plain: int = number(100, "plain steps in the first of them; twice as many in each other one")

    def iterations(self, problem: ConeProblem, tol: float, coulomb: bool, few: bool = False) -> int:
        """Those of APGD. Small problems have fixed costs, unless their contacts are ``few``."""
        per_digit, law, least = (self.elimination, self.law_of_few, 1) if few else (self.patience, self.law, 400)
        per_digit *= (law if coulomb else 1.0) * max(problem.size, least) ** (1.0 / 3.0)
        return broadcast(problem.comm, int(-math.log10(tol) * per_digit))


def solve(
    problem: ConeProblem, guess: Array, limits: Limits, options: Auto, newton: Newton, coulomb: bool = False
) -> Result:
    """Impulses, of the cone problem or of Coulomb's law; ``solver`` of the result names the method that found them."""
    tried = Attempts(problem, limits, newton, coulomb)
    small = tried.small
    first, few = tried.begin(guess, options)
    if first.converged and first.residual > limits.aimed:
        tried.beyond(guess, few)
    elif not (_ended(first) or first.exhausted) and first.iterations < limits.max_it:
        if not coulomb:
            start = min(USUAL_CONIC.start, options.start * first.residual)
            tried.conic(first.impulse, replace(USUAL_CONIC, start=start))
        else:
            basin = max(limits.tol, options.basin)
            second = tried.conic(guess, USUAL_CONIC, 0.0 if small else basin)
            grown = second.status in GREAT  # its path has left those of the law, which may have a solution
            failed = small and not grown and second.status is not Status.GIVEN_UP and second.residual > basin
            if failed and problem.norm(guess) > 0.0:  # a guess at the wall of its cones
                second = tried.conic(np.zeros_like(guess), USUAL_CONIC)
            if failed and second.residual > basin:
                tried.in_turns(options, basin)
            elif grown or not (small and second.final):
                begun = guess if first.status in GREAT else first.impulse
                tried.apgd(second.impulse if second.iterations and not grown else begun, limits.max_it)
            if small and second.status is not Status.GIVEN_UP and not tried.all[-1].converged:
                tried.at_last(guess)
    return tried.result()


def _ended(result: Result) -> bool:
    """Whether another attempt would be in vain."""
    return result.final and result.status is not Status.SQUEEZED


class Attempts:
    """What methods have made of a problem, one after another."""

    def __init__(self, problem: ConeProblem, limits: Limits, newton: Newton, coulomb: bool):
        self.problem, self.limits, self.newton, self.coulomb = problem, limits, newton, coulomb
        self.all: list[Result] = []
        self.small = problem.size <= by_elimination.FEW
        self.most = min(CONIC_ITERATIONS, limits.max_it)
        self.gathers = gathered.takes(problem, newton)

    @cached_property
    def usual(self) -> float:
        """The size of impulses that the data suggest. Collective."""
        return self.problem.norm(self.problem.r) / self.problem.mean_diagonal

    @cached_property
    def whole(self) -> gathered.Whole | None:
        """The problem of all ranks, gathered once, where the conic method takes that. Collective."""
        return gathered.whole(self.problem) if self.gathers else None

    def keep(self, result: Result, solver: str) -> Result:
        """Note a result. Impulses of self-stress may grow in Coulomb's law until their rounding throws bodies away, and
        the natural residual, which is relative to them, falls: such impulses are none. Where they are squeezed in a
        small problem, the residual is that of their works."""
        result.solver, result.newton_its = solver, result.iterations if solver == "conic" else 0
        if self.coulomb and self.problem.norm(result.impulse) > GROWN * self.usual:
            if why := why_unbounded(self.problem, result.impulse):
                result.status, result.reason = Status.UNBOUNDED, why
            else:
                result.status, result.residual = Status.STALLED, np.inf
                result.reason = f"impulses grow beyond {GROWN:g} times the size that r and N suggest"
                result.impulse = np.zeros_like(result.impulse)
        if self.coulomb and self.small and result.converged:
            result.momentum = self.problem.momentum(result.impulse)
            found = figures(self.problem, result.impulse, self.problem.velocity_of(result.momentum))
            result.accuracy = found
            if words := self.limits.squeezed(found, coulomb=True):
                result.status, result.reason = Status.SQUEEZED, words
                result.residual = self.limits.excess(max(found.closing_work, found.opening_work), found.closing_speed)
        self.all.append(result)
        return result

    def begin(self, guess: Array, options: Auto) -> tuple[Result, bool]:
        """What APGD makes of the guess, and whether the problem has few contacts. That is asked only where APGD has not
        come to the aim as soon as the conic method would with few: the answer has its cost."""
        count = partial(options.iterations, self.problem, coulomb=self.coulomb)
        few = self.newton.may_eliminate(self.problem) or self.gathers
        spare = options.iterations(self.problem, self.limits.aim, coulomb=False, few=True) if few else 0
        first = self.apgd(guess, count(self.limits.aimed if few else self.limits.tol, few=few), spare=spare)
        ended = first.final or first.exhausted
        if few and first.residual > self.limits.aimed and not ended:
            few = self.whole is not None or (not self.gathers and self.newton.has_elimination(self.problem))
            if not (few or first.converged):
                more = self.apgd(first.impulse, count(self.limits.tol))
                self.all, first = [more.after(first)], more
        return first, few

    def apgd(self, guess: Array, most: int, options: apgd.APGD = USUAL, spare: int = 0) -> Result:
        limits = self.rest.but(max_it=min(most, self.limits.max_it), spare=spare)
        return self.keep(apgd.solve(self.problem, guess, limits, options, coulomb=self.coulomb), "apgd")

    def _by_conic(
        self, problem: ConeProblem, guess: Array, limits: Limits, options: conic.Conic = USUAL_CONIC,
        coulomb: bool = False,
    ) -> Result:  # fmt: skip
        """What the conic method makes of a problem that differs from the own one in r alone."""
        if self.whole is not None:
            return self.whole.solve(problem.r, guess, limits, options, coulomb)
        return conic.solve(problem, guess, limits, options, self.newton, coulomb=coulomb)

    def conic(self, guess: Array, options: conic.Conic, basin: float = 0.0) -> Result:
        """To the limits, or to the ``basin`` of the residual alone."""
        limits = self.rest.but(max_it=self.most)
        if basin:
            limits = limits.but(tol=basin, closing_work=np.inf, closing_speed=np.inf)
        return self.keep(self._by_conic(self.problem, guess, limits, options, self.coulomb), "conic")

    def beyond(self, guess: Array, few: bool) -> None:
        """To the aim of limits that APGD has met: few contacts by the conic method, where APGD has not found it in its
        first attempt, many by APGD."""
        if few:
            self.conic(guess, USUAL_CONIC)
        if self.best.residual > self.limits.aimed and self.limits.spare and not few:
            self.apgd(self.best.impulse, self.limits.max_it, spare=self.limits.spare)

    @property
    def rest(self) -> Limits:
        """The limits of the next attempt."""
        return self.limits.after(sum(result.iterations for result in self.all))

    @property
    def best(self) -> Result:
        """That of the least residual, which says nothing of impulses that grow."""
        return min(self.all, key=lambda result: (result.status is Status.UNBOUNDED, result.residual))

    def in_turns(self, options: Auto, basin: float) -> None:
        """Plain steps and shorter ones of the conic method, until APGD can go on; where they do not come so far the
        relaxation, and cone problems that begin there."""
        for turn in range(options.turns):
            most = options.plain * 2**turn
            if _ended(self.apgd(self.best.impulse, most, PLAIN)) or _ended(self.conic(self.best.impulse, SHORT)):
                return
            if self.best.residual <= basin:
                self.apgd(self.best.impulse, self.limits.max_it)
                return
        relaxed = self._by_conic(self.problem, np.zeros_like(self.problem.r), self._of_terms.unwatched)
        if why := why_unbounded(self.problem, relaxed.impulse):
            self.keep(replace(relaxed, status=Status.UNBOUNDED, reason=f"of the relaxation, {why}"), "conic")
        else:
            self.by_terms(relaxed.impulse)
            self.all[-1].after(relaxed)

    def at_last(self, guess: Array) -> None:
        """What is left for the best impulses, or the guess where impulses have grown: APGD, where it has not just been
        tried, the cone problems of their De Saxce terms, and shorter steps of the conic method."""
        grown = self.all[-1].status in GREAT
        if grown or self.all[-1].solver != "apgd":
            self.apgd(guess if grown else self.best.impulse, self.limits.max_it)
        if not self.all[-1].converged:
            self.by_terms(self.best.impulse)
        if not self.all[-1].converged:
            self.conic(self.best.impulse, SHORT)
        self.all[-1].exhausted = True

    def by_terms(self, impulse: Array) -> None:
        """Cone problems for given De Saxce terms, the first of them those of impulses; none with moments, whose terms
        these problems do not have."""
        if self.problem.cones.parts == 1:
            self.keep(fixed_point(self._by_conic, self.problem, impulse, self._of_terms, **TERMS), "conic")

    @property
    def _of_terms(self) -> Limits:
        return self.rest.but(max_it=self.most)

    def result(self) -> Result:
        """The last one, or the best where the first met the limits, or nothing is left to try; with what all have
        cost."""
        last = found = self.all[-1]
        if self.all[0].converged:
            found = self.best
        elif last.exhausted and not last.converged:
            found = next((result for result in self.all if result.status is Status.UNBOUNDED), self.best)
        found.exhausted = last.exhausted
        if len(self.all) > 1:
            found.reason = "; ".join(f"{result.solver}: {result.reason}" for result in self.all)
        return found.after(*(result for result in self.all if result is not found))
