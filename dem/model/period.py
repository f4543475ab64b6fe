"""Periodic boundaries: the cell from zero to the periods repeats itself, and grains meet images of other grains.

Positions are kept as they go on, until a grain is a quarter of a period outside of the cell: then all grains are put
back into it. So lists of pairs hold as long as without periods, and what a step does depends on the state alone.

The search knows images: grains moved by at most one period along each axis. Contacts know none: theirs are the rows of
the bodies, with the `moved` way from body b to the image that touches body a.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from mpi4py import MPI

from dem import bodies, quaternion
from dem.arrays import Bools, Floats, Ints
from dem.model.neighbourhood import Neighbourhood, chunk_boxes, image_ways, touched
from dem.model.world import Shear, World
from dem.motion import Fixed
from dem.shapes import Plane, Shape, placed
from dem.together import SceneError

AXES = "xyz"


def wrapped(position: Floats, period: Floats | None, shear: Shear | None = None) -> Floats:
    """Positions (n, 3) [m] in the cell of the periods (3,) [m], inf: none; None: no axis has one."""
    if period is None:
        return position
    out = position.copy()
    if shear is not None:
        out[:, 0] -= crossed(position, shear) * shear.shift
    for k in np.flatnonzero(np.isfinite(period)):
        out[:, k] -= period[k] * np.floor(out[:, k] / period[k])
        out[out[:, k] >= period[k], k] = 0.0  # a negative number that rounding makes a whole period
    return out


def crossed(position: Floats, shear: Shear) -> Floats:
    """How many sheared boundaries (n,) lie between positions (n, 3) and the cell."""
    place = position[:, shear.axis]
    number = np.floor(place / shear.length)
    return number + (place - shear.length * number >= shear.length)  # a negative number that rounding makes a period


def lattice(period: Floats | None, shear: Shear | None) -> tuple[Floats, Floats]:
    """The ways (3, 3) to the next images along each axis [m], and their velocities (3, 3) [m/s]; zeros along axes
    without a period. Sheared images are the nearest along x."""
    way, drift = np.zeros((3, 3)), np.zeros((3, 3))
    if period is not None:
        np.fill_diagonal(way, np.where(np.isfinite(period), period, 0.0))
        if shear is not None:
            way[shear.axis, 0] = shear.shift - period[0] * np.round(shear.shift / period[0])
            drift[shear.axis, 0] = shear.speed
    return way, drift


def resize(world: World, dt: float) -> None:
    """Let the periods grow for dt [s] as the servo of the cell says, and the shift and speed of sheared images with
    them."""
    if world.servo is not None and world.period is not None:
        stretch = 1.0 + dt * world.servo.rate
        world.period = world.period * stretch
        if world.shear is not None:
            length = float(world.period[world.shear.axis])
            world.shear = replace(world.shear, shift=world.shear.shift * float(stretch[0]), length=length)


def before(world: World, dt: float) -> tuple[Floats | None, Shear | None]:
    """The periods (3,) and the shear at the start of the step of dt [s] that has led to this world; see `resize`."""
    if world.period is None:
        return None, None
    stretch = np.ones(3) if world.servo is None else 1.0 + dt * world.servo.rate
    period, shear = world.period / stretch, world.shear
    if shear is not None:
        length = float(period[shear.axis])
        shear = replace(shear, shift=shear.shift / float(stretch[0]) - dt * shear.rate * length, length=length)
    return period, shear


def velocity_in_cell(position: Floats, velocity: Floats, shear: Shear | None) -> Floats:
    """Velocities (n, 6) that grains at these positions (n, 3) have where they are put back into the cell."""
    if shear is None:
        return velocity
    out = velocity.copy()
    out[:, 0] -= crossed(position, shear) * shear.speed
    return out


def put_back(world: World) -> None:
    """Put all grains back into the cell if one is further outside than a quarter of a period; collective. SceneError
    for large bodies that periods do not allow now."""
    if world.period is None:
        return
    refuse_across(world)
    period, position = world.period, world.grains.position
    # where the length along the gradient changes, so does the velocity of a grain outside: none may stay there
    far = 0.25 if world.servo is None or world.shear is None else 0.0
    outside = np.maximum(-position, position - period) > far * period
    if world.comm.allreduce(bool((outside & np.isfinite(period)).any()), MPI.LOR):
        world.grains.velocity = velocity_in_cell(position, world.grains.velocity, world.shear)
        world.grains.position = wrapped(position, period, world.shear)
        world.lists = None


def refuse_across(world: World) -> None:
    """SceneError if a plane of a large body is not along the periodic directions now, or if another shape moves."""
    assert world.period is not None
    axes = np.isfinite(world.period)
    for row, body in enumerate(world.large_bodies):
        if not isinstance(body.motion, Fixed) and not all(isinstance(shape, Plane) for shape in body.shapes):
            raise SceneError(f"large body {body.name!r} moves: with periods only bodies of planes may")
        turn = normals(world.large.quaternion[row], body.shapes)
        if len(turn) and np.abs(turn[:, axes]).max() > 1e-9:
            axis = AXES[int(np.flatnonzero(axes & (np.abs(turn) > 1e-9).any(axis=0))[0])]
            raise SceneError(f"large body {body.name!r} has a plane across the periodic direction {axis}")


def refuse_short(world: World, margin: Floats) -> None:
    """SceneError, on all ranks, if a grain of one of the margins (grains,) [m] could meet another grain on both sides
    of it, or itself; collective."""
    if world.period is None:
        return
    reach = float((bodies.bounding_radius(world.grains) + margin).max(initial=0.0))
    reach = world.comm.allreduce(reach, MPI.MAX)
    short = np.flatnonzero(world.period <= 4.0 * reach)
    if len(short):
        raise SceneError(
            f"the period of {world.period[short[0]]:g} m along {AXES[short[0]]} is too short: grains are sought within "
            f"{reach:.4g} m of a centre, and could meet a grain and its image; take more than {4.0 * reach:.4g} m, six "
            "diameters are always enough, or a smaller dt"
        )


@dataclass(frozen=True)
class Images:
    """The images of grains and ghosts that the search of a rank must see: further ghosts, behind the others."""

    source: Ints  #: (images,) rows of the grains and ghosts in the table of the neighbourhood
    way: Floats  #: (images, 3) by which they are moved [m]
    base: int  #: number of grains and ghosts
    across: Floats  #: (images,) number of sheared boundaries between them and their grains

    steps: Floats  #: (images, 3) the periods in these ways

    def now(self, world: World) -> Images:
        """The same where the shear and the size of the cell have brought them."""
        assert world.period is not None
        way = self.steps * np.where(np.isfinite(world.period), world.period, 0.0)
        if world.shear is not None:
            way[:, 0] += self.across * world.shear.shift
        return replace(self, way=way)

    @cached_property
    def rows(self) -> Ints:
        """(n,) rows of grains, ghosts and images in the table of the neighbourhood."""
        return np.concatenate([np.arange(self.base), self.source])

    def among(self, near: Neighbourhood) -> Neighbourhood:
        """The neighbourhood with the images as further ghosts."""
        count = len(near.bodies) - self.base
        rows = np.concatenate([self.rows, self.base + np.arange(count)])
        table = near.bodies.take(rows)
        table.position[self.base : len(self.rows)] += self.way
        ghosts = near.ghosts + len(self.source)
        return Neighbourhood(table, near.margin[self.rows], near.index[rows], near.grains, ghosts)

    def place(self, row: Ints) -> tuple[Ints, Floats]:
        """The rows (nc,) in the table of the neighbourhood of those in the table with images, and by what ways (nc, 3)
        images are moved [m]."""
        last, image = len(self.rows), np.flatnonzero((row >= self.base) & (row < len(self.rows)))
        way = np.zeros((len(row), 3))
        way[image] = self.way[row[image] - self.base]
        out = np.where(row >= last, row - len(self.source), row)
        out[image] = self.source[row[image] - self.base]
        return out, way

    def boundaries(self, row: Ints) -> Floats:
        """Numbers (nc,) of sheared boundaries between bodies in rows of the table with images and the cell."""
        out, image = np.zeros(len(row)), np.flatnonzero((row >= self.base) & (row < len(self.rows)))
        out[image] = self.across[row[image] - self.base]
        return out

    def own(self, grains: int) -> Bools:
        """Mask (ghosts and images,) of the images of local grains, in a neighbourhood of so many local grains."""
        mask = np.zeros(len(self.rows) - grains, bool)
        mask[self.base - grains :] = self.source < grains
        return mask


def normals(turn: Floats, shapes: tuple[Shape, ...]) -> Floats:
    """Outward normals (k, 3) of the half spaces among the shapes of a body of orientation `turn` (4,)."""
    found = [quaternion.rotate(turn, np.array(shape.normal, float)) for shape in shapes if isinstance(shape, Plane)]
    return np.reshape(found, (len(found), 3))


def _boxes(world: World) -> Floats:
    """Bounding boxes (k, 2, 3) of the parts of large bodies that are no half spaces [m]."""
    found = []
    for row, body in enumerate(world.large_bodies):
        for shape in body.shapes:
            if not isinstance(shape, Plane):
                kind, center, _, size = placed(shape)
                middle = world.large.position[row] + quaternion.rotate(world.large.quaternion[row], center)
                radius = bodies.enclosing_radius(np.array([kind]), size[None])[0]
                found.append([middle - radius, middle + radius])
    return np.reshape(found, (len(found), 2, 3))


def images(world: World, near: Neighbourhood) -> Images:
    """The images of the grains and ghosts of `near`, with its margins, that may touch local grains; and those of local
    grains that may touch large bodies, which are at rest but for planes."""
    assert world.period is not None
    count = near.grains + near.ghosts
    position = near.bodies.position[:count]
    radius = bodies.enclosing_radius(near.bodies.shape[:count], near.bodies.size[:count]) + near.margin
    own = chunk_boxes(position[: near.grains], radius[: near.grains], 8)
    large = _boxes(world)
    source, moved, across = [np.zeros(0, np.int64)], [np.zeros((0, 3))], [np.zeros(0)]
    for way, boundaries in zip(*image_ways(world.period, world.shear)):
        rows = touched(position + way, radius, own[None])[0]
        if len(large):
            of_large = touched(position[: near.grains] + way, radius[: near.grains], large[None])[0]
            rows = np.union1d(rows, of_large)
        source.append(rows)
        moved.append(np.tile(way, (len(rows), 1)))
        across.append(np.full(len(rows), boundaries))
    way, boundaries = np.concatenate(moved), np.concatenate(across)
    shift = 0.0 if world.shear is None else world.shear.shift
    steps = np.round((way - np.outer(shift * boundaries, (1.0, 0.0, 0.0))) / world.period)
    return Images(np.concatenate(source), way, count, boundaries, steps).now(world)


def between(pairs: Ints, near: Neighbourhood) -> Ints:
    """The pairs (m, 2) of rows, the lower first, without those that are found at the other side of a period too: the
    grain of lower index owns a contact."""
    return pairs[near.index[pairs[:, 0]] < near.index[pairs[:, 1]]]

