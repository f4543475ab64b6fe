"""The compact form of the mass-scaled map G against its blocks."""

from __future__ import annotations

import numpy as np
import pytest
from cases import bodies_of, dense_scaled_map, heap, step
from mpi4py import MPI

from dem.contact import find_contacts
from dem.contact_map import root_blocks
from dem.motion import Dynamic, Guided, Oscillation
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.start import new_world
from dem.system import ContactSystem


def cross_matrix(vector):
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def root_matrix(row):
    """M^-1/2 (6, 6) of a body."""
    if len(row) == 6:
        return np.diag(row)
    matrix = np.zeros((6, 6))
    matrix[:3, :3], matrix[3:, 3:] = root_blocks(row[None])[0]
    return matrix


def arrays_of(rows):
    return rows.frame, rows.arm, rows.body, rows.root


def from_compact(system, comm):
    """G (3 nc, 6 bodies) of the local contacts."""
    rows = system.contact_map.given
    roots = [root_matrix(row) for part in comm.allgather(rows.root) for row in part]
    assert len(roots) == bodies_of(system)
    blocks = np.zeros((len(system.key), 3, bodies_of(system), 6))
    for c in range(len(system.key)):
        frame = rows.frame[c].reshape(3, 3)
        for side, sign in ((0, -1.0), (1, 1.0)):
            body, arm = rows.body[c, side], rows.arm[c, 3 * side : 3 * side + 3]
            if body >= 0:
                moment = frame @ -cross_matrix(arm)  # of w: F (w x r)
                blocks[c, :, body] += sign * np.hstack([frame, moment]) @ roots[body]
    return blocks.reshape(3 * len(system.key), -1)


def mixed(comm):
    """All shapes, with prescribed bodies and a dynamic large one."""
    world = new_world(heap(3, side=4, capsules=True), comm)
    for _ in range(20):
        step(world)
    return world


def pressed(motion, comm):
    """A layer of spheres on a floor under a plate."""
    scene = Scene(0.4)
    scene.add_body("floor", [Plane((0, 0, 1))])
    grid = np.stack(np.meshgrid(*[0.21 * np.arange(5)] * 2, [0.1], indexing="ij"), axis=-1).reshape(-1, 3)
    scene.add_spheres(grid, 0.1, 1000.0, velocity=(0.3, 0.1, 0.4), angular_velocity=(1.0, 2.0, 3.0))
    weight = {"density": 500.0} if isinstance(motion, Dynamic) else {}
    scene.add_body("plate", [Box((0.6, 0.6, 0.05))], motion, position=(0.4, 0.4, 0.25), **weight)
    return new_world(scene, comm)


def spheres(comm):
    """Spheres alone with bodies of prescribed motion: the roots are diagonal."""
    return pressed(Oscillation((0, 0, 1), 0.01, 1.0), comm)


CASES = {
    "all shapes": (mixed, 12),
    "spheres": (spheres, 6),
    "guided": (lambda comm: pressed(Guided((1, 0, 2)), comm), 12),
    "dynamic large body": (lambda comm: pressed(Dynamic(), comm), 12),
}


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("case", CASES)
def test_compact_rows_are_g(case):
    comm = MPI.COMM_WORLD
    make, width = CASES[case]
    world = make(comm)
    system = ContactSystem(world, find_contacts(world, 0.03), 0.01)
    rows = system.contact_map.given
    assert comm.allreduce(len(system.key)) > 40
    assert rows.root.shape == (world.owned, width)
    for array, shape, kind in zip(arrays_of(rows), [(9,), (6,), (2,), (width,)], "ffif"):
        assert array.shape[1:] == shape
        assert array.dtype == np.dtype(f"{kind}8")
        assert array.flags.c_contiguous
    dense = dense_scaled_map(system, comm)
    np.testing.assert_allclose(from_compact(system, comm), dense, atol=1e-13 * np.abs(dense).max(initial=1.0))


def test_without_contacts():
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 5]], 0.1, 1000.0)
    world = new_world(scene, MPI.COMM_SELF)
    rows = ContactSystem(world, find_contacts(world, 0.01), 0.01).contact_map.given
    assert [array.shape for array in arrays_of(rows)] == [(0, 9), (0, 6), (0, 2), (1, 6)]
