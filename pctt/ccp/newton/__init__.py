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

from collections.abc import Callable, Sequence
from typing import Any, Union

import numpy as np
from mpi4py import MPI

from dem.exchange import on_any
from pctt.arrays import Array
from pctt.ccp.delassus import GivenMatrix
from pctt.ccp.newton.by_elimination import GIVEN_MORE, ByElimination, has_few, is_cheap, matrix_of, order_of
from pctt.ccp.newton.by_factors import ByFactors
from pctt.ccp.newton.by_ksp import ByKSP
from pctt.ccp.newton.compare import Comparison
from pctt.ccp.newton.defaults import DEFAULTS, GIVEN
from pctt.ccp.newton.elimination import Order
from pctt.ccp.newton.factor import Room
from pctt.ccp.newton.forms import BodyForm, ContactForm, GivenForm, System
from pctt.ccp.newton.kkt import KKT
from pctt.ccp.newton.kkt_form import KKTForm
from pctt.ccp.problem import ConeProblem
from pctt.ksp_options import OWN
from pctt.log import phase
from pctt.petsc import options_database

FORMS: dict[str, Callable[[ConeProblem], System]] = {"contact": ContactForm, "body": BodyForm, "kkt": KKTForm}
Linear = Union[ByKSP, ByFactors, ByElimination]
_ASKED = {OWN + "pc_type", OWN + "ksp_type"}  # options that say how a system is to be solved
_OF_KSP = (OWN + "ksp_", OWN + "pc_")


