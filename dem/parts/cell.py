"""The simulation cell: a box from the origin on that may repeat itself, be sheared, and change its size.

Open space is a cell without periods, so that nobody who asks a cell has a case for it. A shear (Lees and Edwards 1972)
is a flow along x with its gradient along y or z: the images behind that boundary are moved along x. A cell that changes
its size takes all centres with it, see `dem.step.servo`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any, ClassVar

import numpy as np

from dem import bodies, checks, quaternion
from dem.arrays import Bools, Floats
from dem.bodies import Bodies
from dem.motion import Fixed, Motion
from dem.parts.named import Named
from dem.shapes import Plane, Shape

SHEARED = 0.01  #: the shear strain of a cell in a step
STRAINED = 0.002  #: the strain of its periods in a step
SAME = np.eye(3)  #: no deformation
PASSING = 0.1  #: the step, in the time d sqrt(rho / P) in which the stress of a cell closes a hole


def _three(fill: float) -> Any:
    return field(default_factory=lambda: np.full(3, fill))


@dataclass(frozen=True, eq=False)
class Cell(Named):
    """The cell as it is now; by default open space."""

    period: Floats = _three(np.inf)  #: (3,) lengths along x, y, z; inf: it does not repeat itself [m]
    gradient: int | None = None  #: axis of the gradient of the shear, 1 or 2; None: it is not sheared
    shear_rate: float = 0.0  #: d v_x / d y or z [1/s]
    shift: float = 0.0  #: by how much the images behind the period of the gradient are moved along x so far [m]
    deforms: bool = False  #: whether the periods change, as stresses or strain rates ask
    stress: Floats = _three(np.nan)  #: (3,) asked along x, y, z, positive in compression; NaN: none [Pa]
    strain_rate: Floats = _three(np.nan)  #: (3,) in the place of the stresses from `start` on, likewise [1/s]
    start: float = 0.0  #: [s]
    rate: Floats = _three(0.0)  #: (3,) of the periods in the last step, over them [1/s]
    CHANGED: ClassVar = ("shear_rate", "stress", "strain_rate")

    @cached_property
    def axes(self) -> Bools:
        """Mask (3,) of the axes along which the cell repeats itself."""
        return np.isfinite(self.period)

    @cached_property
    def periodic(self) -> bool:
        return bool(self.axes.any())

    @property
    def lengths(self) -> Floats:
        """The periods (3,); 0: none [m]."""
        return np.where(self.axes, self.period, 0.0)

    @property
    def moves(self) -> bool:
        """Whether images move beside their bodies, by a shear or as the cell changes its size."""
        return self.gradient is not None or self.deforms

    @property
    def speed(self) -> float:
        """Velocity along x of the images behind the period of the gradient, relative to their bodies [m/s]."""
        return 0.0 if self.gradient is None else self.shear_rate * float(self.period[self.gradient])

    @property
    def volume(self) -> float:
        """[m^3]; infinite without three periods."""
        return float(self.period.prod())

    @property
    def pressure(self) -> float:
        """The greatest asked stress; 0 without [Pa]."""
        return float(np.nan_to_num(self.stress).max())

    # -- places ----------------------------------------------------------------------------------------------

    def wrapped(self, position: Floats) -> Floats:
        """Positions (n, 3) put into the cell [m]."""
        if not self.periodic:
            return position
        out = position.copy()
        if self.gradient is not None:
            out[:, 0] -= self._crossed(position) * self.shift
        out -= self.lengths * np.floor(out / self.period)
        out[out >= self.period] = 0.0  # a negative number that rounding makes a whole period
        return out

    def inside(self, table: Bodies) -> Bodies:
        """The bodies put into the cell, with the velocities that they have there."""
        if not self.periodic:
            return table
        velocity = table.velocity
        if self.gradient is not None:
            velocity = velocity.copy()
            velocity[:, 0] -= self._crossed(table.position) * self.speed
        return replace(table, position=self.wrapped(table.position), velocity=velocity)

    def _crossed(self, position: Floats) -> Floats:
        """How many sheared boundaries (n,) lie between positions (n, 3) and the cell."""
        place, length = position[:, self.gradient], self.period[self.gradient]
        number = np.floor(place / length)
        return number + (place - length * number >= length)  # a negative number that rounding makes a period

    def leaves(self, position: Floats) -> bool:
        """Whether one of the positions (n, 3) is further outside than a quarter of a period."""
        return bool(((np.maximum(-position, position - self.period) > 0.25 * self.period) & self.axes).any())

    def taken_along(self, then: Cell, position: Floats, velocity: Floats) -> Floats:
        """Velocities (n, 6) of bodies that had them at these positions (n, 3) in the cell `then`: behind a sheared
        boundary they go with the images there, whose speed changes with the shear rate and the period."""
        faster = self.speed - then.speed
        if not faster or not (crossed := then._crossed(position)).any():
            return velocity
        out = velocity.copy()
        out[:, 0] += faster * crossed
        return out

    def whole(self, vector: Floats) -> Floats:
        """The part (..., 3) of ways (..., 3) that is whole periods [m]; without it, ways lead to the nearest image."""
        return self.lengths * np.round(vector / self.period) if self.periodic else np.zeros(vector.shape)

    def images(self) -> tuple[Floats, Floats]:
        """By how many periods (k, 3) a body and its images about the cell are moved, and how many sheared boundaries
        (k,) lie between them and the cell; the body itself is the first. Behind a boundary images are shifted by up to
        half a period, so that one more may be near."""
        each: list[tuple[float, ...]] = [(-1.0, 0.0, 1.0) if repeats else (0.0,) for repeats in self.axes]
        if self.gradient is not None:
            each[0] = (-2.0, -1.0, 0.0, 1.0, 2.0)
        steps = np.array([(0.0, 0.0, 0.0), *(steps for steps in product(*each) if any(steps))])
        if self.gradient is None:
            return steps, np.zeros(len(steps))
        across = steps[:, self.gradient]
        near = (np.abs(steps[:, 0]) < 2.0) | (across != 0.0)
        steps, across = steps[near], across[near]
        steps[:, 0] -= across * np.round(self.shift / self.period[0])
        return steps, across

    @property
    def image_vectors(self) -> Floats:
        """The ways (k, 3) of `images` [m]."""
        return self.moved(*self.images())

    def moved(self, steps: Floats, across: Floats) -> Floats:
        """The ways (k, 3) by so many periods (k, 3) and over so many sheared boundaries (k,) [m]."""
        vector = steps * self.lengths
        vector[:, 0] += across * self.shift
        return vector

    @property
    def lattice(self) -> tuple[Floats, Floats]:
        """The ways (3, 3) to the next images along each axis [m], and their velocities (3, 3) [m/s]; zeros along axes
        without a period. Sheared images are the nearest along x."""
        vectors, drift = np.diag(self.lengths), np.zeros((3, 3))
        if self.gradient is not None:
            vectors[self.gradient, 0] = self.shift - self.period[0] * np.round(self.shift / self.period[0])
            drift[self.gradient, 0] = self.speed
        return vectors, drift

    # -- motion ----------------------------------------------------------------------------------------------

    def after(self, dt: float) -> Cell:
        """The cell dt [s] later."""
        if not self.moves:
            return self
        stretch = 1.0 + dt * self.rate
        return replace(self, period=self.period * stretch, shift=self.shift * float(stretch[0]) + dt * self.speed)

    def before(self, dt: float) -> Cell:
        """The cell at the start of the step of dt [s] that has led to this one."""
        if not self.moves:
            return self
        stretch = 1.0 + dt * self.rate
        then = replace(self, period=self.period / stretch)
        return replace(then, shift=(self.shift - dt * then.speed) / float(stretch[0]))

    def beside_flow(self, position: Floats, velocity: Floats) -> Floats:
        """Velocities (n, 3 or 6) beside those of the shear at these positions (n, 3)."""
        if self.gradient is None:
            return velocity
        beside = velocity.copy()
        beside[:, 0] -= self.shear_rate * position[:, self.gradient]
        return beside

    def margin(self, dt: float, grains: Bodies) -> Floats:
        """What the margins (n,) of grains have beside their ways in dt [s]: the share of a grain in the way by which
        the shear, and the cell as it changes its size, bring the centres of a pair together [m]."""
        strain = dt * (abs(self.shear_rate) + float(np.abs(self.rate).max()))
        return strain * 3.0 * bodies.bounding_radius(grains)  # with a margin of two radii, the greatest there is

    def strained_since(self, then: Cell) -> tuple[Floats, float]:
        """The deformation (3, 3) that brings the images of `then` to where they are now, and by which part of their
        distance it brings points nearer to each other at most."""
        if not self.moves:
            return SAME, 0.0
        out = np.eye(3)
        out[self.axes, self.axes] = self.period[self.axes] / then.period[self.axes]
        if self.gradient is not None:
            out[0, self.gradient] = (self.shift - out[0, 0] * then.shift) / then.period[self.gradient]
        return out, 1.0 - float(np.linalg.svd(out, compute_uv=False)[-1])

    def needs(self, grains: Bodies) -> dict[str, float]:
        """The time steps [s] that the motion of the cell and its stress need, by what needs them, for these grains."""
        found = {}
        if self.shear_rate:
            found[f"a shear rate of {self.shear_rate:.3g} 1/s"] = SHEARED / abs(self.shear_rate)
        if rate := float(np.abs(np.nan_to_num(self.strain_rate)).max()):
            found[f"a strain rate of {rate:.3g} 1/s"] = STRAINED / rate
        if self.pressure > 0.0 and len(grains):
            thick, wide = 2.0 * bodies.least_half_thickness(grains), 2.0 * bodies.bounding_radius(grains)
            square = 6.0 / np.pi * thick * grains.mass / wide**2 / self.pressure  # d^2 rho / P of a sphere
            found[f"a stress of {self.pressure:.3g} Pa"] = PASSING * float(np.sqrt(square.min()))
        return found

    # -- changes, checkpoints, records -----------------------------------------------------------------------

    def changed(self, time: float, tally: Any = None, **values: Any) -> Cell:
        """As of `Named`: another shear rate [1/s], other stresses (3,) [Pa], or strain rates (3,) [1/s] in the place of
        stresses; None: none along an axis. ValueError if the scene has none of its kind."""
        for name in values:
            if name == "shear_rate" and self.gradient is None:
                raise ValueError(f"{name}: the cell of this scene is not sheared; give the Scene a shear_rate, or 0")
            if name != "shear_rate" and not self.deforms:
                constant = "the periods of this cell are constant; give the Scene a stress or a strain_rate"
                raise ValueError(f"{name}: {constant}")
        start = time if "strain_rate" in values else self.start
        return replace(self, start=start, **{name: CHECKS[name](value) for name, value in values.items()})

    def state(self) -> dict[str, np.ndarray]:
        """The arrays of a checkpoint, for `restored`."""
        shear = {"shear": np.array([self.shear_rate, self.shift])} if self.gradient is not None else {}
        sizes = self.stress, self.strain_rate, np.full(3, self.start), self.rate, self.period
        return shear | ({"servo": np.array(sizes)} if self.deforms else {})

    def restored(self, kept: Mapping[str, np.ndarray]) -> Cell:
        """This cell of a scene, as the arrays of a checkpoint have it. ValueError if they have none of its kind."""
        out = self
        if self.deforms:
            table = np.array(kept.get("servo", np.full((5, 3), np.nan)), float)
            if table.shape != (5, 3) or not np.isfinite(table[2:]).all() or not (table[4] > 0.0).all():
                raise ValueError("the state has no stress or strain rate of the cell, as the scene has")
            stress, strain, start, rate, period = table
            out = replace(self, stress=stress, strain_rate=strain, start=float(start[0]), rate=rate, period=period)
        if self.gradient is not None:
            rate, shift = np.array(kept.get("shear", (0.0, np.nan)), float)
            if not np.isfinite([rate, shift]).all():
                raise ValueError("the state has no shear of the cell, as the scene has")
            out = replace(out, shear_rate=float(rate), shift=float(shift))
        return out

    def attributes(self) -> dict[str, Floats]:
        """What a frame has of the cell; nothing of open space."""
        vectors, drift = self.lattice
        return {"lattice": vectors, "drift": drift, "rate": self.rate} if self.periodic else {}

    def record(self, stress: Callable[[], Floats]) -> dict[str, float]:
        """The periods, and the stress (3, 3) [Pa]; nothing of a cell that does not move, or has a direction without a
        period."""
        if not self.moves or not self.axes.all():
            return {}
        found, pairs = stress(), ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        out = {f"period_{axis} [m]": float(length) for axis, length in zip("xyz", self.period)}
        return out | {f"stress_{'xyz'[i]}{'xyz'[j]} [Pa]": 0.5 * float(found[i, j] + found[j, i]) for i, j in pairs}

    # -- what it cannot have ---------------------------------------------------------------------------------

    def why_refused(self, name: str, motion: Motion, shapes: Sequence[Shape], turn: Floats) -> str:
        """Why a large body of this motion and orientation `turn` (4,) cannot be in the cell, in words; "" if it can."""
        planes = [shape for shape in shapes if isinstance(shape, Plane)]
        if self.periodic and not isinstance(motion, Fixed) and len(planes) < len(shapes):
            return f"large body {name!r} moves: with periods only bodies of planes may; other shapes are Fixed"
        normal = [quaternion.rotate(turn, np.array(shape.normal, float)) for shape in planes]
        across = np.flatnonzero(self.axes & (np.abs(np.reshape(normal, (-1, 3))) > 1e-9).any(axis=0))
        if not len(across):
            return ""
        axis = "xyz"[across[0]]
        return f"large body {name!r} has a plane across the periodic direction {axis}; allowed are planes along it"


OPEN = Cell()  #: space without periods


def of_scene(
    gravity: Sequence[float], period: Sequence[float | None] | None, shear_rate: float | None, shear_gradient: str,
    stress: Sequence[float | None] | None, strain_rate: Sequence[float | None] | None, strain_start: float,
) -> Cell:  # fmt: skip
    """The cell at time zero of what `dem.scene.Scene` is given. ValueError for what is none."""
    absent = (None, None, None)
    repeats = _triple("period", absent if period is None else period, checks.positive, np.inf)
    asked = CHECKS["stress"](absent if stress is None else stress)
    strain = CHECKS["strain_rate"](absent if strain_rate is None else strain_rate)
    start = float(checks.not_negative("strain_start", strain_start))
    deforms, what = stress is not None or strain_rate is not None, "strain_rate" if stress is None else "stress"
    if deforms and np.isinf(repeats).any():
        raise ValueError(f"{what} needs periods along x, y and z")
    if deforms and np.any(gravity):
        raise ValueError(f"{what} needs gravity (0, 0, 0): in a cell without walls grains would fall for ever")
    rate = 0.0 if shear_rate is None else CHECKS["shear_rate"](shear_rate)
    if shear_gradient not in ("y", "z"):
        raise ValueError(f"shear_gradient must be 'y' or 'z', got {shear_gradient!r}")
    axis = "xyz".index(shear_gradient)
    if shear_rate is None and shear_gradient != "y":
        raise ValueError(f"shear_gradient {shear_gradient!r} needs a shear_rate, or 0")
    if start > 0.0 and not deforms:
        raise ValueError(f"strain_start {start:g} needs a strain_rate or a stress")
    if shear_rate is not None and np.isinf(repeats[[0, axis]]).any():
        raise ValueError(f"shear_rate needs periods along x and {shear_gradient}")
    return Cell(repeats, None if shear_rate is None else axis, rate, 0.0, deforms, asked, strain, start)


def _triple(name: str, values: Sequence[float | None], check: Callable[..., Floats], none: float) -> Floats:
    """Numbers (3,) that have passed a check, and `none` where None stands."""
    if np.shape(np.asarray(values, object)) != (3,):
        raise ValueError(f"{name} must have three entries, for x, y and z, got {values}")
    return np.array([none if value is None else float(check(name, value)) for value in values])


#: The checked values of what a run may change.
CHECKS: dict[str, Callable[[Any], Any]] = {
    "shear_rate": lambda value: float(checks.finite("shear_rate", value)),
    "stress": lambda values: _triple("stress", values, checks.positive, np.nan),
    "strain_rate": lambda values: _triple("strain_rate", values, checks.finite, np.nan),
}
