"""The cone complementarity problem (CCP): min 1/2 g'Ng + r'g over the friction cones."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from dem.compiled import loop
from dem.contact_map import BlockRows, ContactMap
from dem.exchange import reduced, refuse
from pctt.arrays import TINY, Array, all_from
from pctt.ccp import door
from pctt.ccp.cones import Cones, FrictionCones
from pctt.ccp.cones.base import Units
from pctt.ccp.delassus import BlockMap, GivenMatrix, GivenOperator, delassus, ritz_values, without_dense_columns
from pctt.options import known_arguments, short


class Errors(NamedTuple):
    """Of impulses g and velocities y = N g + r.

    Attributes
    ----------
    natural : ||g - P(g - y / mean diag N)|| / ||g||. inf if that is undefined: for g = 0, unless it solves the problem,
        and if g or y has a nan or inf
    work : the larger of the closing and the opening work, over 1/2 g'Ng: the sums of g_n max(-y_n, 0) and of max(g.y,
        0) over the contacts. 0 without impulses, inf if it is no number
    speed : the greatest -y_n: how fast a contact still closes beyond what its spring gives (m/s)
    """

    natural: float
    work: float
    speed: float


class ConeProblem:
    """A cone problem is that of one step, with its contacts distributed over the ranks of ``comm``.

    N = G M^-1 G' + C is given by the map G from velocities of unknowns to those of contacts, with the masses M of the
    unknowns, or directly (``N``). The compliance C is diagonal: contacts that yield a little, see
    `dem.start.stiffness`. Arrays and scipy matrices are the rows of this rank's contacts, with the columns of all.

    ValueError on all ranks for data of other shapes, or that are no numbers, for negative coefficients, and for
    matrices that are not symmetric.

    Parameters
    ----------
    r : (nc, 3) velocities of the contacts without impulses, plus gap/dt (m/s); (nc, 2) for contacts of the plane, whose
        N and G have two rows for each, of the normal and of the tangent
    mu : (nc,) friction coefficients, or (nc, 2), of each tangent, in elliptic cones |g_1 / mu_1, g_2 / mu_2| <= g_n
    cones : in its place, cones of `pctt.ccp`: `RollingCones` have moments too, r, G and impulses twice as many rows of
        3 (`dem.contact_map.TurningMap`), those of the forces first; then G is a map between bodies
    N : a numpy array, a scipy matrix, a PETSc Mat, or a `pctt.ccp.Operator`: products and diagonal blocks
    G : a numpy array, a scipy matrix or a PETSc Mat (3 nc, n); `BlockRows`, `CompactRows` or a `ContactMap`, which are
        scaled by M^-1/2
    masses : of all n columns of G, whole on every rank: (n,) numbers, a matrix, a factor with ``solve(b)``, the pair of
        `scipy.linalg.cho_factor`, a function b -> M^-1 b; a PETSc Vec, Mat or KSP. Without them M is the identity. If
        they are no numbers N is made by one solve for each row

    Attributes
    ----------
    r : (nc, 3) in the units of the cones, see ``units``
    mu : (nc,) friction coefficients of circular cones
    units : (nc, 3) the user's impulses over those in the cones; None where they are the same
    operator : G or N, with its products; a copy of what was given, unless that is a `ContactMap` or an operator
    contact_map : the operator if it is G, and the bodies are known; or None
    point : (nc, 3) contact points (m) or None; orders the unknowns of hierarchical preconditioners
    key : (nc,) persistent names of the contacts or None
    compliance : (nc, 3) the diagonal of C, (C_n, C_t, C_t) per contact (1/kg); given as C_n, a number or (nc,), as
        (nc, 2), or whole: then it is that array
    yields, all_yield : whether C is not zero, and whether no contact is rigid along its normal, the same on all ranks
    size : contacts on all ranks, Nc
    unanswered : contacts on all ranks that no impulse moves: N has zeros in their rows
    mean_diagonal : mean of the diagonal of N without compliance (1/kg); 1 for a problem without contacts
    spread : the greatest over the least normal number of the diagonal of N that is above zero; 0 without contacts
    """

    @known_arguments()
    def __init__(
        self, comm: MPI.Comm, r: Array, mu: Array | None = None, *, cones: Cones | None = None,
        G: door.Given | None = None, N: door.Matrix | GivenOperator | None = None, masses: Any = None,
        point: Array | None = None, key: np.ndarray | None = None, compliance: Array | float = 0.0,
    ):  # fmt: skip
        if not isinstance(comm, MPI.Comm):
            raise ValueError(f"comm {short(comm)}: allowed is a communicator of mpi4py, such as MPI.COMM_WORLD")
        data = {"N": N, "G": G, "masses": masses, "point": point, "key": key, "compliance": compliance}
        contacts = door.contacts_of(comm, r, mu, cones, **data)
        operator = door.operator_of(comm, len(contacts.r), contacts.width, N, G, masses)
        cones = FrictionCones(contacts.mu) if cones is None else cones
        self._begin(comm, contacts, cones, operator, point, key, compliance)
        door.refuse_out_of_range(comm, self.r, self.mean_diagonal)

    @classmethod
    def of_bodies(
        cls, comm: MPI.Comm, r: Array, cones: Cones, G: ContactMap, point: Array | None, key: np.ndarray | None,
        compliance: Array,
    ) -> ConeProblem:  # fmt: skip
        """The same of a program's own contacts, whose arrays fit and need no check; ``compliance`` (nc, 3).
        Collective."""
        problem, G.log_flops = object.__new__(cls), PETSc.Log.logFlops
        problem._begin(comm, door.Contacts(3, None, r, cones.mu, r), cones, G, point, key, compliance)
        return problem

    def _begin(
        self, comm: MPI.Comm, contacts: door.Contacts, cones: Cones, operator: ContactMap | GivenOperator,
        point: Array | None, key: np.ndarray | None, compliance: Array | float,
    ) -> None:  # fmt: skip
        self.units, self._width, self._given_r = contacts.units, contacts.width, contacts.given_r
        self.comm, self.r, self.mu, self.cones, self.key = comm, contacts.r, contacts.mu, cones, key
        self._curvature: list[float] = []  # shared with problems of other r
        self.point = point if point is None or cones.parts == 1 else np.concatenate([point] * cones.parts)
        self.compliance = compliances(compliance, cones.count, len(self.r))
        self.operator = self._given_operator = operator
        if self.units is not None:
            self.operator = door.in_units(comm, operator, self.units)
        self.contact_map = None if isinstance(self.operator, GivenOperator) else self.operator
        blocks = self.operator.contact_blocks()  # not kept: few methods take more of them than their diagonals
        trace = float(_diagonals(blocks).sum())  # has squares of all numbers of G
        known = self.contact_map is not None and math.isfinite(trace)
        wrong = 0 if known else _not_finite(blocks)
        self.diagonal = _diagonals(blocks) + self.compliance
        soft, rigid, unanswered, most, least = _rows_with(self.diagonal, self.compliance, self.cones.count)
        here = wrong, self.cones.count, soft, rigid, unanswered, self.r.size, trace
        (*counts, trace), (most, least) = reduced(comm, here, (most, -least))
        wrong, self.size, soft, rigid, self.unanswered, rows = map(int, counts)
        if wrong:
            self.destroy()
            raise ValueError(f"G has a NaN or an infinite number in {wrong} contacts")
        self.yields, self.all_yield = bool(soft), soft > 0 and not rigid
        self.mean_diagonal, self.spread = trace / rows if trace > 0.0 else 1.0, most / -least

    def __repr__(self) -> str:
        given = "N" if self.contact_map is None else "G"
        return f"ConeProblem({self.size} contacts, {self.comm.size} ranks, given by {given})"

    def with_velocities(self, r: Array) -> ConeProblem:
        """The same problem with other velocities r, of the shape of the first ones; it shares all else, and is valid
        until one of both is destroyed. ValueError on all ranks for another shape or what is no number."""
        given = self._given_r[:, : self._width]
        words = door.wrong_velocities(r, given.shape)
        refuse(self.comm, words)
        padded = door.padded(np.asarray(r, dtype=float).reshape(given.shape))
        other = self.with_r(padded if self.units is None else self.units * padded)
        other._given_r = padded
        door.refuse_out_of_range(self.comm, other.r, self.mean_diagonal)
        return other

    def with_r(self, r: Array) -> ConeProblem:
        """The same problem with other r (nc, 3) in the units of the cones; it shares all else."""
        other = copy.copy(self)
        other.__dict__.pop("N", None)
        other.r = r
        return other

    def part(self, contacts: NDArray[np.intp]) -> ConeProblem:
        """The problem of these contacts of this rank alone, ascending, of which no other has a body that moves.
        Collective."""
        assert self.contact_map is not None
        rows = self.cones.rows_of(contacts)
        return ConeProblem.of_bodies(
            self.comm, self.r[rows], self.cones.only(contacts), self.contact_map.part(contacts),
            None if self.point is None else self.point[contacts], None if self.key is None else self.key[contacts],
            self.compliance[contacts],
        )

    # -- the user's units ------------------------------------------------------------------------------------

    def shown(self, g: Array) -> Array:
        """The user's impulses (nc, 3), or (nc, 2) in the plane, of impulses g (nc, 3) in the cones."""
        return g if self.units is None else (self.units * g)[:, : self._width]

    def taken(self, what: str, impulse: Any, finite: bool = False) -> Array:
        """Impulses (nc, 3) in the cones from the user's, which may be flat. ValueError on all ranks for another shape,
        and for what are no numbers, or no ``finite`` ones. Collective."""
        shape, wrong = (len(self.r), self._width), ""
        found = np.zeros(shape)
        try:
            found = np.ascontiguousarray(impulse, dtype=float)
        except (TypeError, ValueError) as error:
            wrong = f"{what} of no numbers: {error}"
        if finite and not all_from(found.ravel(), -np.inf):
            wrong = f"{what} with a NaN or an infinite number"
        if found.shape not in (shape, (len(self.r) * self._width,)):
            wrong = f"{what} of shape {found.shape}; allowed is {shape}"
        refuse(self.comm, wrong)
        return self.in_cones(found.reshape(shape))

    def in_cones(self, impulse: Array) -> Array:
        """Impulses (nc, 3) in the cones from the user's."""
        if self.units is None:
            return impulse
        g = np.zeros(self.r.shape)
        given = self.units[:, : self._width]
        np.divide(impulse, given, out=g[:, : self._width], where=given > 0.0)
        return g

    def velocities_by(self, g: Array) -> Array:
        """The user's velocities y = N g + r (nc, 3), or (nc, 2) in the plane, by impulses g (nc, 3) in the cones."""
        g = g if self.units is None else self.units * g
        y = self._given_r + self.compliance * g
        self._given_operator.add_delassus(g, y)
        return y[:, : self._width]

    # -- the operator ---------------------------------------------------------------------------------------

    def product(self, g: Array) -> Array:
        """N g for impulses g (nc, 3): velocities of the contacts (nc, 3)."""
        y = self.compliance * g if self.yields else np.zeros(self.r.shape)
        self.operator.add_delassus(g, y)
        return y

    def momentum(self, g: Array) -> Array:
        """G' g (6m,): the change of the mass-scaled velocities of this rank's bodies by impulses g (nc, 3). A problem
        given by N has no bodies: g itself."""
        return self.operator.momenta(g).ravel()

    def velocity_of(self, momentum: Array) -> Array:
        """G v: velocities of the contacts (nc, 3) for those of the bodies; N g where the problem is given by N."""
        return self.operator.velocities(momentum)

    def errors(self, g: Array, y: Array, coulomb: bool = False, units: Units | None = None) -> Errors:
        """How far impulses g with the velocities y = N g + r are from a solution. For Coulomb's law y gets De Saxce's
        term. Both are in ``units``, if these are given."""
        sums, most = self.cones.errors(g, y, self.r, 1.0 / self.mean_diagonal, coulomb, units)
        (moved, whole, closing, opening, energy), (speed,) = reduced(self.comm, sums, (most,))
        natural = 0.0 if moved == 0.0 else math.sqrt(moved) / math.sqrt(whole) if whole > 0.0 else math.inf
        most = closing if closing > opening or math.isnan(closing) else opening  # impulses may be no numbers
        work = 0.0 if energy <= 0.0 else most / energy
        if math.isnan(natural + work + speed):
            return Errors(*map(_number, (natural, work, speed)))
        return Errors(natural, work, speed)

    def natural_residual(self, g: Array, y: Array, coulomb: bool = False) -> float:
        """That of the `errors`."""
        return self.errors(g, y, coulomb).natural

    @cached_property
    def N(self) -> PETSc.Mat:
        """N as a Mat of block size 3 (BAIJ), without dense columns of G; built at its first use and kept."""
        N = self.rigid_matrix()
        if self.yields:
            diagonal = N.createVecLeft()
            diagonal.array[:] = self.compliance.ravel()
            N.setDiagonal(diagonal, PETSc.InsertMode.ADD_VALUES)
            diagonal.destroy()
        return N

    def rigid_matrix(self) -> PETSc.Mat:
        """A new Mat like ``N`` without the compliance. ValueError if the problem is given by products."""
        if isinstance(self.operator, GivenMatrix):
            return self.operator.mat.duplicate(copy=True)
        if not self.has_entries:
            raise ValueError("N is given by its products, and has no entries; allowed is N as a matrix")
        return delassus(self.comm, self._split[0])

    @property
    def has_entries(self) -> bool:
        """Whether those of N are known, and not its products alone."""
        return self.contact_map is not None or isinstance(self.operator, GivenMatrix)

    @property
    def has_dense_columns(self) -> bool:
        """Whether some bodies have more than DENSE contacts and would fill N: ``N`` is without their columns of G."""
        return self.contact_map is not None and self._split[1]

    @cached_property
    def _split(self) -> tuple[BlockRows, bool]:
        assert self.contact_map is not None
        return without_dense_columns(self.comm, self.contact_map.block_rows)

    @cached_property
    def diagonal_blocks(self) -> Array:
        """The 3 x 3 diagonal blocks of N (nc, 3, 3), dense columns and the compliance included."""
        if not self.yields:
            return self._rigid_blocks
        blocks = self._rigid_blocks.copy()
        for k in range(3):
            blocks[:, k, k] += self.compliance[:, k]
        return blocks

    @cached_property
    def diagonal(self) -> Array:
        """The diagonal of N (nc, 3), dense columns and the compliance included."""
        return _diagonals(self._rigid_blocks) + self.compliance

    @cached_property
    def compliance_blocks(self) -> Array:
        """C as blocks (nc, 3, 3)."""
        return self.compliance[:, :, None] * np.eye(3)

    @cached_property
    def _rigid_blocks(self) -> Array:
        return self.operator.contact_blocks()

    def structure(self) -> tuple[np.ndarray, ...]:
        """Arrays of this rank that are equal where contacts, their bodies and all sizes are."""
        key = np.zeros(0) if self.key is None else self.key
        return (key, *self.operator.structure(), np.array([self.size]))

    @property
    def lowest_curvature(self) -> float:
        """The least d'Nd / d'd that some Lanczos steps find for impulses d, over the greatest; 0 where N is positive
        semidefinite by its making. Rounded digits of N make it negative too: -1e-5 with five. It is found once for all
        r. Collective."""
        if self.contact_map is not None:
            return 0.0
        if self._curvature:
            return self._curvature[0]
        free = np.ones_like(self.r)
        free[self.cones.first_tangents == 0.0, 1:] = 0.0  # what has no friction has no tangential impulses
        start = free * np.random.default_rng(self.comm.rank).standard_normal(self.r.shape)
        values = ritz_values(lambda d: free * self.product(d), start, self.sum)
        self._curvature.append(min(values[0] / max(abs(values[0]), abs(values[-1]), TINY), 0.0))
        return self._curvature[0]

    def by_rows(self) -> ConeProblem:
        """The same problem with the rows of its map as they are, if more than contacts couples its bodies; it shares
        all arrays, and has the same residuals. Collective."""
        if self.contact_map is None or not self.contact_map.couples:
            return self
        other = copy.copy(self)
        for name in ("_rigid_blocks", "diagonal", "diagonal_blocks", "_split", "N"):  # those of its map are estimates
            other.__dict__.pop(name, None)
        other.contact_map = other.operator = self._block_map
        return other

    @cached_property
    def _block_map(self) -> BlockMap:
        assert self.contact_map is not None
        return BlockMap(self.comm, self.contact_map.block_rows)

    def by_matrix(self, N: GivenMatrix) -> ConeProblem:
        """The same problem given by its N without compliance; it shares all arrays."""
        other = copy.copy(self)
        other.contact_map, other.operator = None, N
        return other

    # -- reductions over all contacts -----------------------------------------------------------------------

    def sum(self, x):
        """Over all ranks, of a number or an array."""
        return x if self.comm.size == 1 else self._reduced(x, MPI.SUM)

    def sums(self, *parts: float) -> Sequence[float]:
        """Of numbers over all ranks, in one reduction."""
        return parts if self.comm.size == 1 else self._reduced(np.array(parts, dtype=float), MPI.SUM).tolist()

    def min(self, x: float) -> float:
        return self._reduced(x, MPI.MIN)

    def max(self, x):
        return self._reduced(x, MPI.MAX)

    def _reduced(self, x, op: MPI.Op):
        if self.comm.size == 1:
            return x
        here = np.array(x, order="C")
        if here.dtype == bool:  # MPI has no maximum of these
            here = here.astype(int)
        everywhere = np.empty_like(here)
        self.comm.Allreduce(here, everywhere, op)
        return everywhere if here.ndim else everywhere.item()

    def dot(self, x: Array, y: Array) -> float:
        with np.errstate(over="ignore"):  # infinite, of bodies that fly apart; numpy 2 warns
            return self.sum(float(x.ravel().dot(y.ravel())))

    def norm(self, x: Array) -> float:
        return math.sqrt(self.dot(x, x))

    def __enter__(self) -> ConeProblem:
        return self

    def __exit__(self, *exception: object) -> None:
        self.destroy()

    def destroy(self) -> None:
        """Free the PETSc objects now."""
        self.operator.destroy()
        if self._given_operator is not self.operator:
            self._given_operator.destroy()
        if "N" in self.__dict__:
            self.__dict__.pop("N").destroy()


