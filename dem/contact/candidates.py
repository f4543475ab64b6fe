"""Pairs whose margins meet: grains and grains, grains and the parts of large bodies, these with each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dem import bodies
from dem.arrays import Bools, Floats, Ints
from dem.bodies import BOX, MESH, PLANE
from dem.compiled import inlined, loop
from dem.contact.lists import Lists, Rows
from dem.contact.primitives import Primitives
from dem.contact.spheres import frame_of
from dem.model.neighbourhood import Neighbourhood
from dem.model.world import World

#: Rows i, j (m,) of `Primitives`, of which i has the lower number, and the gaps (m,) within which their margins meet.
Pairs = tuple[Ints, Ints, Floats]

#: The `Rows` of grains: start and other; their margins (grains + ghosts,) [m], and which of them have pairs that count.
Grains = tuple[Ints, NDArray[np.int32], Floats, Bools]

#: Of parts of large bodies the rows (p,) of `Primitives`, the bodies (p,) and the frames (p, 9).
Parts = tuple[Ints, Ints, Floats]

#: Of large bodies the pivots (bodies, 3), the shifts (k, bodies, 6) by which they may move and turn, which of them
#: (bodies,) have surfaces that go further than their margins, and these (bodies,).
Travels = tuple[Floats, Floats, Bools, Floats]


def meeting(
    world: World, near: Neighbourhood, lists: Lists, table: Primitives, delta: float, shifts: Floats, grown: Bools
) -> Pairs:
    """All pairs of this rank whose margins meet, or by rounding do not, in the order of `Contacts`; of pairs with
    grains those of which one has `grown` (grains + ghosts,). Margins of large bodies are delta/2 or the way of their
    surfaces, if the bodies move and turn by any of the `shifts` (k, large, 6) [m, rad]."""
    last = world.comm.rank == world.comm.size - 1
    first = near.grains + near.ghosts
    foreign = np.zeros(len(table.row) - first, np.bool_)
    if not last:
        foreign = bodies.is_dynamic(world.large)[table.row[first:] - first]
    found = [_of_grains(near, lists.own, ~foreign, table, delta, shifts, grown)]
    if last:
        if world.large_moves:
            found.append(_of_large(world, near, table, delta, shifts))
    else:
        found.append(_of_grains(near, lists.away, foreign, table, delta, shifts, grown))
    if len(lists.images):
        if last:
            found.append(_of_grains(near, lists.away, np.zeros_like(foreign), table, delta, shifts, grown))
        found.append(_of_images(near, lists.images.own(near.grains) & grown[near.grains :], table, delta, shifts))
    i, j, reach = (np.concatenate(columns) for columns in zip(*found)) if len(found) > 1 else found[0]
    return i, j, reach


def _of_images(near: Neighbourhood, wanted: Bools, table: Primitives, delta: float, shifts: Floats) -> Pairs:
    """Pairs of the `wanted` (ghosts,) images of local grains with the parts of large bodies that are no half spaces."""
    first, image = near.grains + near.ghosts, near.grains + np.flatnonzero(wanted)
    count = len(image)
    bodies_of = np.concatenate([image, np.arange(first, len(near.bodies))])
    image_bodies = Neighbourhood(near.bodies.take(bodies_of), near.margin[image], near.index[bodies_of], count, 0)
    rows = np.concatenate([image, np.arange(first, len(table.kind))])
    names = ("number", "kind", "center", "quaternion", "size", "radius")
    columns = {name: getattr(table, name)[rows] for name in names}
    row = np.concatenate([np.arange(count), table.row[first:] - first + count])
    none = Rows(np.zeros(count + 1, np.int64), np.zeros(0, np.int32))
    solid = table.kind[first:] != PLANE
    given = none, solid, table._replace(row=row, **columns), delta, shifts, np.ones(count, bool)
    found = _of_grains(image_bodies, *given)
    return rows[found[0]], rows[found[1]], found[2]


def _of_grains(
    near: Neighbourhood, rows: Rows, wanted: Bools, table: Primitives, delta: float, shifts: Floats, grown: Bools
) -> Pairs:
    """Pairs of local grains with those in their rows, and with the `wanted` (parts,) parts of large bodies, of which a
    grain has `grown` (grains + ghosts,)."""
    first = near.grains + near.ghosts
    part, body, turn, turning, least = prepared(wanted, first, table.row, table.quaternion, shifts, delta)
    grains, parts = (rows.start, rows.other, near.margin, grown), (part, body, turn)
    given = grains, parts, (near.bodies.position[first:], shifts, turning, least)
    shapes = table.kind, table.center, table.size, table.radius
    done, found, room = 0, 0, len(rows.other) + near.grains + len(part)
    out = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room)
    while True:
        done, found = fill(*given, shapes, table.number, done, found, out)
        if done == near.grains:
            i, j, reach = out
            return i[:found], j[:found], reach[:found]
        i, j, reach = (np.concatenate([column, np.empty_like(column)]) for column in out)
        out = i, j, reach


@loop
def prepared(
    wanted: Bools, first: int, row: Ints, quaternion: Floats, shifts: Floats, delta: float
) -> tuple[Ints, Ints, Floats, Bools, Floats]:
    """The `Parts` of those `wanted`, in rows from the `first` on, and of the large bodies the last two of `Travels`."""
    many, moving = wanted.sum(), shifts.shape[1]
    part, body, turn = np.empty(many, np.int64), np.empty(many, np.int64), np.empty((many, 9))
    turning, least = np.zeros(moving, np.bool_), np.empty(moving)
    k = 0
    for n in range(len(wanted)):
        if wanted[n]:
            part[k], body[k] = first + n, row[first + n] - first
            frame = frame_of(quaternion[part[k]])
            for i in range(9):
                turn[k, i] = frame[i]
            k += 1
    for n in range(moving):
        travel = 0.0
        for s in range(len(shifts)):
            x, y, z = shifts[s, n, 0], shifts[s, n, 1], shifts[s, n, 2]
            travel = max(travel, np.sqrt(x * x + z * z + y * y))
            turning[n] = turning[n] or shifts[s, n, 3] != 0.0 or shifts[s, n, 4] != 0.0 or shifts[s, n, 5] != 0.0
        least[n] = max(0.5 * delta, 0.0 if turning[n] else travel)
    return part, body, turn, turning, least


@loop
def fill(
    grains: Grains, parts: Parts, travels: Travels, shapes: tuple[Ints, Floats, Floats, Floats], number: Ints,
    done: int, found: int, out: Pairs,
) -> tuple[int, int]:  # fmt: skip
    """Add to the first pairs of `out` those of the grains that are not done, as long as there is room; new numbers of
    grains done and pairs found."""
    start, other, margin, grown = grains
    part, body, turn = parts
    pivot, shifts, turning, least = travels
    kind, center, size, radius = shapes
    i, j, reach = out
    for n in range(done, len(start) - 1):
        if found + start[n + 1] - start[n] + len(part) > len(i):
            return n, found
        x, y, z, own, wide = center[n, 0], center[n, 1], center[n, 2], margin[n], radius[n]
        for k in range(start[n], start[n + 1]):
            m = other[k]
            if not (grown[n] or grown[m]):
                continue
            u, v, w = center[m, 0] - x, center[m, 1] - y, center[m, 2] - z
            most = ((wide + own) + (radius[m] + margin[m])) * (1.0 + 1e-12)
            if u * u + v * v + w * w <= most * most:
                ahead = number[n] < number[m]
                i[found], j[found], reach[found] = n if ahead else m, m if ahead else n, own + margin[m]
                found += 1
        last, limit = -1, 0.0
        for k in range(len(part) if grown[n] else 0):
            if body[k] != last:
                last = body[k]
                travel = least[last]
                if turning[last]:
                    u, v, w = x - pivot[last, 0], y - pivot[last, 1], z - pivot[last, 2]
                    for s in range(len(shifts)):
                        p, q, r = shifts[s, last, 3], shifts[s, last, 4], shifts[s, last, 5]
                        a = shifts[s, last, 0] + q * w - r * v
                        b = shifts[s, last, 1] + r * u - p * w
                        c = shifts[s, last, 2] + p * v - q * u
                        travel = max(travel, np.sqrt(a * a + b * b + c * c) + wide * np.sqrt(p * p + q * q + r * r))
                limit = own + travel
            m, far = part[k], wide * (1.0 + 1e-9) + limit  # where rounding matters, the narrow phase is to decide
            u, v, w = x - center[m, 0], y - center[m, 1], z - center[m, 2]
            if kind[m] == PLANE:
                apart = u * size[m, 0] + v * size[m, 1] + w * size[m, 2]
            else:
                square, enough = u * u + v * v + w * w, radius[m] + far
                if square > enough * enough:
                    continue
                if kind[m] == BOX or kind[m] == MESH:  # of meshes the box about them
                    apart = 0.0
                    for axis in range(3):
                        a = abs(u * turn[k, axis] + v * turn[k, 3 + axis] + w * turn[k, 6 + axis]) - size[m, axis]
                        if a > far:
                            apart = np.inf
                            break
                        apart += max(a, 0.0) ** 2
                    apart = np.sqrt(apart)
                else:
                    apart = np.sqrt(square) - radius[m]
            if apart <= far:
                i[found], j[found], reach[found] = n, m, limit
                found += 1
    return len(start) - 1, found


def _of_large(world: World, near: Neighbourhood, table: Primitives, delta: float, shifts: Floats) -> Pairs:
    """Pairs of the parts of two large bodies, of which one at least is free to move."""
    first = near.grains + near.ghosts
    shapes = tuple(column[first:] for column in (table.kind, table.center, table.size, table.radius))
    of_bodies = bodies.is_dynamic(world.large), near.bodies.position[first:], shifts
    return pairs_of_parts(first, table.row[first:] - first, shapes, of_bodies, delta)


@loop
def pairs_of_parts(first, body, shapes, of_bodies, delta):
    """The loop of `_of_large`, over parts in the rows from the `first` on, of these bodies (parts,), which are free or
    not (bodies,), and move and turn about their positions (bodies, 3) by any of the shifts (k, bodies, 6)."""
    (kind, center, size, radius), (free, pivot, shifts) = shapes, of_bodies
    count, room = 0, 16
    one, two, reach = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room)
    for i in range(len(body)):
        for j in range(i + 1, len(body)):
            if body[i] == body[j] or not (free[body[i]] or free[body[j]]):
                continue
            # Two half spaces never touch: what has a centre tells how far the surfaces go
            at, on = (j, i) if kind[i] == PLANE else (i, j)
            most = 0.0
            for b in (body[i], body[j]):
                most += part_margin(shifts, b, pivot[b], center[at], radius[at], delta)
            x, y, z = center[at, 0] - center[on, 0], center[at, 1] - center[on, 1], center[at, 2] - center[on, 2]
            if kind[on] == PLANE:
                apart = x * size[on, 0] + y * size[on, 1] + z * size[on, 2] - radius[at]
            else:
                apart = np.sqrt(x * x + y * y + z * z) - (radius[i] + radius[j])
            if apart > most + 1e-9 * radius[at]:  # where rounding matters, the narrow phase is to decide
                continue
            if count == room:
                room *= 2
                one, two = np.append(one, np.empty_like(one)), np.append(two, np.empty_like(two))
                reach = np.append(reach, np.empty_like(reach))
            one[count], two[count], reach[count] = first + i, first + j, most
            count += 1
    return one[:count], two[:count], reach[:count]


@inlined
def part_margin(shifts, body, pivot, center, radius, delta):
    """The margin of a part of a large body at the surface of a shape of this centre and radius [m]. The body moves and
    turns, about its pivot, by any of the `shifts` (k, bodies, 6)."""
    most = 0.5 * delta
    x, y, z = center[0] - pivot[0], center[1] - pivot[1], center[2] - pivot[2]
    for s in range(len(shifts)):
        p, q, r = shifts[s, body, 3], shifts[s, body, 4], shifts[s, body, 5]
        a, b = shifts[s, body, 0] + q * z - r * y, shifts[s, body, 1] + r * x - p * z
        c = shifts[s, body, 2] + p * y - q * x
        most = max(most, np.sqrt(a * a + b * b + c * c) + radius * np.sqrt(p * p + q * q + r * r))
    return most
