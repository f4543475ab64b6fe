"""Moments with which contacts resist the turning of their bodies against each other.

Moments are measured in force times a length of each contact, and turning velocities in that length times an angular
velocity: so all numbers of a contact have the same units and about the same size, and the residual of a solver means
the same for moments as for forces.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dem.arrays import Floats
from dem.contact_map import ContactMap, TurningMap
from dem.model.world import World
from dem.parts.laws import ContactState

if TYPE_CHECKING:
    from dem.contact import Contacts


class Resistance(NamedTuple):
    """Of the contacts of a step: the map with their rows of turning, and what resists there."""

    map: TurningMap
    length: Floats  #: (nc,) [m]
    most: tuple[Floats, Floats]  #: (nc,) each: moments about tangents and normals over normal forces and lengths
    velocity: Floats  #: (nc, 3) lengths times angular velocities without impulses [m/s]


def resistance(
    world: World, contacts: Contacts, met: ContactState | None, known: ContactMap, frame: Floats, free: Floats
) -> Resistance | None:
    """Of contacts, as laws have met them, with their map without turning, frames (nc, 3, 3), and the free velocities
    (rows, 6) of all bodies in the rows of `near`; None, on all ranks, in a world without resistance."""
    if met is None or (moments := world.pairs.moments(met)) is None:
        return None
    table, a, b = contacts.near.bodies, contacts.a, contacts.b
    turns = (1.0 / table.inertia[a] + 1.0 / table.inertia[b]).mean(axis=1)
    length = np.sqrt(np.divide(met.mobility, turns, out=np.ones(len(a)), where=(turns > 0.0) & (met.mobility > 0.0)))
    turn = (frame * length[:, None, None]).reshape(-1, 9)
    G = TurningMap(known.comm, known.source, turn, known.halo, known.body, mass=known.mass)
    tangents, normals = (values / length for values in moments)
    return Resistance(G, length, (tangents, normals), G.turning(free))
