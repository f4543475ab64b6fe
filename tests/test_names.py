"""The names of `pctt`: what they are, that they cost nothing before their first use, and what objects say in a line."""

from __future__ import annotations

import io
import pydoc
import subprocess
import sys
from contextlib import redirect_stdout
from importlib import import_module

import numpy as np
import pytest

import pctt
from pctt import Box, Dynamic, Plane, Scene, Simulation
from pctt.options import OptionError
from pctt.render import Picture


def test_names_are_those_of_their_modules():
    for name in pctt.__all__:
        home = import_module(pctt._HOME[name])
        assert getattr(pctt, name) is getattr(home, name)
        assert name in dir(pctt)
    with pytest.raises(AttributeError, match="module 'pctt' has no attribute 'Sphear'"):
        _ = pctt.Sphear


def test_help_names_them():
    with redirect_stdout(io.StringIO()) as said:
        pydoc.doc(pctt, output=said)
    assert [name for name in pctt.__all__ if name not in said.getvalue()] == []


def test_preconditioners_load_no_mechanics():
    text = "import pctt, sys; assert 'numpy' not in sys.modules; import pctt.pc; print([n for n in sys.modules if "
    text += "n.startswith(('dem.scene', 'dem.step', 'pctt.run', 'pctt.simulation'))])"
    assert subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_objects_say_what_they_are_in_a_line():
    scene = Scene(0.4)
    scene.add_spheres([[0, 0, 0.1], [0, 0, 0.4]], 0.1, 1000.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_body("arm", [Box((0.1, 0.1, 0.1))], Dynamic(), density=1e3, position=(3, 0, 1.5))
    scene.add_joint("pin", None, "arm", anchor=(3, 0, 1.7))
    assert repr(scene) == "<Scene: 2 grains; 2 large bodies, 'floor', 'arm'; 1 joints; friction 0.4>"
    sim = Simulation(scene)
    assert repr(sim.body("arm")) == "<Body 'arm': Dynamic, at (3, 0, 1.5) m, 0 m/s>"
    assert repr(sim.joint("pin")) == "<Joint 'pin': hinge of the world and 'arm'>"
    picture = Picture(np.zeros((480, 640, 3), np.uint8))
    assert repr(picture).startswith("<Picture of 640 x 480 pixels")
    with pytest.raises(OptionError, match=r"save\('now.jpg'\): allowed is a name that ends with .png"):
        picture.save("now.jpg")  # it would be a PNG file
