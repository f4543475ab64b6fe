"""APGD for as many iterations as about half of the conic interior point method costs; then that method, from there.

What the conic method costs is regular: as many iterations of APGD as 48 for each digit of the tolerance, times the cube
root of the number of contacts, within a quarter of what was measured on settled mixers of 18,483 and 142,175 contacts
(docs/ccp.md). So a problem that is hard for APGD costs one and a half times what the conic method alone would, and one
that is easy costs nothing more.

For Coulomb's law the conic method stalls often, but the path that it follows leads to the neighbourhood of a solution.
So it begins at the first guess, is stopped at a residual of 3e-4, and APGD goes on from the end of its path. Problems
so small that they get dense factors are the exception: there it goes on to the end.

Where contacts resist rolling or spinning, it is APGD alone: the conic method has no such cones. So it is with joints,
which its sparse systems do not have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dem.contact_map.jointed import JointedMap
from pctt.ccp.cone import Array
from pctt.ccp.first_order import apgd
from pctt.ccp.interior import conic
from pctt.ccp.newton import Newton
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result
from pctt.ccp.rolling import RollingProblem
from pctt.options import number


@dataclass(frozen=True)
class Auto:
    """Settings of `auto`."""

    patience: float = number(25.0, "APGD's iterations per digit of the tolerance and cube root of the contacts")
    few: float = number(12.0, "the same of problems that get dense factors: all of `conic` costs 7 to 30 there")
    law: float = number(5.0, "factor on it for Coulomb's law: more systems, and unsymmetric; docs/notebook_ccp.md")
    start: float = number(3e4, "complementarity of the conic method's start, at most, by APGD's residual")
    basin: float = number(3e-4, "Coulomb residual at which the conic method's path is near enough for APGD")

    def iterations(self, contacts: int, tol: float, coulomb: bool, few: bool = False) -> int:
        """Those of APGD. Small problems have fixed costs, except where they are ``few`` enough for dense factors."""
        per_digit = self.few * np.cbrt(contacts) if few else self.patience * np.cbrt(max(contacts, 400))
        per_digit *= self.law if coulomb else 1.0
        return int(-np.log10(tol) * per_digit)


def solve(
    problem: ConeProblem, guess: Array, limits: Limits, options: Auto, newton: Newton, coulomb: bool = False
) -> Result:
    """Impulses, of the cone problem or of Coulomb's law; ``solver`` of the result names the method that found them."""
    if isinstance(problem, RollingProblem) or isinstance(problem.contact_map, JointedMap):
        first = apgd.solve(problem, guess, limits, apgd.APGD(), coulomb)
        first.solver = "apgd"
        return first
    dense = newton.has_few(problem)
    most = options.iterations(problem.size, limits.tol, coulomb, dense)
    few = min(limits.max_it, problem.comm.bcast(most))
    first = apgd.solve(problem, guess, replace(limits, max_it=few), apgd.APGD(), coulomb)
    first.solver = "apgd"
    if first.final or few == limits.max_it:
        return first
    inner, start = replace(limits, max_it=min(60, limits.max_it)), options.start * first.residual
    if not coulomb:
        second = conic.solve(problem, first.impulse, inner, conic.Conic(start=min(conic.Conic().start, start)), newton)
        second.solver, second.newton_its = "conic", second.iterations
        second.reason = f"apgd: {first.reason}; conic: {second.reason}"
        return second.after(first)
    if not dense:
        inner = replace(inner, tol=max(limits.tol, options.basin), closing_work=np.inf)
    second = conic.solve(problem, guess, inner, conic.Conic(), newton, coulomb)
    second.solver, second.newton_its = "conic", second.iterations
    if dense and second.final:
        second.reason = f"apgd: {first.reason}; conic: {second.reason}"
        return second.after(first)
    begin = second.impulse if second.iterations else first.impulse
    last = apgd.solve(problem, begin, limits, apgd.APGD(), coulomb)
    last.solver, last.reason = "apgd", f"apgd: {first.reason}; conic: {second.reason}; apgd: {last.reason}"
    return last.after(first, second)
