"""Newton systems of the interior point methods, in one of three forms, and their solvers.

An interior point step has barrier blocks B (nc, 3, 3), one per contact, and asks for impulses dg and mass-scaled
momenta dv with

    (N + C + B) dg = q + G r_v,    dv = G' dg - r_v,

N = G G' + C the Delassus matrix with its compliance. ``-ccp_newton`` chooses the unknowns: ``contact`` (`contact.py`),
``kkt`` (`kkt.py`), ``body`` (`body.py`). A `Newton` object lives as long as the simulation: Krylov methods and
preconditioners stay from one cone problem to the next, and matrices too where the contacts are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.ccp.cone import TINY, Array
from pctt.ccp.newton.body import BodyForm
from pctt.ccp.newton.compare import Comparison
from pctt.ccp.newton.contact import ContactForm
from pctt.ccp.newton.form import NewtonForm
from pctt.ccp.newton.kkt import KKTForm
from pctt.ccp.newton.linear import LinearSolver
from pctt.ccp.problem import ConeProblem
from pctt.log import phase

FORMS: dict[str, Callable[[ConeProblem], NewtonForm]] = {"contact": ContactForm, "kkt": KKTForm, "body": BodyForm}
_ASKED = {"pc_type", "ksp_type"}  # options that say how a system is to be solved
SHARP_LIMIT = 50_000  # contacts: above, factors of the kkt system take too much memory
DEFAULTS = {
    "contact": {"ksp_type": "bcgs", "pc_type": "pbjacobi"},
    "kkt": {"ksp_type": "preonly", "pc_type": "cholesky"},
    "body": {"ksp_type": "cg", "ksp_norm_type": "unpreconditioned", "pc_type": "pbjacobi"},
}


class Newton:
    """The Newton systems of one cone problem after another.

    form : of FORMS. The body form changes from block Jacobi to factors by itself unless the options name a KSP or PC;
        a problem that knows no bodies (given by N) is solved in the form `kkt` instead.

    Attributes
    ----------
    ksp_its, fallbacks : of the present problem: Krylov iterations, systems not solved by the user's KSP
    memory : what a method keeps here for the next problem (`auto`); None at first
    """

    def __init__(self, comm: MPI.Comm, form: str = "contact", compare: Comparison | None = None):
        self.comm, self.form, self.compare = comm, form, compare
        self.memory: object = None
        self.system: NewtonForm | None = None
        self._present = form
        self._structure: tuple | None = None
        self._linear: dict[str, LinearSolver] = {}

    def begin(self, problem: ConeProblem) -> None:
        """Take the next problem; its structure is kept where contacts and bodies are those of the last."""
        self.problem = problem
        present = "kkt" if self.form == "body" and problem.contact_map is None else self.form
        for linear in self._linear.values():
            linear.begin()
        structure = problem.structure()
        same = self.system is not None and present == self._present and self._structure is not None
        same = same and all(map(np.array_equal, structure, self._structure or ()))
        if problem.comm.allreduce(same, op=MPI.LAND):
            assert self.system is not None
            self.system.load(problem)
        else:
            self._take(present)
        self._structure = structure

    def sharpen(self) -> bool:
        """Continue this problem in the form that rounding hurts least, `kkt`. False if it has that form already, or is
        too large for it. Body systems of rigid contacts lose a natural residual of 1e-8: (B + C)^-1 grows like its
        inverse."""
        if self._present == "kkt" or self.problem.size > SHARP_LIMIT or self.problem.has_hubs:
            return False
        self._take("kkt")
        self._structure = None
        return True

    def _take(self, form: str) -> None:
        self.forget()
        self._present = form
        self.system = FORMS[form](self.problem)
        self._x, self._b = self.system.matrix.createVecs()

    @property
    def linear(self) -> LinearSolver:
        """What solves the systems of the present form."""
        form = self._present
        if form not in self._linear:
            own = form == "body" and self.compare is None and not _ASKED & PETSc.Options().getAll().keys()
            compare, prefix = (self.compare, "") if form == self.form else (None, f"{form}_")
            self._linear[form] = LinearSolver(self.comm, DEFAULTS[form], compare, prefix, own)
        return self._linear[form]

    @property
    def primary(self) -> str:
        """What solutions are exact in but for the system's residual: momenta or impulses."""
        return "momenta" if self._present == "body" else "impulses"

    @property
    def factored(self) -> bool:
        """Whether the present matrix has been factorised, and another solve costs little."""
        return self.linear.factored

    @property
    def ksp_its(self) -> int:
        return sum(linear.iterations for linear in self._linear.values())

    @property
    def fallbacks(self) -> int:
        return sum(linear.fallbacks for linear in self._linear.values())

    @property
    def pc_report(self) -> list[str]:
        """Lines about the preconditioner and its fallbacks so far, if it is one of this package."""
        return [line for linear in self._linear.values() for line in linear.report()]

    def words(self) -> str:
        """Krylov method and preconditioner of the present form."""
        return self.linear.words()

    def what(self) -> str:
        """What preconditioners of this package really were so far; empty if there are none."""
        return "; ".join(filter(None, (linear.what() for linear in self._linear.values())))

    @property
    def takes_any(self) -> bool:
        """Whether the present systems may be unsymmetric."""
        return self._present == "body" and self.linear.takes_any

    def update(self, barrier: Array, inverse: Array | None = None, symmetric: bool = True) -> None:
        """Set the barrier blocks B (nc, 3, 3). A caller that has (B + C)^-1 more accurately than by inversion passes it
        as ``inverse``. Only systems with `takes_any` accept blocks that are not ``symmetric``."""
        with phase("CCPUpdate"):
            assert self.system is not None
            self.system.update(barrier, inverse, symmetric)
            self.linear.new_matrix(self.system)

    def solve(
        self,
        q: Array,
        tol: float,
        r_v: Array | None = None,
        earlier: Sequence[Array] = (),
        uncoupled: Array | None = None,
    ) -> tuple[Array, Array]:
        """dg (nc, 3) and the system's solution x, to a residual of ``tol`` (sqrt J: of momenta; of velocities times the
        root of the mean diagonal of N). ``earlier`` are earlier solutions x to begin from; a fixed ``-ksp_rtol`` refers
        to the residual that they leave. ``uncoupled`` is (B + C)^-1 q, the change of each contact without the others,
        for callers that have it more accurately than by a product."""
        with phase("CCPKrylov"):
            assert self.system is not None
            b = self.system.right_hand_side(q, r_v, uncoupled)
            x, product = self._start(b, earlier)
            self._b.array[:] = b - product
            norm = self._b.norm()
            wanted = tol if self.primary == "momenta" else tol * float(np.sqrt(self.problem.mean_diagonal))
            if PETSc.Options().hasName("ksp_rtol"):  # the user's, which the linear solver takes whatever is wanted
                wanted = min(wanted, 0.5 * norm)
            if wanted < norm < np.inf:  # the caller finds no step in a direction that is no number
                self.linear.solve(self._b, self._x, max(wanted / norm, 1e-14))
                x += self._x.array
            return self.system.impulses(x, q, uncoupled), x

    def _start(self, b: Array, earlier: Sequence[Array]) -> tuple[Array, Array]:
        """Where to begin from, and its product: the last of the earlier solutions, or zero. Of several, where A is
        positive definite, the combination x with the least energy 1/2 x'Ax - b'x: in the norm of A no other one is
        nearer to the solution."""
        assert self.system is not None
        several = len(earlier) > 1 and self.system.symmetric and self.system.definite
        xs = np.array(earlier).reshape(len(earlier), len(b))
        if not several:
            xs = xs[-1:]
        products = np.empty_like(xs)
        for x, product in zip(xs, products):
            self._x.array[:] = x
            self.system.matrix.mult(self._x, self._b)
            product[:] = self._b.array
        share = self._least_energy(xs, products, b) if several else np.ones(len(xs))
        return share @ xs, share @ products

    def _least_energy(self, xs: Array, products: Array, b: Array) -> Array:
        """The coefficients of the combination of vectors xs (k, rows) with the least energy; zeros if the energies are
        no numbers."""
        sums = self.problem.sum(np.column_stack([xs @ products.T, xs @ b]))
        if not np.isfinite(sums).all():
            return np.zeros(len(xs))
        energies, works = sums[:, :-1], sums[:, -1]
        size = np.sqrt(np.maximum(np.diagonal(energies), TINY))
        # scaled, as solutions shrink from one Newton step to the next; of nearly parallel ones only the sum counts
        return np.linalg.lstsq(energies / np.outer(size, size), works / size, rcond=1e-10)[0] / size

    def momentum(self, x: Array, dg: Array, r_v: Array) -> Array:
        """dv of a solution x."""
        return x if self.primary == "momenta" else self.problem.momentum(dg) - r_v

    def forget(self) -> None:
        """Drop what belongs to the last problem's structure."""
        for linear in self._linear.values():
            linear.forget()
        if self.compare is not None:
            self.compare.forget()
        if self.system is not None:
            for thing in (self.system, self._x, self._b):
                thing.destroy()
            self.system = None

    def destroy(self) -> None:
        self.forget()
        for linear in self._linear.values():
            linear.destroy()
        self._linear.clear()
        if self.compare is not None:
            self.compare.destroy()
