"""Kills runs with SIGKILL again and again, at random moments, lets them go on from their last checkpoints, and compares
what they leave with what runs in peace leave, bit for bit:

    run/study torture [CASE ...] [-n N] [-kills K] [-steps S] [-ranks P,P]

A case is a scene: the settled `shear` of size N; `plant`, with a source, an outlet, a mesh that turns, joints and a
motor; `cell`, sheared and of given stress. Exit status 1 if anything is lost or differs."""

from __future__ import annotations

import contextlib
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from dem.experiment import Experiment, option
from dem.measures import Block
from dem.mesh import Mesh
from dem.motion import Dynamic, Rotation
from dem.packing import random_packing
from dem.scene import Scene
from dem.shapes import Plane, Sphere
from pctt.folder import Folder

ROOT = Path(__file__).resolve().parents[2]
PYTHON, MPIEXEC = ROOT / ".venv/bin/python", ROOT / ".venv/bin/mpiexec"
#: Every step is recorded: what a kill loses is seen at once.
ALWAYS = ("-ccp_type", "apgd", "-ccp_tol", "1e-3", "-checkpoint_every", "2", "-output_every", "1", "-quiet")
CASES = {
    "shear": ("-scene", "shear", "-scene_n"),
    "plant": ("-scene", __file__, "-scene_n"),
    "cell": ("-scene", __file__, "-scene_cell", "1", "-scene_n"),
}


@dataclass(frozen=True)
class Plant(Experiment):
    """Grains fall from a source beside a paddle, a mesh that turns, and a chain that a motor swings; or, as a cell,
    they are sheared under a given stress."""

    n: int = option(4, "size: of the source, or of the cell in diameters")
    cell: bool = option(False, "the cell")

    def build(self) -> Scene:
        """The scene, with the large bodies "floor" and "paddle", or none."""
        r = 0.01
        if self.cell:
            size = 2.0 * r * max(self.n + 2, 6)
            place, radius = random_packing((size,) * 3, r, 0.5, periodic=(True,) * 3, seed=1)
            period, rate = (size,) * 3, 2.0
            scene = Scene(0.4, (0, 0, 0), period=period, stress=(500.0,) * 3, shear_rate=rate, shear_gradient="z")
            scene.add_spheres(place, radius, 2500.0, velocity=np.outer(place[:, 2], [rate, 0.0, 0.0]))
            return scene
        scene, width = Scene(0.4), 2.5 * r * self.n
        scene.add_body("floor", [Plane((0, 0, 1))])
        corners = [[-width, -2 * r, r], [width, -2 * r, r], [width, -2 * r, 6 * r], [-width, -2 * r, 6 * r]]
        blade = Mesh(corners, [[0, 1, 2], [0, 2, 3]])
        scene.add_body("paddle", [blade], motion=Rotation((0.0, 0.0, 4.0)))
        chain = [f"bead {k}" for k in range(3)]
        for k, name in enumerate(chain):
            scene.add_body(name, [Sphere(r)], Dynamic(), position=(-width, 5 * r, 8 * r - 2.1 * r * k), density=2500.0)
        scene.add_joint("motor", None, chain[0], anchor=(-width, 5 * r, 9 * r), axis=(0, 1, 0), speed=1.0, strength=0.1)
        for k in range(2):
            anchor = (-width, 5 * r, 6.95 * r - 2.1 * r * k)
            scene.add_joint(f"link {k}", chain[k], chain[k + 1], kind="ball", anchor=anchor)
        region = Block((-width, 0.0, 10 * r), (width, width, 20 * r))
        scene.add_source("rain", region, radius=r, density=2500.0, number_rate=200.0 * self.n, velocity=(0, 0, -1.0))
        scene.add_outlet("rim", Block((-2 * width, -2 * width, -1), (2 * width, 2 * width, 1)), outside=True)
        return scene


def torture(place: Path, scene: tuple[str, ...], settles: bool, ranks: int, kills: int, steps: int) -> int:
    """Kill a run of this scene, and say what is lost."""
    peace, killed = place / "peace", place / "killed"
    begin = "settled" if settles else ""
    seconds = []
    for count in (0, 0, steps):  # the first makes the settled state, the second tells how long a start takes
        begun = time.perf_counter()
        if start(scene, ranks, begin, peace, count).wait():
            return 1
        seconds.append(time.perf_counter() - begun)
    _, startup, whole = seconds
    checkpoint = killed / "checkpoint.h5"
    first, end = span(Folder(peace))
    print(f"{steps} steps in {whole:.1f} s, of which {startup:.1f} s to start", flush=True)
    done, count, torn, whole_end = first - 1, 0, 0, False  # a run killed after its last step leaves no analysis
    while count < kills and done < end:
        run = start(scene, ranks, checkpoint if checkpoint.exists() else begin, killed, end - done)
        try:
            run.wait(random.uniform(0.5 * startup, 1.5 * startup + 2 * max(whole - startup, 0.0) / kills))
            done, whole_end = end, True  # it came to its end
            break
        except subprocess.TimeoutExpired:
            kill(run)
        count += 1
        torn += len(list(killed.rglob(".*.tmp")))
        if checkpoint.exists():
            with h5py.File(checkpoint, "r") as file:
                done = int(file["world/step"][()])
            if (wrong := broken(killed, first, done)):
                print(f"kill {count}, after step {done}: {wrong}")
                return 1
        print(f"kill {count:3d}: {done - first + 1:4d} steps done", flush=True)
    if done < end:
        start(scene, ranks, checkpoint if checkpoint.exists() else begin, killed, end - done).wait()
        whole_end = True
    differ = [item for item in differences(peace, killed) if whole_end or not item.startswith("analysis.csv")]
    print(f"{count} kills, {torn} files caught half-written: " + ("; ".join(differ) or "the same to the last bit"))
    return 1 if differ else 0


