"""What the laws of contact see of the contacts of a step."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from dem import bodies
from dem.arrays import Floats
from dem.bodies import COMPOUND
from dem.model.world import World
from dem.parts.laws import ContactState

if TYPE_CHECKING:
    from dem.contact import Contacts


def contact_state(world: World, contacts: Contacts, dt: float, slip: Floats) -> ContactState:
    """The contacts of a step of dt [s] that slip (nc, 2) along their surfaces [m/s]."""
    table, a, b = contacts.near.bodies, contacts.a, contacts.b
    with np.errstate(divide="ignore"):  # of two large bodies, which are flat: inf
        curvature = 1.0 / np.where(table.shape == COMPOUND, np.inf, bodies.least_half_thickness(table))
        radius = 2.0 / (curvature[a] + curvature[b])
    mobility = 1.0 / table.mass[a] + 1.0 / table.mass[b]
    return ContactState(dt, (table.material[a], table.material[b]), contacts.gap, radius, mobility, np.hypot(*slip.T))


def along_normal(size: Floats) -> Floats:
    """Impulses (nc, 3) of these sizes (nc,) along the normals."""
    out = np.zeros((len(size), 3))
    out[:, 0] = size
    return out


def slowest(world: World, contacts: Contacts, dt: float, closing: Floats, forced: Floats) -> Floats:
    """The speeds (nc,) with which bodies come that rest [m/s], as others on them may press them: those of a fall of one
    step, or what forces add in the step to the velocity of one of the two, `forced` (rows, 3), or to the speed with
    which the contact closes, `closing` (nc,). Such bodies do not bounce."""
    push = np.sqrt(np.einsum("ri,ri->r", forced, forced))
    of_one = np.maximum(push[contacts.a], push[contacts.b])
    return np.maximum(np.maximum(closing, of_one), dt * math.hypot(*world.gravity))
