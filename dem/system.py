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
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem import bodies
from dem.arrays import Floats, Ints
from dem.bodies import Bodies
from dem.checks import positive
from dem.contact import Contacts
from dem.exchange import exchange
from dem.free_motion import free_directions, free_velocities, project
from dem.quaternion import cross

if TYPE_CHECKING:
    from dem.world import World


class BlockRows(NamedTuple):
    """Local block rows of a distributed matrix in block-CSR form, one 3 x 6 block per contact and body."""

    indptr: Ints  #: (nc + 1,) where the blocks of each local contact start
    indices: Ints  #: (nb,) global body indices, ascending within a contact
    data: Floats  #: (nb, 3, 6)


class ContactSystem:
    """The contact problem of one step on this rank. Members that are collective say so.

    Attributes, of nc local contacts and of the bodies whose rows this rank owns (`World.owned`):
        dt (float): step [s]
        key (nc,), mu (nc,), point (nc, 3): contact key, friction coefficient, contact point [m]
        frame (nc, 3, 3): rows normal (from a to b), t1, t2
        b (nc, 3): (max(gap / dt, -recovery_speed), 0, 0) [m/s]
        r (nc, 3): b + D' v_free [m/s]
        free_velocity (owned, 6): velocities without contacts
        local_contacts, owned_bodies, total_bodies (int): sizes
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
        self.local_contacts = len(contacts)
        self.owned_bodies, self.total_bodies = world.owned, world.body_count
        self._comm, self._slabs, self._large_row = world.comm, world.slabs, world.large_row
        self._near = near

        # The two bodies of each contact in the order of their columns: rows of the table, and -1 for a, +1
        # for b.
        order = np.argsort(contacts.body, axis=1)
        self._body = np.take_along_axis(contacts.body, order, axis=1)
        self._row = np.take_along_axis(np.stack([contacts.a, contacts.b], axis=1), order, axis=1)
        self._sign = 2.0 * order - 1.0

        grains = near.grains + near.ghosts
        self._free_directions = free_directions(world.large_bodies)
        free = free_velocities(world, near, dt)
        owned_large = slice(grains, grains + world.owned - near.grains)
        self.free_velocity = np.concatenate([free[: near.grains], free[owned_large]])
        self.b = np.zeros((len(contacts), 3))
        self.b[:, 0] = np.maximum(contacts.gap / dt, -recovery_speed)
        self.r = self.b + self._relative_velocity(free)

    @cached_property
    def G(self) -> BlockRows:
        """Mass-scaled map D' M^-1/2, local block rows; bodies of prescribed motion have no blocks.

        M^-1/2 of a body is diag(m^-1/2 E, I^-1/2), with the symmetric root of the inertia tensor; of a guided
        body diag(m^-1/2 d d', 0).
        """
        table, row = self._near.bodies, self._row
        blocks = self._blocks()
        blocks[..., :3] /= np.sqrt(table.mass)[row][:, :, None, None]
        blocks[..., 3:] = blocks[..., 3:] @ bodies.inverse_root_inertia(table)[row]
        first_large = len(table) - len(self._free_directions)
        large = row >= first_large
        blocks[large, :, :3] = blocks[large, :, :3] @ self._free_directions[row[large] - first_large]
        dynamic = bodies.is_dynamic(table)[row]
        indptr = np.concatenate([[0], np.cumsum(dynamic.sum(axis=1))])
        return BlockRows(indptr, self._body[dynamic], blocks[dynamic])

    @cached_property
    def D(self) -> PETSc.Mat:
        """The map of impulses to generalised forces, MPIAIJ (6 M x 3 Nc), of all bodies; collective. `destroy` frees
        it."""
        # A scalar row of D' has the entries of the first body, then those of the second: no row is
        # off-process.
        entries = self._blocks().transpose(0, 2, 1, 3)
        columns = np.broadcast_to(6 * self._body[:, None, :, None] + np.arange(6), entries.shape)
        indptr = 12 * np.arange(3 * self.local_contacts + 1)
        transposed = PETSc.Mat().createAIJ(
            ((3 * self.local_contacts, None), (6 * self.owned_bodies, None)),
            csr=(indptr.astype(PETSc.IntType), columns.astype(PETSc.IntType).ravel(), entries.ravel()),
            comm=self._comm,
        )
        mat = transposed.transpose(PETSc.Mat())
        transposed.destroy()
        return mat

    def destroy(self) -> None:
        """Free the matrix D, if it was asked for: PETSc keeps what is spread over ranks until it is told."""
        if "D" in self.__dict__:
            self.__dict__.pop("D").destroy()

    def velocity(self, impulse: Floats) -> Floats:
        """Velocities (owned, 6) after the step, v_free + M^-1 D g, for impulses (nc, 3); collective."""
        near = self._near
        load, large_load = self.generalised_impulse(impulse)
        grains, large = (
            near.bodies.take(slice(0, near.grains)),
            near.bodies.take(slice(near.grains + near.ghosts, None)),
        )
        change = np.concatenate([_accelerate(grains, load), _accelerate(large, large_load)])
        change[near.grains :, :3] = project(self._free_directions, change[near.grains :, :3])
        return self.free_velocity + change[: self.owned_bodies]  # only the last rank owns the large bodies

    def force_on(self, name: str, impulse: Floats) -> Floats:
        """Contact force and torque (6,) [N, N m] on a large body, about its reference point, averaged over
        the step, from the impulses (nc, 3) of all ranks; collective. KeyError if there is no such body."""
        row = self._large_row(name)
        return self.generalised_impulse(impulse)[1][row] / self.dt

    def _arm(self, side: int) -> Floats:
        """Vectors (nc, 3) from the centre of one of the two bodies to the contact point."""
        return self.point - self._near.bodies.position[self._row[:, side]]

    def _blocks(self) -> Floats:
        """Blocks (nc, 2, 3, 6) of D': rows of the frame, and their moments about the centres of the two
        bodies."""
        blocks = np.empty((self.local_contacts, 2, 3, 6))
        for side in (0, 1):
            direction = self._sign[:, side, None, None] * self.frame
            blocks[:, side, :, :3] = direction
            blocks[:, side, :, 3:] = cross(self._arm(side)[:, None, :], direction)
        return blocks

    def _relative_velocity(self, velocity: Floats) -> Floats:
        """D' v (nc, 3) for velocities (rows of the table, 6)."""
        relative = np.zeros((self.local_contacts, 3))
        for side in (0, 1):
            moving = velocity[self._row[:, side]]
            at_point = moving[:, :3] + cross(moving[:, 3:], self._arm(side))
            relative += self._sign[:, side, None] * at_point
        return (self.frame @ relative[:, :, None])[:, :, 0]

    def generalised_impulse(self, impulse: Floats) -> tuple[Floats, Floats]:
        """D g of the local grains (grains, 6), and of the large bodies (large, 6), the same on all ranks, from
        the impulses (nc, 3) of all ranks [N s, N m s]; collective."""
        near, count = self._near, len(self._near.bodies)
        push = (impulse[:, None, :] @ self.frame)[:, 0]
        load = np.zeros((count, 6))
        for side in (0, 1):
            row, force = self._row[:, side], self._sign[:, side, None] * push
            load[:, :3] += _sum_rows(row, force, count)
            load[:, 3:] += _sum_rows(row, cross(self._arm(side), force), count)
        ghosts = slice(near.grains, near.grains + near.ghosts)
        index = near.index[ghosts]
        owner = np.searchsorted(self._slabs, index, side="right") - 1
        home = exchange(self._comm, {"row": index - self._slabs[owner], "load": load[ghosts]}, owner)
        local = load[: near.grains] + _sum_rows(home["row"], home["load"], near.grains)
        large = load[ghosts.stop :].copy()
        self._comm.Allreduce(MPI.IN_PLACE, large)
        return local, large


def contact_frames(normal: Floats) -> Floats:
    """Orthonormal right-handed frames (nc, 3, 3), rows n, t1, t2, of unit normals (nc, 3).

    Duff et al. (2017), "Building an Orthonormal Basis, Revisited": a function of the normal alone, continuous
    but where the sign of its z component changes.
    """
    x, y, z = normal.T
    sign = np.copysign(1.0, z)
    p = -1.0 / (sign + z)
    q = x * y * p
    frame = np.empty((len(normal), 3, 3))
    frame[:, 0] = normal
    frame[:, 1, 0], frame[:, 1, 1], frame[:, 1, 2] = 1.0 + sign * x * x * p, sign * q, -sign * x
    frame[:, 2, 0], frame[:, 2, 1], frame[:, 2, 2] = q, sign + y * y * p, -y
    return frame


def _accelerate(table: Bodies, load: Floats) -> Floats:
    """M^-1 times impulses and angular impulses (n, 6)."""
    angular = (bodies.inverse_inertia(table) @ load[:, 3:, None])[:, :, 0]
    return np.hstack([load[:, :3] / table.mass[:, None], angular])


def _sum_rows(row: Ints, values: Floats, count: int) -> Floats:
    """Sums (count, 3 or 6) of the values (n, 3 or 6) of equal row."""
    return np.stack([np.bincount(row, column, minlength=count) for column in values.T], axis=1)
