"""Newton systems of the interior point methods, in one of three forms, and their solvers.

An interior point step has barrier blocks B (nc, 3, 3), one per contact, and asks for impulses dg and mass-scaled
momenta dv with

    (N + C + B) dg = q + G r_v,    dv = G' dg - r_v,

N = G G' the Delassus matrix and C the compliance. ``-ccp_newton`` chooses the unknowns: ``contact`` or ``body``
(`forms.py`). A method with constraints f <= 0 and multipliers asks for the changes of these too (`Newton.linearise`,
`step`), and can have them as unknowns, in the form ``kkt`` (`kkt.py`). A `Newton` object lives as long as the
simulation: Krylov methods and preconditioners stay from one cone problem to the next, and matrices too where the
contacts are the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.ccp.cones import TINY, Array
from pctt.ccp.delassus import GivenMatrix, all_blocks
from pctt.ccp.newton.compare import Comparison
from pctt.ccp.newton.few import Order, ordered
from pctt.ccp.newton.forms import BodyForm, ContactForm, FewForm, NewtonForm
from pctt.ccp.newton.kkt import KKT, KKTForm
from pctt.ccp.newton.linear import LinearSolver, Settings
from pctt.ccp.problem import ConeProblem
from pctt.ksp_options import OWN
from pctt.log import phase
from pctt.petsc import options_database

FORMS: dict[str, Callable[[ConeProblem], NewtonForm]] = {"contact": ContactForm, "body": BodyForm, "kkt": KKTForm}
_ASKED = {OWN + "pc_type", OWN + "ksp_type"}  # options that say how a system is to be solved
DEFAULTS = {
    "contact": {"ksp_type": "bcgs", "pc_type": "pbjacobi"},
    "kkt": {"ksp_type": "bcgs", "pc_type": "pbjacobi"},
    "body": {"ksp_type": "cg", "ksp_norm_type": "unpreconditioned", "pc_type": "pbjacobi"},
}
# of a problem that is given by N: a solve as accurate as that of the bodies would be
GIVEN = {"ksp_type": "gmres", "pc_type": "cholesky"}


class Newton:
    """The Newton systems of one cone problem after another.

    form : of FORMS. The body form has its own solver unless the options name a KSP or PC; a problem of few contacts, or
        one that knows no bodies (given by N), is solved in the form `contact` instead, by factors.

    Attributes
    ----------
    system : the present problem's, not there before the first
    linear : what solves it
    ksp_systems : the number of systems that a KSP was to solve so far
    """

    system: NewtonForm

    def __init__(self, comm: MPI.Comm, form: str = "contact", compare: Comparison | None = None):
        self.comm, self.form, self.compare = comm, form, compare
        self.ksp_systems = 0
        self._structure: tuple | None = None  # of the system's problem
        self._instead = False  # of the bodies' form, which the present problem has not
        self._has_entries = True  # the present problem's N
        self._linear: LinearSolver | None = None
        self._looked: tuple[Any, tuple[GivenMatrix, Order] | None] = (None, None)

    def begin(self, problem: ConeProblem) -> ConeProblem:
        """Take the next problem; its structure is kept where contacts and bodies are those of the last.

        Returns the problem as its systems know it: given by N where its contacts are few, by the rows of its map where
        joints or a cell couple bodies."""
        problem = problem.by_rows()
        few = self._prepare(problem)
        instead = self._instead
        self.problem = problem if few is None else problem.by_matrix(few[0])
        structure, last = problem.structure(), self._structure or ()
        same = len(structure) == len(last) and all(map(np.array_equal, structure, last))
        self.linear.begin()
        # then the linear solver takes it whatever is wanted
        self._rtol_is_given = OWN + "ksp_rtol" in options_database()
        if problem.comm.allreduce(same, op=MPI.LAND):
            self.system.load(self.problem)
        else:
            self.forget()
            if few is not None:
                self.system = FewForm(self.problem, few[1])
            else:
                self.system = FORMS["contact" if instead else self.form](problem)
        self._structure = structure
        return self.problem

    def check(self, problem: ConeProblem) -> None:
        """ValueError if the problem is given by products, and the preconditioner reads entries."""
        if problem.has_entries:
            return
        self._prepare(problem)
        if readers := self.linear.readers:
            raise ValueError(
                f"the preconditioner {readers[0]} reads entries, but N is given by its products; allowed are none, "
                "jacobi and pbjacobi"
            )

    def _prepare(self, problem: ConeProblem) -> tuple[GivenMatrix, Order] | None:
        """Choose how the problem's systems are solved; N and an order of elimination where contacts are few."""
        few = self._few(problem)
        instead = self.form == "body" and (few is not None or problem.contact_map is None)
        if (instead, problem.has_entries) != (self._instead, self._has_entries):
            self.destroy()
            self._instead, self._has_entries = instead, problem.has_entries
        return few

    def has_few(self, problem: ConeProblem) -> bool:
        """Whether the systems of this problem get the factors of `FewForm`."""
        return self._few(problem.by_rows()) is not None

    def _few(self, problem: ConeProblem) -> tuple[GivenMatrix, Order] | None:
        """N and an order of elimination, if the contacts are few; that of the last problem is kept."""
        if self._looked[0] is not problem.operator:
            few = self.takes_few and problem.comm.size == problem.cones.parts == 1 and problem.size <= Settings.few
            self._looked = (problem.operator, _eliminated(problem) if few else None)
        return self._looked[1]

    @property
    def takes_few(self) -> bool:
        """Whether systems of few contacts on one rank get factors of their own."""
        return self.form == "body" and self._own

    @property
    def takes_any(self) -> bool:
        """Whether the present systems may be unsymmetric."""
        return self.linear.own or isinstance(self.system, FewForm)

    @property
    def linear(self) -> LinearSolver:
        """What solves the systems of the present form."""
        if self._linear is None:
            own = self.form == "body" and not self._instead and self._own
            form = "contact" if self._instead else self.form
            defaults = GIVEN if self._instead and self._has_entries else DEFAULTS[form]
            free = self.compare is None and OWN + "pc_type" not in options_database()
            incomplete = self.form == "contact" and free and self._has_entries
            self._linear = LinearSolver(self.comm, defaults, self.compare, own, incomplete, self._has_entries)
        return self._linear

    @property
    def _own(self) -> bool:
        """Whether the linear solver is the project's own choice."""
        return self.compare is None and not _ASKED & options_database().keys()

    def update(self, barrier: Array | None, inverse: Array | None = None, symmetric: bool = True) -> None:
        """Set the barrier blocks B (nc, 3, 3). A caller that has (B + C)^-1 more accurately than by inversion passes it
        as ``inverse``; a system that `mends` needs no B then. Only a linear solver that `takes_any` accepts blocks that
        are not ``symmetric``."""
        with phase("CCPUpdate"):
            self.system.update(barrier, inverse, symmetric)
            if not isinstance(self.system, FewForm):
                self.linear.new_matrix(self.system)

    def linearise(self, kkt: KKT) -> None:
        """Set the Newton matrix of a method with constraints and multipliers. Forms other than `kkt` eliminate them."""
        self._kkt = kkt
        if isinstance(self.system, KKTForm):
            if self.system.constraints not in (0, kkt.f.shape[1]):  # those of another method
                structure = self._structure
                self.forget()
                self.system, self._structure = KKTForm(self.problem), structure
            with phase("CCPUpdate"):
                self.system.linearise(kkt)
                self.linear.new_matrix(self.system)
        else:
            self.update(kkt.schur())

    def step(
        self, r_g: Array, r_lam: Array, tol: float, earlier: Sequence[Array] = ()
    ) -> tuple[Array, Array, Array]:
        """dg (nc, 3), dlam (nc, k) and the system's solution x for the right-hand side r_g (nc, 3), r_lam (nc, k) of
        `KKT`, to a residual of ``tol`` as in `solve`."""
        if not isinstance(self.system, KKTForm):
            dg, x = self.solve(self._kkt.reduced(r_g, r_lam), tol, earlier=earlier)
            return dg, self._kkt.multipliers(dg, r_lam), x
        with phase("CCPKrylov"):
            x = self._solution(self.system.right_side(r_g, r_lam), tol, earlier)
            return (*self.system.changes(x), x)

    def solve(
        self,
        q: Array,
        tol: float,
        r_v: Array | None = None,
        earlier: Sequence[Array] = (),
        uncoupled: Array | None = None,
    ) -> tuple[Array, Array]:
        """dg (nc, 3) and the system's solution x, to a residual of ``tol`` [m/s, over all contacts]. ``earlier`` are
        earlier solutions x to begin from; a fixed ``-ksp_rtol`` refers to the residual that they leave. ``uncoupled``
        is (B + C)^-1 q, the change of each contact without the others, for callers that have it more accurately than by
        a product."""
        with phase("CCPKrylov"):
            b = self.system.right_hand_side(q, r_v, uncoupled)
            wanted = tol / self.system.speed
            if isinstance(self.system, FewForm):
                x, count = self.system.factors.solve(b.reshape(-1, 3), max(wanted, 1e-14 * math.sqrt(b @ b)))
                self.linear.iterations += count
                if count:
                    return x, x.ravel()
                self.system.update_matrix()
                self.linear.new_matrix(self.system)
            x = self._solution(b, wanted, earlier)
            return self.system.impulses(x, q, uncoupled), x

    def _solution(self, b: Array, wanted: float, earlier: Sequence[Array]) -> Array:
        """x of the present system for the right-hand side b, to this residual."""
        x, product = self._start(b, earlier)
        self._b.array[:] = b - product
        norm = self._b.norm()
        if self._rtol_is_given:
            wanted = min(wanted, 0.5 * norm)
        if wanted < norm < np.inf:  # the caller finds no step in a direction that is no number
            self.ksp_systems += 1
            self.linear.solve(self._b, self._x, max(wanted / norm, 1e-14))
            x += self._x.array
        return x

    def _start(self, b: Array, earlier: Sequence[Array]) -> tuple[Array, Array]:
        """Where to begin from, and its product: the earlier solution, or zero. Of several the combination x with the
        least energy 1/2 x'Ax - b'x, if A is symmetric: in the norm of A no other one is nearer to the solution; else
        that with the least residual."""
        xs = np.array(earlier).reshape(len(earlier), len(b))
        products = np.empty_like(xs)
        for x, product in zip(xs, products):
            self._x.array[:] = x
            self.system.matrix.mult(self._x, self._b)
            product[:] = self._b.array
        left = xs if self.system.symmetric else products
        share = self._least(left, products, b) if len(xs) > 1 else np.ones(len(xs))
        return share @ xs, share @ products

    def _least(self, left: Array, products: Array, b: Array) -> Array:
        """The coefficients of the combination of ``products`` (k, rows) whose difference from b is orthogonal to all of
        ``left``; zeros if the sums are no numbers, or the matrix is not positive."""
        sums = self.problem.sum(np.column_stack([left @ products.T, left @ b]))
        energies, works = sums[:, :-1], sums[:, -1]
        if not np.isfinite(sums).all() or (np.diagonal(energies) < 0.0).any():
            return np.zeros(len(products))
        size = np.sqrt(np.maximum(np.diagonal(energies), TINY))
        # scaled, as solutions shrink from one Newton step to the next; of nearly parallel ones only the sum counts
        return np.linalg.lstsq(energies / np.outer(size, size), works / size, rcond=1e-10)[0] / size

    @property
    def _x(self) -> PETSc.Vec:
        return self._vectors[0]

    @property
    def _b(self) -> PETSc.Vec:
        return self._vectors[1]

    @cached_property
    def _vectors(self) -> tuple[PETSc.Vec, PETSc.Vec]:
        return self.system.matrix.createVecs()

    def forget(self) -> None:
        """Drop what belongs to the last problem's structure."""
        if self._linear is not None:
            self._linear.forget()
        if self.compare is not None:
            self.compare.forget()
        if self._structure is not None:
            for thing in (self.system, *self.__dict__.pop("_vectors", ())):
                thing.destroy()
            self._structure = None

    def destroy(self) -> None:
        self.forget()
        if self._linear is not None:
            self._linear.destroy()
            self._linear = None
        if self.compare is not None:
            self.compare.destroy()


def _eliminated(problem: ConeProblem) -> tuple[GivenMatrix, Order] | None:
    """N and the order of `pctt.ccp.newton.few` of a problem on one rank, if it is cheap enough."""
    if not problem.has_entries:
        return None
    if isinstance(problem.operator, GivenMatrix):
        known = problem.operator
    else:
        assert problem.contact_map is not None
        G = problem.contact_map.block_rows
        if np.square(np.bincount(G.indices)).sum() > 2 * Settings.pairs + len(G.indices):
            return None
        known = GivenMatrix(problem.comm, all_blocks(G))
    order = ordered(known.local.indptr, known.local.indices, Settings.pairs, Settings.rest)
    return None if order is None else (known, order)
