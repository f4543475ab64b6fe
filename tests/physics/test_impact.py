"""Two free spheres that meet, without gravity: inelastic, with momentum kept and friction bounded.

With the reduced mass m = 1/(1/m1 + 1/m2), a closing speed u and a sliding speed s before, a touching pair of
solid spheres has the contact velocities y_n = -u + p_n/m and y_t = s - 3.5 p_t/m. It sticks with p_n = m u,
p_t = m s / 3.5 where that is within the cone, and otherwise slides with p_t = mu p_n and y_n = mu y_t.
Normals are those of the end of the step, foreseen from the velocities before it.
"""

from __future__ import annotations

import numpy as np
import pytest
from drive import RADIUS, SOLVERS, make_steps, momentum
from mpi4py import MPI

import pctt
from dem import quaternion
from dem.contact.ahead import FURTHEST
from dem.scene import Scene
from dem.shapes import Clump, Cylinder, Superellipsoid
from dem.start import new_world

MASSES = [(1000.0, 1000.0), (500.0, 4000.0)]
RUBS = [(0.3, 0.0), (0.5, 1.0), (0.3, 1.9), (0.3, 4.0), (0.1, 2.0), (0.0, 1.0)]  #: friction coefficient, sliding speed


def pair(closing, sliding, densities, friction, gap=0.0, axis=(1.0, 0.0, 0.0)):
    """Two spheres along `axis`; the first one moves, away from the origin so that angular momentum counts."""
    normal = np.array(axis) / np.linalg.norm(axis)
    tangent = np.cross(normal, [0.3, -0.5, 0.8])
    tangent /= np.linalg.norm(tangent)
    scene = Scene(friction, gravity=(0, 0, 0))
    place = np.array([0.3, -0.2, 0.5])
    both = np.stack([place, place + (2 * RADIUS + gap) * normal])
    velocity = np.stack([closing * normal + sliding * tangent, np.zeros(3)])
    scene.add_spheres(both, RADIUS, densities, velocity=velocity)
    return new_world(scene, MPI.COMM_SELF), normal, tangent


def in_order(world):
    order = np.argsort(world.grains.id)
    return world.grains.mass[order], world.grains.velocity[order]


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_gap_is_closed_before_the_impulse_acts(solver):
    """Within one step the first sphere may come as near as the gap."""
    dt, gap = 0.01, 0.005
    world, normal, _ = pair(2.0, 0.0, (1000.0, 1000.0), 0.3, gap=gap)
    last = make_steps(world, 1, dt, solver)
    mass, velocity = in_order(world)
    assert (velocity[0, :3] - velocity[1, :3]) @ normal == pytest.approx(gap / dt, abs=1e-7)
    assert last.impulse[0, 0] == pytest.approx(mass[0] / 2 * (2.0 - gap / dt), rel=1e-7)
    last = make_steps(world, 1, dt, solver)
    assert last.contacts.gap[0] == pytest.approx(0.0, abs=1e-9)
    _, velocity = in_order(world)
    np.testing.assert_allclose(velocity[0], velocity[1], atol=1e-7)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("densities", MASSES)
@pytest.mark.parametrize(("friction", "sliding"), RUBS)
@pytest.mark.parametrize("axis", [(1, 0, 0), (1, 2, -3)])
def test_an_oblique_impact_sticks_or_slides_at_the_cone(solver, densities, friction, sliding, axis):
    closing = 2.0
    world, normal, tangent = pair(closing, sliding, densities, friction, axis=axis)
    before = momentum(world)
    foreseen = min(0.01, FURTHEST * RADIUS / np.hypot(closing, sliding))
    ahead = 2 * RADIUS * normal - foreseen * (closing * normal + sliding * tangent)
    last = make_steps(world, 1, 0.01, solver)
    mass, velocity = in_order(world)
    came = closing * normal + sliding * tangent
    normal = ahead / np.linalg.norm(ahead)
    np.testing.assert_allclose(last.contacts.normal[0], normal, atol=1e-12)
    closing = came @ normal + last.contacts.linear_gap[0] / -0.01
    sliding = np.linalg.norm(came - came @ normal * normal)
    tangent = (came - came @ normal * normal) / max(sliding, 1e-300)
    reduced = 1 / (1 / mass).sum()
    if sliding / 3.5 <= friction * closing:
        p_n, p_t = reduced * closing, reduced * sliding / 3.5
    else:
        p_n = reduced * (closing + friction * sliding) / (1 + 3.5 * friction**2)
        p_t = friction * p_n
    on_b = last.impulse_on_b()[0]
    np.testing.assert_allclose(on_b, p_n * normal + p_t * tangent, atol=1e-6 * reduced)
    np.testing.assert_allclose(velocity[1, :3], on_b / mass[1], atol=1e-9)
    spin = np.cross(normal, tangent) * -p_t * RADIUS / (0.4 * mass * RADIUS**2)[:, None]
    np.testing.assert_allclose(velocity[:, 3:], spin, atol=1e-5)
    assert np.hypot(*last.impulse[0, 1:]) <= friction * last.impulse[0, 0] * (1 + 1e-9)
    turned = np.concatenate([np.zeros(3), -np.cross(last.contacts.moved[0], on_b)])  # the bodies act at the end
    np.testing.assert_allclose(momentum(world), before + turned, atol=1e-12 * np.abs(before).max())


