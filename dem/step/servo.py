"""The stress of a periodic cell, and the rates with which its periods follow what is asked.

The cell changes its size by an affine deformation: with the rate E (3,) of its periods the centre of a grain goes by
dt (v + E x) in a step. So the velocity v of a grain is that beside the motion of the cell, and the relative velocity of
a contact with the way l from centre to centre has the part E l. The impulses g do the work -g E l on it, which is -dt
times the volume times stress times E.

Along an axis of given stress the cell yields to what its stress lacks, as a piston that a viscous fluid brakes,

    E = E0 + (stress of the contacts + stress of the motion - asked) / eta,

the law of the wall of da Cruz et al., Physical Review E 72 (2005) 021309, but for E0. Here E is an unknown of the step
beside the velocities of the bodies (`dem.contact_map.mass`), with the stress of the contacts over that step. So any eta
is stable, whatever dt and the stiffness of the contacts. A cell without contacts closes at asked / eta: CLOSING as an
inertial number, and LEADING times the rates of shear and strain that it is given, as a flow dilates by some tenths of
these. Where the cell has to go on at a rate E, its stress is off by eta (E - E0). So E0 is the
part KEPT of the last E, up to the rates that are given; without these it is zero.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dem import bodies
from dem.arrays import Floats
from dem.contact_map.mass import CellStep
from dem.model.world import World

if TYPE_CHECKING:
    from dem.contact import Contacts

CLOSING = 0.01  #: rate times d sqrt(rho / P): a loose cell closes in quasistatic motion
LEADING = 5.0
KEPT = 0.9


def cell_stress(world: World, contacts: Contacts, force: Floats) -> Floats:
    """Stress (3, 3) of a cell with three periods after a step, of the forces (nc, 3) [N] of its contacts (Love, Weber)
    and of the motion of the grains beside that of the cell, positive in compression [Pa]; collective."""
    borne = world.comm.allreduce(force.T @ contacts.branch(contacts.near.bodies.position))
    stress: Floats = borne / world.cell.volume + _motion(world)[0]
    return stress


def _motion(world: World) -> tuple[Floats, float]:
    """The stress (3, 3) of the motion of the grains [Pa], and the time d sqrt(rho) of their mean diameter and mass
    [s sqrt(Pa)]; collective."""
    grains = world.grains
    speed = world.cell.beside_flow(grains.position, grains.velocity[:, :3])
    sums = np.zeros((5, 3))
    sums[:3], sums[3] = (speed.T * grains.mass) @ speed, grains.mass @ speed
    sums[4, :2] = grains.mass.sum(), 2.0 * bodies.bounding_radius(grains).sum()
    sums = world.comm.allreduce(sums)
    mass, size = sums[4, :2] / world.slabs[-1]
    stress = (sums[:3] - np.outer(sums[3], sums[3]) / sums[4, 0]) / world.cell.volume
    return stress, float(np.sqrt(6.0 / np.pi * mass / size))


def cell_of(world: World, dt: float) -> CellStep | None:
    """How the cell takes part in a step; None where its size is constant; collective."""
    cell = world.cell
    if not cell.deforms:
        return None
    # rates at which periods are to grow; NaN: what the asked stress needs, or none
    given = -cell.strain_rate if world.time >= cell.start - 1e-6 * dt else np.full(3, np.nan)
    follows = np.isnan(given) & ~np.isnan(cell.stress)
    asked = np.where(follows, cell.stress, 0.0)
    stress, time = _motion(world)
    leads = abs(cell.shear_rate) + float(np.abs(np.nan_to_num(given)).max())
    fastest = CLOSING * np.sqrt(asked.max()) / time + LEADING * leads
    eta = np.where(follows, asked / max(fastest, 1e-300), 1.0)
    root = np.where(follows, 1.0 / np.sqrt(eta * dt * cell.volume), 0.0)
    kept = np.clip(KEPT * cell.rate, -leads, leads)
    free = np.where(follows, kept + (np.diag(stress) - asked) / eta, np.nan_to_num(given))
    return CellStep(root, free)
