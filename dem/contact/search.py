"""The contacts of a rank."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Floats, Ints
from dem.bodies import SPHERE, Bodies
from dem.checks import not_negative
from dem.contact.broad import close_pairs
from dem.contact.narrow import Touch, dot
from dem.contact.primitives import FEATURES, PLANE, Primitives, primitives, touches
from dem.free_motion import free_velocity, large_free_velocity
from dem.motion import Dynamic
from dem.neighbourhood import Neighbourhood, neighbourhood, without_ghosts
from dem.quaternion import cross

if TYPE_CHECKING:
    from dem.world import World


#: The margin of a grain is at most so many of its radii, whatever its speed.
WIDEST = 2.0


@dataclass(frozen=True)
class Contacts:
    """The contacts of this rank, ordered by the row of the body that owns them and then by key."""

    key: Ints  #: (nc,) the same for the same two shapes and feature at all times and on any number of ranks
    a: Ints  #: (nc,) row of the first body in `near.bodies`, the one of lower id
    b: Ints  #: (nc,) row of the second body in `near.bodies`
    body: Ints  #: (nc, 2) global indices of the two bodies
    point: Floats  #: (nc, 3) middle between the surfaces [m]
    normal: Floats  #: (nc, 3) unit vector from a to b
    gap: Floats  #: (nc,) signed distance, negative if the bodies overlap [m]
    friction: Floats  #: (nc,) coefficient
    near: Neighbourhood  #: the bodies of the rows `a` and `b`

    def __len__(self) -> int:
        return len(self.key)

    def take(self, rows: np.ndarray) -> Contacts:
        """Those of these rows, or where a mask (nc,) is true."""
        columns = ("key", "a", "b", "body", "point", "normal", "gap", "friction")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})


def find_contacts(world: World, delta: float, dt: float = 0.0, margin: Floats | float = 0.0) -> Contacts:
    """All contacts that this rank owns of the pairs whose margins meet; collective.

    The margin of a body is delta/2 [m], or the way that it goes in dt [s] without contact forces if that is longer: a
    gap of at most `delta` is a contact, and so is a longer one that may close within the step, also as one of the two
    is stopped by a third. A grain in the margin of a large body has that of the large body there if it is wider, as
    the large body may strike it and send it on. `margin` (grains,) [m]: no margin of a local grain is to be less.
    A contact belongs to the rank that owns the body of lower global index. The numbers of contacts that the grains own
    are left in `world.grains.weight`.
    """
    not_negative("contact distance delta", delta)
    shapes = [body.shapes for body in world.large_bodies]
    shift = dt * large_free_velocity(world, dt) if dt else np.zeros_like(world.large.velocity)
    way = _way(world.grains, free_velocity(world.grains, world.gravity, dt), dt)
    margin = np.maximum(np.maximum(delta / 2, way), margin)
    if dt:
        alone = without_ghosts(world, margin)
        margin = _margins_of_struck(alone, primitives(alone, shapes, int(world.slabs[-1])), delta, shift)
    near = neighbourhood(world, margin)
    table = primitives(near, shapes, int(world.slabs[-1]))
    found = [_grain_pairs(near, table), _grains_on_parts(near, table, delta, shift)]
    if world.comm.rank == world.comm.size - 1:
        found.append(_large_pairs(world, near, table, delta, shift))
    pairs, reach = (np.concatenate(columns) for columns in zip(*found))
    swap = table.number[pairs[:, 0]] > table.number[pairs[:, 1]]
    i, j = np.where(swap, pairs[:, 1], pairs[:, 0]), np.where(swap, pairs[:, 0], pairs[:, 1])

    pair, feature, touch = touches(table, i, j, reach)
    gives = _gives_way(world, near, table, i[pair], j[pair], touch.normal)
    pair, feature, touch = pair[gives], feature[gives], Touch(*(values[gives] for values in touch))
    i, j = i[pair], j[pair]
    numbers = int(world.slabs[-1]) + len(table.number) - near.grains - near.ghosts
    key = (table.number[i] * numbers + table.number[j]) * FEATURES + feature
    a, b = table.row[i], table.row[j]
    owner = np.minimum(a, b)  # the local grains are the first rows, and ghosts come from higher ranks only
    order = np.lexsort((key, owner))
    a, b = a[order], b[order]
    world.grains.weight = np.bincount(owner, minlength=near.grains)[: near.grains].astype(np.float64)
    material = near.bodies.material
    return Contacts(
        key=key[order],
        a=a,
        b=b,
        body=np.stack([near.index[a], near.index[b]], axis=1),
        point=touch.point[order],
        normal=touch.normal[order],
        gap=touch.gap[order],
        friction=world.friction[material[a], material[b]],
        near=near,
    )


def find_overrun(world: World, contacts: Contacts, velocity: Floats, delta: float, dt: float) -> Contacts | None:
    """The contacts of wider margins, if with these velocities (owned, 6) grains go further in dt [s] than their margins
    in the search for `contacts`; None if that brings no new ones: then no two grains meet unseen; collective.

    A search for the contacts that are found may be followed by another: margins only grow.
    """
    seen = contacts.near.margin[: contacts.near.grains]
    ways = _way(world.grains, velocity[: len(seen)], dt)
    if not world.comm.allreduce(bool((ways > seen).any()), MPI.LOR):
        return None
    wider = find_contacts(world, delta, dt, np.maximum(seen, ways))
    new = not np.isin(wider.key, contacts.key).all()
    return wider if world.comm.allreduce(new, MPI.LOR) else None


def _way(grains: Bodies, velocity: Floats, dt: float) -> Floats:
    """How far (n,) a point of each grain goes in dt [s], about and at most WIDEST radii [m]; of spheres their centre,
    as turning brings their surface nowhere. NaN where the velocity is not finite."""
    radius = bodies.bounding_radius(grains)
    turn = np.where(grains.shape == SPHERE, 0.0, radius) * np.linalg.norm(velocity[:, 3:], axis=1)
    way = np.minimum(dt * (np.linalg.norm(velocity[:, :3], axis=1) + turn), WIDEST * radius)
    return np.where(np.isfinite(velocity).all(axis=1), way, np.nan)


def _margins_of_struck(near: Neighbourhood, table: Primitives, delta: float, shift: Floats) -> Floats:
    """The margins (grains,) of the grains, those in reach of a large body at least as wide as its own there."""
    pairs, reach = _grains_on_parts(near, table, delta, shift)
    grain, part = pairs[touches(table, pairs[:, 0], pairs[:, 1], reach).pair].T
    margin = near.margin.copy()
    np.maximum.at(margin, grain, _part_margin(near, table, part, grain, delta, shift))
    return np.minimum(margin, np.maximum(near.margin, WIDEST * table.radius[: near.grains]))


def _grain_pairs(near: Neighbourhood, table: Primitives) -> tuple[Ints, Floats]:
    """Rows (m, 2) of local grains, and of a local grain and a ghost, whose margins may meet, and the gaps (m,) within
    which they do."""
    count = near.grains + near.ghosts
    pairs = close_pairs(table.center[:count], table.radius[:count] + near.margin, 0.0)
    if near.ghosts:
        pairs = pairs[pairs[:, 0] < near.grains]
    return pairs, near.margin[pairs].sum(axis=1)


def _grains_on_parts(near: Neighbourhood, table: Primitives, delta: float, shift: Floats) -> tuple[Ints, Floats]:
    """The same for local grains and parts of large bodies, which move and turn by `shift` (large bodies, 6)."""
    grains = np.arange(near.grains)
    found = [(np.zeros((0, 2), np.int64), np.zeros(0))]
    for part in range(near.grains + near.ghosts, len(table.number)):
        parts = np.full(near.grains, part)
        reach = near.margin[grains] + _part_margin(near, table, parts, grains, delta, shift)
        offset = table.center[grains] - table.center[part]
        if table.kind[part] == PLANE:
            rows = np.flatnonzero(offset @ table.size[part] <= table.radius[grains] + reach)
        else:
            rows = np.flatnonzero(dot(offset, offset) <= (table.radius[grains] + reach + table.radius[part]) ** 2)
        found.append((np.stack([rows, parts[rows]], axis=1), reach[rows]))
    pairs, gaps = zip(*found)
    return np.concatenate(pairs), np.concatenate(gaps)


def _large_pairs(
    world: World, near: Neighbourhood, table: Primitives, delta: float, shift: Floats
) -> tuple[Ints, Floats]:
    """The same for the parts of any two large bodies of which one at least is free to move."""
    first = near.grains + near.ghosts
    free = np.array([isinstance(body.motion, Dynamic) for body in world.large_bodies], dtype=bool)
    body = table.row[first:] - first
    i, j = np.triu_indices(len(body), 1)
    touch = (body[i] != body[j]) & (free[body[i]] | free[body[j]])
    i, j = first + i[touch], first + j[touch]
    # Two half spaces never touch: the first is to be the one that has a centre.
    i, j = np.where(table.kind[i] == PLANE, j, i), np.where(table.kind[i] == PLANE, i, j)
    margins = [_part_margin(near, table, part, i, delta, shift) for part in (i, j)]
    return np.stack([i, j], axis=1), margins[0] + margins[1]


def _part_margin(
    near: Neighbourhood, table: Primitives, part: Ints, other: Ints, delta: float, shift: Floats
) -> Floats:
    """Margins (m,) of parts of large bodies at the surfaces of the primitives `other` (m,) [m]."""
    row = table.row[part]
    move, turn = np.split(shift[row - near.grains - near.ghosts], 2, axis=1)
    at_center = move + cross(turn, table.center[other] - near.bodies.position[row])
    way = np.linalg.norm(at_center, axis=1) + table.radius[other] * np.linalg.norm(turn, axis=1)
    return np.maximum(delta / 2, way)


def _gives_way(world: World, near: Neighbourhood, table: Primitives, i: Ints, j: Ints, normal: Floats) -> np.ndarray:
    """Which contacts (nc,) a force can open: not those of a guided body with what holds it across its guide.

    Their normal impulse would change no velocity, and any friction with it.
    """
    first = near.grains + near.ghosts
    gives = np.ones(len(i), dtype=bool)
    rows = np.flatnonzero((table.row[i] >= first) & (table.row[j] >= first))
    if len(rows):
        motions = [body.motion for body in world.large_bodies]
        free = np.array([m.free_directions() if isinstance(m, Dynamic) else np.zeros((3, 3)) for m in motions])
        both = free[table.row[i[rows]] - first] + free[table.row[j[rows]] - first]
        gives[rows] = np.einsum("ci,cij,cj->c", normal[rows], both, normal[rows]) > 1e-8
    return gives
