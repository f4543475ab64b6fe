"""The two forms of the Newton systems, `ContactForm` and `BodyForm`: the system in certain unknowns x, for one set of
barrier blocks after another. Both have

    problem : the cone problem
    matrix : the system's matrix, a function; it is positive definite where it is symmetric
    symmetric : whether the present matrix is
    error_in_momenta : whether the residual of a solve is one of momenta, dv = G' dg - r_v, which the next step of a
        method with momenta of its own mends; or it is one of velocities, (B + C) dg + G dv = q, where it opens what
        should touch
    speed : what a residual of 1 changes the velocities of contacts by, about

and the functions of `ContactForm`. `GivenForm` is that of contacts without bodies, and `pctt.ccp.newton.kkt.KKTForm`
has the multipliers as unknowns too.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Union

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc

from dem.contact_map.loops import local_product, pack
from pctt.arrays import Array
from pctt.blocks import put_diagonal_blocks, set_diagonal_blocks, symmetric_shell
from pctt.body_matrix import BodyOperator, inverse_blocks
from pctt.ccp.delassus import GivenMatrix
from pctt.ccp.newton.defaults import DIRECT, MULTIFRONTAL, Options
from pctt.ccp.newton.elimination import Order
from pctt.ccp.newton.kkt import KKT
from pctt.ccp.newton.multifrontal import Dissection, MultifrontalFactors

if TYPE_CHECKING:
    from pctt.ccp.problem import ConeProblem


class Form:
    """A form makes the systems of a method with constraints and multipliers too (`pctt.ccp.newton.kkt.KKT`): it
    eliminates the multipliers, unless it says otherwise."""

    update: Callable[..., None]
    right_hand_side: Callable[..., Array]
    impulses: Callable[..., Array]
    velocity: Array  #: G dv (rows, 3) of the last `impulses`, where these have come from momenta

    def fits(self, kkt: KKT) -> bool:
        """Whether the matrix can take the values of these constraints."""
        return True

    def linearise(self, kkt: KKT) -> None:
        """Make the matrix of a method with constraints."""
        self.kkt = kkt
        self.update(kkt.schur())

    def right_side(self, r_g: Array, r_lam: Array) -> Array:
        """Of the system for x, for the right-hand side r_g (nc, 3), r_lam (nc, k) of `KKT`."""
        self._q = self.kkt.reduced(r_g, r_lam)
        return self.right_hand_side(self._q, None, None)

    def changes(self, x: Array, r_lam: Array) -> tuple[Array, Array]:
        """dg and dlam of a solution for the last `right_side`."""
        dg = self.impulses(x, self._q, None)
        return dg, self.kkt.multipliers(dg, r_lam)


class ContactForm(Form):
    """The Newton system of the contacts, S = N + C + B (3Nc x 3Nc, block size 3): the paper's Schur complement.

        S dg = q + G r_v,    dv = G' dg - r_v.

    S is a function, S g = N g + (C + B) g, and its entries are made only for a preconditioner that reads them: N's
    structure and values are copied once per cone problem, and a Newton step writes the diagonal blocks alone. Bodies
    with very many contacts (a press, a drum) would fill N: preconditioners get it without the columns of these bodies,
    with the full diagonal blocks.
    """

    error_in_momenta = False
    speed = 1.0

    def __init__(self, problem: ConeProblem):
        self.problem, self.symmetric = problem, True
        self._entries: PETSc.Mat | None = None
        self._current = True

    @property
    def matrix(self) -> PETSc.Mat:
        """With the present values; no object of PETSc is made before it is asked for."""
        if not self._current:
            self._current = True
            self._take_values()
        return self._mat

    @cached_property
    def _mat(self) -> PETSc.Mat:
        return symmetric_shell(self.problem.comm, self.problem.r.size, 3, self._product)

    def load(self, problem: ConeProblem) -> None:
        """Take another problem with the same contacts between the same bodies."""
        self.problem, self._loaded = problem, False

    def update(self, barrier: Array | None, inverse: Array | None = None, symmetric: bool = True) -> None:
        """Make the matrix for the barrier blocks B (nc, 3, 3), or from ``inverse`` = (B + C)^-1 if the caller has it
        more accurately. ``symmetric`` says whether the blocks are."""
        assert barrier is not None
        self.blocks, self._made, self.symmetric = self.problem.diagonal_blocks + barrier, False, symmetric
        self._barrier, self._current = barrier, False

    def _take_values(self) -> None:
        self._local = self._barrier + self.problem.compliance_blocks
        if self.symmetric:
            self._local, blocks = np.empty((len(self._local), 6)), self._local
            pack(blocks, self._local)
        set_diagonal_blocks(self._mat, self.blocks, self.symmetric)

    def _product(self, g: Array, out: Array) -> None:
        g, out = g.reshape(-1, 3), out.reshape(-1, 3)
        if self.symmetric:
            local_product(self._local, g, out)
        else:
            out[:] = self.problem.cones.times(self._local, g)
        PETSc.Log.logFlops(5 * g.size)
        self.problem.operator.add_delassus(g, out)

    def entries(self) -> PETSc.Mat:
        """S without dense columns of G (BAIJ), with the places and names of the contacts that preconditioners may have
        as attributes; collective."""
        if self._entries is None or not self._loaded:
            self._entries = self._with_N(self._entries)
        self._loaded = True
        if not self._made:
            put_diagonal_blocks(self._entries, self.blocks)
            for name, value in (("coordinates", self.problem.point), ("key", self.problem.key)):
                if value is not None:
                    self._entries.setAttr(name, value)
            self._made = True
        return self._entries

    def _with_N(self, old: PETSc.Mat | None) -> PETSc.Mat:  # noqa: N802 - as in formulas
        """A Mat with the entries of N: a new one, or the old one."""
        if old is None:
            old = self.problem.N.duplicate(copy=True)
            old.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        else:
            self.problem.N.copy(old, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        return old

    def right_hand_side(self, q: Array | None, r_v: Array | None, uncoupled: Array | None) -> Array:
        """Of the system for x. ``uncoupled`` is (B + C)^-1 q, if the caller has it more accurately."""
        assert q is not None
        return q.ravel() if r_v is None else (q + self.problem.velocity_of(r_v)).ravel()

    def impulses(self, x: Array, q: Array | None, uncoupled: Array | None) -> Array:
        """dg (nc, 3) of a solution."""
        return x.reshape(-1, 3).copy()

    def momenta(self, x: Array, dg: Array, r_v: Array) -> Array:
        """dv (6m,) of a solution with the impulses dg."""
        return self.problem.momentum(dg) - r_v

    @property
    def factored_by(self) -> Options:
        """Options of the solver that makes factors."""
        return DIRECT[self.symmetric]

    def destroy(self) -> None:
        if "_mat" in self.__dict__:
            self._mat.destroy()
        if self._entries is not None:
            self._entries.destroy()


class GivenForm(ContactForm):
    """The form of few contacts, of a problem that is given by N: its momenta are impulses, and r_v is rounding. It has
    an ``order`` of elimination."""

    def __init__(self, problem: ConeProblem, order: Order):
        super().__init__(problem)
        assert isinstance(problem.operator, GivenMatrix)
        self.order = order

    @property
    def N(self) -> sp.bsr_matrix:  # noqa: N802 - as in formulas
        return self.problem.operator.local  # type: ignore[union-attr]

    def right_hand_side(self, q: Array | None, r_v: Array | None, uncoupled: Array | None) -> Array:
        assert q is not None
        return q.ravel()


class BodyForm(Form):
    """The Newton system of the bodies, K = I + G' (B + C)^-1 G (6M x 6M, block size 6), in mass-scaled velocities: the
    Schur complement of the bodies.

        K dv = G' (B + C)^-1 q - r_v,    dg = (B + C)^-1 (q - G dv).

    The residual of an inexact solve of K stays in the momenta: nothing multiplies it. K is smaller than the contact
    system and far better conditioned once contacts open or slide.

    For Coulomb's law (B + C)^-1 is not symmetric, and K is not either. With moments its blocks are (nc, 6, 6).
    """

    error_in_momenta = True

    def __init__(self, problem: ConeProblem):
        assert problem.contact_map is not None
        self.problem = problem
        self.operator = BodyOperator(problem.contact_map)
        self.matrix = self.operator.mat
        self._places: Array | None = None
        self._placed = False
        self._dissection: Dissection | None = None
        self.symmetric = True

    def load(self, problem: ConeProblem) -> None:
        assert problem.contact_map is not None
        self.problem = problem
        self.operator.load(problem.contact_map)
        self._places, self._placed, self._dissection = None, False, None

    def update(self, barrier: Array | None, inverse: Array | None = None, symmetric: bool = True) -> None:
        if inverse is None:
            assert barrier is not None
            inverse = inverse_blocks(barrier + self.problem.compliance_blocks)
        self._inverse, self.symmetric = inverse, symmetric
        self.operator.update(inverse, symmetric)

    def entries(self) -> PETSc.Mat:
        """K as a matrix that preconditioners can read, with the places of the bodies; collective."""
        entries = self.operator.entries()
        mat = entries.mat
        if not self._placed and self.places() is not None:
            mat.setAttr("coordinates", self.places())
            self._placed = True
        return mat

    def places(self) -> Array | None:
        """Places (n, 3) of this rank's bodies, if the problem has those of its contacts; collective."""
        if self._places is None and self.problem.point is not None:
            self._places = self.operator.entries().places(self.problem.point)
        return self._places

    @property
    def factored_by(self) -> Options:
        return MULTIFRONTAL[self.symmetric]

    def fronts(self, least: float, precision: type[np.floating]) -> MultifrontalFactors:
        """The factors of K without blocks below ``least`` (`BodyMatrix.stiff_part`); all of a problem in the order of
        the first. Collective."""
        part = self.operator.entries().stiff_part(least)
        fronts = MultifrontalFactors(
            self.problem.comm, part, self.places(), precision, self._dissection, self.symmetric
        )
        self._dissection = fronts.dissection
        return fronts

    @property
    def speed(self) -> float:
        return float(self.problem.mean_diagonal**0.5)

    def right_hand_side(self, q: Array | None, r_v: Array | None, uncoupled: Array | None) -> Array:
        if uncoupled is None:
            assert q is not None
            uncoupled = self.problem.cones.times(self._inverse, q)
        push = self.problem.momentum(uncoupled)
        return push if r_v is None else push - r_v

    def impulses(self, x: Array, q: Array | None, uncoupled: Array | None) -> Array:
        times, self.velocity = self.problem.cones.times, self.problem.velocity_of(x)
        if uncoupled is None:
            assert q is not None
            return times(self._inverse, q - self.velocity)
        return uncoupled - times(self._inverse, self.velocity)

    def momenta(self, x: Array, dg: Array, r_v: Array) -> Array:
        return x

    def destroy(self) -> None:
        self.operator.destroy()


System = Union[ContactForm, BodyForm]
