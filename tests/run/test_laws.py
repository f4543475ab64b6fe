"""-law, -stiffness and -ccp_type auto in the program."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from program import SETTLED, steps_of, summary_of

from pctt.run.report import LARGE_OPENING


def steps(folder: Path) -> list[dict]:
    return steps_of(folder / "results")


@pytest.mark.parallel(1, 2)
def test_steps_with_coulombs_law(program, settled, tmp_path):
    """Which is the default; the relaxation says how far off it is."""
    options = ("-ccp_type", "apgd", "-ccp_tol", 1e-4, "-steps", 2)
    done = program(*SETTLED, *options)
    assert "apgd to 0.0001, Coulomb's law" in done.stdout
    worst = max(line["coulomb_residual"] for line in steps(tmp_path))
    assert f"law of contact: coulomb in 2 steps; Coulomb residual at most {worst:.1e}\n" in done.stdout
    for line in steps(tmp_path):
        assert line["converged"], line["reason"]
        assert line["law"] == "coulomb"
        assert line["coulomb_residual"] <= 1.01e-4
    done = program(*SETTLED, *options, "-law", "relaxation", "-overwrite")
    assert "apgd to 0.0001, relaxation of Coulomb's law" in done.stdout
    assert all(line["natural_residual"] <= 1.01e-4 for line in steps(tmp_path))
    worst = max(line["coulomb_residual"] for line in steps(tmp_path))
    assert all(line["law"] == "relaxation" for line in steps(tmp_path))
    assert f"law of contact: relaxation in 2 steps; Coulomb residual at most {worst:.1e}" in done.stdout
    assert ("add -law coulomb" in done.stdout) == (worst > LARGE_OPENING)


PRESS = """
from dataclasses import dataclass
from dem.experiment import Experiment
from dem.motion import Guided, Hinged
from dem.scene import Scene
from dem.shapes import Box

@dataclass(frozen=True)
class Press(Experiment):
    '''Spheres under a press on an oblique guide, or on a hinge.'''
    def build(self):
        scene = Scene(friction=0.3)
        scene.add_body("floor", [Box((2, 2, 0.1))], position=(0, 0, -0.1))
        scene.add_spheres([(x, y, 0.1) for x in (-0.5, 0.5) for y in (-0.5, 0.5)], 0.1, 1000.0)
        scene.add_body("press", [Box((2, 2, 0.1))], MOTION, position=(0, 0, 0.3), density=500.0)
        return scene
"""


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("motion", ["Guided((1, 0, 2), -100.0)", "Hinged((1, 2, 0), 500.0)"])
def test_a_problem_with_a_guided_or_hinged_body_is_written_as_it_is(program, tmp_path, motion):
    (tmp_path / "press.py").write_text(PRESS.replace("MOTION", motion))
    options = ("-ccp_type", "apgd", "-ccp_tol", 1e-8)
    program("-scene", "press.py", "-steps", 1, *options, "-dump_problem", "problems")
    (line,) = steps(tmp_path)
    assert line["contacts"] == 8
    for path in line["dumped"]:
        program("-problem", path, *options, "-output", "again", "-overwrite")
        again = summary_of(tmp_path / "again")
        assert again["objective"] == pytest.approx(line["objective"], rel=1e-6)


def test_a_loose_tolerance_is_warned_of(program, settled):
    for options, warned in (
        (("-ccp_type", "apgd", "-ccp_tol", 3e-3), True),
        (("-ccp_type", "apgd", "-ccp_tol", 2e-3), False),
    ):
        done = program(*SETTLED, "-steps", 1, *options, "-overwrite")
        assert ("WARNING: -ccp_tol 0.003" in done.stdout) == warned


def test_the_law_that_holds_where_none_is_asked_for(program, settled, tmp_path):
    """Coulomb's with every solver and tolerance, but for the paper's method and comparisons."""
    for options, law in (
        ((), "coulomb"),
        (("-ccp_type", "apgd", "-ccp_tol", 1e-6), "coulomb"),
        (("-ccp_type", "conic"), "coulomb"),
        (("-ccp_type", "barzilai_borwein"), "coulomb by cone problems"),
        (("-ccp_type", "pdip"), "relaxation"),
        (("-compare", "pbjacobi"), "relaxation"),
        (("-ccp_type", "pdip", "-law", "coulomb"), "coulomb by cone problems"),
    ):
        done = program(*SETTLED, "-steps", 1, *options, "-overwrite")
        (line,) = steps(tmp_path)
        assert line["law"] == law
        assert line["converged"]
        assert ("(by apgd)" in done.stdout) == (line["solver"] != line["asked_solver"])
        assert options or line["solver"] == "apgd"
        assert line["asked_solver"] == dict([options[:2] or ("-ccp_type", "auto")]).get("-ccp_type", "pdip")
        words = f"Coulomb residual {line['coulomb_residual']:.1e} by {line['cone_problems']} cone problems"
        assert (words in done.stdout) == (law == "coulomb by cone problems")


@pytest.mark.parametrize("stiffness", [1e6, np.inf])
def test_the_stiffness_goes_with_the_problem(program, settled, tmp_path, stiffness):
    options = ("-ccp_type", "pdip", "-dt", 0.025, "-ccp_tol", 1e-6, "-dump_problem", "problems")
    program(*SETTLED, "-steps", 1, "-stiffness", stiffness, *options)
    (line,) = steps(tmp_path)
    assert line["natural_residual"] <= 1.01e-6
    for path in line["dumped"]:
        program("-problem", path, "-ccp_type", "conic", "-ccp_tol", 1e-6, "-output", "again", "-overwrite")
        again = summary_of(tmp_path / "again")
        rest = 1.0 / (stiffness * 0.025**2)  # without damping
        assert 0.5 * rest <= again["mean_compliance"] <= rest
        assert again["objective"] == pytest.approx(line["objective"], rel=1e-5)
