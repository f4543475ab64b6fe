"""The contacts of a rank."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dem.arrays import Floats, Ints
from dem.checks import not_negative
from dem.contact.broad import close_pairs
from dem.contact.narrow import Touch, dot
from dem.contact.primitives import FEATURES, PLANE, Primitives, primitives, touches
from dem.motion import Dynamic
from dem.neighbourhood import Neighbourhood, neighbourhood

if TYPE_CHECKING:
    from dem.world import World


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


def find_contacts(world: World, delta: float) -> Contacts:
    """All contacts of gap at most `delta` [m] that this rank owns; collective.

    A contact belongs to the rank that owns the body of lower global index. The numbers of contacts that the
    grains own are left in `world.grains.weight`.
    """
    not_negative("contact distance delta", delta)
    near = neighbourhood(world, delta)
    table = primitives(near, [body.shapes for body in world.large_bodies], int(world.slabs[-1]))
    pairs = np.concatenate([_grain_pairs(near, table, delta), *_grains_on_parts(near, table, delta)])
    if world.comm.rank == world.comm.size - 1:
        pairs = np.concatenate([pairs, _large_pairs(world, near, table)])
    swap = table.number[pairs[:, 0]] > table.number[pairs[:, 1]]
    i, j = np.where(swap, pairs[:, 1], pairs[:, 0]), np.where(swap, pairs[:, 0], pairs[:, 1])

    pair, feature, touch = touches(table, i, j, delta)
    gives = _gives_way(world, near, table, i[pair], j[pair], touch.normal)
    pair, feature, touch = pair[gives], feature[gives], Touch(*(values[gives] for values in touch))
    i, j = i[pair], j[pair]
    shapes = int(world.slabs[-1]) + len(table.number) - near.grains - near.ghosts
    key = (table.number[i] * shapes + table.number[j]) * FEATURES + feature
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


def _grain_pairs(near: Neighbourhood, table: Primitives, delta: float) -> Ints:
    """Rows (m, 2) of local grains, and of a local grain and a ghost, that may be in reach of each other."""
    count = near.grains + near.ghosts
    pairs = close_pairs(table.center[:count], table.radius[:count], delta)
    return pairs[pairs[:, 0] < near.grains] if near.ghosts else pairs


def _grains_on_parts(near: Neighbourhood, table: Primitives, delta: float) -> list[Ints]:
    """For each part of a large body the rows (m, 2) of local grains that may be in its reach, and of the part."""
    position, reach = table.center[: near.grains], table.radius[: near.grains] + delta
    pairs = []
    for part in range(near.grains + near.ghosts, len(table.number)):
        offset = position - table.center[part]
        if table.kind[part] == PLANE:
            rows = np.flatnonzero(offset @ table.size[part] <= reach)
        else:
            rows = np.flatnonzero(dot(offset, offset) <= (reach + table.radius[part]) ** 2)
        pairs.append(np.stack([rows, np.full(len(rows), part)], axis=1))
    return pairs


def _large_pairs(world: World, near: Neighbourhood, table: Primitives) -> Ints:
    """Rows (m, 2) of the parts of any two large bodies of which one at least is free to move."""
    first = near.grains + near.ghosts
    free = np.array([isinstance(body.motion, Dynamic) for body in world.large_bodies], dtype=bool)
    if not free.any():
        return np.zeros((0, 2), np.int64)
    body = table.row[first:] - first
    i, j = np.triu_indices(len(body), 1)
    touch = (body[i] != body[j]) & (free[body[i]] | free[body[j]])
    return first + np.stack([i[touch], j[touch]], axis=1)


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
