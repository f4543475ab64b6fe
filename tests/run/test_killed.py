"""A run that is killed at any moment leaves whole files, and goes on from its last checkpoint."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import time
from pathlib import Path

import pytest
from program import (
    EVERY,
    SETTLED,
    SMALL,
    arrays,
    assert_same_bits,
    command,
    environment,
    recorded_steps,
    steps_of,
    table,
)

from pctt.folder import Folder

STEPS = 20
OPTIONS = ("-ccp_type", "apgd", "-ccp_tol", 1e-3)


def processes(parent):
    """Ids of all descendants of a process, whichever of its threads started them."""
    children = []
    for task in Path(f"/proc/{parent}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            children += [int(word) for word in task.read_text().split()]
    return children + [late for child in children for late in processes(child)]


def python_of(parent):
    """Descendants that run the program."""
    found = []
    for process in processes(parent):
        try:
            with open(f"/proc/{process}/cmdline") as file:
                words = file.read().split("\0")
        except OSError:
            continue
        if "pctt.run" in words and "python" in words[0]:
            found.append(process)
    return found


def kill_later(folder, cache, tmp_path, options, ranks, delay):
    """Start a run, wait for its next checkpoint and a little more, and kill -9 it, or one of several ranks.

    Whether it was killed: it may have come to its end before.
    """
    checkpoint = folder / "checkpoint.h5"
    before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else None
    with subprocess.Popen(
        command(*options, ranks=ranks),
        cwd=tmp_path,
        env=environment(cache),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as run:
        end = time.monotonic() + 60
        while not checkpoint.exists() or checkpoint.stat().st_mtime_ns == before:
            assert run.poll() is None, "the run ended before its first checkpoint"
            assert time.monotonic() < end, "no checkpoint came"
            time.sleep(0.002)
        time.sleep(delay)
        if ranks == 1:
            run.kill()
        else:
            for process in python_of(run.pid)[-1:]:
                os.kill(process, signal.SIGKILL)
        return run.wait(60) != 0


def check_files(folder):
    """All files can be read; the step of the checkpoint."""
    found = Folder(folder)
    found.require_frames()
    step = int(arrays(folder / "checkpoint.h5")["world/step"])
    noted = [line["step"] for line in found.lines()]
    for number in found.steps:
        assert found.frame(number).position.shape == (29, 3)
    for steps in (found.steps, noted):  # nothing is missing up to the checkpoint
        assert steps == list(range(steps[0], steps[-1] + 1))
        assert steps[0] <= step <= steps[-1]
    assert found.summary["steps"] == len(noted)  # also where summary.json is still that of a run before
    found.derive()  # what a run would write at its end
    assert json.loads((folder / "summary.json").read_text())["steps"] == len(noted)
    assert [int(name) for name in recorded_steps(arrays(folder / "state.h5"))] == found.steps
    assert table(folder / "records.csv")["step"].tolist() == noted
    return step


@pytest.mark.parametrize(("ranks", "kills"), [(1, 1), pytest.param(2, 3, marks=[pytest.mark.mpi, pytest.mark.slow])])
def test_a_killed_run_goes_on_as_if_nothing_had_happened(ranks, kills, program, settled, cache, tmp_path):
    options = (*SMALL, *EVERY, *OPTIONS)
    program(*SETTLED, *OPTIONS, "-steps", STEPS, "-output", "whole", ranks=ranks)
    start = int(arrays(settled)["world/step"])
    folder = tmp_path / "killed"
    rng = random.Random()
    restart, done, killed = settled, start, 0
    for _ in range(kills):
        left = start + STEPS - done
        if left <= 2:
            break
        more = (*options, "-restart", restart, "-output", "killed", "-steps", left)
        delay = rng.uniform(0.0, 0.05)
        killed += kill_later(folder, cache, tmp_path, more, ranks, delay)
        done = check_files(folder)
        restart = folder / "checkpoint.h5"
    assert killed > 0
    if done < start + STEPS:
        program(*options, "-restart", restart, "-output", "killed", "-steps", start + STEPS - done, ranks=ranks)
    assert check_files(folder) == start + STEPS
    assert_same_bits(tmp_path / "whole" / "state.h5", folder / "state.h5")
    assert_same_bits(tmp_path / "whole" / "checkpoint.h5", folder / "checkpoint.h5")
    lines = [steps_of(f) for f in (tmp_path / "whole", folder)]
    for one, two in zip(*lines):
        for field in ("step", "time", "contacts"):
            assert one[field] == two[field]
        for field in ("natural_residual", "objective"):  # sums that no step rests on: equal but for rounding
            assert one[field] == pytest.approx(two[field], rel=1e-9)
    assert len(lines[0]) == len(lines[1]) == STEPS
