"""The output folder of a small run, made once, and the programs that show it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
OPTIONS = ("-scene_n", "2", "-ccp_type", "pdip", "-dt", "0.1", "-compare", "pbjacobi,none", "-compare_every", "8")


def start(*words: object) -> subprocess.CompletedProcess[str]:
    own = {name: value for name, value in os.environ.items() if not name.startswith(("PETSC_OPT", "DISPLAY"))}
    environment = {**own, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    words = (sys.executable, *map(str, words))
    return subprocess.run(words, env=environment, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four steps of a mixer of 125 spheres, coarse enough that the lowest have come to the paddle and the floor."""
    path = tmp_path_factory.mktemp("look") / "results"
    done = start("-m", "pctt.run", *OPTIONS, "-quiet", "-steps", 4, "-output", path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    return path


@pytest.fixture
def python():
    """`python(*words)` starts Python with these words."""
    return start


@pytest.fixture
def show(folder: Path):
    """`show(program, *options)` runs `python -m pctt.<program>` on the folder."""

    def run(program: str, *options: object, status: int = 0, folder: Path = folder) -> subprocess.CompletedProcess[str]:
        done = start("-m", f"pctt.{program}", folder, *options)
        assert done.returncode == status, done.stdout + done.stderr
        return done

    return run
