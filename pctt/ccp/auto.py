"""APGD for as many iterations as about half of the conic interior point method costs; then that method, from there.

What the conic method costs is regular: as many iterations of APGD as 48 for each digit of the tolerance, times the cube
root of the number of contacts, within a quarter of what was measured on settled mixers of 18,483 and 142,175 contacts
(docs/methods.md). So a problem that is hard for APGD costs one and a half times what the conic method alone would, and
one that is easy costs nothing more.

For Coulomb's law the conic method stalls often, but the path that it follows leads to the neighbourhood of a solution.
So it begins at the first guess, is stopped at a residual of 3e-4, and APGD goes on from the end of its path. Problems
of few contacts are the exception: there it goes on to the end. It also takes these to an aim beyond the limits: it
needs a few more steps for that, where APGD may need hundreds.

With joints, which the sparse systems of the conic method do not have, it is APGD alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from pctt.ccp.cone import Array
from pctt.ccp.first_order import apgd
from pctt.ccp.interior import conic
from pctt.ccp.newton import Newton
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result
from pctt.options import number


@dataclass(frozen=True)
class Auto:
    """Settings of `auto`."""

    patience: float = number(25.0, "APGD's iterations per digit of the tolerance and cube root of the contacts")
    few: float = number(6.0, "APGD's iterations per digit where contacts are few (`pctt.ccp.newton.few`): 1/2 `conic`")
    law: float = number(5.0, "factor on it for Coulomb's law: more systems, and unsymmetric; docs/notebook_ccp.md")
    start: float = number(3e4, "complementarity of the conic method's start, at most, by APGD's residual")
    basin: float = number(3e-4, "Coulomb residual at which the conic method's path is near enough for APGD")

    def iterations(self, contacts: int, tol: float, coulomb: bool, few: bool = False) -> int:
        """Those of APGD. Small problems have fixed costs; where they are ``few`` those of both methods are calls."""
        per_digit = self.few if few else self.patience * np.cbrt(max(contacts, 400))
        per_digit *= self.law if coulomb else 1.0
        return int(-np.log10(tol) * per_digit)


def solve(
    problem: ConeProblem, guess: Array, limits: Limits, options: Auto, newton: Newton, coulomb: bool = False
) -> Result:
    """Impulses, of the cone problem or of Coulomb's law; ``solver`` of the result names the method that found them."""
    tried: list[Result] = []

    def attempt(method: ModuleType, guess: Array, limits: Limits, *more: Any) -> Result:
        result: Result = method.solve(problem, guess, limits, *more, coulomb=coulomb)
        result.solver = "conic" if method is conic else "apgd"
        result.newton_its = result.iterations if method is conic else 0
        tried.append(result)
        return result

    alone = problem.contact_map is not None and not problem.contact_map.has_rows  # apgd takes it alone
    few = not alone and newton.has_few(problem)
    most = limits.max_it if alone else options.iterations(problem.size, limits.tol, coulomb, few)
    begun = min(limits.max_it, problem.comm.bcast(most))
    last = first = attempt(apgd, guess, replace(limits, max_it=begun, spare=0 if few else limits.spare), apgd.APGD())
    if few and first.converged and first.residual > limits.aimed:
        last = min(first, attempt(conic, guess, limits, conic.Conic(), newton), key=lambda result: result.residual)
        tried.sort(key=lambda result: result is last)
    elif not first.final and begun < limits.max_it:
        inner, settings, begin = replace(limits, max_it=min(60, limits.max_it)), conic.Conic(), guess
        if not coulomb:
            settings = conic.Conic(start=min(settings.start, options.start * first.residual))
            begin = first.impulse
        elif not few:
            inner = replace(inner, tol=max(limits.tol, options.basin), closing_work=np.inf, closing_speed=np.inf)
        last = second = attempt(conic, begin, inner, settings, newton)
        if coulomb and not (few and second.final):
            last = attempt(apgd, second.impulse if second.iterations else first.impulse, limits, apgd.APGD())
        last.reason = "; ".join(f"{result.solver}: {result.reason}" for result in tried)
    return last.after(*tried[:-1])
