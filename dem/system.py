"""The contact problem of one time step: free motion, contact frames, maps between bodies and contacts.

With v the velocities of all bodies (6 each) and g the impulses of all contacts (normal, t1, t2 each):

    D' v       velocities of body b relative to body a at the contact points, in the contact frames,
    D g        impulses and angular impulses on the bodies: +g on b, -g on a,
    v          = v_free + M^-1 D g,  v_free = v_old + dt M^-1 f,
    G          = D' M^-1/2, the mass-scaled map, so that the Delassus matrix is N = G G' = D' M^-1 D,
    r          = b + D' v_free,  b = (gap / dt, 0, 0) per contact.

Bodies of prescribed motion have M^-1 = 0 and their prescribed velocity as v_free. For a guided body M^-1 is
d d' / m, with d the direction of its guide.
Source: Anitescu and Hart (2004), Tasora and Anitescu (2011): the cone complementarity problem of a time step.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Floats, Ints
from dem.checks import positive
from dem.compiled import loop
from dem.contact import Contacts
from dem.exchange import exchange
from dem.free_motion import drive_impulses, free_directions, free_velocities
from dem.quaternion import cross
from dem.world import World

#: The entries (xx, xy, xz, yy, yz, zz) of a symmetric matrix, and the numbers (3, 3) of its entries among these.
UPPER = np.triu_indices(3)
SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


class ScaledMap(NamedTuple):
    """Local rows of G = D' M^-1/2 without its blocks; all arrays are C-contiguous.

    A contact moves with the velocity F (v_b + w_b x r_b - v_a - w_a x r_a), F its frame, of its bodies a and b.
    """

    frame: Floats  #: (nc, 9) rows n, t1, t2 of F, n from a to b
    arm: Floats  #: (nc, 6) r_a and r_b, from the centres of the bodies to the contact point [m]
    body: Ints  #: (nc, 2) global indices of a and b; -1 for a body of prescribed motion
    #: M^-1/2 of the bodies whose rows this rank owns: its diagonal (owned, 6) where that is all on all ranks; else
    #: (owned, 12) two symmetric matrices (xx, xy, xz, yy, yz, zz), of translation and of rotation in world axes
    root: Floats


class ContactSystem:
    """The contact problem of one step on this rank. Members that are collective say so.

    Attributes, of nc local contacts and of the bodies whose rows this rank owns (`World.owned`):
        dt (float): step [s]
        key (nc,), mu (nc,), point (nc, 3): contact key, friction coefficient, contact point [m]
        frame (nc, 3, 3): rows normal (from a to b), t1, t2
        b (nc, 3): (max(gap / dt, -recovery_speed), 0, 0) [m/s]
        r (nc, 3): b + D' v_free [m/s]
        free_velocity (owned, 6): velocities without contacts
        drive_impulse (large, 6): impulses and angular impulses of the drives of large bodies, the same on all ranks
        owned_bodies, total_bodies (int): number of bodies whose rows this rank owns, and of all
    """

    def __init__(self, world: World, contacts: Contacts, dt: float, recovery_speed: float = np.inf) -> None:
        """`recovery_speed` [m/s] bounds the speed at which overlaps are pushed apart."""
        positive("time step", dt)
        if np.isnan(recovery_speed) or recovery_speed < 0.0:
            raise ValueError(f"recovery speed must not be negative, got {recovery_speed}")
        near = contacts.near
        self.dt = dt
        self.key, self.mu, self.point = contacts.key, contacts.friction, contacts.point
        self.frame = contact_frames(contacts.normal)
        self.owned_bodies, self.total_bodies = world.owned, world.body_count
        self._comm, self._slabs = world.comm, world.slabs
        self._near, self._body = near, contacts.body
        self._row = np.stack([contacts.a, contacts.b], axis=1)
        self._arm = contact_arms(self.point, near.bodies.position, self._row)

        self._owned = np.arange(world.owned)
        self._owned[near.grains :] += near.ghosts
        self._free_directions = free_directions(world.large_bodies)
        self._diagonal = world.only_spheres and not bodies.is_dynamic(world.large).any()
        free = free_velocities(world, near, dt)
        self.free_velocity = free.take(self._owned, axis=0)
        self.drive_impulse = drive_impulses(world, dt)
        self.b = np.zeros((len(contacts), 3))
        self.b[:, 0] = np.maximum(contacts.gap / dt, -recovery_speed)
        self.r = self.b + relative_velocity(self.frame, self._arm, self._row, free)

    @cached_property
    def contact_map(self) -> ScaledMap:
        """The mass-scaled map G = D' M^-1/2 as frames, arms and bodies, for solvers that need no blocks."""
        body = np.where(bodies.is_dynamic(self._near.bodies)[self._row], self._body, -1)
        return ScaledMap(self.frame.reshape(-1, 9), self._arm, body, self._root)

    @cached_property
    def _root(self) -> Floats:
        """M^-1/2 of the bodies whose rows this rank owns, as in `ScaledMap`."""
        if self._diagonal:
            mass, inertia = self._near.bodies.mass[self._owned], self._near.bodies.inertia[self._owned]
            return 1.0 / np.sqrt(np.column_stack([mass, mass, mass, inertia]))
        owned = self._near.bodies.take(self._owned)
        translation = np.eye(3) / np.sqrt(owned.mass)[:, None, None]
        guides = self._free_directions[: self.owned_bodies - self._near.grains]
        translation[self._near.grains :] = translation[self._near.grains :] @ guides
        both = np.stack([translation, bodies.inverse_root_inertia(owned)], axis=1)
        return both[:, :, UPPER[0], UPPER[1]].reshape(-1, 12)

    def velocity(self, impulse: Floats) -> Floats:
        """Velocities (owned, 6) after the step, v_free + M^-1 D g, for impulses (nc, 3); collective."""
        load = np.concatenate(self.generalised_impulse(impulse))[: self.owned_bodies]  # large bodies: the last rank's
        return self.free_velocity + scaled(self._root, scaled(self._root, load))

    def blocks(self) -> tuple[Ints, Floats]:
        """D' of all bodies: the global indices (nc, 2) of the two bodies of each contact, ascending, and their blocks
        (nc, 2, 3, 6) in that order: rows of the frame, and their moments about the centres."""
        order = np.argsort(self._body, axis=1)
        direction = (2.0 * order - 1.0)[:, :, None, None] * self.frame[:, None]
        arm = np.take_along_axis(self._arm.reshape(-1, 2, 3), order[:, :, None], axis=1)
        blocks = np.concatenate([direction, cross(arm[:, :, None], direction)], axis=3)
        return np.take_along_axis(self._body, order, axis=1), blocks

    def generalised_impulse(self, impulse: Floats) -> tuple[Floats, Floats]:
        """D g of the local grains (grains, 6), and of the large bodies (large, 6), the same on all ranks, from
        the impulses (nc, 3) of all ranks [N s, N m s]; collective."""
        near = self._near
        impulse = np.ascontiguousarray(impulse, dtype=np.float64).reshape(len(self.frame), 3)  # the loop trusts it
        load = sum_of_impulses(self.frame, self._arm, self._row, impulse, len(near.bodies))
        ghosts = slice(near.grains, near.grains + near.ghosts)
        index = near.index[ghosts]
        owner = np.searchsorted(self._slabs, index, side="right") - 1
        home = exchange(self._comm, {"row": index - self._slabs[owner], "load": load[ghosts]}, owner)
        local = load[: near.grains]
        if len(home["row"]):
            local = local + sum_rows(home["row"], home["load"], near.grains)
        large = load[ghosts.stop :].copy()
        self._comm.Allreduce(MPI.IN_PLACE, large)
        return local, large


