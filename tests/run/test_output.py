"""What a run leaves behind: summary.json, state.h5 and what it says."""

from __future__ import annotations

import io
import json
import math
import re
import sys

import h5py
import numpy as np
import pytest
from program import SETTLED, SMALL, arrays, database, simulated, steps_of, summary_of

from pctt.scenes import Mixer

STEP = {
    "step": int,
    "time": float,
    "contacts": int,
    "newton_its": int,
    "ksp_its": int,
    "natural_residual": float,
    "objective": float,
    "seconds": float,
}
DT = 0.01


def frame(path, step):
    """The data sets of one step of a state.h5, and the attributes of the step."""
    with h5py.File(path, "r") as file:
        attributes = dict(file[f"steps/{step:06d}"].attrs)
    return {n[7:]: a for n, a in arrays(path).items() if n.startswith(f"{step:06d}/")}, attributes


@pytest.mark.parametrize("solver", ["pdip", "apgd"])
def test_the_summary_has_the_documented_fields(solver, program, settled, tmp_path):
    program(*SETTLED, "-steps", 3, "-dt", DT, "-ccp_type", solver)
    summary, lines = summary_of(tmp_path / "results"), steps_of(tmp_path / "results")
    assert (summary["bodies"], summary["ranks"], summary["compare"]) == (29, 1, {})
    assert (summary["steps"], summary["not_converged"]) == (3, 0)
    first = lines[0]["step"]
    assert (summary["first_step"], summary["last_step"], summary["time"]) == (first, first + 2, lines[-1]["time"])
    for name in ("newton_its", "ksp_its", "seconds"):
        assert summary[name] == pytest.approx(sum(line[name] for line in lines))
    assert summary["natural_residual"] == max(line["natural_residual"] for line in lines)
    deepest = max(lines, key=lambda line: line["worst_overlap"])
    assert summary["worst_overlap"] == {
        "overlap [m]": deepest["worst_overlap"], "step": deepest["step"], "smallest_radius [m]": 0.1
    }
    for k, line in enumerate(lines):
        for name, kind in STEP.items():
            assert type(line[name]) is kind, f"{name}: {line[name]!r}"
        assert line["step"] == first + k
        assert line["time"] == pytest.approx(lines[0]["time"] + k * DT)
        assert line["contacts"] > 40
        of_the_law = "coulomb_residual" if line["law"] == "coulomb" else "natural_residual"
        assert 0 < line[of_the_law] <= 1e-3
        assert line["objective"] < 0
        assert 0 < line["seconds"] < 100
        newton = solver == "pdip"
        assert (line["newton_its"] > 0) == newton
        assert (line["ksp_its"] >= line["newton_its"]) if newton else line["ksp_its"] == 0
        assert sum(line["phases"].values()) == pytest.approx(line["seconds"])
    assert len(lines) == 3


@pytest.mark.parallel(1, 2)
def test_the_first_step_without_contacts_is_free_fall(program, tmp_path):
    """It tells the order of the rows: by id, the large bodies last."""
    options = ("-steps", 1, "-dt", DT, "-scene_gravity", 5.0, "-delta", 1e-6)
    done = program(*SMALL, *options)
    scene = Mixer(n=1, margin=0.7)
    (line,) = steps_of(tmp_path / "results")
    assert (line["contacts"], line["newton_its"], line["natural_residual"], line["objective"]) == (0, 0, 0, 0)
    assert "NOT CONVERGED" not in done.stdout
    data, attributes = frame(tmp_path / "results" / "state.h5", 1)
    assert attributes == {"step": 1, "time": DT}
    fallen = scene.positions()[:] - [0, 0, 5.0 * DT**2]
    np.testing.assert_allclose(data["position"][:27], fallen, atol=1e-14)
    paddle = [0, 0, scene.clearance + scene.paddle_height * scene.width / 2]
    np.testing.assert_allclose(data["position"][27:], [[0, 0, 0], paddle], atol=1e-14)
    falling = [0, 0, -5.0 * DT, 0, 0, 0]
    np.testing.assert_allclose(data["velocity"][:27], np.tile(falling, (27, 1)), atol=1e-14)
    turning = [0, 0, 0, 0, 0, scene.angular_velocity]
    np.testing.assert_allclose(data["velocity"][27:], [np.zeros(6), turning], atol=1e-12)
    half = scene.angular_velocity * DT / 2
    np.testing.assert_allclose(data["quaternion"][:28], np.tile([1.0, 0, 0, 0], (28, 1)), atol=1e-14)
    np.testing.assert_allclose(data["quaternion"][28], [math.cos(half), 0, 0, math.sin(half)], atol=1e-14)
    assert data["contact/impulse"].shape == (0, 3)