def compliances(compliance: Array | float, contacts: int, rows: int) -> Array:
    """The diagonal of C (rows, 3), of so many contacts in the first rows, from what a `ConeProblem` takes as the
    compliance."""
    given = np.asarray(compliance, dtype=float)
    if given.shape == (rows, 3):
        return np.ascontiguousarray(given)
    out = np.zeros((rows, 3))
    if given.ndim == 2:
        out[:contacts] = given[:, [0, 1, -1]]
    else:
        out[:contacts, 0] = given
    return out


@loop
def _rows_with(diagonal: Array, compliance: Array, contacts: int) -> tuple[int, int, int, float, float]:
    """How many rows (n, 3) of C have compliance, how many of the first ones, of so many contacts, have none along the
    normal, and in how many rows the diagonal of N (n, 3) is zero; and the greatest and the least of its normal numbers
    above zero, of contacts."""
    soft, rigid, unanswered, most, least = 0, 0, 0, 0.0, np.inf
    for c in range(len(compliance)):
        rigid += c < contacts and not compliance[c, 0] > 0.0
        if c < contacts and diagonal[c, 0] > 0.0:
            most, least = max(most, diagonal[c, 0]), min(least, diagonal[c, 0])
        gives = False
        answers = False
        for k in range(3):
            gives = gives or compliance[c, k] > 0.0
            answers = answers or diagonal[c, k] != 0.0
        soft, unanswered = soft + gives, unanswered + (not answers)
    return soft, rigid, unanswered, most, least


def _number(x: float) -> float:
    """The same, inf if it is no number."""
    return x if x == x else math.inf


def _diagonals(blocks: Array) -> Array:
    """The diagonals (nc, 3) of blocks (nc, 3, 3). (Three times as fast as numpy's einsum.)"""
    return blocks.reshape(-1, 9)[:, ::4]


def _not_finite(array: Array) -> int:
    """How many rows of an array have a NaN or an infinite number."""
    if np.isfinite(array.sum()):  # so are all its numbers
        return 0
    return int((~np.isfinite(array).reshape(len(array), -1).all(axis=1)).sum())
