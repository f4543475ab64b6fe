"""Cone problems of steps in files: -dump_problem, the hard ones by themselves, and -problem that solves them again."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from program import SETTLED, SMALL, steps_of, summary_of

from pctt.run.dump import Dump

TOL = ("-ccp_tol", 1e-8)
PDIP = (*SETTLED, "-ccp_type", "pdip")
HARD = (*PDIP, "-ccp_max_it", 2)  # no step is solved in two Newton steps


def product(group: h5py.Group, x: np.ndarray, transposed: bool = False) -> np.ndarray:
    """A x or A' x for a matrix in triplets."""
    assert group["nz"][0] == len(group["x"])
    row, column = (group["p"][:], group["i"][:]) if transposed else (group["i"][:], group["p"][:])
    y = np.zeros(int(group["n" if transposed else "m"][0]))
    np.add.at(y, row, group["x"][:] * x[column])
    return y


def first_step(settled: Path) -> int:
    with h5py.File(settled) as file:
        return int(file["world/step"][()]) + 1


@pytest.mark.parallel(1, 2)
def test_the_problem_of_a_step_is_written_and_solved_again(program, settled, tmp_path):
    program(*PDIP, *TOL, "-dt", 0.025, "-steps", 2, "-dump_problem", "problems")
    steps = steps_of(tmp_path / "results")
    last = steps[1]
    names = {f"problems/step{line['step']:06d}_{line['contacts']}contacts" for line in steps}
    assert {name for line in steps for name in line["dumped"]} == {f"{name}.h5" for name in names}
    assert {str(path.relative_to(tmp_path)) for path in (tmp_path / "problems").iterdir()} == {
        f"{name}.h5" for name in names
    }
    done = program("-problem", *last["dumped"], *TOL, "-output", "again", "-overwrite")  # from the file's guess
    again = summary_of(tmp_path / "again")
    assert again["converged"]
    assert again["contacts"] == last["contacts"]
    assert again["objective"] == pytest.approx(last["objective"], rel=1e-6)
    assert again["velocity_norm"] == pytest.approx(last["velocity_norm"], rel=1e-5)
    assert again["format"] == "FCLIB global"
    assert again["title"] == f"mixer, step {last['step']}"
    assert again["start"] == "the guess in the file"
    reference = again["references"]["solution"]
    assert reference["relative_distance"] < 1e-6
    assert reference["natural_residual"] == pytest.approx(last["natural_residual"], rel=1e-3, abs=1e-12)
    assert again["references"]["guess"]["relative_distance"] > 1e-4
    assert "the file's solution: velocity_distance" in done.stdout
    check_mechanics(last, tmp_path)


def check_mechanics(line: dict, tmp_path: Path) -> None:
    """M v = H r + f, u = H'v + w, with the velocities and impulses of state.h5, which the solver's side did not write;
    the walls and the paddle have no rows."""
    with h5py.File(tmp_path / line["dumped"][0]) as file, h5py.File(tmp_path / "results" / "state.h5") as state:
        step = state[f"steps/{line['step']:06d}"]
        group, solution = file["fclib_global"], file["solution"]
        r, u, v = (solution[name][:] for name in "ruv")
        assert len(v) == 6 * 27
        f, w = group["vectors/f"][:], group["vectors/w"][:]
        assert np.allclose(product(group["M"], v), product(group["H"], r) + f, atol=1e-12 * np.abs(f).max())
        assert np.allclose(product(group["H"], v, transposed=True) + w, u, atol=1e-12)
        assert np.array_equal(step["contact/impulse"][:].ravel(), r)
        assert np.array_equal(file["pctt/point"][:], step["contact/point"][:])
        grains = step["velocity"][:27]
        assert np.allclose(np.sort(grains[:, 2]), np.sort(v.reshape(-1, 6)[:, 2]), atol=1e-13)
        mass = 2500 * 4 / 3 * np.pi * 0.1**3
        assert group["M/nz"][0] == 6 * 27
        assert np.allclose(np.sort(group["M/x"][:]), np.repeat([0.4 * mass * 0.01, mass], 81))
        # a contact's w is its gap over dt, but where the paddle moves, and where spheres slide or roll on each other
        touches_large = (step["contact/body"][:] >= 27).any(1)
        gap = np.maximum(step["contact/gap"][:] / 0.025, -1.0)
        assert (~touches_large).any()
        less = (gap - w.reshape(-1, 3)[:, 0])[~touches_large]
        assert np.abs(less).max() < 0.1
        assert np.median(np.abs(less)) < 0.01
        assert np.allclose(w.reshape(-1, 3)[~touches_large, 1:], 0, atol=1e-12)


