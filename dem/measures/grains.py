"""What contacts do to grains, and to the triangles of meshes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dem import quaternion
from dem.arrays import Bools, Floats, Ints
from dem.compiled import loop
from dem.measures.images import about, images
from dem.measures.sample import Sample, measure, summed
from dem.mesh import Mesh, Surface


class Ends(NamedTuple):
    """The ends of contacts at grains: number of the grain (m,), its centre, the contact point, the force on it (m, 3),
    and the contact's row (m,)."""

    grain: Ints
    center: Floats
    point: Floats
    force: Floats
    contact: Ints


def ends(sample: Sample) -> Ends:
    """The ends of this rank's contacts at grains; not collective."""
    return Ends(*_ends(sample.bodies, sample.count, sample.center, sample.point, sample.force))


@loop
def _ends(bodies, grains, center, point, force):
    """The columns of `Ends`."""
    count = 0
    for c in range(len(bodies)):
        count += (bodies[c, 0] < grains) + (bodies[c, 1] < grains)
    grain, contact = np.empty(count, np.int64), np.empty(count, np.int64)
    middle, place, pressed = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
    to = 0
    for c in range(len(bodies)):
        for side in range(2):
            if bodies[c, side] < grains:
                grain[to], contact[to] = bodies[c, side], c
                for k in range(3):
                    middle[to, k], place[to, k] = center[c, side, k], point[c, k]
                    pressed[to, k] = force[c, k] if side else -force[c, k]
                to += 1
    return grain, middle, place, pressed, contact


def branches(sample: Sample, end: Ends, low: Floats, high: Floats, reach: float = 0.0) -> tuple[Ints, Floats, Floats]:
    """Rows (m,) of the ends of contacts and of their images, their points (m, 3) and the ways from there to the centres
    (m, 3); of all that may come within `reach` of the box from `low` to `high` (3,) [m]."""
    branch = end.center - end.point
    longest = max(float(branch.max(initial=0.0)), -float(branch.min(initial=0.0)))
    row, step = images(end.point, sample.lattice, low, high, reach + longest)
    return row, end.point.take(row, axis=0) + step @ sample.lattice, branch.take(row, axis=0)


@measure
def bearing(sample: Sample) -> Bools:
    """Return the mask (nc,) of this rank's contacts that bear force: their normal force exceeds 1 % of the mean, as
    solvers leave small forces at others."""
    normal = np.einsum("ck,ck->c", sample.force, sample.normal)
    total, count = summed(sample, [normal.sum(), float(len(normal))])
    mask: Bools = normal > 0.01 * total / max(count, 1.0)
    return mask


class Grains(NamedTuple):
    """What contacts do to each grain; the rows are all grains in the order of the scene."""

    force: Floats  #: (count, 3) [N]
    torque: Floats  #: (count, 3) about its centre [N m]
    moment: Floats  #: (count, 3, 3) sum of force times branch; over a volume it is the stress of the grain [N m]
    coordination: Ints  #: (count,) number of contacts that bear force


@measure
def per_grain(sample: Sample) -> Grains:
    """Contact force, torque, stress times volume, and coordination number of every grain."""
    table, moment = np.zeros((sample.count, 16)), np.zeros((0, 3)) if sample.moment is None else sample.moment
    _add(sample.bodies, sample.center, sample.point, sample.force, moment, bearing(sample), table)
    table = summed(sample, table)
    return Grains(table[:, :3], table[:, 3:6], table[:, 6:15].reshape(-1, 3, 3), np.rint(table[:, 15]).astype(np.int64))


@loop
def _add(bodies, center, point, force, moment, bears, table):
    """table (count, 16) += the columns of `Grains` of contacts, where ``moment`` may be empty."""
    for c in range(len(bodies)):
        for side in range(2):
            n = bodies[c, side]
            if n < len(table):
                sign = 1.0 if side else -1.0
                x, y, z = sign * force[c, 0], sign * force[c, 1], sign * force[c, 2]
                r = point[c, 0] - center[c, side, 0]
                s = point[c, 1] - center[c, side, 1]
                t = point[c, 2] - center[c, side, 2]
                row = table[n]
                row[0] += x
                row[1] += y
                row[2] += z
                row[3] += s * z - t * y
                row[4] += t * x - r * z
                row[5] += r * y - s * x
                if len(moment):
                    for k in range(3):
                        row[3 + k] += sign * moment[c, k]
                for k, f in enumerate((x, y, z)):
                    row[6 + 3 * k] -= f * r
                    row[7 + 3 * k] -= f * s
                    row[8 + 3 * k] -= f * t
                row[15] += bears[c]


@measure
def triangle_forces(sample: Sample, body: int, mesh: Mesh, position: Floats, turn: Floats) -> Floats:
    """Return forces (triangles, 3) of grains on the triangles of a mesh, in the world frame [N].

    The mesh is all of the large body of this number (`Sample.bodies`) at `position` (3,) [m] and orientation `turn`
    (4,). A contact's force is that of the triangle nearest to its point, or to an image of it: searches keep no
    triangles."""
    first, second = (sample.bodies[:, side] == body for side in (0, 1))
    force = sample.force * (second.astype(float) - first)[:, None]
    rows = first | second
    inverse_turn, own = quaternion.conjugate(turn), np.array(mesh.quaternion)
    point = sample.point[rows, None] + about(sample.lattice)  # a mesh is no longer than the cell
    point = quaternion.rotate(inverse_turn, point - position) - np.array(mesh.center)
    point = quaternion.rotate(quaternion.conjugate(own), point) - mesh.surface.middle
    out = np.zeros((len(mesh.surface.triangle), 3))
    np.add.at(out, nearest(mesh.surface, point), force[rows])
    return np.asarray(summed(sample, out))


def nearest(surface: Surface, point: Floats) -> Ints:
    """The triangle (m,) that is nearest to one of the k images of each point (m, k, 3) in the frame of the surface, the
    first of equals."""
    count = point.shape[1]
    out, left, point = np.zeros(len(point), np.int64), np.arange(point[..., 0].size), point.reshape(-1, 3)
    reach = 1e-3 * float(surface.half.max())
    while len(left):
        row, triangle = surface.near(point[left], np.full(len(left), reach))
        away = surface.closest(point[left[row]], triangle).distance
        close = away <= reach  # nearer triangles than these are all among them
        row, triangle, away = left[row[close]] // count, triangle[close], away[close]
        order = np.lexsort((triangle, away, row))
        found, first = np.unique(row[order], return_index=True)
        out[found] = triangle[order[first]]
        left, reach = left[~np.isin(left // count, found)], 2.0 * reach
    return out