@loop
def contact_frames(normal: Floats) -> Floats:
    """Orthonormal right-handed frames (nc, 3, 3), rows n, t1, t2, of unit normals (nc, 3).

    Duff et al. (2017), "Building an Orthonormal Basis, Revisited": a function of the normal alone, continuous
    but where the sign of its z component changes.
    """
    frame = np.empty((len(normal), 3, 3))
    for c in range(len(normal)):
        x, y, z = normal[c, 0], normal[c, 1], normal[c, 2]
        sign = np.copysign(1.0, z)
        p = -1.0 / (sign + z)
        q = x * y * p
        frame[c, 0, 0], frame[c, 0, 1], frame[c, 0, 2] = x, y, z
        frame[c, 1, 0], frame[c, 1, 1], frame[c, 1, 2] = 1.0 + sign * x * x * p, sign * q, -sign * x
        frame[c, 2, 0], frame[c, 2, 1], frame[c, 2, 2] = q, sign + y * y * p, -y
    return frame


@loop
def contact_arms(point: Floats, position: Floats, row: Ints) -> Floats:
    """Vectors (nc, 6) from the centres of the two bodies of each contact to its point (nc, 3); `row` (nc, 2) are the
    bodies' rows in a table of positions (rows, 3)."""
    arm = np.empty((len(point), 6))
    for c in range(len(point)):
        a, b = row[c, 0], row[c, 1]
        for k in range(3):
            arm[c, k], arm[c, 3 + k] = point[c, k] - position[a, k], point[c, k] - position[b, k]
    return arm


