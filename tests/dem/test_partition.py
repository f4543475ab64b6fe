from __future__ import annotations

import numpy as np
import pytest
from cases import grains_by_id, heap, step
from mpi4py import MPI

from dem.bodies import Bodies
from dem.contact import find_contacts
from dem.geometry.morton import Frame, morton_codes
from dem.model.partition import rebalance, splitters
from dem.scene import Scene
from dem.shapes import Plane
from dem.start import new_world


def interleave(x, y, z):
    return sum(((x >> i & 1) | (y >> i & 1) << 1 | (z >> i & 1) << 2) << 3 * i for i in range(21))


def test_morton_codes_interleave_the_bits():
    rng = np.random.default_rng(1)
    cells = rng.integers(0, 2**21, (200, 3))
    cells[0], cells[1] = 0, 2**21 - 1
    codes = morton_codes(cells.astype(float), Frame(np.zeros(3), 2.0**21 - 1))
    assert codes.tolist() == [interleave(*map(int, cell)) for cell in cells]
    assert codes.min() == 0
    assert codes.max() == 2**63 - 1


def test_morton_codes_of_one_point():
    assert morton_codes(np.ones((1, 3))).tolist() == [0]


@pytest.mark.parallel(2, 3, 4)
def test_splitters_cut_the_weight_evenly():
    comm = MPI.COMM_WORLD
    rng = np.random.default_rng(comm.rank)
    codes = rng.integers(0, 2**63 - 1, 1000 * (comm.rank + 1)) >> rng.integers(0, 60)
    weights = rng.integers(1, 10, len(codes)).astype(float)
    cuts = splitters(comm, codes, weights, comm.size)
    assert comm.bcast(cuts.tolist()) == cuts.tolist()
    everything = comm.allgather((codes, weights))
    codes, weights = (np.concatenate(part) for part in zip(*everything))
    below = np.array([weights[codes < cut].sum() for cut in cuts])
    up_to = np.array([weights[codes <= cut].sum() for cut in cuts])
    target = weights.sum() * np.arange(1, comm.size) / comm.size
    assert (below <= target).all(), (below, target)
    few = 1.001e-3 * weights.sum() / comm.size
    assert ((up_to > target) | (below > target - few)).all(), (up_to, target)


@pytest.mark.parallel(1, 2, 3, 4)
def test_rebalancing_keeps_the_bodies_and_spreads_the_contacts():
    comm = MPI.COMM_WORLD
    world = new_world(heap(1, side=8, boxes=False), comm)
    for _ in range(3):
        step(world)
    before = grains_by_id(world)

    # Unbalance: the first rank takes everything.
    parts = comm.allgather(world.grains.columns())
    whole = Bodies(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
    world.set_grains(whole if comm.rank == 0 else whole.take(slice(0, 0)))
    world.grains.weight = find_contacts(world, 0.05).owned
    before.weight = grains_by_id(world).weight

    def imbalance() -> float:
        load = float((world.grains.weight + 1.0).sum())
        return comm.allreduce(load, MPI.MAX) * comm.size / comm.allreduce(load)

    if comm.size > 1:
        assert imbalance() > 1.9
        assert rebalance(world)
    assert imbalance() < 1.05, imbalance()
    assert not rebalance(world)

    after = grains_by_id(world)
    assert (after.id == np.arange(512)).all()
    for name, column in after.columns().items():
        assert (column == getattr(before, name)).all(), name
    assert (world.slabs == np.cumsum([0] + comm.allgather(len(world.grains)))).all()

    # Sorted along one curve over all ranks.
    low, high = after.position.min(axis=0), after.position.max(axis=0)
    codes = np.concatenate(comm.allgather(morton_codes(world.grains.position, Frame.between(low, high))))
    if comm.size > 1:
        assert (np.diff(codes) >= 0).all()


@pytest.mark.parallel(2, 3)
def test_few_grains_are_not_spread_again_and_again():
    """No cut divides a grain with its contacts."""
    world = new_world(heap(1, side=3, boxes=False), MPI.COMM_WORLD)
    again = 0
    for _ in range(6):
        world.grains.weight = find_contacts(world, 0.05).owned
        again += rebalance(world)
    assert again <= 1


@pytest.mark.parallel(2, 3)
def test_a_grain_that_is_far_away_leaves_the_others_spread():
    comm = MPI.COMM_WORLD
    scene = Scene(friction=0.3)
    scene.add_body("floor", [Plane(normal=(0, 0, 1))])
    grid = 0.2 * np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(-1, 3) + 0.1
    scene.add_spheres([*grid, [0.0, 1e8, 0.1]], 0.1, 1000.0)
    counts = np.array(comm.allgather(len(new_world(scene, comm).grains)))
    assert counts.sum() == 126
    assert abs(counts - 126 / comm.size).max() <= 2
