"""The solvers of the cone problem. ``-ccp_type`` and the tests are made from this list, and the table of
docs/solvers.md is compared with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pctt.ccp import auto
from pctt.ccp.cones import Cones, FrictionCones, RollingCones
from pctt.ccp.first_order import apgd, faces, gauss_seidel, projected_steps
from pctt.ccp.first_order.scaled import FirstOrder
from pctt.ccp.interior import conic, pdip
from pctt.ccp.result import COULOMB, Result

PRODUCT, MATRIX, NEWTON = "products with N", "rows of N", "Newton systems"
BOTH = (FrictionCones, RollingCones)
EITHER = "products with N, or Newton systems"


@dataclass(frozen=True)
class Solver:
    """A method: ``function(problem, guess, limits, options)``, with a ``pctt.ccp.Newton`` after them if it solves
    Newton systems.

    ``needs`` is PRODUCT, MATRIX, NEWTON or EITHER; ``iterations`` the default limit (``-ccp_max_it``). A method that
    ``has_law`` takes ``coulomb=True`` and then finds impulses of Coulomb's law by itself; ``cones`` are
    the kinds that it takes, and one that ``has_multipliers`` can have them as unknowns of its Newton systems (the form
    `kkt`).
    """

    name: str
    function: Callable[..., Result]
    options: type
    needs: str
    iterations: int
    help: str
    source: str
    has_law: bool = False
    cones: tuple[type[Cones], ...] = (FrictionCones,)
    has_multipliers: bool = False

    @property
    def newton(self) -> bool:
        return self.needs in (NEWTON, EITHER)

    @property
    def prefix(self) -> str:
        """What the names of its options start with."""
        return f"ccp_{self.name}_"


SOLVERS = {
    solver.name: solver
    for solver in (
        Solver("pdip", pdip.solve, pdip.PDIP, NEWTON, 200,
               "the paper's primal-dual interior point method", "the paper, section 2.4", has_multipliers=True),
        Solver("conic", conic.solve, conic.Conic, NEWTON, auto.CONIC_ITERATIONS,
               "symmetric cone interior point method, Nesterov-Todd scaling, Mehrotra's corrector",
               "Nesterov, Todd 1997; Acary et al. 2023", has_law=True, cones=BOTH),
        Solver("auto", auto.solve, auto.Auto, EITHER, 20_000,
               "`apgd` for as many iterations as half of `conic` costs, then `conic`", "`pctt/ccp/auto.py`",
               has_law=True, cones=BOTH),
        Solver("apgd", apgd.solve, apgd.APGD, PRODUCT, 20_000,
               "accelerated projected gradient descent with restart", "Mazhar et al. 2015", has_law=True, cones=BOTH),
        Solver("barzilai_borwein", projected_steps.adaptive, projected_steps.BarzilaiBorwein, PRODUCT, 20_000,
               "projected Barzilai-Borwein steps with an adaptive nonmonotone line search", "Dai, Fletcher 2005"),
        Solver("spectral", projected_steps.spectral, projected_steps.BarzilaiBorwein, PRODUCT, 20_000,
               "preconditioned spectral projected gradient with fallback (P-SPG-FB)",
               "Heyn et al. 2013; Birgin, Martinez, Raydan 2000"),
        Solver("kucera", faces.kucera, FirstOrder, PRODUCT, 20_000,
               "conjugate gradients in the faces of the cones, gradient projection between them",
               "Kucera 2007, 2008"),
        Solver("gpminres", faces.gpminres, FirstOrder, PRODUCT, 20_000,
               "gradient projection alternating with MINRES in a face", "Heyn et al. 2013"),
        Solver("gauss_seidel", gauss_seidel.solve, gauss_seidel.GaussSeidel, MATRIX, 20_000,
               "projected block Gauss-Seidel over the colours of the contact graph",
               "Tasora, Anitescu 2011; Jones, Plassmann 1993"),
        Solver("jacobi", projected_steps.jacobi, FirstOrder, PRODUCT, 50_000,
               "projected block Jacobi, relaxed by an exact line search", "Tasora, Anitescu 2011"),
    )
}  # fmt: skip


def why_refused(type: str, cones: type[Cones]) -> str:
    """In words, why a method cannot take problems with these cones, and which methods can; "" if it can."""
    if cones in SOLVERS[type].cones:
        return ""
    return f"{cones.what}; allowed are {', '.join(name for name, method in SOLVERS.items() if cones in method.cones)}"


def why_no_form(type: str, form: str) -> str:
    """In words, why a method cannot have its Newton systems in a form, and which are allowed; "" if it can."""
    if form != "kkt" or SOLVERS[type].has_multipliers:
        return ""
    allowed = ", ".join(name for name, method in SOLVERS.items() if method.has_multipliers)
    return f"{type} has no constraints with multipliers; allowed with it are contact and body, and kkt with {allowed}"


def why_idle(type: str, form: str, law: str) -> str:
    """As of `why_no_form`, of a form that is asked for: also if nothing would be solved in it."""
    method = SOLVERS[type]
    if form != "auto" and not method.newton:
        allowed = ", ".join(name for name, other in SOLVERS.items() if other.newton)
        return f"{type} solves no Newton systems; allowed are {allowed}"
    if form == "contact" and law == COULOMB and method.has_law:
        return f"{type} solves Coulomb's law in the form body alone; allowed are body, and the law relaxation"
    return why_no_form(type, form)
