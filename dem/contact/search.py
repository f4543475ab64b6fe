"""The contacts of a rank."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI

from dem import bodies, quaternion
from dem.arrays import Floats, Ints
from dem.bodies import BOX, SPHERE, Bodies
from dem.checks import not_negative
from dem.contact.broad import close_pairs
from dem.contact.narrow import Touch
from dem.contact.primitives import MESH, PLANE, Primitives, extents, primitives, touches
from dem.free_motion import free_directions, free_velocity, large_free_velocity
from dem.motion import Hinged
from dem.neighbourhood import Neighbourhood, neighbourhood
from dem.quaternion import cross, length
from dem.world import World


@dataclass(frozen=True)
class Contacts:
    """The contacts of this rank. First come those that need no other rank, because it owns both bodies or their motion
    is prescribed, then the others. Each part is ordered by the row of the body that owns the contact, and then by
    key."""

    key: Ints  #: (nc,) the same for the same two shapes and feature at all times and on any number of ranks
    a: Ints  #: (nc,) row of the first body in `near.bodies`, the one of lower id
    b: Ints  #: (nc,) row of the second body in `near.bodies`
    body: Ints  #: (nc, 2) global indices of the two bodies
    point: Floats  #: (nc, 3) middle between the surfaces [m]
    normal: Floats  #: (nc, 3) unit vector from a to b
    gap: Floats  #: (nc,) signed distance, negative if the bodies overlap [m]
    friction: Floats  #: (nc,) coefficient
    near: Neighbourhood  #: the bodies of the rows `a` and `b`
    shifts: Floats  #: (k, large, 6) the ways and turns of the large bodies that the search reckoned with [m, rad]

    def __len__(self) -> int:
        return len(self.key)

    def columns(self) -> dict[str, np.ndarray]:
        """The arrays with a row per contact by name, without copies."""
        return {name: value for name, value in vars(self).items() if name not in ("near", "shifts")}

    def take(self, rows: np.ndarray) -> Contacts:
        """The contacts of the given rows (index array or mask)."""
        return replace(self, **{name: column[rows] for name, column in self.columns().items()})


def find_contacts(
    world: World, delta: float, dt: float = 0.0, margin: Floats | float = 0.0, shifts: Floats | None = None
) -> Contacts:
    """All contacts that this rank owns of the pairs whose margins meet; collective.

    The margin of a body is delta/2 [m], or the way that it goes in dt [s] without contact forces if that is longer. So
    a gap of at most `delta` is a contact, and so is a wider one that may close within the step, also when a third body
    stops one of the two. `margin` (grains,) [m] are the least margins of the local grains, `shifts` (k, large, 6)
    [m, rad] further ways and turns of the large bodies that their margins are to cover. A contact belongs to the rank
    that owns the body of lower global index. The numbers of contacts that the grains own are left in
    `world.grains.weight`.
    """
    not_negative("contact distance delta", delta)
    shapes, total = [body.shapes for body in world.large_bodies], int(world.slabs[-1])
    if shifts is None:
        shifts = (dt * large_free_velocity(world, dt) if dt else np.zeros_like(world.large.velocity))[None]
    free = free_velocity(world.grains, world.gravity, dt) if dt else world.grains.velocity
    way = _way(world.grains, free, dt)
    margin = np.maximum(np.maximum(delta / 2, way), margin)
    near = neighbourhood(world, margin)
    table = primitives(near, shapes, total)
    found = [_grain_pairs(near, table), _grains_on_parts(near, table, delta, shifts)]
    if world.comm.rank == world.comm.size - 1:
        found.append(_large_pairs(world, near, table, delta, shifts))
    pairs, reach = (np.concatenate(columns) for columns in zip(*found))
    swap = table.number[pairs[:, 0]] > table.number[pairs[:, 1]]
    i, j = np.where(swap, pairs[:, 1], pairs[:, 0]), np.where(swap, pairs[:, 0], pairs[:, 1])

    pair, feature, touch = touches(table, i, j, reach)
    i, j = i[pair], j[pair]
    key = table.keys(i, j, feature)
    a, b = table.row[i], table.row[j]
    order = contact_order(world, near, a, b, key)
    order = order[_gives_way(world, near, a, b, touch)[order]]
    a, b = a[order], b[order]
    owner = np.minimum(a, b)
    world.grains.weight = np.bincount(owner, minlength=near.grains)[: near.grains].astype(np.float64)
    material = near.bodies.material
    return Contacts(
        key=key[order],
        a=a,
        b=b,
        body=np.stack([near.index[a], near.index[b]], axis=1),
        point=touch.point.take(order, axis=0),  # faster than an index
        normal=touch.normal.take(order, axis=0),
        gap=touch.gap[order],
        friction=world.friction[material[a], material[b]],
        near=near,
        shifts=shifts,
    )


def contact_order(world: World, near: Neighbourhood, a: Ints, b: Ints, key: Ints) -> Ints:
    """The order of contacts of bodies in the rows a, b (nc,): first those whose solution needs no other rank, of bodies
    that this rank owns or whose motion is prescribed; each part by the row of the owner and by key."""
    foreign = np.zeros(len(near.bodies), dtype=bool)
    foreign[near.grains : near.grains + near.ghosts] = True
    if world.comm.rank < world.comm.size - 1:
        foreign[near.grains + near.ghosts :] = bodies.is_dynamic(world.large)
    owner = np.minimum(a, b)  # the local grains are the first rows, and ghosts come from higher ranks only
    return np.lexsort((key, owner, foreign[a] | foreign[b]))


def find_overrun(world: World, contacts: Contacts, velocity: Floats, delta: float, dt: float) -> Contacts | None:
    """The contacts of wider margins, if with these velocities (owned, 6) bodies go further in dt [s] than their margins
    in the search for `contacts`; None if that brings no new ones: then no grain meets anything unseen; collective.

    The search may be repeated for the contacts that it finds: margins only grow.
    """
    seen = contacts.near.margin[: contacts.near.grains]
    ways = _way(world.grains, velocity[: len(seen)], dt)
    shift = dt * world.large_velocity(velocity)
    # reduced, though all ranks have the same data: processors of other kinds may round otherwise
    beyond = world.comm.allreduce(_go_beyond(world, shift, contacts.shifts, delta), MPI.LOR)
    if not (world.comm.allreduce(bool((ways > seen).any()), MPI.LOR) or beyond):
        return None
    shifts = np.concatenate([contacts.shifts, shift[None]]) if beyond else contacts.shifts
    wider = find_contacts(world, delta, dt, np.maximum(seen, ways), shifts)
    new = len(wider) > len(contacts) or not np.isin(wider.key, contacts.key, assume_unique=True).all()
    return wider if world.comm.allreduce(new, MPI.LOR) else None


def _go_beyond(world: World, shift: Floats, seen: Floats, delta: float) -> bool:
    """Whether a free large body that moves and turns by `shift` (large, 6) goes further than delta/2, and not as in one
    of the shifts `seen` (k, large, 6) that its margin covers, to a hundredth of delta."""
    free = bodies.is_dynamic(world.large)
    size = extents([body.shapes for body in world.large_bodies])[free]

    def way(shift: Floats) -> Floats:
        return length(shift[..., free, :3]) + size * length(shift[..., free, 3:])

    return bool(((way(shift) > delta / 2) & (way(shift - seen) > 0.01 * delta).all(axis=0)).any())


def _way(grains: Bodies, velocity: Floats, dt: float) -> Floats:
    """About how far (n,) a point of each grain goes in dt [s], at most two of its radii [m]. For spheres it is the
    centre's way, as turning does not move their surface. NaN where the velocity is not finite."""
    radius = bodies.bounding_radius(grains)
    turn = np.where(grains.shape == SPHERE, 0.0, radius) * length(velocity[:, 3:])
    way = np.minimum(dt * (length(velocity[:, :3]) + turn), 2.0 * radius)
    finite = np.isfinite(velocity)
    return way if finite.all() else np.where(finite.all(axis=1), way, np.nan)


