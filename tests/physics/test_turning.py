"""Capsules and boxes whose tips move by a part of their radius in a step do not run into each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drive import RADIUS, spinning
from mpi4py import MPI
from several_ranks import alone

from dem import quaternion
from dem.contact import find_contacts
from dem.record.energies import energy
from dem.scene import Scene
from dem.shapes import Plane
from dem.start import new_world
from dem.step import advanced, missed
from dem.step.missed import find_turned
from dem.unconstrained import unconstrained
from pctt.simulation import Simulation

DT, DELTA = 0.01, 0.1 * RADIUS


def simulation_of(scene):
    return Simulation(scene, dt=DT, delta=DELTA, solver="apgd", tol=1e-6, comm=MPI.COMM_SELF)


@pytest.mark.parametrize("shape", ["capsules", "boxes"])
@pytest.mark.parametrize("seed", [0, 1])
def test_spinning_grains_do_not_run_into_each_other(shape, seed):
    """Without a correction capsules overlap by up to .05 of the radius, boxes by .15 of the least half extent.
    With it: by .01 and .06; with the relaxation, in which what slides opens, all by less than .01."""
    sim = simulation_of(spinning(shape, 1 / 3, seed))
    kinetic, _ = energy(sim.world.grains, sim.world.gravity)
    for _ in range(40):
        assert sim.step()["converged"]
        assert sim.contacts.gap.min(initial=0.0) > -0.1 * RADIUS
        now, _ = energy(sim.world.grains, sim.world.gravity)
        assert now < (1 + 1e-5) * kinetic  # angular momentum is kept exactly, so energy is not
        kinetic = now


@pytest.mark.parametrize("angle", [0.2, 0.4])
def test_a_lever_stops_with_its_tip_on_the_floor(angle):
    """A box tips about an edge that rests on the floor, and would turn in the step by `angle`, half of it beneath the
    floor. Its corners go along circles: with the gaps of the start alone they end beneath the floor at 0.4."""
    length, lean, thick = 10 * RADIUS, 0.5 * angle, 0.1 * RADIUS
    axis, up = np.array([np.cos(lean), 0, np.sin(lean)]), np.array([-np.sin(lean), 0, np.cos(lean)])
    middle = 0.5 * length * axis + thick * up + [0, 0, 1e-9]
    spin = np.array([0.0, angle / DT, 0.0])
    scene = Scene(0.0, gravity=(0, 0, 0))
    scene.add_body("floor", [Plane((0, 0, 1))])
    turn = (np.cos(lean / 2), 0, -np.sin(lean / 2), 0)
    motion = {"quaternions": turn, "velocity": np.cross(spin, middle), "angular_velocity": spin}
    scene.add_boxes(middle, (0.5 * length, RADIUS, thick), 1000.0, **motion)
    sim = simulation_of(scene)
    sim.step()
    sim.step()  # whose contacts are those of the end of the first
    assert sim.contacts.gap.min() > -0.1 * DELTA - 1e-6


def test_bodies_that_keep_apart_are_left_alone():
    """Far from each other, or turning less than the overlap that is allowed, or spheres."""
    world = new_world(spinning("boxes", 1 / 3), MPI.COMM_SELF)
    free, velocity = unconstrained(world, DT), np.concatenate([world.grains.velocity, np.zeros((1, 6))])
    contacts = find_contacts(world, DELTA, free)
    assert find_turned(world, free, contacts, velocity, 0.01 * RADIUS, np.inf, 0) is None
    assert find_turned(world, free, contacts, 100 * velocity, 100 * RADIUS, np.inf, 0) is None
    assert world.step == 0
    assert find_turned(world, free, contacts, np.nan * velocity, 0.01 * RADIUS, np.inf, 0) is None


def test_what_springs_bear_is_no_reason_to_solve_a_step_again():
    """Capsules that turn on a soft, smooth floor have sunk into it by more than the overlap that is let pass."""
    scene = Scene(0.0, stiffness=3e6)
    scene.add_body("floor", [Plane((0, 0, 1))])
    lying = (np.sqrt(0.5), 0, np.sqrt(0.5), 0)
    scene.add_capsules((0, 0, RADIUS), RADIUS, 2 * RADIUS, 1000.0, quaternions=lying, angular_velocity=(0, 0, 5))
    sim = simulation_of(scene)
    sim.run(steps=40)
    world, depth = sim.world, 1e-5 * RADIUS
    free, velocity = unconstrained(world, DT), np.concatenate([world.grains.velocity, np.zeros((1, 6))])
    contacts = find_contacts(world, DELTA, free)
    assert contacts.gap.max() < -10.0 * depth
    assert find_turned(world, free, contacts, velocity, depth, np.inf, 0) is None
    wide = replace(contacts, linear=contacts.gap + 20.0 * depth)  # by which the step would not have seen it
    assert len(find_turned(world, free, wide, velocity, depth, np.inf, 0)) == 2


def test_the_gap_at_the_start_leads_to_that_of_the_end():
    """With velocities that send grains into each other: gap + dt times normal velocity is the gap of the end."""
    world, contacts, velocity, found = found_of(MPI.COMM_SELF)
    end = find_contacts(advanced(world, unconstrained(world, DT), contacts, velocity), 0.0)
    new = found.take(np.isin(found.key, end.key) & ~np.isin(found.key, contacts.key))
    assert len(new) > 0
    assert set(contacts.key) <= set(found.key)
    moves = np.concatenate([velocity[:27], np.zeros((1, 6))])
    place = found.near.bodies.position
    at_point = [moves[row, :3] + np.cross(moves[row, 3:], new.point - place[row]) for row in (new.a, new.b)]
    change = DT * np.einsum("ci,ci->c", new.normal, at_point[1] - at_point[0])
    gap = dict(zip(end.key, end.gap))
    np.testing.assert_allclose(new.linear_gap + change, [gap[key] for key in new.key], atol=1e-12)


def boxes_that_hit(**given):
    """Two boxes that tumble towards each other and hit in the second step, in radii and steps."""
    scene = Scene(0.5, (0, 0, 0))
    place = [(0, 0, 0), (-0.4554, -0.6976, -0.6831)]
    turn = [(0.182, 0.889, 0.371, -0.198), (-0.0572, 0.2836, -0.9403, 0.179)]
    way = [(0.0349, 0.0154, -0.0485), (-0.0311, 0.0002, 0.0523)]
    spin = [(0.0002, -0.0029, 0.0066), (0.0043, -0.0169, 0.0103)]
    scene.add_boxes(
        place, (0.340, 0.381, 0.418), 1000.0, quaternions=turn, velocity=way, angular_velocity=spin
    )  # fmt: skip
    return Simulation(scene, dt=1.0, delta=0.02, comm=MPI.COMM_SELF, **given)


def test_bodies_overlap_by_no_more_than_they_do():
    """A contact that is linearised at the end of the step may start from a linear gap far beneath zero."""
    sim = boxes_that_hit()
    linear = []
    for _ in range(4):
        assert sim.step()["worst_overlap"] < 0.01
        linear.append(sim.last.contacts.linear_gap.min(initial=0.0))
    assert min(linear) < -0.05


def test_a_second_linearisation_of_another_direction_or_point_stands_beside_the_first():
    """What turns between two features would be linearised to and fro, and overlap in the end."""
    sim = boxes_that_hit()
    sim.step()
    world, depth = sim.world, 1e-3
    velocity = world.grains.velocity
    free = unconstrained(world, 1.0)
    first = find_turned(world, free, find_contacts(world, 0.02, free), velocity, depth, np.inf, 0)
    assert find_turned(world, free, first, velocity, depth, np.inf, 1) is None  # they foresee how deep these end
    first = replace(first, linear=first.linear_gap + 100.0 * depth)  # now they do not
    for angle, stands in ((0.01, False), (0.4, True)):
        turn = quaternion.exponential(angle * np.eye(3)[:1])
        turned = replace(first, normal=quaternion.rotate(np.repeat(turn, len(first), axis=0), first.normal))
        again = find_turned(world, free, turned, velocity, depth, np.inf, 1)
        assert set(turned.key) <= set(again.key)
        assert (len(again) > len(turned)) == stands
        assert len(set(again.key)) == len(again)
        assert len(find_turned(world, free, turned, velocity, depth, np.inf, 0)) == len(turned)
    for way, stands in ((5.0, False), (20.0, True)):
        moved = replace(first, point=first.point + way * depth * np.eye(3)[1])
        assert (len(find_turned(world, free, moved, velocity, depth, np.inf, 1)) > len(first)) == stands


def found_of(comm):
    """A world, its contacts, velocities (owned, 6) with which its capsules turn and fly into each other, and what is
    found then."""
    world = new_world(spinning("capsules", 2.0, pitch=2.02), comm)
    world.grains.velocity *= [12, 12, 12, 1, 1, 1]
    velocity = np.concatenate([world.grains.velocity, np.zeros((world.owned - len(world.grains), 6))])
    free = unconstrained(world, DT)
    contacts = find_contacts(world, DELTA, free)
    found = find_turned(world, free, contacts, velocity, 0.01 * RADIUS, np.inf, 0)
    return world, contacts, velocity, found


def table_of(comm):
    """Keys, gaps and points of what is found, of all ranks, by key."""
    _, _, _, found = found_of(comm)
    key, gap, point = (np.concatenate(comm.allgather(values)) for values in (found.key, found.gap, found.point))
    order = np.argsort(key)
    return key[order], gap[order], point[order]


@pytest.mark.parallel(2, 3)
def test_what_is_found_does_not_depend_on_the_number_of_ranks(ranks):
    for here, there in zip(table_of(MPI.COMM_WORLD), alone(table_of)):
        np.testing.assert_allclose(here, there, atol=1e-12, err_msg=f"{ranks} ranks")


def test_only_contacts_of_bodies_that_turn_are_looked_for_again(monkeypatch):
    """Of sixteen stacks of two boxes one top box spins on the other."""
    places = np.indices((4, 4)).reshape(2, -1).T
    low, high = (np.column_stack([0.5 * places, np.full(16, z)]) for z in (0.1, 0.3))
    scene, spin = Scene(friction=0.3), np.zeros((16, 3))
    scene.add_body("floor", [Plane((0, 0, 1))])
    spin[5] = 0, 0, 4.0
    scene.add_boxes(low, (0.1, 0.1, 0.1), 1e3)
    scene.add_boxes(high, (0.1, 0.1, 0.1), 1e3, angular_velocity=spin)
    search, bodies = missed.find_contacts, []

    def watched(*given, **named):
        found = search(*given, **named)
        if "among" in named:
            bodies.extend(found.near.bodies.id[found.a])
            bodies.extend(found.near.bodies.id[found.b])
        return found

    monkeypatch.setattr(missed, "find_contacts", watched)
    Simulation(scene, dt=0.005, comm=MPI.COMM_SELF).run(steps=4)
    assert set(bodies) == {5, 16 + 5}
