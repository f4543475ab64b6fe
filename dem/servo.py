"""The stress of a periodic cell, and the servo that brings it to what was asked.

The cell changes its size by an affine deformation: with the rate E (3,) of its periods the centre of a grain goes by
dt (v + E x) in a step. So the velocity v of a grain is that beside the motion of the cell, and the relative velocity of
a contact with the way l from centre to centre has the part E l, its drift (`Contacts.drift`). The impulses g do the
work -g E l on it, which is -dt times the volume times stress times E.

The rate follows from the stiffness of the cell. Where nothing gives way, a contact of compliance C takes the impulse
n E l / C, so equal rates along all axes raise the stress along axis k in a step by R_k times them, with
R_k = sum n_k l_k |l| / (C dt V) of the contacts that bear; a rate along one axis does less. The rate
(stress - asked) / (STEPS R_k) thus needs STEPS steps at least to take back an error, and is stable for each dt,
stiffness and number of grains. In a loose cell
grains give way: the stress over the last rate is then far less than R_k, and takes its place, with a factor of STEPS^2
to be safe.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dem import bodies
from dem.arrays import Floats
from dem.contact import Contacts
from dem.system import ContactSystem
from dem.world import World

STEPS = 2.0  #: in which a packing takes back an error of its stress, if it is elastic
#: The greatest rate, as an inertial number: rate times d sqrt(rho / P). A loose cell then closes in quasistatic motion.
FASTEST = 0.01


def cell_stress(world: World, contacts: Contacts, system: ContactSystem, impulse: Floats) -> Floats:
    """Stress (3, 3) of a cell with three periods after a step, of its contacts (Love, Weber) and of the motion of the
    grains beside that of the cell, positive in compression [Pa]; collective."""
    assert world.period is not None
    force = np.einsum("ci,cij->cj", impulse, system.frame) / system.dt
    grains = world.grains
    speed = grains.velocity[:, :3].copy()
    if world.shear is not None:
        speed[:, 0] -= world.shear.rate * grains.position[:, world.shear.axis]
    sums = np.zeros((8, 3))
    sums[:3] = force.T @ contacts.way(contacts.near.bodies.position)
    sums[3:6] = (speed.T * grains.mass) @ speed
    sums[6], sums[7] = grains.mass @ speed, grains.mass.sum()
    sums = world.comm.allreduce(sums)
    kinetic = sums[3:6] - np.outer(sums[6], sums[6]) / sums[7, 0]
    stress: Floats = (sums[:3] + kinetic) / world.period.prod()
    return stress


def follow_stress(world: World, contacts: Contacts, system: ContactSystem, impulse: Floats) -> None:
    """Set the rate of a cell with a servo for the next step, from the last one; collective."""
    servo = world.servo
    if servo is None or world.period is None:
        return
    stress = np.diag(cell_stress(world, contacts, system, impulse))
    soft = (impulse[:, 0] > 0.0) & (system.compliance > 0.0)
    way = contacts.way(contacts.near.bodies.position)[soft]
    along = way * system.frame[soft, 0]
    grains = world.grains
    sums = np.zeros((3, 3))
    sums[0] = (along * (along.sum(axis=1) / system.compliance[soft])[:, None]).sum(axis=0)
    sums[1], sums[2] = grains.mass.sum(), 2.0 * bodies.bounding_radius(grains).sum()
    sums = world.comm.allreduce(sums)
    response = np.maximum(sums[0], 0.0) / (system.dt * world.period.prod())
    asked = np.where(np.isnan(servo.asked), stress, servo.asked)
    mass, size = sums[1:, 0] / world.slabs[-1]
    fastest = FASTEST * np.sqrt(np.pi / 6.0 * size * np.nan_to_num(servo.asked).max() / mass)
    error = stress - asked
    last = np.abs(servo.rate)
    response = np.minimum(response, STEPS**2 * np.abs(stress) / np.maximum(last, 1e-300))
    slow = np.maximum(STEPS * response, np.abs(error) / max(fastest, 1e-300))
    world.servo = replace(servo, rate=error / np.maximum(slow, 1e-300))