def _grain_pairs(near: Neighbourhood, table: Primitives) -> tuple[Ints, Floats]:
    """Rows (m, 2) of local grains, and of a local grain and a ghost, whose margins may meet, and the gaps (m,) within
    which they do."""
    count = near.grains + near.ghosts
    pairs = close_pairs(table.center[:count], table.radius[:count] + near.margin)
    if near.ghosts:
        pairs = pairs[pairs[:, 0] < near.grains]
    return pairs, near.margin[pairs[:, 0]] + near.margin[pairs[:, 1]]


def _grains_on_parts(
    near: Neighbourhood, table: Primitives, delta: float, shifts: Floats
) -> tuple[Ints, Floats]:
    """Rows (m, 2) of a local grain and a part of a large body whose margins may meet, and the gaps (m,) within which
    they do. The bodies move and turn by `shifts` (k, large bodies, 6)."""
    count, first = near.grains, near.grains + near.ghosts
    center, radius = table.center[:count], table.radius[:count]
    found = [(np.zeros((0, 2), np.int64), np.zeros(0))]
    for body in np.unique(table.row[first:]):
        margin = _part_margin(shifts[:, [body - first]], near.bodies.position[[body]], center, radius, delta)
        reach = near.margin[:count] + margin
        for part in first + np.flatnonzero(table.row[first:] == body):
            # where the rounding matters, the narrow phase is to decide
            rows = np.flatnonzero(_distance_at_least(table, part, center) - (1.0 + 1e-9) * radius <= reach)
            found.append((np.stack([rows, np.full(len(rows), part)], axis=1), reach[rows]))
    pairs, gaps = zip(*found)
    return np.concatenate(pairs), np.concatenate(gaps)