@pytest.mark.parallel(1, 2)
def test_hard_problems_are_kept_and_the_steps_say_so(program, settled, tmp_path):
    done = program(*HARD, "-steps", 6)
    steps = steps_of(tmp_path / "results")
    hard = [s for s in steps if s["solver"] != s["asked_solver"]]
    kept = [f"results/hard/step{s['step']:06d}_{s['contacts']}contacts_2its.h5" for s in hard]
    assert len(kept) >= 3
    assert [line["hard_problem"] for line in hard] == kept
    assert {line["hard_problem"] for line in steps} == {*kept, ""}
    assert sorted(str(p.relative_to(tmp_path)) for p in (tmp_path / "results" / "hard").iterdir()) == kept
    assert re.findall(r"hard problem kept: (\S+)\)", done.stdout) == kept
    program("-problem", kept[1], *TOL, "-output", "solved")
    solved = summary_of(tmp_path / "solved")
    assert solved["converged"]
    assert solved["contacts"] == steps[1]["contacts"]
    limits = ("-ccp_type", "pdip", "-ccp_max_it", 2, "-ccp_fallback", 0)
    few = program("-problem", kept[1], *limits, "-output", "few", status=3)
    assert f"pctt.run: -problem {kept[1]}: NOT CONVERGED: " in few.stderr
    assert (summary_of(tmp_path / "few")["converged"], summary_of(tmp_path / "few")["newton_its"]) == (False, 2)


def test_a_hard_problem_of_very_many_contacts_is_not_written_unasked(program, settled, tmp_path, monkeypatch):
    monkeypatch.setattr(Dump, "most", 10)
    with pytest.warns(UserWarning, match="more than are written unasked; allowed are 10, unless the run keeps all"):
        program(*HARD, "-steps", 2, "-dump_problem", "all")
    assert [line["hard_problem"] for line in steps_of(tmp_path / "results")] == ["", ""]
    assert not (tmp_path / "results" / "hard").exists()
    assert len(list((tmp_path / "all").iterdir())) == 2


def test_hard_problems_of_another_run_are_replaced_and_of_this_one_kept(program, settled, tmp_path):
    def hard() -> list[int]:
        return sorted(int(path.name[4:10]) for path in (tmp_path / "results" / "hard").iterdir())

    first = first_step(settled)
    program(*HARD, "-steps", 2)
    assert hard() == [first, first + 1]
    again = [*SMALL, "-ccp_type", "pdip", "-ccp_max_it", 2, "-restart", "results/checkpoint.h5", "-steps", 1]
    program(*again)
    assert hard() == [first, first + 1, first + 2]
    program(*HARD, "-steps", 1, "-overwrite")
    assert hard() == [first]


UNWRITTEN = """
from dataclasses import dataclass
from dem.experiment import Experiment
from dem.scene import Scene
from dem.shapes import Plane

@dataclass(frozen=True)
class Row(Experiment):
    def build(self):
        scene = Scene(friction=0.3, rolling=ROLLING)
        scene.add_body("floor", [Plane((0, 0, 1))])
        ids = scene.add_spheres([[0.2 * k, 0, 0.1] for k in range(4)], 0.1, 1000.0, velocity=(1.0, 0, 0))
        if not ROLLING:
            scene.add_joint("bond", ids[0], ids[1], kind="ball", anchor=(0.1, 0, 0.1))
        return scene
"""


@pytest.mark.parametrize(("rolling", "what"), [(0.01, "rolling"), (0.0, "joints")])
def test_problems_that_no_file_can_hold_are_not_written(program, tmp_path, rolling, what):
    (tmp_path / "row.py").write_text(UNWRITTEN.replace("ROLLING", str(rolling)))
    given = ("-scene", "row.py", "-dt", 0.01, "-ccp_max_it", 1, "-ccp_fallback", "false", "-steps", 3)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        program(*given, "-output", "kept")
    remarks = [str(one.message) for one in said if "is not written" in str(one.message)]
    assert len(remarks) == 1
    steps = steps_of(tmp_path / "kept")
    assert not steps[0]["converged"]
    assert [line["hard_problem"] for line in steps] == [""] * 3
    assert not (tmp_path / "kept" / "hard").exists()
    done = program(*given, "-output", "new", "-dump_problem", "problems", status=2)
    assert f"-dump_problem: files have no {what}" in done.stderr
    assert [path for folder in ("new", "problems") for path in (tmp_path / folder).glob("*")] == []
