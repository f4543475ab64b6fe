"""Surfaces that move along themselves while their bodies stay: belts.

The velocity s of the surface of body b relative to body b, less that of body a, is added to the tangential velocity of
a contact. So friction acts against the sliding along the belt.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from dem import checks, quaternion
from dem.arrays import Floats
from dem.model.world import World
from dem.scene import LargeBody
from dem.together import together

if TYPE_CHECKING:
    from dem.contact import Contacts


def surface_velocities(world: World, contacts: Contacts, frame: Floats) -> Floats | None:
    """Of contacts with frames (nc, 3, 3), the tangential velocities (nc, 2) of the surface of b relative to that of a
    that their bodies do not have [m/s]; None if no surface moves. Collective; SceneError if a function fails."""
    moving = [row for row, body in enumerate(world.large_bodies) if body.surface is not None]
    if not moving:
        return None
    near, slip = contacts.near, np.zeros((len(contacts), 2))
    for row in moving:
        body = world.large_bodies[row]
        for rows, outward in ((contacts.a, 1.0), (contacts.b, -1.0)):  # a normal leads from a to b
            here = np.flatnonzero(rows == near.grains + near.ghosts + row)
            place, turn = world.large.position[row], world.large.quaternion[row]
            if contacts.moved is not None and outward < 0.0:
                place = place + contacts.moved[here]
            pose = contacts.point[here] - place, outward * contacts.normal[here], turn
            found = together(world.comm, f"surface velocity of {body.name!r}", partial(_velocity, body, *pose))
            slip[here] -= outward * np.einsum("cij,cj->ci", frame[here, 1:], found)
    return slip


def _velocity(body: LargeBody, arm: Floats, normal: Floats, turn: Floats) -> Floats:
    """Velocities (n, 3) of the surface of a body in the world, at points with `arm` (n, 3) from its position."""
    given: Any = body.surface
    if callable(given):
        back = quaternion.conjugate(turn)
        given = given(quaternion.rotate(back, arm), quaternion.rotate(back, normal))
    return quaternion.rotate(turn, checks.rows(f"surface velocity of {body.name!r}", given, len(arm), 3))