class Newton:
    """A `Newton` object makes and solves the Newton systems of one cone problem after another.

    Parameters
    ----------
    form : of FORMS. The body form has its own solver unless the options name a KSP or PC; a problem of few contacts, or
        one that knows no bodies (given by N), is solved in the form `contact` instead, by factors.

    Attributes
    ----------
    system : the present problem's, not there before the first
    linear : what solves it: `ByKSP`, `ByFactors` or `ByElimination`
    """

    system: System

    def __init__(self, comm: MPI.Comm, form: str = "contact", compare: Comparison | None = None):
        self.comm, self.form, self.compare, self._room = comm, form, compare, Room(comm)
        self._structure: tuple | None = None  # of the system's problem
        self._kind: tuple[str, bool] | None = None  # of the linear solver: of which form, and whether N has entries
        self._linear: Linear | None = None
        self._systems = 0
        self._seen: tuple[Any, tuple, Order | None] = (None, (), None)  # an operator, its structure and order
        self._made: tuple[Any, GivenMatrix | None] = (None, None)  # an operator, and its matrix
        self._of_parts: Newton | None = None

    @property
    def of_parts(self) -> Newton:
        """Another one of the same choice, for a part of a problem that is solved beside the whole: each keeps its
        structure from step to step. This one itself if preconditioners are compared, or the options say something
        of KSPs: two would write into one file."""
        if self.compare is not None or any(name.startswith(_OF_KSP) for name in options_database()):
            return self
        self._of_parts = self._of_parts or Newton(self.comm, self.form)
        return self._of_parts

    # -- the choice -------------------------------------------------------------------------------------------

    def _choose(self, problem: ConeProblem | None) -> None:
        """Take one of the three solvers for a problem, or for those that are to come; the last one if it will do."""
        few = problem is not None and self._look(problem)[1] is not None
        given = self.form == "body" and problem is not None and problem.contact_map is None
        entries = problem is None or problem.has_entries
        kind = "few" if few else "given" if given else self.form
        if self._linear is not None and self._kind == (kind, entries):
            return
        self._drop_solver()
        self._kind = kind, entries
        if few:
            self._linear = ByElimination(self.comm, self._room)
        elif self.own and not given:
            self._linear = ByFactors(self.comm, self._room)
        else:
            defaults = GIVEN if given and entries else DEFAULTS["contact" if given else self.form]
            free = self.compare is None and OWN + "pc_type" not in options_database()
            incomplete = self.form == "contact" and free and entries
            lu = self.own and entries  # of a given N
            self._linear = ByKSP(self.comm, self._room, defaults, self.compare, incomplete, entries, lu)

    @property
    def own(self) -> bool:
        """Whether the linear solver is the project's own choice."""
        return self.form == "body" and self.compare is None and not _ASKED & options_database().keys()

    @property
    def linear(self) -> Linear:
        if self._linear is None:
            self._choose(None)
        assert self._linear is not None
        return self._linear

    def may_eliminate(self, problem: ConeProblem) -> bool:
        """Whether an order of elimination is looked for at all."""
        return has_few(problem) and self.own

    def has_elimination(self, problem: ConeProblem) -> bool:
        """Whether the systems of this problem are solved by elimination, and that is cheap."""
        return is_cheap(self._look(problem.by_rows())[1])

    def _look(self, problem: ConeProblem) -> tuple[tuple, Order | None]:
        """The structure of a problem, and an order of elimination if its contacts are few. Both are those of the last
        problem if the structures are equal."""
        looked, structure, order = self._seen
        if looked is not problem.operator:
            found = problem.structure()
            if not (len(found) == len(structure) and all(map(np.array_equal, found, structure))):
                structure, order = found, None
                if self.own and has_few(problem):
                    order = order_of(self._matrix(problem), GIVEN_MORE if problem.contact_map is None else 1)
            self._seen = problem.operator, structure, order
        return structure, order

    def _matrix(self, problem: ConeProblem) -> GivenMatrix | None:
        """The N of few contacts; that of the last problem is kept."""
        if self._made[0] is not problem.operator:
            self._made = problem.operator, matrix_of(problem)
        return self._made[1]

    def check(self, problem: ConeProblem) -> None:
        """ValueError if the problem is given by products, and the preconditioner reads entries."""
        if problem.has_entries:
            return
        self._choose(problem)
        if readers := self.linear.readers:
            raise ValueError(
                f"the preconditioner {readers[0]} reads entries, but N is given by its products; allowed are none, "
                "jacobi and pbjacobi"
            )

    # -- systems ----------------------------------------------------------------------------------------------

    def begin(self, problem: ConeProblem) -> ConeProblem:
        """Take the next problem; its structure is kept where contacts and bodies are those of the last.

        Returns the problem as its systems know it: given by N where its contacts are few, by the rows of its map where
        joints or a cell couple bodies."""
        problem = problem.by_rows()
        self._choose(problem)
        structure, order = self._look(problem)
        N = None if order is None else self._matrix(problem)
        self.problem = problem if N is None else problem.by_matrix(N)
        self.linear.begin()
        if not on_any(problem.comm, structure is not self._structure)[0]:
            self.system.load(self.problem)
        else:
            given = self.form == "body" and problem.contact_map is None
            form = FORMS["contact" if given else self.form]
            self._take(form(problem) if order is None else GivenForm(self.problem, order), structure)
        return self.problem

    def _take(self, system: System, structure: tuple | None) -> None:
        self.forget()
        self.system, self._structure = system, structure

    def update(self, barrier: Array | None, inverse: Array | None = None, symmetric: bool = True) -> None:
        """Set the barrier blocks B (nc, 3, 3). A caller that has (B + C)^-1 more accurately than by inversion passes it
        as ``inverse``; a system with `error_in_momenta` needs no B then. Only a linear solver that `takes_unsymmetric`
        accepts blocks that are not ``symmetric``."""
        with phase("CCPUpdate"):
            self.system.update(barrier, inverse, symmetric)
            self.linear.factor(self.system)

    def linearise(self, kkt: KKT) -> None:
        """Set the Newton matrix of a method with constraints and multipliers. Forms other than `kkt` eliminate them."""
        with phase("CCPUpdate"):
            if not self.system.fits(kkt):  # those of another method
                self._take(FORMS[self.form](self.problem), self._structure)
            self.system.linearise(kkt)
            self.linear.factor(self.system)

    def step(
        self, r_g: Array, r_lam: Array, tol: float, earlier: Sequence[Array] = ()
    ) -> tuple[Array, Array, Array]:
        """dg (nc, 3), dlam (nc, k) and the system's solution x for the right-hand side r_g (nc, 3), r_lam (nc, k) of
        `KKT`, to a residual of ``tol`` as in `solve`."""
        with phase("CCPKrylov"):
            x = self.linear.solve(self.system.right_side(r_g, r_lam), tol / self.system.speed, earlier)
            return (*self.system.changes(x, r_lam), x)

    def solve(
        self,
        q: Array | None,
        tol: float,
        r_v: Array | None = None,
        earlier: Sequence[Array] = (),
        uncoupled: Array | None = None,
    ) -> tuple[Array, Array]:
        """dg (nc, 3) and the system's solution x, to a residual of ``tol`` [m/s, over all contacts]. ``earlier`` are
        earlier solutions x to begin from; a fixed ``-ksp_rtol`` refers to the residual that they leave. ``uncoupled``
        is (B + C)^-1 q, the change of each contact without the others, for callers that have it more accurately than by
        a product; a system with `error_in_momenta` needs no q then."""
        with phase("CCPKrylov"):
            b = self.system.right_hand_side(q, r_v, uncoupled)
            x = self.linear.solve(b, tol / self.system.speed, earlier)
            return self.system.impulses(x, q, uncoupled), x

    @property
    def ksp_systems(self) -> int:
        """The number of systems that a KSP was to solve so far."""
        parts = self._of_parts.ksp_systems if self._of_parts is not None else 0
        return self._systems + (self._linear.systems if self._linear is not None else 0) + parts

    def forget(self) -> None:
        """Drop what belongs to the last problem's structure."""
        if self._linear is not None:
            self._linear.forget()
        if self.compare is not None:
            self.compare.forget()
        if self._structure is not None:
            self.system.destroy()
            self._structure = None

    def destroy(self) -> None:
        self._drop_solver()
        if self._of_parts is not None:
            self._of_parts.destroy()

    def _drop_solver(self) -> None:
        self.forget()
        if self._linear is not None:
            self._systems += self._linear.systems
            self._linear.destroy()
            self._linear = None
        if self.compare is not None:
            self.compare.destroy()