def start(scene: tuple[str, ...], ranks: int, state: str | Path, folder: Path, steps: int) -> subprocess.Popen:
    """A run of so many steps from a state: the settled one, none (the start of the scene), or that of a file."""
    words = [*scene, *ALWAYS, "-output", str(folder), "-steps", str(steps)]
    words += ["-restart", str(state)] if state else []
    words += ["-overwrite"] * (state in ("", "settled"))  # what was killed before its first checkpoint
    before = [MPIEXEC, "-n", str(ranks)] if ranks > 1 else []
    return subprocess.Popen([*before, PYTHON, "-m", "pctt.run", *words], cwd=ROOT)


def kill(run: subprocess.Popen) -> None:
    """End a run with all processes that it has started, the ranks before mpiexec, which would tell them; and wait until
    they have ended, so that the next run finds the folder free."""
    family = [run.pid]
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:  # it has ended
                continue
    for pid in family:
        family += [child for child, parent in parents.items() if parent == pid]
    for pid in reversed(family):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    run.wait()
    while any(alive(pid) for pid in family):
        time.sleep(0.01)


def alive(pid: int) -> bool:
    """Whether a process is there that has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def span(run: Folder) -> tuple[int, int]:
    """First and last step of a run."""
    return run.summary["first_step"], run.summary["last_step"]


def broken(folder: Path, first: int, done: int) -> str:
    """What is lost in a folder whose checkpoint is of the step ``done``, in words; empty if nothing is."""
    run = Folder(folder)
    run.require_frames()
    frames = [step for step in run.steps if run.frame(step).position.shape[1] == 3]
    for name, steps in {"frames": frames, "steps.jsonl": [line["step"] for line in run.lines()]}.items():
        if steps != list(range(first, first + len(steps))) or steps[-1] < done:
            return f"{name} has the steps {steps}"
    return ""


def differences(one: Path, two: Path) -> list[str]:
    """What the folders of two runs differ in, but for the seconds that they took."""
    found = [f"{name} differs" for name in ("records.csv", "analysis.csv") if text(one / name) != text(two / name)]
    found += [f"{name}: {item}" for name in ("state.h5", "checkpoint.h5") for item in unequal(one / name, two / name)]
    steps = [Folder(folder).lines() for folder in (one, two)]
    for field in ("step", "contacts", "iterations"):
        if [line[field] for line in steps[0]] != [line[field] for line in steps[1]]:
            found.append(f"steps.jsonl: {field}")
    for field in ("natural_residual", "objective"):  # sums that no step rests on: equal but for rounding
        if not all(math.isclose(one[field], two[field], rel_tol=1e-9) for one, two in zip(*steps)):
            found.append(f"steps.jsonl: {field}")
    return found


def text(path: Path) -> str:
    return path.read_text() if path.exists() else ""


def unequal(one: Path, two: Path) -> list[str]:
    """Names of the datasets of two files that are not the same bits."""
    tables = []
    for path in (one, two):
        table: dict[str, bytes] = {}
        with h5py.File(path, "r") as file:
            _collect(file, "", table)
        tables.append(table)
    names = tables[0].keys() | tables[1].keys()
    return sorted(name for name in names if tables[0].get(name) != tables[1].get(name))


def _collect(group: h5py.Group, prefix: str, table: dict[str, bytes]) -> None:
    for name in group:  # not visititems, which does not follow the links to the frames
        if isinstance(group[name], h5py.Group):
            _collect(group[name], f"{prefix}{name}/", table)
        else:
            table[prefix + name] = group[name][()].tobytes()


def main() -> int:
    """All cases on all numbers of ranks; the worst exit status."""
    from shared import at_least_one, listed, parser

    words = parser("torture", __doc__)
    words.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)}; none: all")
    words.add_argument("-n", type=at_least_one, default=4, help="size of the scenes (4)")
    words.add_argument("-kills", type=at_least_one, default=20, help="at most, of each run (20)")
    words.add_argument("-steps", type=at_least_one, default=60, help="of each run (60)")
    words.add_argument("-ranks", type=listed(at_least_one), default="1,2", help="with commas between (1,2)")
    given = words.parse_args()
    if unknown := set(given.cases) - set(CASES):
        words.error(f"{unknown.pop()}: allowed are {', '.join(CASES)}")
    worst = 0
    for name in given.cases or CASES:
        for ranks in given.ranks:
            print(f"{name} of n = {given.n} on {ranks} rank{'s' * (ranks > 1)}", flush=True)
            with tempfile.TemporaryDirectory(prefix="pctt-torture-") as place:
                scene = (*CASES[name], str(given.n))
                worst |= torture(Path(place), scene, name == "shear", ranks, given.kills, given.steps)
    return worst


if __name__ == "__main__":
    sys.exit(main())
