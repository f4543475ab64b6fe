"""The scene of docs/tutorial.md, as the page has it, and what is said to a user whose scene file is at fault."""

from __future__ import annotations

import re

import numpy as np
import pytest
from mpi4py import MPI
from program import ROOT, simulated

from dem.experiment import from_file
from dem.together import SceneError
from pctt.options import OptionError
from pctt.run.options import read_options
from pctt.run.settings import find_scene
from pctt.simulation import Simulation


@pytest.fixture
def hopper(tmp_path, monkeypatch):
    """The file hopper.py of the page."""
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "tutorial.md").read_text(), re.DOTALL)
    assert len(code.splitlines()) <= 60
    (tmp_path / "hopper.py").write_text(code)
    return tmp_path / "hopper.py"


def test_grains_flow_out_of_the_hopper_and_none_is_lost(hopper):
    scene = from_file(hopper)(n=4, settling_time=0.3)
    words = {"scene": str(hopper), "scene_n": "4", "scene_settling_time": "0.3", "ccp_type": "apgd", "ccp_tol": "1e-3"}
    options = read_options(words, MPI.COMM_SELF)
    assert repr(options.scene) == repr(scene)
    sim = Simulation(options.scene, options.settings, comm=MPI.COMM_SELF)
    rows, world = [sim.step() for _ in range(90)], sim.world
    out = np.array([row["grains_out"] for row in rows])
    assert (out[:32] == 0).all()
    assert out[-1] > 10
    assert (np.diff(out) >= 0).all()
    assert [row["grains_outside"] for row in rows] == [0] * 90
    assert len(world.grains) == world.slabs[-1] == 64
    door = np.array([row["force_door_z [N]"] for row in rows])
    assert door[:30].min() < 0  # grains lay on it
    records = {name: np.array([row[name] for row in rows]) for name in rows[0] if "phases" not in name}
    assert scene.analyse(records)["mean_discharge_rate [1/s]"] == pytest.approx(out[-1] / 0.89)


GOOD = """
from dataclasses import dataclass
from dem.experiment import Experiment, option
from dem.scene import Scene
from dem.start import new_world
@dataclass(frozen=True)
class One(Experiment):
    height: float = 1.0
    def build(self):
        scene = Scene(0.3)
        scene.add_spheres([0, 0, self.height], 0.1, 1000.0)
        return scene
"""
BAD_FILES = {
    "def f(:\n": "line 1: ",
    "x = 1\ny = 1 / 0\n": "line 2: ZeroDivisionError",
    "x = 1\n": "no class derived",
    GOOD + GOOD.replace("One", "Two"): "must define one scene, has One, Two",
    GOOD.replace("    height: float = 1.0", "    height: float"): "option height of One has no default",
    GOOD.replace("height: float = 1.0", "height: list = None"): "option height of One: the type must be",
    GOOD.replace("@dataclass(frozen=True)", ""): "must be marked @dataclass",
    GOOD.replace("def build", "def bild"): "no method build",
}


@pytest.mark.parametrize("text", BAD_FILES)
def test_a_bad_scene_file_is_refused_with_the_reason(text, tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(text)
    with pytest.raises(OptionError, match=re.escape(BAD_FILES[text])) as error:
        find_scene(str(path))
    assert str(error.value).startswith(f"-scene {path}: ")


def test_a_scene_may_have_two_names(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(GOOD + "Other = One\n")
    assert find_scene(str(path)).__name__ == "One"


FAULTS = {
    "build must return a dem.scene.Scene, not NoneType": GOOD.replace("return scene", "return None"),
    "no large body 'lid'": GOOD + "    def record(self, step):\n        return {'z': step.position('lid')[2]}\n",
    "that is not in use": GOOD + "    def record(self, step):\n        return {'step': 1}\n",
    "allowed is a number": GOOD + "    def record(self, step):\n        return {'z [m]': [1, 2]}\n",
    "record returns 'z': allowed are": GOOD + "    def record(self, step):\n        return {'z': 1j}\n",
    "analyse returns 'z': allowed are": GOOD + "    def analyse(self, records):\n        return {'z': 'x'}\n",
    "analyse must return a dict": GOOD + "    def analyse(self, records):\n        return None\n",
    "analyse of the scene One: KeyError": GOOD + "    def analyse(self, records):\n        return records['z']\n",
    "has no settling_time": GOOD,
}


@pytest.mark.parametrize("message", FAULTS)
def test_faults_of_a_scene_end_the_run(message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(FAULTS[message])
    how = {"settle": "true"} if FAULTS[message] is GOOD else {"steps": "1", "ccp_type": "apgd"}
    words = {"scene": "mine.py", **how}
    with pytest.raises((OptionError, SceneError), match=re.escape(message)):
        simulated(words)
