"""The mass-scaled map G of a step, with the halo of the search, against its definition."""

from __future__ import annotations

import numpy as np
import pytest
from cases import bodies_of, dense_map, dense_scaled_map, heap, step
from mpi4py import MPI

from dem.contact import find_contacts
from dem.contact_map import root_blocks
from dem.exchange import offsets
from dem.motion import Dynamic, Guided, Oscillation
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.start import new_world
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained


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


CASES = {
    "all shapes": (mixed, 12),
    "spheres": (lambda comm: pressed(Oscillation((0, 0, 1), 0.01, 1.0), comm), 6),
    "guided": (lambda comm: pressed(Guided((1, 0, 2)), comm), 12),
    "dynamic large body": (lambda comm: pressed(Dynamic(), comm), 12),
}


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("threads", [1, 2], indirect=True)
def test_products_are_those_of_the_definition(case, threads):
    """Of D' from frames and arms, and M^-1/2 of all bodies; the halo is that of the search."""
    comm = MPI.COMM_WORLD
    make, width = CASES[case]
    world = make(comm)
    system = ContactSystem(world, find_contacts(world, 0.03), unconstrained(world, 0.01))
    G, bodies = system.contact_map, bodies_of(system)
    assert comm.allreduce(len(system.key)) > 40
    assert G.source.root.shape == (world.owned, width)
    roots = np.concatenate(comm.allgather(root_blocks(G.source.root)))
    D = dense_map(system).reshape(-1, bodies, 2, 3)
    dense = np.einsum("cbpi,bpij->cbpj", D, roots).reshape(len(D), -1)
    np.testing.assert_allclose(dense_scaled_map(system, comm), dense, atol=1e-13 * np.abs(dense).max(initial=1.0))
    rng = np.random.default_rng(0)
    v, g = rng.normal(size=(bodies, 6)), rng.normal(size=system.r.shape)
    starts = offsets(comm, G.columns)
    own = slice(starts[comm.rank], starts[comm.rank + 1])
    close = {"rtol": 1e-11, "atol": 1e-11 * comm.allreduce(np.abs(dense).max(initial=1.0), MPI.MAX)}
    np.testing.assert_allclose(G.velocities(v[own]).ravel(), dense @ v.ravel(), **close)
    momenta = comm.allreduce(dense.T @ g.ravel()).reshape(-1, 6)
    np.testing.assert_allclose(G.momenta(g), momenta[own], **close)
    change = np.einsum("bpij,bpj->bpi", roots, momenta.reshape(-1, 2, 3)).reshape(-1, 6)[own]
    np.testing.assert_allclose(system.velocity(g), system.free_velocity + change, **close)
    out, H = np.zeros((G.columns, 6)), np.tile(np.diag([2.0, 1.0, 1.0]), (G.rows, 1, 1))
    G.through(G.weights(H), v[own], out)
    weighed = comm.allreduce(dense.T @ (dense @ v.ravel() * np.tile([2.0, 1.0, 1.0], G.rows))).reshape(-1, 6)
    np.testing.assert_allclose(out, v[own] + weighed[own], **close)
    again = type(G)(comm, G.source)  # with a halo that is found from the numbers of the bodies
    np.testing.assert_allclose(again.momenta(g), G.momenta(g), **close)
    assert len(again.halo.ghosts) == len(G.halo.ghosts)  # none that no contact touches


class Counting:
    """A communicator that counts the messages which this rank prepares to send."""

    def __init__(self, comm):
        self._comm, self.sent = comm, 0

    def __getattr__(self, name):
        return getattr(self._comm, name)

    def Send_init(self, *arguments):  # noqa: N802 - as MPI names it
        self.sent += 1
        return self._comm.Send_init(*arguments)


@pytest.mark.parallel(2, 4)
def test_a_product_sends_one_message_to_each_rank_that_shares_a_ghost():
    """As docs/cluster.md counts them: momenta to the owners of ghosts, velocities to the ranks that have ghosts."""
    comm = Counting(MPI.COMM_WORLD)
    world = new_world(heap(3, side=4, large=False), MPI.COMM_WORLD)
    system = ContactSystem(world, find_contacts(world, 0.05), unconstrained(world, 0.01))
    given = system.contact_map.source
    starts = offsets(MPI.COMM_WORLD, given.columns)
    owners = set(np.searchsorted(starts, given.body[given.body >= 0], side="right") - 1) - {comm.rank}
    holders = [rank for rank, theirs in enumerate(comm.allgather(owners)) if comm.rank in theirs]
    assert comm.allreduce(len(owners)) > 0
    G = type(system.contact_map)(comm, given, system.contact_map.halo, system.contact_map.body)
    G.halo.comm = comm
    G.halo._messages.clear()
    for _ in range(3):  # the first prepares the messages of all
        G.velocities(np.zeros((G.columns, 6)))
    assert comm.sent == len(holders)
    for _ in range(3):
        G.momenta(np.zeros_like(system.r))
    assert comm.sent == len(holders) + len(owners)
