"""What all ranks have in common is compared at the start."""

from __future__ import annotations

import time

import numpy as np
import pytest
from mpi4py import MPI

from dem import together
from dem.together import first_differing_rank


@pytest.mark.parallel(2, 3)
def test_the_rank_with_other_words_or_numbers_is_found():
    comm, x = MPI.COMM_WORLD, np.random.default_rng(0).normal(size=1000)
    last = comm.size - 1
    odd = comm.rank == last
    changed = x.copy()
    changed[437] += 1e-3 * odd
    many = [np.zeros(3 + odd)] if comm.rank else [np.zeros(3)]
    assert first_differing_rank(comm, "a", [x, np.inf * x]) == 0
    assert first_differing_rank(comm, "ab"[odd]) == last
    assert first_differing_rank(comm, "a", [x, changed]) == last
    assert first_differing_rank(comm, "a", many) == last
    assert first_differing_rank(comm, "a", [x] * (1 + odd)) == last
    assert first_differing_rank(comm, "a", [np.where(np.arange(1000) == odd, np.inf, x)]) == last


@pytest.mark.parallel(2)
def test_the_last_bits_of_another_processor_are_no_difference():
    x = np.random.default_rng(0).normal(size=100_000)
    assert first_differing_rank(MPI.COMM_WORLD, "", [x * (1.0 + 2e-16 * MPI.COMM_WORLD.rank)]) == 0


@pytest.mark.parallel(2)
def test_a_rank_that_waits_for_long_says_where(monkeypatch, capsys):
    comm = MPI.COMM_WORLD
    monkeypatch.setattr(together, "PATIENCE", together.Patience(0.04))
    together.barrier(comm, "a place")
    for _ in range(2):
        time.sleep(0.2 * comm.rank)
        together.barrier(comm, "another place")
    said = capsys.readouterr().err
    assert said.count("rank 0 has waited for 0.04 s for other ranks: another place. All ranks must") == 1 - comm.rank
