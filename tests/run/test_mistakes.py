"""Likely mistakes in Python, each with a sentence that says what is allowed."""

from __future__ import annotations

import warnings

import pytest

from pctt import Box, Dynamic, Plane, Scene, Simulation
from pctt.options import OptionError


def falling(**law):
    scene = Scene(0.5, **law)
    scene.add_spheres([[0, 0, 0.3], [1, 0, 0.4]], 0.05, 1500.0, material="glass")
    scene.add_body("floor", [Plane((0, 0, 1))])
    return scene


@pytest.mark.parametrize(("shapes", "motion", "words"), [
    ([Box((1, 1, 1))], Dynamic, r"motion of 'b': the class Dynamic; allowed is one, Dynamic\(...\)"),
    (Box((1, 1, 1)), Dynamic(), "shapes of 'b': Box.*; allowed is a list of one or more"),
    ([], Dynamic(), "shapes of 'b': .*; allowed is a list of one or more"),
])  # fmt: skip
def test_a_body_of_a_class_or_of_no_list_is_refused(shapes, motion, words):
    with pytest.raises(ValueError, match=words):
        falling().add_body("b", shapes, motion, density=1000.0)


def test_an_attribute_that_a_simulation_does_not_have_is_not_set():
    sim = Simulation(falling())
    for name in ("dt", "gravity", "figurs"):
        with pytest.raises(AttributeError, match=f"a Simulation has no '{name}' to set; settings are arguments"):
            setattr(sim, name, 0.5)
    sim.figures = {}  # it has
    sim.step()
    assert sim.copy().steps == 1


def test_a_time_that_is_past_is_no_end():
    sim = Simulation(falling(), dt=0.01)
    sim.run(until=0.05)
    sim.run(until=sim.time)
    assert sim.steps == 5
    with pytest.raises(OptionError, match=r"run\(until=0.02\): the time is 0.05 s already; allowed is a later one"):
        sim.run(until=0.02)


def test_unused_materials_and_rolling_of_more_than_a_radius_are_told():
    scene = falling(rolling=0.06)
    scene.set_pair("glas", "glass", friction=0.1)
    words = r"no body has the material .glas.; did you mean glass\?; rolling or spinning of 0.06 m"
    with pytest.warns(UserWarning, match=words):
        Simulation(scene)
    scene = falling(rolling=0.04)
    scene.set_pair("default", "glass", friction=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulation(scene)
