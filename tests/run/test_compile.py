"""Loops that are compiled ahead of the first step."""

from __future__ import annotations

import subprocess
import sys

import pytest

from pctt import compile

BEYOND = """
import gc
from numba.core.dispatcher import Dispatcher
from pctt import Box, Plane, Scene, Simulation, compile
from pctt.scenes import Blade, Drum

def used():
    loops = [each for each in gc.get_objects() if isinstance(each, Dispatcher)]
    return {f"{each.py_func.__qualname__} {signature}" for each in loops for signature in each.signatures}

for kind in compile.KINDS.values():
    kind()
ready = used()
assert len(ready) > 100
Simulation(Drum()).run(steps=2)
Simulation(Blade()).run(steps=2)
scene = Scene(0.3)
scene.add_body("floor", [Plane((0, 0, 1))])
scene.add_boxes([[0, 0, 0.1], [0.01, 0, 0.3], [0, 0, 0.51]], (0.1, 0.1, 0.1), 1e3)
Simulation(scene).run(steps=2)
print(*used() - ready, sep=chr(10))
"""


@pytest.mark.slow
def test_first_steps_need_no_other_loops(tmp_path):
    words = [sys.executable, "-c", BEYOND]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout == "\n"


def test_words_are_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["pctt.compile", "-n"])
    with pytest.raises(SystemExit, match="2"):
        compile.main()
    assert capsys.readouterr().err.endswith("error: unrecognized arguments: -n\n")
