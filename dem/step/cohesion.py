"""Cohesion: a constant force c [N] with which bodies attract each other up to a range of their gap.

The impulses g of a contact are then in a friction cone that is shifted along its axis: h = g + (c dt, 0, 0) is in the
cone, so that g_n >= -c dt and |g_t| <= mu (g_n + c dt). In h the problem of a step is that without cohesion, with
N h + r - N (c dt, 0, 0) for N g + r: the free velocities of the bodies have what the attraction gives them. So all
solvers take it as it is; what they find, and what the memory keeps, is h. Springs of contacts bear h: bodies that rest
on each other overlap by c / k more.

Source: the shifted cone is that of contact dynamics: Radjai, Richefeu, "Contact dynamics as a nonsmooth discrete
element method", Mech. Mater. 41 (2009).
"""

from __future__ import annotations

import numpy as np

from dem.arrays import Floats
from dem.contact import Contacts
from dem.model.world import World


def attraction(world: World, contacts: Contacts, dt: float) -> Floats | None:
    """The attractive impulses c dt (nc,) of the contacts in a step [N s]; None, on all ranks, in a world without."""
    if not world.pairs.cohesion.any():
        return None
    material = contacts.near.bodies.material
    one, two = material[contacts.a], material[contacts.b]
    force, reach = world.pairs.cohesion[one, two], world.pairs.cohesion_range[one, two]
    return np.where(contacts.gap <= reach, dt * force, 0.0)


def along_normal(size: Floats) -> Floats:
    """Impulses (nc, 3) of these sizes (nc,) along the normals."""
    out = np.zeros((len(size), 3))
    out[:, 0] = size
    return out
