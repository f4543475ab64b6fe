"""Reading an output folder, and what the programs say of one that is none."""

from __future__ import annotations

import json
import subprocess
import sys

import h5py
import handmade
import numpy as np
import pytest
from several_ranks import environment, mpiexec

from pctt.disk import FileError
from pctt.folder import Folder
from pctt.scenes import Mixer


def test_a_run_tells_the_shapes_of_its_bodies(folder):
    read = Folder(folder)
    read.require_frames()
    assert read.steps == [1, 2, 3, 4]
    assert read.grains == 125
    assert (read.shape[:125] == 0).all()
    assert (read.size[:125] == [0.1, 0, 0]).all()
    np.testing.assert_allclose(read.mass, [*[2500 * 4 / 3 * np.pi * 0.1**3] * 125, np.inf, np.inf])
    assert [read.materials[k] for k in read.material] == ["default"] * 127
    scene = Mixer(n=2).build()
    assert [body["name"] for body in read.large] == ["box", "mixer"]
    for stored, made in zip(read.large, scene.large_bodies):
        assert [shape["kind"] for shape in stored["shapes"]] == [type(shape).__name__ for shape in made.shapes]
    paddle = scene.large_bodies[1].shapes[0]
    assert read.large[1]["shapes"][0]["half_extents"] == list(paddle.half_extents)


def test_a_summary_of_fewer_steps_is_that_of_a_run_before(folder, tmp_path):
    """A run that goes on may be killed before it has removed the summary of the run before it."""
    made = Folder(folder)
    lines = made.lines()
    (tmp_path / "settings.json").write_text((folder / "settings.json").read_text())
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (tmp_path / "steps.jsonl").write_text(text)
    (tmp_path / "summary.json").write_text(json.dumps({**made.summary, "steps": 3, "worst": "stale"}))
    summary = Folder(tmp_path).summary
    assert summary["steps"] == len(lines) == 4
    assert "worst" not in summary


def test_forces_of_the_contacts_change_the_momentum(folder):
    """Newton's second law from the files alone: m dv = dt (sum of contact forces + weight)."""
    read = Folder(folder)
    read.require_frames()
    before, after = read.frame(3), read.frame(4)
    contacts = after.contacts
    assert contacts.dt == 0.1
    assert len(contacts.gap) > 10
    total = np.zeros((127, 3))
    np.add.at(total, contacts.bodies[:, 1], contacts.force)
    np.subtract.at(total, contacts.bodies[:, 0], contacts.force)
    mass = read.mass[:125, None]
    gained = mass * (after.velocity - before.velocity)[:125, :3] / contacts.dt + mass * [0, 0, 9.81]
    np.testing.assert_allclose(gained, total[:125], atol=1e-8)


def test_loads_are_sums_of_force_magnitudes(tmp_path):
    read = Folder(handmade.write(tmp_path / "made", handmade.FLOOR))
    frame = read.frame(1)
    np.testing.assert_allclose(frame.contacts.force, [[8, 0, -6], [0, 4, 0]], atol=1e-14)
    np.testing.assert_allclose(frame.load(), [14, 0, 4, 10])
    assert frame.speed[0] == 5


@pytest.mark.parametrize("program", ["plot", "render", "export"])
def test_a_folder_without_results_is_refused(program, show, tmp_path):
    assert "no such folder" in show(program, folder=tmp_path / "absent", status=2).stderr
    done = show(program, folder=tmp_path, status=2)
    assert str(tmp_path) in done.stderr
    assert "no output folder" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("program", ["render", "export"])
def test_a_run_without_recorded_steps_is_refused(program, show, tmp_path):
    (tmp_path / "summary.json").write_text('{"steps": 0}')
    assert "-output_every" in show(program, folder=tmp_path, status=2).stderr


@pytest.mark.parametrize(
    ("program", "options", "words"),
    [
        ("plot", ("-format", "bmp"), ("-format", "png")),
        ("export", ("-output", ""), ("-output", "the name of a folder")),
        ("export", ("-first", 9), ("-first", "1 to 4")),
        ("export", ("-every", 0), ("-every", ">= 1")),
        ("render", ("-color", "heat"), ("-color", "speed")),
        ("render", ("-size", "3x5"), ("-size", "3x5")),
        ("render", ("-color", "material", "-range", 0, 1), ("-range", "material")),
        ("render", ("-elevation", 95), ("-elevation", "95")),
        ("render", ("-azimuth", "nan"), ("-azimuth", "finite number")),
    ],
)
def test_a_bad_option_is_named(program, options, words, show):
    done = show(program, *options, status=2)
    for word in words:
        assert word in done.stderr
    assert "Traceback" not in done.stderr


