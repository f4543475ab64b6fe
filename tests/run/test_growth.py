"""What a step writes does not depend on how many steps were before."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from program import arrays, recorded_steps, steps_of

from dem.together import SceneError
from pctt.look.folder import Folder
from pctt.run.lines import StepLines
from pctt.run.options import read_options
from pctt.run.place import Place
from pctt.run.results import Results
from pctt.run.simulate import simulate

STEPS = 200
SCENE = """
from dataclasses import dataclass
from dem.experiment import Experiment
from dem.scene import Scene

@dataclass(frozen=True)
class Fall(Experiment):
    last: int = 0

    def build(self):
        scene = Scene(friction=0.3)
        scene.add_spheres([[0, 0, k] for k in range(3)], radius=0.1, density=2500.0)
        return scene

    def record(self, step):
        if step.world.step > LAST:
            raise ValueError("no record")
        return {}
"""


def written() -> int:
    """Bytes that this process has written to files so far."""
    try:
        words = Path("/proc/self/io").read_text().split()
    except OSError:
        pytest.skip("this system does not count what a process writes")
    return int(words[words.index("wchar:") + 1])


def test_two_hundred_steps(tmp_path, monkeypatch):
    """A run that ends by an error after 200 steps: bytes per step, and what is there then; and one that goes on."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # it is the time here
    seen, linked = [written()], []
    stands, link = Results.stands, Results._link

    def look(results, *arguments):
        stands(results, *arguments)
        seen.append(written())

    def count(results, steps):
        linked.append(len(steps))
        link(results, steps)

    monkeypatch.setattr(Results, "stands", look)
    monkeypatch.setattr(Results, "_link", count)

    def run(last, **more):
        Path("fall.py").write_text(SCENE.replace("LAST", str(last)))
        words = {"scene": "fall.py", "ccp_type": "apgd", "output": "out", "quiet": "true", "checkpoint_every": "20"}
        simulate(read_options({**words, **more}, MPI.COMM_SELF), MPI.COMM_SELF)

    with pytest.raises(SceneError, match="no record"):
        run(STEPS, steps=str(STEPS + 10))
    per_step = np.diff(seen)
    assert len(per_step) == STEPS
    early, late = per_step[100:120].mean(), per_step[180:200].mean()
    assert late < 1.25 * early
    assert sum(linked) < 100 * STEPS
    assert linked[:100] == list(range(1, 101))
    state = recorded_steps(arrays(tmp_path / "out" / "state.h5"))
    assert state == [f"{step:06d}" for step in range(1, len(state) + 1)]
    assert len(state) >= 0.99 * STEPS - 1
    assert Folder(tmp_path / "out").steps == list(range(1, STEPS + 1))
    run(STEPS + 1, steps="1", restart="out/checkpoint.h5", restart_changed_file="true")
    assert len(recorded_steps(arrays(tmp_path / "out" / "state.h5"))) == STEPS + 1
    assert [line["step"] for line in steps_of(tmp_path / "out")] == list(range(1, STEPS + 2))


def test_a_line_is_added_to_those_of_the_step_before_with_one_write(tmp_path, monkeypatch):
    """The lines of an earlier run are copied once, and those after the step from which the run goes on are left out."""
    path = tmp_path / "lines"
    path.write_text("".join(f"{k}\n" for k in range(1, 101)) + "10")
    lines = StepLines(Place(tmp_path, MPI.COMM_SELF), "lines", int, last=90)
    assert [int(line) for line in lines] == list(range(1, 91))
    assert path.read_text().endswith("100\n10")  # nothing goes before there is something new
    lines.add("91")
    before = written()
    lines.add("92")
    assert written() - before <= 3
    assert [int(line) for line in path.read_text().splitlines()] == list(range(1, 93)) == [int(k) for k in lines]
