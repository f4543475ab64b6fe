"""Scenes and small tools that several tests use."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dem import quaternion
from dem.arrays import Floats
from dem.bodies import Bodies
from dem.contact import Contacts, find_contacts
from dem.model.world import World
from dem.motion import Dynamic, Oscillation, Rotation
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere
from dem.step import advance
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained


def force_on(world: World, system: ContactSystem, name: str, impulse: np.ndarray) -> np.ndarray:
    """Contact force and torque (6,) [N, N m] on a large body, from the impulses (nc, 3) of all ranks; collective."""
    return system.impulse_on_large(impulse)[world.large_row(name)] / system.dt


def random_quaternions(rng: np.random.Generator, count: int) -> Floats:
    return quaternion.normalized(rng.normal(size=(count, 4)))


def heap(
    seed: int = 0, side: int = 5, boxes: bool = True, large: bool = True, capsules: bool = False
) -> Scene:
    """A loose jittered lattice of spheres of three sizes, every seventh grain a small box, every other seventh a
    capsule, with spins and speeds, among walls, a turning blade, an oscillating ball and a free slab."""
    rng = np.random.default_rng(seed)
    scene = Scene(friction=0.3)
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    position = 0.25 * grid + 0.13 + rng.uniform(-0.02, 0.02, grid.shape)
    is_box = (grid @ [1, 2, 3] % 7 == 3) & boxes  # no two of them next to each other

    is_capsule = (grid @ [1, 2, 3] % 7 == 5) & capsules
    is_sphere = ~is_box & ~is_capsule

    def speeds(count: int) -> dict[str, Floats]:
        linear, angular = rng.normal(size=(count, 3)), 5.0 * rng.normal(size=(count, 3))
        return {"velocity": linear, "angular_velocity": angular}

    count = int(is_sphere.sum())
    radius = rng.choice([0.09, 0.1, 0.104], count)
    scene.add_spheres(position[is_sphere], radius, 1000.0, material="glass", **speeds(count))
    if boxes:
        count = int(is_box.sum())
        half = rng.uniform(0.04, 0.06, (count, 3))
        turns = random_quaternions(rng, count)
        scene.add_boxes(position[is_box], half, 700.0, quaternions=turns, material="wood", **speeds(count))
    if capsules:
        count = int(is_capsule.sum())
        radius, half_length = rng.uniform(0.03, 0.05, count), rng.uniform(0.03, 0.05, count)
        turns = random_quaternions(rng, count)
        scene.add_capsules(
            position[is_capsule], radius, half_length, 900.0, quaternions=turns, material="wood", **speeds(count)
        )
    if large:
        width = 0.25 * side + 0.01
        walls = [Plane((0, 0, 1)), Plane((1, 0, 0)), Plane((-1, 0, 0), (width, 0, 0)), Plane((0, 1, 0))]
        scene.add_body("walls", [*walls, Plane((0, -1, 0), (0, width, 0))], material="steel")
        scene.add_body(
            "blade",
            [Box((0.3, 0.02, 0.1)), Sphere(0.05, (0.3, 0, 0.1))],
            Rotation((0.0, 0.3, 1.0), (width / 2, 0, 0)),
            position=(width / 2, width + 0.05, 0.4),
        )
        scene.add_body(
            "ball", [Sphere(0.3)], Oscillation((1, 1, 0), 0.05, 0.5, 0.4), position=(-0.3, 0.4, 0.5)
        )
        scene.add_body(
            "slab",
            [Sphere(0.1, (x, y, 0)) for x in (0.2, min(0.9, width - 0.11)) for y in (0.3, min(0.8, width - 0.11))],
            Dynamic(),
            density=500.0,
            position=(0, 0, 0.25 * side + 0.12),
            velocity=(0.1, 0, -1.0),
            angular_velocity=(0.1, 0.2, 0.3),
        )
    scene.set_pair("wood", "steel", friction=0.6)
    scene.set_pair("glass", "steel", friction=0.1)
    return scene


def crude_impulse(system: ContactSystem) -> Floats:
    """One projected gradient step on the cones: no solution, but contacts push and rub, the same on any
    ranks."""
    impulse = -0.3 * system.r
    impulse[:, 0] = np.maximum(impulse[:, 0], 0.0)
    slip = np.linalg.norm(impulse[:, 1:], axis=1)
    impulse[:, 1:] *= np.minimum(1.0, system.mu * impulse[:, 0] / np.maximum(slip, 1e-300))[:, None]
    return impulse


def step(world: World, dt: float = 0.005, delta: float = 0.02) -> Contacts:
    contacts = find_contacts(world, delta)
    system = ContactSystem(world, contacts, unconstrained(world, dt), recovery_speed=0.5)
    advance(world, system.motion, system.contacts, system.velocity(crude_impulse(system)))
    return contacts


def grains_by_id(world: World) -> Bodies:
    """All grains in the order of their ids, on every rank."""
    parts = world.comm.allgather(world.grains.columns())
    table = Bodies(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
    return table.take(np.argsort(table.id))


def contacts_by_key(contacts: Contacts, comm: MPI.Comm) -> dict[str, np.ndarray]:
    """All contacts in the order of their keys, on every rank, with ids instead of rows."""
    table = contacts.near.bodies
    mine = {"key": contacts.key, "a": table.id[contacts.a], "b": table.id[contacts.b]}
    mine.update(point=contacts.point, normal=contacts.normal, gap=contacts.gap, friction=contacts.friction)
    parts = comm.allgather(mine)
    whole = {name: np.concatenate([part[name] for part in parts]) for name in mine}
    order = np.argsort(whole["key"])
    return {name: column[order] for name, column in whole.items()}


def dense_map(system: ContactSystem) -> Floats:
    """D' (3 nc, 6 bodies) of the local contacts."""
    body = system.near.index[system.contact_map.body]
    dense = np.zeros((len(system.key), 3, bodies_of(system), 6))
    contact, arms = np.arange(len(body)), system.contact_map.source.arm.reshape(-1, 2, 1, 3)
    for side, sign in ((0, -1.0), (1, 1.0)):
        dense[contact, :, body[:, side], :3] = sign * system.frame
        dense[contact, :, body[:, side], 3:] = sign * np.cross(arms[:, side], system.frame)
    return dense.reshape(3 * len(system.key), 6 * dense.shape[2])


def bodies_of(system: ContactSystem) -> int:
    """The number of bodies on all ranks; collective."""
    return int(system.contact_map.comm.allreduce(system.contact_map.columns))


def dense_scaled_map(system: ContactSystem, comm: MPI.Comm) -> Floats:
    """G = D' M^-1/2 (3 nc, 6 bodies) of the local contacts, from the blocks that solvers make of it; collective."""
    G = system.contact_map.block_rows
    dense = np.zeros((len(system.key), 3, bodies_of(system), 6))
    contact = np.repeat(np.arange(len(system.key)), np.diff(G.indptr))
    dense[contact, :, G.indices] = G.blocks
    return dense.reshape(3 * len(system.key), 6 * dense.shape[2])
