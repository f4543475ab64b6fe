"""Fixtures that run the program."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from mpi4py import MPI
from petsc4py import PETSc
from program import SMALL, database, simulated, start

from pctt.run.__main__ import run as run_program
from pctt.run.interrupt import SIGNALS

Program = Callable[..., "CompletedProcess[str]"]


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache of settled states for all tests, in which that of SMALL is made at its first use."""
    return MPI.COMM_WORLD.bcast(tmp_path_factory.mktemp("cache"))


@pytest.fixture
def program(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Program:
    """`program(*options)` runs with these options in `tmp_path`, and fails the test unless it ends with `status`.

    It runs in this process, on all ranks of the test; `own=True` or another number of `ranks` starts one.
    """
    comm = MPI.COMM_WORLD

    def here(words: list[str], cache: Path) -> CompletedProcess[str]:
        options = PETSc.Options()
        with monkeypatch.context() as patch:
            patch.chdir(tmp_path)
            patch.setenv("XDG_CACHE_HOME", str(cache))
            patch.setattr(sys, "argv", ["pctt.run", *words])
            for name in options.getAll():
                options.delValue(name)
            for name, value in database(words).items():
                options.setValue(name, value)
            capfd.readouterr()
            handlers = {number: signal.getsignal(number) for number in SIGNALS}
            try:
                status = run_program()
            finally:
                for number, handler in handlers.items():
                    signal.signal(number, handler)
                for name in options.getAll():
                    options.delValue(name)
                said = comm.allgather(capfd.readouterr())
        return CompletedProcess(words, status, "".join(out for out, _ in said), "".join(err for _, err in said))

    def run(
        *options: object, ranks: int = comm.size, status: int | None = 0, cache: Path = cache, own: bool = False
    ) -> CompletedProcess[str]:
        words = [*map(str, options)]
        done = start(words, ranks, tmp_path, cache) if own or ranks != comm.size else here(words, cache)
        what = f"{' '.join(words)} on {ranks} ranks: {done.returncode}\n{done.stdout}\n{done.stderr}"
        assert status is None or done.returncode == status, what
        return done

    return run


@pytest.fixture
def settled(cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The settled state of SMALL, which one rank makes."""
    comm = MPI.COMM_WORLD
    if comm.rank == 0 and not list(cache.glob("pctt/*.h5")):
        with monkeypatch.context() as patch:
            patch.setenv("XDG_CACHE_HOME", str(cache))
            simulated(database([*SMALL, "-settle", "-quiet"]))
    comm.Barrier()
    (path,) = cache.glob("pctt/*.h5")  # tests of other scenes use a cache of their own
    return path
