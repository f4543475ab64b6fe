"""What solvers ask of cones. Another kind of cone is a class with these members, in a file of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pctt.arrays import Array, all_from
from pctt.ccp.cones.lorentz import LorentzForm, joined, rows, step_inside

#: A number u and sizes s (rows, 3) of unknowns: u / s is the unit of impulses, u s that of velocities.
Units = tuple[float, Array]


class Cones(ABC):
    """The cones of all contacts of this rank, each of which is met by discs: with parts p of a contact's numbers beside
    the normal one n, and a coefficient of each,

        |p_k| <= c_k n,

    with the dual cone n >= sum of c_k |p_k|. Arrays of unknowns are (rows, 3), of which a contact has one row, or more
    where it has moments: first the rows of all contacts with the normal numbers, then the next ones.

    Attributes
    ----------
    mu : (count,) coefficients of friction
    count : contacts
    parts : rows of a contact
    tangents : of each part, which numbers of a contact it has
    what : in words, what a problem with them has
    """

    mu: Array
    count: int
    parts: int
    tangents: tuple[tuple[int, ...], ...]
    what: str

    @property
    @abstractmethod
    def coefficients(self) -> Array:
        """Those of the parts (k, count)."""

    def why_refused(self) -> str:
        """What is wrong with the coefficients, in words; else ""."""
        for name, values in self.named():
            if values.shape != (self.count,):
                return f"{name} has the shape {values.shape}; allowed is {(self.count,)}, one for each contact"
            if not all_from(values, 0.0):
                bad = np.flatnonzero(~(np.isfinite(values) & (np.asarray(values) >= 0.0)))
                return f"{name} is {values[bad[0]]} at contact {bad[0]}; allowed are finite numbers >= 0"
        return ""

    def named(self) -> list[tuple[str, Array]]:
        """The coefficients by their names."""
        return [("mu", self.mu)]

    # -- places of numbers ------------------------------------------------------------------------------------

    @property
    def first_tangents(self) -> Array:
        """The coefficient of the second number of each row (rows,): where it is zero, so are the second and third."""
        part_of = {number: k for k, part in enumerate(self.tangents) for number in part}
        return np.concatenate([self.coefficients[part_of[3 * row + 1]] for row in range(self.parts)])

    def joined(self, x: Array) -> Array:
        """The numbers (count, width) of each contact, of rows (rows, 3)."""
        return joined(x, self.parts)

    def rows(self, x: Array) -> Array:
        """The rows (rows, 3) of the numbers (count, width) of each contact."""
        return rows(x, self.parts)

    def times(self, blocks: Array, x: Array) -> Array:
        """Products of blocks (count, width, width) with the numbers of contacts, in rows (rows, 3)."""
        return self.rows(np.einsum("cij,cj->ci", blocks, self.joined(x)))

    def rows_of(self, contacts: NDArray[np.intp]) -> NDArray[np.intp]:
        """The rows of these contacts (n,), ascending."""
        return contacts if self.parts == 1 else np.concatenate([contacts + k * self.count for k in range(self.parts)])

    @abstractmethod
    def scaled(self, size: Array, precision: type[np.floating]) -> Cones:
        """The cones of unknowns multiplied by ``size`` (rows, 3), whose numbers along a disc are equal."""

    @abstractmethod
    def only(self, contacts: NDArray[np.intp]) -> Cones:
        """Those of these contacts (n,)."""

    # -- what first-order methods ask -------------------------------------------------------------------------

    @abstractmethod
    def project(self, x: Array, out: Array) -> Array:
        """The nearest points (rows, 3), into ``out``, which may be x."""

    def distance(self, x: Array) -> Array:
        """How far the numbers of each contact (count,) are from its cone."""
        d = self.joined(self.project(x, np.empty_like(x)) - x)
        return np.sqrt(np.einsum("ci,ci->c", d, d))

    @abstractmethod
    def de_saxce(self, y: Array) -> Array:
        """De Saxce's term, the sum of c_k |y_k| (count,): the power that velocities y lose for a unit of normal
        impulse."""

    @abstractmethod
    def accelerated_step(
        self, x: Array, last_x: Array, y: Array, compliance: Array, beta: float, step: float, coulomb: bool, out: Array
    ) -> tuple[float, float, float]:
        """P(z - step y_z) into ``out``, for z = x + beta (x - last_x) and its gradient y_z = y + C z, with De Saxce's
        term for Coulomb's law; d'Cd and |d|^2 of d = out - z, and y_z'(out - x) (`friction.accelerated_step`)."""

    def move(self, x: Array, y: Array, step: Array | float, coulomb: bool = False) -> Array:
        """P(x - step y) - x (rows, 3) for one length or many; for Coulomb's law y_n gets De Saxce's term."""
        out = y.copy()
        if coulomb:
            out[: self.count, 0] += self.de_saxce(y)
        out *= -step
        out += x
        self.project(out, out)
        out -= x
        return out

    @abstractmethod
    def errors(
        self, g: Array, y: Array, r: Array, step: float, coulomb: bool, units: Units | None = None
    ) -> tuple[Sequence[float], float]:
        """||`move`||^2, |g|^2, closing work, opening work and 1/2 g.(y - r) of this rank's contacts, and the
        greatest speed at which one closes. With ``units`` g and y are in these."""

    def active(self, x: Array, last_x: Array, y: Array, least: float) -> NDArray[np.bool_]:
        """Mask (count,) of the contacts but those without an impulse at x and last_x whose distance inside the dual
        cone, y_n less `de_saxce`, exceeds the ``least``."""
        x, last_x, opening = x[: self.count, 0], last_x[: self.count, 0], y[: self.count, 0] - self.de_saxce(y)
        return (x > 0) | (last_x > 0) | ~(opening > least)

    # -- what interior point methods ask ----------------------------------------------------------------------

    def step_length(self, x: Array, dx: Array) -> float:
        """Largest a such that x + a dx is in the cones of this rank (inf where nothing limits it); x is inside."""
        form = self.lorentz()
        return step_inside(form.apply(x), form.apply(dx))

    def lorentz(self) -> LorentzForm:
        """The cones as Lorentz cones."""
        return LorentzForm(self.coefficients, self.tangents)


def floats(values: Array) -> Array:
    """An array without gaps, of double precision unless it is of single."""
    return np.ascontiguousarray(values, None if getattr(values, "dtype", None) == np.float32 else float)
