"""What contacts bear until a body lands within a step.

A step solves all contacts at once. Where a body lands on a second support and leaves the first one, as a block that
rocks from edge to edge, the second would bear its weight from the start of the step, and the first none of it: a loss
of speed of first order in the step. Velocities are those of the middle between two steps, so an impact at the time
s dt comes (1/2 + s) dt after those before. Until then contacts go on to bear what they bore in the last step, 1/2 + s
times that: what is more than once of it they bear in the next step, in which they are open. The step finds what they
bear beside that. What stopped the body in the last step, beside what the forces on it press, they do not bear again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.bodies import BOX, CONVEX, POLYHEDRON
from dem.compiled import loop
from dem.exchange import on_any
from dem.model.world import World
from dem.quaternion import length
from dem.shapes import Capsule, Convex, Sphere

if TYPE_CHECKING:
    from dem.contact import Contacts
    from dem.contact_map import ContactMap
    from dem.model.neighbourhood import Neighbourhood

LEFT = 0.01  #: of what a contact bears before, which it bears beside that where it opens


class Landing(NamedTuple):
    """What contacts with bodies that forces do not move bear until others of the same body close."""

    before: Floats  #: (nc, 3) in this step [N s]
    after: Floats  #: (nc, 3) in the next one, if they open [N s]
    lands: Bools  #: (nc,) contacts that close

    def rest(self, impulse: Floats, body: np.ndarray, rows: int) -> Floats:
        """What contacts bear in the next step (nc, 3) that have opened, where `impulse` (nc, 3) are those beside
        `before` and `body` (nc, 2) the bodies, in so many rows."""
        landed = np.zeros(rows, np.bool_)
        landed[body[self.lands & (impulse[:, 0] > 0.0)]] = True
        left = landed[body].any(axis=1) & (impulse[:, 0] <= LEFT * self.before[:, 0])
        return np.where(left[:, None], self.after, 0.0)


def landing(
    world: World, contacts: Contacts, contact_map: ContactMap, free: Floats, freely: Floats, last: Floats, dt: float
) -> Landing | None:
    """Find what contacts bear until bodies land; None if none bears any that may. Bodies have the velocities `free`
    (rows, 6) without contacts, contacts `freely` (nc, 3) [m/s], and `last` (nc, 3) are the impulses of the last step;
    collective. Contacts of bodies that are round somewhere go from place to place without impacts: they are left out.
    """
    if world.only_spheres and not world.large_moves:
        return None
    table, gap = contacts.near.bodies, contacts.linear_gap
    if not on_any(contact_map.comm, _any_closes(gap, freely, last, dt))[0]:
        return None
    push = length(free[:, :3] - table.velocity[:, :3])
    corners = _with_corners(world, contacts.near)
    body, share = _bearing(contacts.a, contacts.b, (table.mass, push), corners, gap, freely, last, dt)
    if not on_any(contact_map.comm, bool(share.any()))[0]:
        return None
    whole = share[:, None] * last
    speed = -dt * (freely[:, 0] + contact_map.velocities(contact_map.momenta(whole))[:, 0])
    lands = (body >= 0) & (last[:, 0] == 0.0) & (gap > 0.0) & (speed > gap)
    time = np.full(len(table.mass), np.inf)
    np.minimum.at(time, body[lands], gap[lands] / speed[lands])
    part = np.where(time < 1.0, 0.5 + time, 0.0)[body][:, None]
    return Landing(whole * np.minimum(part, 1.0), whole * np.maximum(part - 1.0, 0.0), lands)


def _with_corners(world: World, near: Neighbourhood) -> Bools:
    """Which bodies (rows,) are round nowhere."""
    shape, first = near.bodies.shape, near.grains + near.ghosts
    corners = (shape == BOX) | ((shape >= POLYHEDRON) & (shape < CONVEX))
    round_parts = Sphere, Capsule, Convex
    corners[first:] = [not any(isinstance(part, round_parts) for part in large.shapes) for large in world.large_bodies]
    return corners


@loop
def _any_closes(gap: Floats, freely: Floats, last: Floats, dt: float) -> bool:
    """Whether a contact (nc,) may close in the step that bore nothing in the last one."""
    found = False
    for c in range(len(gap)):
        found |= last[c, 0] == 0.0 and gap[c] > 0.0 and gap[c] + dt * freely[c, 0] < 0.0
    return found


@loop
def _bearing(
    a: Ints, b: Ints, laws: tuple[Floats, Floats], corners: Bools, gap: Floats, freely: Floats, last: Floats, dt: float
) -> tuple[Ints, Floats]:
    """Of contacts (nc,) of a body with `corners` (rows,) and one that forces do not move, the row of the former, else
    -1; and the share (nc,) of what they bore in the last step that the forces on the body press, where another one of
    it may close in this one, else 0. Bodies have masses, and forces add to their speeds (rows,)."""
    mass, push = laws
    body, share = np.full(len(a), -1), np.zeros(len(a))
    lands, load = np.zeros(len(mass), np.bool_), np.zeros(len(mass))
    for c in range(len(a)):
        one, other = np.isfinite(mass[a[c]]), np.isfinite(mass[b[c]])
        if one == other:
            continue
        n = a[c] if one else b[c]
        if not corners[n]:
            continue
        body[c] = n
        load[n] += last[c, 0]
        lands[n] |= last[c, 0] == 0.0 and gap[c] > 0.0 and gap[c] + dt * freely[c, 0] < 0.0
    for c in range(len(a)):
        n = body[c]
        if n >= 0 and lands[n] and last[c, 0] > 0.0:
            share[c] = min(1.0, mass[n] * push[n] / load[n])
    return body, share