def angular_momentum(sim):
    grains = sim.local
    linear = grains.mass[:, None] * grains.velocity[:, :3]
    return (np.cross(grains.position, linear) + grains.inertia * grains.velocity[:, 3:]).sum(axis=0)[2]


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_a_pile_that_central_forces_press_together_keeps_its_angular_momentum(friction):
    """Thirteen spheres turn as a whole, held together by forces towards the origin. With normals of the end of a step
    they gained 7 % in half a second."""
    scene = Scene(friction, gravity=(0, 0, 0))
    sites = np.indices((3, 3, 3)).reshape(3, -1).T - 1.0
    place = 2 * 0.05 / np.sqrt(2) * sites[np.abs(sites).sum(axis=1) % 2 == 0]
    velocity = np.cross([0, 0, 2.0], place)
    scene.add_spheres(place, 0.05, 1000.0, velocity=velocity, angular_velocity=(0, 0, 2.0))
    scene.add_load("together", force=lambda time, table: -20.0 * table.mass[:, None] * table.position)
    with pctt.Simulation(scene, comm=MPI.COMM_SELF) as sim:
        before = angular_momentum(sim)
        sim.run(until=0.5)
        assert angular_momentum(sim) == pytest.approx(before, rel=1e-3)


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_a_pair_that_a_spring_presses_together_keeps_its_angular_momentum(friction):
    scene = Scene(friction, gravity=(0, 0, 0))
    velocity = [[0, -0.5, 0], [0, 0.5, 0]]
    ids = scene.add_spheres([[-0.1, 0, 0], [0.1, 0, 0]], 0.1, 1000.0, velocity=velocity, angular_velocity=(0, 0, 5.0))
    scene.add_spring("tie", *ids, stiffness=1e4, length=0.195)
    with pctt.Simulation(scene, comm=MPI.COMM_SELF) as sim:
        before = angular_momentum(sim)
        sim.run(until=0.25)
        assert angular_momentum(sim) == pytest.approx(before, rel=5e-4)


GRAINS = {
    "ellipsoids": lambda scene, place, **moves: scene.add_grains(
        place, Superellipsoid((0.15, 0.1, 0.08)), 1000.0, **moves
    ),
    "capsules": lambda scene, place, **moves: scene.add_capsules(place, 0.06, 0.08, 1000.0, **moves),
    "cylinders": lambda scene, place, **moves: scene.add_grains(place, Cylinder(0.1, 0.15), 1000.0, **moves),
    "boxes": lambda scene, place, **moves: scene.add_boxes(place, (0.1, 0.07, 0.12), 1000.0, **moves),
    "clumps": lambda scene, place, **moves: scene.add_clumps(
        place, Clump([(0, 0, 0), (0.12, 0, 0)], [0.08, 0.06]), 1000.0, **moves
    ),
}


def whole_angular_momentum(sim):
    """About the origin, of grains of any shapes."""
    grains = sim.local
    turned = quaternion.rotate(quaternion.conjugate(grains.quaternion), grains.velocity[:, 3:])
    spin = quaternion.rotate(grains.quaternion, grains.inertia * turned)
    return (np.cross(grains.position, grains.mass[:, None] * grains.velocity[:, :3]) + spin).sum(axis=0)


@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("grains", GRAINS)
def test_impacts_of_grains_that_are_no_spheres_keep_the_angular_momentum(grains, friction):
    """Ways of a tenth of the size in a step: impulses on the places of the surfaces at the start, which are apart,
    would add 1 to 6 %. What is left is of bodies that are struck while they tumble."""
    rng, errors = np.random.default_rng(5), []
    for restitution in (0.0, 0.7):
        for _ in range(2):
            scene = Scene(friction, gravity=(0, 0, 0), restitution=restitution)
            for x in (-0.25, 0.25):
                place, turn = [x, *rng.uniform(-0.05, 0.05, 2)], rng.normal(size=4)
                spin = rng.normal(size=3)
                GRAINS[grains](scene, place, quaternions=turn, velocity=(-4 * x, 0, 0), angular_velocity=spin)
            with pctt.Simulation(scene, comm=MPI.COMM_SELF) as sim:
                before, size = whole_angular_momentum(sim), 0.1 * sim.local.mass.sum()
                sim.run(until=0.35)
                assert np.abs(sim.velocities[:, 0]).max() < 0.95  # they have met
                errors.append(np.linalg.norm(whole_angular_momentum(sim) - before) / size)
    assert np.mean(errors) < 4e-3


@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("grains", ["ellipsoids", "capsules", "cylinders"])
def test_round_grains_that_turn_on_each_other_keep_their_angular_momentum(grains, friction):
    """A spring presses two together, which slide as they turn. With arms to two places they gained 1 to 6 %."""
    scene = Scene(friction, gravity=(0, 0, 0))
    moves = {"velocity": [[0, -0.5, 0], [0, 0.5, 0]], "angular_velocity": [[0, 0, 0], [0, 0, 3.0]]}
    half = 0.15 if grains == "ellipsoids" else 0.06 if grains == "capsules" else 0.1
    GRAINS[grains](scene, [[-half, 0, 0], [half, 0, 0]], **moves)
    scene.add_spring("tie", 0, 1, stiffness=1e4, length=1.95 * half)
    with pctt.Simulation(scene, comm=MPI.COMM_SELF) as sim:
        before = whole_angular_momentum(sim)[2]
        sim.run(until=0.25)
        assert whole_angular_momentum(sim)[2] == pytest.approx(before, rel=1e-3)
