"""The program as a user starts it, in a process of its own, and what it leaves in files."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]

#: A mixer with 27 spheres and room enough that the paddle jams none of them.
SMALL = ("-scene_n", "1", "-scene_margin", "0.7")  # narrower boxes jam, and pdip leaves such steps to APGD
SETTLED = (*SMALL, "-restart", "settled")



def environment(cache: Path) -> dict[str, str]:
    """Variables of a run that keeps its settled states in `cache`."""
    own = {name: value for name, value in os.environ.items() if not name.startswith(("PETSC_OPT", "OMPI_MCA_ess"))}
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    return {
        **own,
        "PYTHONPATH": path,
        "XDG_CACHE_HOME": str(cache),
        "OMP_NUM_THREADS": "1",
        "OMPI_ALLOW_RUN_AS_ROOT": "1",
        "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
        "OMPI_MCA_rmaps_base_oversubscribe": "1",
    }


def command(*options: object, ranks: int = 1) -> list[str]:
    """The command line of a run; one rank is started without mpiexec."""
    line = [sys.executable, "-m", "pctt.run", *map(str, options)]
    if ranks == 1:
        return line
    beside = Path(sys.executable).with_name("mpiexec")
    mpiexec = str(beside) if beside.exists() else shutil.which("mpiexec")
    if mpiexec is None:
        pytest.skip("no mpiexec")
    return [mpiexec, "-n", str(ranks), *line]


def arrays(path: Path) -> dict[str, np.ndarray]:
    """All data sets of a file by name; those of the steps in state.h5 through its links."""
    found = {}
    with h5py.File(path, "r") as file:
        for name in file:
            if name == "steps":
                for step in file[name]:
                    _collect(file[name][step], f"{step}/", found)
            else:
                _collect({name: file[name]}, "", found)
    return found


def steps_of(folder: Path) -> list[dict]:
    """The figures of the steps in an output folder; what is no JSON fails."""
    lines = (folder / "steps.jsonl").read_text().splitlines()
    return [json.loads(line, parse_constant=_refuse) for line in lines]


def _refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


def table(path: Path) -> dict[str, np.ndarray]:
    """The columns of a CSV file by name."""
    with path.open() as file:
        names = file.readline().rstrip("\n").split(",")
        return dict(zip(names, np.loadtxt(file, delimiter=",", ndmin=2).T))


def recorded_steps(found: dict[str, np.ndarray]) -> list[str]:
    """Names of the steps in the arrays of a state.h5."""
    return sorted({name.partition("/")[0] for name in found} - {"bodies"})


def _collect(group, prefix, found):
    for name, item in group.items():
        if isinstance(item, h5py.Dataset):
            found[prefix + name] = item[()]
        else:
            _collect(item, f"{prefix}{name}/", found)


def assert_same_bits(path: Path, other: Path) -> None:
    """Two files hold the same data sets, bit for bit."""
    one, two = arrays(path), arrays(other)
    assert set(one) == set(two)
    differ = [name for name in one if one[name].tobytes() != two[name].tobytes()]
    assert not differ, f"{path} and {other} differ in {differ}"