def _distance_at_least(table: Primitives, part: int, points: Floats) -> Floats:
    """A lower bound of the distances (m,) of points (m, 3) from the surface of a part [m]; of planes and boxes the
    distance itself, as far as it is positive; of meshes that of the box about them."""
    place, size = table.center[part], table.size[part]
    if table.kind[part] == PLANE:
        return points @ size - place @ size
    offset = points - place
    if table.kind[part] in (BOX, MESH):
        return length(np.maximum(np.abs(offset @ quaternion.matrix(table.quaternion[part])) - size, 0.0))
    return length(offset) - table.radius[part]


def _large_pairs(
    world: World, near: Neighbourhood, table: Primitives, delta: float, shifts: Floats
) -> tuple[Ints, Floats]:
    """Rows (m, 2) of the parts of two large bodies, of which one at least is free to move, and the gaps (m,) within
    which their margins meet."""
    first = near.grains + near.ghosts
    free = bodies.is_dynamic(world.large)
    body = table.row[first:] - first
    i, j = np.triu_indices(len(body), 1)
    touch = (body[i] != body[j]) & (free[body[i]] | free[body[j]])
    i, j = first + i[touch], first + j[touch]
    # Two half spaces never touch: the first is to be the one that has a centre.
    i, j = np.where(table.kind[i] == PLANE, j, i), np.where(table.kind[i] == PLANE, i, j)
    at = table.center[i], table.radius[i]
    rows = [table.row[part] for part in (i, j)]
    margins = [_part_margin(shifts[:, row - first], near.bodies.position[row], *at, delta) for row in rows]
    return np.stack([i, j], axis=1), margins[0] + margins[1]


def _part_margin(shifts: Floats, pivot: Floats, center: Floats, radius: Floats, delta: float) -> Floats:
    """Margins (m,) of the parts of large bodies at the surfaces of primitives of centres (m, 3) and radii (m,) [m]. The
    bodies move and turn, about the pivots (m, 3), by any of the `shifts` (k, m, 6).

    Of one body, with (k, 1, 6) and (1, 3), a single margin (1,) if that is the same everywhere.
    """
    move, turn = shifts[..., :3], shifts[..., 3:]
    way = length(move)
    if turn.any():
        way = length(move + cross(turn, center - pivot)) + radius * length(turn)
    return np.maximum(delta / 2, way.max(axis=0))


def _gives_way(world: World, near: Neighbourhood, a: Ints, b: Ints, touch: Touch) -> np.ndarray:
    """Which contacts (nc,) of bodies in the rows a, b (nc,) a force can open. It cannot open those whose normal is
    across the guide of a guided body, nor those that do not turn a hinged one, if the other body is held too.

    Their normal impulse changes no velocity, and would allow any friction.
    """
    first = near.grains + near.ghosts
    gives = np.ones(len(a), dtype=bool)
    rows = np.flatnonzero((a >= first) & (b >= first))
    if len(rows):
        motions = [body.motion for body in world.large_bodies]
        free = free_directions(world.large_bodies) * bodies.is_dynamic(world.large)[:, None, None]
        axis = np.array([m.axis if isinstance(m, Hinged) else np.zeros(3) for m in motions])
        normal, opens = touch.normal[rows], np.zeros(len(rows))
        for body in (a[rows], b[rows]):
            arm = touch.point[rows] - near.bodies.position[body]
            lever = cross(axis[body - first], arm / np.maximum(length(arm), 1e-300)[:, None])
            opens += np.einsum("ci,cij,cj->c", normal, free[body - first], normal)
            opens += np.einsum("ci,ci->c", lever, normal) ** 2
        gives[rows] = opens > 1e-8
    return gives
