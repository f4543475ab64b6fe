from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from dem.contact.search import contact_frames
from dem.step.impulses import ImpulseMemory

RNG = np.random.default_rng(3)


def frames(count):
    normal = RNG.normal(size=(count, 3))
    return contact_frames(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def test_the_last_step_replaces_the_one_before():
    memory = ImpulseMemory(MPI.COMM_SELF)
    frame = frames(1)
    memory.remember(np.array([1]), np.ones((1, 3)), frame)
    memory.remember(np.array([2]), np.ones((1, 3)), frame)
    assert memory.recall(np.array([1, 2]), np.repeat(frame, 2, axis=0))[1].tolist() == [False, True]


def test_in_a_turned_frame_the_world_vector_is_the_same():
    memory = ImpulseMemory(MPI.COMM_SELF)
    frame, impulse = frames(1), np.array([[2.0, 0.3, -0.4]])
    memory.remember(np.array([1]), impulse, frame)
    angle = 0.7
    turned = frame.copy()
    turned[:, 1] = np.cos(angle) * frame[:, 1] + np.sin(angle) * frame[:, 2]
    turned[:, 2] = -np.sin(angle) * frame[:, 1] + np.cos(angle) * frame[:, 2]
    recalled = memory.recall(np.array([1]), turned)[0]
    np.testing.assert_allclose(recalled[0] @ turned[0], impulse[0] @ frame[0], atol=1e-15)
    assert recalled[0, 0] == 2.0


@pytest.mark.parallel(1, 2, 3, 4)
def test_memory_does_not_depend_on_who_asks():
    comm = MPI.COMM_WORLD
    keys = 8 * np.random.default_rng(1).permutation(5000)[:1000]
    impulse = np.random.default_rng(2).normal(size=(1000, 3))
    frame = np.tile(np.eye(3), (1000, 1, 1))

    def part(seed):
        return np.flatnonzero(np.random.default_rng(seed).integers(0, comm.size, 1000) == comm.rank)

    memory = ImpulseMemory(comm)
    mine = part(1)
    memory.remember(keys[mine], impulse[mine], frame[mine])
    stored, _ = memory.state()
    assert comm.allreduce(len(stored)) == 1000
    assert len(stored) < 1300 / comm.size  # spread over the ranks

    def check(memory, seed):
        mine = part(seed)
        asked = np.concatenate([keys[mine], [4, 12]])  # the last two are unknown
        recalled, found, _ = memory.recall(asked, np.tile(np.eye(3), (len(asked), 1, 1)))
        assert found[:-2].all()
        assert not found[-2:].any()
        assert (recalled[:-2] == impulse[mine]).all()
        assert not recalled[-2:].any()

    check(memory, 2)
    # A restart that hands the rows of all ranks to the last one.
    rows = comm.allgather(memory.state())
    key, values = (np.concatenate(column) for column in zip(*rows))
    take = slice(None) if comm.rank == comm.size - 1 else slice(0, 0)
    again = ImpulseMemory(comm)
    again.restore(key[take], values[take])
    check(again, 3)
