"""A folder that holds a run is refused, or replaced with -overwrite: not before the first new step is written."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from program import DROP, arrays, contents, recorded_steps, simulated, steps_of, summary_of, table

from dem.together import SceneError
from pctt.ccp import BlockRows, ConeProblem, fclib
from pctt.disk import FileError
from pctt.options import OptionError
from pctt.run.options import read_options
from pctt.run.output import Place
from pctt.run.simulate import simulate, solve_file

SELF = MPI.COMM_SELF
FAILING = DROP.replace("return {}", "raise ValueError('no record')")
UNBUILDABLE = DROP.replace("return scene", "raise ValueError('no scene')")


@pytest.fixture
def run(tmp_path, monkeypatch):
    """`run(options, text=DROP)` makes steps of a scene file with this text, into out."""
    monkeypatch.chdir(tmp_path)

    def run(text=DROP, **options):
        (tmp_path / "drop.py").write_text(text)
        words = {"scene": "drop.py", "ccp_type": "apgd", "output": "out", "output_every": "1", "quiet": "true"}
        words |= options
        given = {name: value for name, value in words.items() if value is not None}
        simulated(given)

    return run


@pytest.fixture
def problem(tmp_path, monkeypatch):
    """A file with a problem of one contact."""
    monkeypatch.chdir(tmp_path)
    rows = np.zeros((1, 3, 6))
    rows[0, :, :3] = np.eye(3)
    G = BlockRows(np.array([0, 1]), np.array([0]), rows, 1)
    fclib.write_local(tmp_path / "problem.hdf5", ConeProblem(SELF, np.array([[-1.0, 0, 0]]), np.array([0.3]), G=G))
    return "problem.hdf5"


@pytest.mark.parametrize(
    "name", ["state.h5", "records.csv", "steps.jsonl", "summary.json", "checkpoint.h5", "frames/000001.h5"]
)
def test_a_folder_with_any_part_of_a_run_is_refused_before_any_work(name, problem, tmp_path):
    (tmp_path / "out" / "frames").mkdir(parents=True)
    (tmp_path / "out" / name).write_text("what was there")
    before = contents(tmp_path / "out")
    for options in ({"scene_n": "1"}, {"steps": "0"}, {"problem": problem}):
        with pytest.raises(OptionError) as refusal:
            read_options({**options, "output": "out"}, SELF)
        for word in ("-output out: holds a run", name.partition("/")[0], "-overwrite", "another folder"):
            assert word in str(refusal.value)
        assert ("-restart out/checkpoint.h5" in str(refusal.value)) == (name == "checkpoint.h5")
    assert contents(tmp_path / "out") == before


CHANGED = "ignore:.*was made with another text of the scene file"


@pytest.mark.filterwarnings(CHANGED)
def test_a_run_that_fails_in_its_first_step_has_destroyed_nothing(run, tmp_path):
    run(steps="3")
    early = (tmp_path / "out" / "checkpoint.h5").read_bytes()
    run(steps="3", restart="out/checkpoint.h5")
    (tmp_path / "out" / "checkpoint.h5").write_bytes(early)  # as of a run that was killed between two checkpoints
    before = contents(tmp_path / "out")
    with pytest.raises(SceneError, match="no record"):
        run(FAILING, overwrite="true")
    assert contents(tmp_path / "out") == before
    with pytest.raises(SceneError, match="no record"):
        run(FAILING, restart="out/checkpoint.h5")
    assert contents(tmp_path / "out") == before
    with pytest.raises(SceneError, match="no scene"):
        run(UNBUILDABLE, overwrite="true")
    run(overwrite="true", steps="0")
    run(restart="out/checkpoint.h5", steps="0")
    assert contents(tmp_path / "out") == before


def test_a_run_that_replaces_another_leaves_nothing_of_it(run, problem, tmp_path):
    """But files that are of no run; and none of either when a problem of a file is solved there."""
    run(steps="4", ccp_type="pdip", ccp_max_it="2", dt="0.1")
    assert list((tmp_path / "out" / "hard").iterdir())
    (tmp_path / "out" / "notes.txt").write_text("mine")
    run(steps="2", overwrite="true", output_every="2")
    assert (steps_of(tmp_path / "out")[-1]["step"], len(steps_of(tmp_path / "out"))) == (2, 2)
    assert table(tmp_path / "out" / "analysis.csv")["twice"].tolist() == [0.02, 0.04]
    run(steps="3", output="anew", output_every="2")
    run(steps="3", overwrite="true", output_every="2")
    there, alone = contents(tmp_path / "out"), contents(tmp_path / "anew")
    assert there.pop("notes.txt") == b"mine"
    assert set(there) == set(alone)
    for name in ("records.csv", "analysis.csv"):
        assert there[name] == alone[name]
    assert recorded_steps(arrays(tmp_path / "out" / "state.h5")) == ["000002", "000003"]
    solve_file(read_options({"problem": problem, "output": "out", "overwrite": "true", "quiet": "true"}, SELF), SELF)
    assert set(contents(tmp_path / "out")) == {"summary.json", "notes.txt"}
    assert summary_of(tmp_path / "out")["problem"] == problem


@pytest.mark.filterwarnings(CHANGED)
def test_a_run_that_goes_on_makes_anew_what_lies_behind_its_checkpoint(run, tmp_path):
    """The steps after it go when the first new step is written, with the analysis and the links."""
    run(steps="2")
    early = (tmp_path / "out" / "checkpoint.h5").read_bytes()
    run(steps="4", restart="out/checkpoint.h5")
    whole = contents(tmp_path / "out")
    (tmp_path / "out" / "checkpoint.h5").write_bytes(early)
    run(steps="1", restart="out/checkpoint.h5", output_every="0", overwrite="true")
    assert [line["step"] for line in steps_of(tmp_path / "out")] == [1, 2, 3]
    assert recorded_steps(arrays(tmp_path / "out" / "state.h5")) == ["000001", "000002"]
    assert sorted(path.stem for path in (tmp_path / "out" / "frames").iterdir()) == ["000001", "000002", "bodies"]
    run(steps="3", restart="out/checkpoint.h5")
    assert (tmp_path / "out" / "records.csv").read_bytes() == whole["records.csv"]
    assert (tmp_path / "out" / "analysis.csv").read_bytes() == whole["analysis.csv"]
    summary = summary_of(tmp_path / "out")
    assert (summary["steps"], summary["first_step"], summary["last_step"]) == (6, 1, 6)
    text = DROP.replace('{"twice": 2 * records["time [s]"]}', "{}")
    run(text, steps="1", restart="out/checkpoint.h5")
    assert not (tmp_path / "out" / "analysis.csv").exists()


@pytest.mark.parallel(2)
def test_two_ranks_replace_a_run(run, program, tmp_path):
    if MPI.COMM_WORLD.rank == 0:
        run(steps="3")
    MPI.COMM_WORLD.Barrier()
    words = ("-scene", "drop.py", "-ccp_type", "apgd", "-steps", 2, "-output_every", 1, "-output", "out")
    done = program(*words, status=2)
    assert done.stderr.count("pctt.run: -output out: holds a run") == 1
    program(*words, "-overwrite")
    assert recorded_steps(arrays(tmp_path / "out" / "state.h5")) == ["000001", "000002"]
    assert summary_of(tmp_path / "out")["ranks"] == 2
    assert not (tmp_path / "out" / ".new").exists()
    with h5py.File(tmp_path / "out" / "checkpoint.h5") as file:
        assert file["world/step"][()] == 2


def test_a_folder_to_which_a_run_is_writing_is_refused_until_it_ends(run, tmp_path):
    place = Place(tmp_path / "out", SELF)
    with pytest.raises(FileError, match="another run is writing there"):
        run(overwrite="true")
    assert not contents(tmp_path / "out")
    place.leave()
    run()


def test_a_run_does_not_replace_one_that_came_while_it_began(run, tmp_path):
    (tmp_path / "drop.py").write_text(DROP)
    late = read_options({"scene": "drop.py", "ccp_type": "apgd", "output": "out", "quiet": "true"}, SELF)
    run()
    before = contents(tmp_path / "out")
    with pytest.raises(FileError, match="-output out: holds a run"):
        simulate(late, SELF)
    assert contents(tmp_path / "out") == before


def test_a_run_goes_on_beside_a_damaged_list_of_steps_with_a_remark(run, tmp_path):
    run(steps="3")
    path, on = tmp_path / "out" / "steps.jsonl", {"restart": "out/checkpoint.h5", "steps": "1"}
    lines = path.read_text().splitlines(keepends=True)
    path.write_text(lines[0] + lines[2])
    with pytest.warns(UserWarning, match="has no figures of some of the steps up to 3"):
        run(**on)
    assert [line["step"] for line in steps_of(tmp_path / "out")] == [1, 3, 4]
    path.unlink()
    with pytest.warns(UserWarning, match="has no figures of some of the steps up to 4"):
        run(**on)
    path.write_text(path.read_text() + "garbage\n")
    with pytest.raises(FileError, match="line 2 is no step .*; delete it, and the run goes on with the others"):
        run(**on)
