"""-help lists every option with its default, unit and meaning, and does nothing."""

from __future__ import annotations

import dataclasses
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mpi4py import MPI
from petsc4py import PETSc
from program import ROOT, SMALL

import pctt
from pctt import ccp
from pctt.pc import BlockICC, TensorTrain
from pctt.run.settings import Run, Settings
from pctt.scenes import Mixer

GROUPS = [(Run, ""), (Mixer, "scene_"), (Settings, "ccp_")]
GROUPS += [(solver.options, f"ccp_{name}_") for name, solver in ccp.SOLVERS.items()]
GROUPS += [(kind.options_class, kind.options_prefix) for kind in (BlockICC, TensorTrain)]


def options_of(group):
    return [field for field in dataclasses.fields(group) if not field.metadata.get("python_only")]


@pytest.mark.parallel(1, 2)
def test_help_lists_every_option_and_runs_nothing(program, tmp_path):
    done = program("-help", *SMALL, "-steps", "1", own=MPI.COMM_WORLD.size == 1)
    assert not list(tmp_path.iterdir())
    listed = re.findall(r"^  -(\w+) <(.*?)>: (.+)$", done.stdout, re.MULTILINE)
    names = [name for name, _, _ in listed]
    assert len(names) == len(set(names))
    table = {name: (default, meaning) for name, default, meaning in listed}
    count = 0
    for group, prefix in GROUPS:
        for field in options_of(group):
            default, meaning = table[field.metadata.get("name") or prefix + field.name]
            assert field.metadata["help"] in meaning
            unit = field.metadata.get("unit", "")
            assert default.endswith(f" {unit}" if unit else "")
            if isinstance(field.default, (int, float)) and not isinstance(field.default, bool):
                assert float(default.split()[0]) == field.default
            count += 1
    assert count == len(names)
    units = {"dt": "s", "delta": "m", "recovery_speed": "m/s", "scene_radius": "m", "scene_density": "kg/m^3"}
    units |= {"scene_angular_velocity": "rad/s", "scene_gravity": "m/s^2"}
    assert all(table[name][0].endswith(f" {unit}") for name, unit in units.items())


@pytest.mark.parametrize(
    ("topic", "there", "missing"), [("scene", "-scene_n ", "-ccp_tol"), ("ccp", "-ccp_tol ", "-scene_n")]
)
def test_help_on_one_topic(topic, there, missing, program):
    text = program("-help", topic).stdout
    assert f"  {there}" in text
    assert missing not in text


def test_an_unknown_topic_is_refused(program):
    done = program("-help", "scnee", status=2)
    assert done.stderr == (
        "pctt.run: -help scnee: there is no such topic; allowed are run, scene, ccp, pc, ksp, or none for all\n"
    )


def test_the_version_names_petsc(program):
    words = program("--version").stdout.split()
    assert words[:2] == ["pctt", pctt.__version__]
    assert f"(PETSc {'.'.join(map(str, PETSc.Sys.getVersion()))}," in " ".join(words)


def test_a_reader_that_has_enough_ends_it_without_a_word():
    """As `| head` does; PETSc would print a page about the signal."""
    done = subprocess.Popen([sys.executable, "-m", "pctt.run", "-help"], stdout=-1, stderr=-1, text=True, cwd=ROOT)
    assert done.stdout
    assert done.stderr
    done.stdout.close()
    assert done.stderr.read() == ""
    assert done.wait() == -signal.SIGPIPE


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_an_answer_without_room_is_one_line(program, monkeypatch):
    """And no other at the end, when Python closes the file."""
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        done = program("-version", status=2)
    assert done.stderr == "pctt.run: the answer cannot be written (No space left on device)\n"