def no_hdf5(path):
    path.write_text("these are no data\n" * 100)


def truncated(path):
    path.write_bytes(path.read_bytes()[:-1000])


def other_hdf5(path):
    with h5py.File(path, "w") as file:
        file["data"] = np.zeros(3)


@pytest.mark.parametrize("damage", [no_hdf5, truncated, other_hdf5], ids=lambda f: f.__name__)
@pytest.mark.parametrize("name", ["frames/000001.h5", "frames/bodies.h5"])
def test_a_damaged_file_is_named(name, damage, tmp_path):
    made = handmade.write(tmp_path / "made", handmade.FLOOR)
    damage(made / name)

    def read():
        folder = Folder(made)
        folder.require_frames()
        folder.frame(1)

    with pytest.raises(FileError, match=name) as error:
        read()
    assert str(made) in str(error.value)
    assert "\n" not in str(error.value)


def test_without_the_libraries_one_line_names_the_extra(python, tmp_path):
    """Also where they are: the import finds nothing."""
    made = handmade.write(tmp_path / "made", handmade.FLOOR)
    source = f"""
import importlib.abc, runpy, sys
class Nothing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in ("matplotlib", "vtkmodules", "PIL", "imageio_ffmpeg"):
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Nothing())
for program in ("plot", "render", "export"):
    sys.argv = ["pctt." + program, {str(made)!r}]
    try:
        runpy.run_module("pctt." + program, run_name="__main__")
    except SystemExit as end:
        print(end.code)
"""
    done = python("-c", source)
    assert done.stdout.split() == ["2", "2", "2"], done.stderr
    lines = done.stderr.splitlines()
    for line, program, missing in zip(lines, ("plot", "render", "export"), ("matplotlib", "", "vtkmodules")):
        assert line.startswith(f"pctt.{program}: No module named ")
        assert missing in line  # the pictures may ask for matplotlib or for vtkmodules first
        assert "pip install 'pctt[pictures]'" in line
    assert len(lines) == 3


FAILS = """
from pctt.look.program import run

def main(comm):
    if comm.rank == 1:
        raise KeyError("lost")
    comm.Barrier()

run(main, "plot")
"""


@pytest.mark.mpi
def test_an_error_of_one_rank_ends_all():
    words = [*mpiexec(2), sys.executable, "-c", FAILS]
    done = subprocess.run(words, env=environment(), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode != 0
    assert "KeyError: 'lost'" in done.stderr


def test_records_are_columns_of_numbers(tmp_path):
    read = Folder(handmade.write(tmp_path / "made", handmade.FLOOR))
    assert read.records() == {}
    records = [{"step": 1, "time [s]": 0.5, "force_blade_x [N]": 3.0}, {"step": 2, "time [s]": 1.0, "late [N]": None}]
    lines = [json.dumps({"step": record["step"], "record": record}) for record in records]
    (tmp_path / "made" / "steps.jsonl").write_text("\n".join([*lines, ""]))
    columns = read.records()
    np.testing.assert_array_equal(columns["force_blade_x [N]"], [3, np.nan])
    np.testing.assert_array_equal(columns["late [N]"], [np.nan, np.nan])
    (tmp_path / "made" / "analysis.csv").write_text("step,force\n1,many\n")
    with pytest.raises(FileError, match="analysis.csv"):
        read.analysis()


def test_figures_of_steps_that_were_no_numbers_are_infinite(tmp_path):
    read = Folder(handmade.write(tmp_path / "made", handmade.FLOOR))
    assert read.lines() == []
    table = tmp_path / "made" / "steps.jsonl"
    table.write_text('{"step": 1, "natural_residual": null}\n{"step": 2, "natural_residual": 1e-5}\n{"step": 3, "nat')
    assert read.lines() == [
        {"step": 1, "natural_residual": float("inf")}, {"step": 2, "natural_residual": 1e-5}
    ]  # the third is half a line
    table.write_text("words\n")
    with pytest.raises(FileError, match="steps.jsonl"):
        read.lines()
