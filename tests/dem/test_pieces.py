"""What run/study cluster_model counts on one rank for many."""

from __future__ import annotations

import pytest
from cases import heap
from cluster_model import moving, pieces
from mpi4py import MPI

from dem.contact import find_contacts
from dem.model.partition import redistribute
from dem.start import new_world
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained


def searched(comm):
    world = new_world(heap(3), comm)
    world.grains.weight = find_contacts(world, 0.05).owned
    redistribute(world)
    return world, find_contacts(world, 0.05)


@pytest.mark.parallel(2, 4)
def test_the_pieces_of_a_bed_are_what_as_many_ranks_have():
    comm = MPI.COMM_WORLD
    world, contacts = searched(comm)
    G = ContactSystem(world, contacts, unconstrained(world, 0.01)).contact_map
    asked, given = G.halo._owners, G.halo._holders
    here = {
        "contacts": len(contacts), "bodies": G.columns, "ghosts": len(G.halo.ghosts),
        "messages": len(asked) + len(given), "moved": len(G.halo.ghosts) + len(G.halo._shared),
    }  # fmt: skip
    assert here["messages"] > 0
    whole, found = searched(MPI.COMM_SELF)
    counted = pieces(whole, moving(whole, found), comm.size)
    assert {name: int(of[comm.rank]) for name, of in counted.items()} == here
