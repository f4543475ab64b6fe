"""The output folder of a small run, made once, and the programs that show it."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from mpi4py import MPI
from several_ranks import environment

from pctt.look.program import run as program_of_folder
from pctt.run.options import read_options
from pctt.run.simulate import simulate

OPTIONS = {"scene_n": "2", "ccp_type": "pdip", "dt": "0.1", "compare": "pbjacobi,none", "compare_every": "40"}
OPTIONS |= {"output_every": "1"}


def start(*words: object) -> subprocess.CompletedProcess[str]:
    words = (sys.executable, *map(str, words))
    return subprocess.run(words, env=environment(), capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four steps of a mixer of 125 spheres, coarse enough that the lowest have come to the paddle and the floor."""
    path = tmp_path_factory.mktemp("look") / "results"
    options = {**OPTIONS, "quiet": "true", "steps": "4", "output": str(path)}
    if MPI.COMM_WORLD.rank == 0:
        simulate(read_options(options, MPI.COMM_SELF), MPI.COMM_SELF)
    return MPI.COMM_WORLD.bcast(path)


@pytest.fixture
def python():
    """`python(*words)` starts Python with these words."""
    return start


@pytest.fixture
def show(folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):
    """`show(program, *options)` runs the program `python -m pctt.<program>` on the folder, in this process."""

    def run(program: str, *options: object, status: int = 0, folder: Path = folder) -> subprocess.CompletedProcess[str]:
        monkeypatch.setattr(sys, "argv", [program, *map(str, (folder, *options))])
        monkeypatch.delenv("DISPLAY", raising=False)
        capfd.readouterr()
        try:
            found = program_of_folder(importlib.import_module(f"pctt.{program}").main, program)
        except SystemExit as end:  # of argparse
            found = end.code
        done = subprocess.CompletedProcess(sys.argv, found, *capfd.readouterr())
        assert done.returncode == status, done.stdout + done.stderr
        return done

    return run
