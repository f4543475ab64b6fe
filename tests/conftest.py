"""Fixtures for all tests."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Callable

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def mpirun(tmp_path: Path, request: pytest.FixtureRequest) -> Callable[..., str]:
    """`mpirun(source, ranks, *arguments)` runs a Python program on several ranks and returns what it printed.

    The program finds the packages of the project and the modules beside the test file, starts in `tmp_path`,
    and fails the test, with its messages, if any rank raises (mpi4py then stops the others).
    """
    beside = Path(sys.executable).with_name("mpiexec")
    mpiexec = str(beside) if beside.exists() else shutil.which("mpiexec")
    if mpiexec is None:
        pytest.skip("no mpiexec")
    environment = dict(
        os.environ,
        OMP_NUM_THREADS="1",
        OMPI_ALLOW_RUN_AS_ROOT="1",
        OMPI_ALLOW_RUN_AS_ROOT_CONFIRM="1",
        OMPI_MCA_rmaps_base_oversubscribe="1",
        PYTHONPATH=os.pathsep.join(
            [str(ROOT), str(request.path.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
        ),
    )

    def run(source: str, ranks: int, *arguments: object) -> str:
        program = tmp_path / "program.py"
        program.write_text(source)
        command = [
            mpiexec,
            "-n",
            str(ranks),
            sys.executable,
            "-m",
            "mpi4py",
            str(program),
            *map(str, arguments),
        ]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120, check=False
        )
        assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    return run
