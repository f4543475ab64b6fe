"""The program as a user starts it, and what it leaves in files."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import several_ranks
from mpi4py import MPI

from pctt.run.options import read_options
from pctt.run.simulate import simulate

ROOT = Path(__file__).resolve().parents[2]

#: A mixer with 27 spheres and room enough that the paddle jams none of them.
SMALL = ("-scene_n", "1", "-scene_margin", "0.7")  # narrower boxes jam, and pdip leaves such steps to APGD
EVERY = ("-output_every", "1", "-checkpoint_every", "1")
SETTLED = (*SMALL, *EVERY, "-restart", "settled")


#: A scene file: spheres fall one upon the other.
DROP = """
from dataclasses import dataclass
from dem.experiment import Experiment, option
from dem.scene import Scene
from dem.shapes import Plane

@dataclass(frozen=True)
class Drop(Experiment):
    height: float = option(0.2, "of the lowest centre", unit="m")

    def build(self):
        scene = Scene(friction=0.3)
        scene.add_body("floor", [Plane(normal=(0, 0, 1))])
        places = [[0.05 * k, 0, self.height + 0.3 * k] for k in range(3)]
        scene.add_spheres(places, radius=0.1, density=2500.0)
        return scene

    def record(self, step):
        return {}

    def analyse(self, records):
        return {"twice": 2 * records["time [s]"]}
"""


def database(words: list[str]) -> dict[str, str | None]:
    """The options in the words of a command line, as PETSc takes them."""

    def is_name(word: str) -> bool:
        return word[:1] == "-" and not word[1:2].isdigit()

    return {
        name.lstrip("-"): None if is_name(value) else value
        for name, value in zip(words, [*words[1:], "-"])
        if is_name(name)
    }


def environment(cache: Path) -> dict[str, str]:
    """Variables of a run that keeps its settled states in `cache`."""
    return several_ranks.environment(XDG_CACHE_HOME=str(cache))


def command(*options: object, ranks: int = 1) -> list[str]:
    """The command line of a run; one rank is started without mpiexec."""
    line = [sys.executable, "-m", "pctt.run", *map(str, options)]
    return line if ranks == 1 else [*several_ranks.mpiexec(ranks), *line]


def start(words: list[str], ranks: int, folder: Path, cache: Path) -> subprocess.CompletedProcess[str]:
    """Run in a process of its own, or several, as a user does."""
    line, env = command(*words, ranks=ranks), environment(cache)
    return subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, timeout=300, check=False)


def simulated(words: dict[str, str], comm: MPI.Comm = MPI.COMM_SELF) -> None:
    """What the program does with these options, in this process; errors come out as they are raised."""
    simulate(read_options(words, comm), comm)


def one_line(done: subprocess.CompletedProcess[str], status: int) -> str:
    """The one line that a run has said at its end, with this status."""
    assert done.returncode == status, done.stdout + done.stderr
    said = [line for line in done.stderr.splitlines() if line.startswith("pctt.run: ")]
    assert len(said) == 1, done.stderr
    for word in ("Traceback", "PETSC ERROR", "HDF5-DIAG"):
        assert word not in done.stdout + done.stderr
    return said[0]


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a folder, but those of a run that has not replaced another yet."""
    paths = [path for path in folder.rglob("*") if path.is_file() and ".new" not in path.parts]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def summary_of(folder: Path) -> dict:
    """The figures of a whole run."""
    return json.loads((folder / "summary.json").read_text())


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
