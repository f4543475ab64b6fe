"""Tests on several ranks that fail, die or hang end alone, and tell why."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from mpi4py import MPI
from several_ranks import environment

TESTS = """
import os
import time
import pytest
from mpi4py import MPI

comm = MPI.COMM_WORLD

@pytest.mark.parallel(1, 2)
def test_good(ranks, tmp_path):
    assert comm.size == ranks

@pytest.mark.parallel(2)
def test_one_rank_fails():
    if comm.rank == 1:
        assert comm.rank == 17
    comm.Barrier()

@pytest.mark.parallel(2)
def test_left_out():
    pytest.skip("not today")

@pytest.mark.parallel(2)
def test_one_rank_dies():
    if comm.rank == 1:
        print("these are my last words", flush=True)
        os._exit(3)
    comm.Barrier()

@pytest.mark.parallel(2)
def test_one_rank_sleeps():
    if comm.rank == 1:
        time.sleep(600)
    comm.Barrier()

@pytest.mark.parallel(2)
@pytest.mark.parametrize("text", ["a b::c", "ü"])
def test_good_again(text):
    assert comm.allreduce(1) == 2
"""


@pytest.mark.parallel(1, 2, 3)
def test_all_ranks_run_it_with_one_folder(ranks, tmp_path):
    comm = MPI.COMM_WORLD
    assert comm.size == ranks
    assert comm.allgather(tmp_path) == [tmp_path] * ranks
    (tmp_path / str(comm.rank)).touch()
    comm.Barrier()
    assert len(list(tmp_path.iterdir())) == ranks


@pytest.mark.slow
@pytest.mark.mpi
def test_what_goes_wrong_on_one_rank(tmp_path):
    (tmp_path / "conftest.py").write_text('pytest_plugins = ["several_ranks"]\n')
    (tmp_path / "test_them.py").write_text(TESTS)
    options = ["-vrs", "-p", "no:cacheprovider", "--rank-seconds=10", f"--rootdir={tmp_path}"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options],
        cwd=tmp_path,
        env=environment(PYTHONPATH=str(Path(__file__).parent)),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    outcomes = dict(re.findall(r"^test_them.py::test_(.*?) (PASSED|FAILED|SKIPPED)", done.stdout, re.MULTILINE))
    assert outcomes == {
        "good[1 rank]": "PASSED",
        "good[2 ranks]": "PASSED",
        "one_rank_fails[2 ranks]": "FAILED",
        "left_out[2 ranks]": "SKIPPED",
        "one_rank_dies[2 ranks]": "FAILED",
        "one_rank_sleeps[2 ranks]": "FAILED",
        "good_again[2 ranks-a b::c]": "PASSED",
        "good_again[2 ranks-\\xfc]": "PASSED",
    }, done.stdout + done.stderr
    for words in ("on rank 1 of 2, call", "assert 1 == 17", "not today", "these are my last words", "Timeout"):
        assert words in done.stdout
    assert "in test_one_rank_sleeps" in done.stdout  # where it was