@loop
def relative_velocity(frame: Floats, arm: Floats, row: Ints, velocity: Floats) -> Floats:
    """D' v (nc, 3) for the velocities (rows, 6) of the bodies of a table, of which `row` (nc, 2) are those in contact,
    with frames (nc, 3, 3) and arms (nc, 6)."""
    out = np.empty((len(frame), 3))
    for c in range(len(frame)):
        v, w, r = velocity[row[c, 0]], velocity[row[c, 1]], arm[c]
        x = w[0] + w[4] * r[5] - w[5] * r[4] - (v[0] + v[4] * r[2] - v[5] * r[1])
        y = w[1] + w[5] * r[3] - w[3] * r[5] - (v[1] + v[5] * r[0] - v[3] * r[2])
        z = w[2] + w[3] * r[4] - w[4] * r[3] - (v[2] + v[3] * r[1] - v[4] * r[0])
        for k in range(3):
            out[c, k] = frame[c, k, 0] * x + frame[c, k, 1] * y + frame[c, k, 2] * z
    return out


@loop
def sum_of_impulses(frame: Floats, arm: Floats, row: Ints, impulse: Floats, count: int) -> Floats:
    """D g (count, 6) for the impulses (nc, 3) of contacts as in `relative_velocity`, on the bodies of a table."""
    out = np.zeros((count, 6))
    for c in range(len(frame)):
        n, s, t = impulse[c, 0], impulse[c, 1], impulse[c, 2]
        x = n * frame[c, 0, 0] + s * frame[c, 1, 0] + t * frame[c, 2, 0]
        y = n * frame[c, 0, 1] + s * frame[c, 1, 1] + t * frame[c, 2, 1]
        z = n * frame[c, 0, 2] + s * frame[c, 1, 2] + t * frame[c, 2, 2]
        a, b, r = out[row[c, 0]], out[row[c, 1]], arm[c]
        a[0] -= x
        a[1] -= y
        a[2] -= z
        a[3] -= r[1] * z - r[2] * y
        a[4] -= r[2] * x - r[0] * z
        a[5] -= r[0] * y - r[1] * x
        b[0] += x
        b[1] += y
        b[2] += z
        b[3] += r[4] * z - r[5] * y
        b[4] += r[5] * x - r[3] * z
        b[5] += r[3] * y - r[4] * x
    return out


def sum_rows(row: Ints, values: Floats, count: int) -> Floats:
    """Sums (count, 6) of the values (n, 6) of equal row."""
    sums = np.empty((count, values.shape[1]))  # of no rows bincount makes integers
    for k, column in enumerate(values.T):
        sums[:, k] = np.bincount(row, column, minlength=count)
    return sums


def scaled(root: Floats, values: Floats) -> Floats:
    """M^-1/2 times the values (n, 6), with its rows (n, 6) or (n, 12) as in `ScaledMap`."""
    if root.shape[1] == 6:
        return root * values
    return np.einsum("nbij,nbj->nbi", root.reshape(-1, 2, 6)[:, :, SYMMETRIC], values.reshape(-1, 2, 3)).reshape(-1, 6)