@pytest.mark.parallel(1, 2)
def test_the_state_has_bodies_and_contacts_of_each_step(ranks, program, settled, tmp_path):
    program(*SETTLED, "-steps", 2, "-ccp_type", "apgd")
    path = tmp_path / "results" / "state.h5"
    with h5py.File(path, "r") as file:
        assert json.loads(file.attrs["scene"])["margin"] == 0.7
        assert list(file.attrs["large_bodies"]) == ["box", "mixer"]
    summary = summary_of(tmp_path / "results")
    assert summary["ranks"] == ranks
    radius, friction = 0.1, 0.25
    constant = {name[7:] for name in arrays(path) if name.startswith("bodies/")}
    assert constant == {"shape", "size", "mass", "material", "materials", "large"}
    before = None
    for line in steps_of(tmp_path / "results"):
        data, _ = frame(path, line["step"])
        shapes = {name: array.shape for name, array in data.items()}
        nc = line["contacts"]
        assert shapes == {
            "position": (29, 3),
            "quaternion": (29, 4),
            "velocity": (29, 6),
            "start": (29, 3),
            "contact/key": (nc,),
            "contact/body": (nc, 2),
            "contact/point": (nc, 3),
            "contact/frame": (nc, 3, 3),
            "contact/moved": (nc, 3),
            "contact/gap": (nc,),
            "contact/impulse": (nc, 3),
        }
        np.testing.assert_allclose(np.linalg.norm(data["quaternion"], axis=1), 1.0, atol=1e-14)
        contact = {name[8:]: array for name, array in data.items() if name.startswith("contact/")}
        assert len(np.unique(contact["key"])) == nc
        assert (contact["body"][:, 0] < contact["body"][:, 1]).all()
        unit = contact["frame"] @ contact["frame"].transpose(0, 2, 1)
        np.testing.assert_allclose(unit, np.tile(np.eye(3), (nc, 1, 1)), atol=1e-12)
        normal, sliding = contact["impulse"][:, 0], np.hypot(*contact["impulse"][:, 1:].T)
        assert (sliding <= friction * normal + 1e-12).all()
        assert (normal > 1e-3).sum() > 20
        if before is not None:  # gaps are those of the start of the step, between the bodies named
            both = contact["body"][:, 1] < 27
            a, b = contact["body"][both].T
            np.testing.assert_array_equal(data["start"][:27], before["position"][:27])
            distance = np.linalg.norm(before["position"][b] - before["position"][a], axis=1)
            np.testing.assert_allclose(contact["gap"][both], distance - 2 * radius, atol=1e-13)
        before = data


def test_no_state_is_written_if_none_is_wanted(program, settled, tmp_path):
    program(*SETTLED, "-steps", 2, "-output_every", 0, "-ccp_type", "apgd")
    assert sorted(p.name for p in (tmp_path / "results").iterdir() if p.is_file()) == [
        "checkpoint.h5",
        "records.csv",
        "settings.json",
        "steps.jsonl",
        "summary.json",
    ]


def test_lines_are_plain_where_there_is_no_terminal(program, settled):
    done = program(*SETTLED, "-steps", 2, "-ccp_type", "apgd")
    assert done.stderr == ""
    assert "\r" not in done.stdout
    assert "\033" not in done.stdout
    head, first = (done.stdout.splitlines()[k].split() for k in (4, 5))
    assert head[:3] == ["step", "time", "s"]
    assert int(first[0]) > 90


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_on_a_terminal_the_present_step_is_shown(settled, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMIX_RANK"):  # those of mpiexec, which MPI itself may set
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "stdout", terminal := Terminal())
    simulated(database([*SMALL, "-restart", str(settled), "-steps", "2", "-ccp_type", "apgd"]))
    first, said = int(arrays(settled)["world/step"]) + 1, terminal.getvalue()
    assert f"\r\033[Kstep {first}, time" in said
    assert "(2 of 2)" in said
    assert re.search(r"about \d+ s left", said)


def test_a_quiet_run_says_nothing_but_errors(program, settled, tmp_path):
    done = program(*SETTLED, "-steps", 1, "-ccp_type", "apgd", "-quiet")
    assert done.stdout == done.stderr == ""
    assert len(steps_of(tmp_path / "results")) == 1
    done = program(*SETTLED, "-quiet", "-steps", -1, status=2)
    assert done.stdout == ""
    assert "-steps -1" in done.stderr


def test_seconds_take_the_place_of_steps(program, settled, tmp_path):
    program(*SETTLED, "-steps", 1, "-dt", 0.0025, "-seconds", 0.014)  # another dt than that of settling
    lines = steps_of(tmp_path / "results")
    assert lines[-1]["time"] - lines[0]["time"] == pytest.approx(5 * 0.0025)
    assert all(line["converged"] for line in lines)
