"""Fixtures that start the program."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from program import SMALL, command, environment

Program = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache of settled states for all tests, in which that of SMALL is made at its first use."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def program(tmp_path: Path, cache: Path) -> Program:
    """`program(*options, ranks=1)` runs in `tmp_path`, and fails the test unless it ends with `status`."""

    def run(
        *options: object, ranks: int = 1, status: int | None = 0, cache: Path = cache
    ) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            command(*options, ranks=ranks),
            cwd=tmp_path,
            env=environment(cache),
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        what = f"{' '.join(map(str, options))} on {ranks} ranks: {done.returncode}\n{done.stdout}\n{done.stderr}"
        assert status is None or done.returncode == status, what
        return done

    return run


@pytest.fixture
def settled(program: Program, cache: Path) -> Path:
    """The settled state of SMALL."""
    if not list(cache.glob("pctt/*.h5")):
        program(*SMALL, "-settle")
    (path,) = cache.glob("pctt/*.h5")  # tests of other scenes use a cache of their own
    return path
