"""Kills a run of the shear test with SIGKILL again and again, at random moments, lets it go on from its last
checkpoint, and compares what it leaves with what a run in peace leaves, bit for bit: run/study torture [N [KILLS
[STEPS]]], default 4 20 60. Exit status 1 if anything is lost or differs."""

from __future__ import annotations

import math
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py

from pctt.folder import Folder

ROOT = Path(__file__).resolve().parents[2]
SCENE = ("-scene", "shear", "-ccp_type", "apgd", "-ccp_tol", "1e-3", "-checkpoint_every", "2")


def main(n: int = 4, kills: int = 20, steps: int = 60) -> int:
    with tempfile.TemporaryDirectory(prefix="pctt-torture-") as place:
        return torture(Path(place), n, kills, steps)


def torture(place: Path, n: int, kills: int, steps: int) -> int:
    scene = (*SCENE, "-scene_n", str(n))
    peace, killed = place / "peace", place / "killed"
    seconds = []
    for count in (0, 0, steps):  # the first makes the settled state, the second tells how long a start takes
        begun = time.perf_counter()
        if start(scene, "settled", peace, count).wait():
            return 1
        seconds.append(time.perf_counter() - begun)
    _, startup, whole = seconds
    checkpoint = killed / "checkpoint.h5"
    first, end = span(Folder(peace))
    print(f"shear n = {n}: {steps} steps in {whole:.1f} s, of which {startup:.1f} s to start", flush=True)
    done, count, torn, whole_end = first - 1, 0, 0, False  # a run killed after its last step leaves no analysis
    while count < kills and done < end:
        run = start(scene, checkpoint if checkpoint.exists() else "settled", killed, end - done)
        try:
            run.wait(random.uniform(0.5 * startup, 1.5 * startup + 2 * max(whole - startup, 0.0) / kills))
            done, whole_end = end, True  # it came to its end
            break
        except subprocess.TimeoutExpired:
            run.kill()
            run.wait()
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
        start(scene, checkpoint if checkpoint.exists() else "settled", killed, end - done).wait()
        whole_end = True
    differ = [item for item in differences(peace, killed) if whole_end or not item.startswith("analysis.csv")]
    print(f"{count} kills, {torn} files caught half-written: " + ("; ".join(differ) or "the same to the last bit"))
    return 1 if differ else 0


def start(scene: tuple[str, ...], state: str | Path, folder: Path, steps: int) -> subprocess.Popen:
    words = [*scene, "-restart", str(state), "-output", str(folder), "-steps", str(steps), "-quiet"]
    words += ["-overwrite"] * (state == "settled")  # what was killed before its first checkpoint
    return subprocess.Popen([sys.executable, "-m", "pctt.run", *words], cwd=ROOT)


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


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
