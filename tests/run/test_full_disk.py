"""A disk that fills up, or takes no files: status 2, one clear line, and what was written before stays whole."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import subprocess
import tempfile

import numpy as np
import pytest
from mpi4py import MPI
from program import (
    EVERY,
    SMALL,
    arrays,
    command,
    contents,
    environment,
    one_line,
    recorded_steps,
    simulated,
    steps_of,
)

from pctt import disk
from pctt.disk import FileError, append

LOOSE = ("-ccp_type", "apgd", "-ccp_tol", "1e-3")
SCENE = {"scene_n": "1", "scene_margin": "0.5", "dt": "0.025", "output": "out", "quiet": "true"}
SCENE |= {"ccp_type": "apgd", "ccp_tol": "1e-3", "output_every": "1", "checkpoint_every": "1"}


def check_whole(folder):
    """All that is there can be read and nothing else is there; the step of the checkpoint."""
    assert not list(folder.rglob("*.tmp"))
    steps = [line["step"] for line in steps_of(folder)]
    step = int(arrays(folder / "checkpoint.h5")["world/step"])
    assert set(steps) >= set(range(1, step + 1))
    if (folder / "state.h5").exists():  # not with -output_every 0
        state = arrays(folder / "state.h5")
        assert all(state[f"{name}/position"].shape == (29, 3) for name in recorded_steps(state))
        assert {int(name) for name in recorded_steps(state)} >= set(range(1, step + 1))
    return step


class Limit:
    """Within it no file of this process gets longer than so many bytes, as if the disk were full."""

    def __init__(self, size):
        self.size = size

    def __enter__(self):
        self.before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (self.size, self.before[1]))

    def __exit__(self, *_):
        resource.setrlimit(resource.RLIMIT_FSIZE, self.before)


@pytest.mark.parametrize(
    ("size", "file", "options"),
    [
        (9_000, "out/frames/000003.h5", {}),
        (500, "out/settings.json", {"output_every": "0"}),
        (2_000, "out/steps.jsonl", {"output_every": "0"}),
        (20_000, "out/checkpoint.h5", {"output_every": "0"}),
        (20_000, "problems/step000003_", {"dump_problem": "problems"}),
    ],
)
def test_a_file_that_cannot_be_written_ends_the_run_and_spares_the_others(size, file, options, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(**more):
        simulated({**SCENE, **more})

    run(steps="2", **options)
    shutil.rmtree("problems", ignore_errors=True)
    assert check_whole(tmp_path / "out") == 2
    again = {"restart": "out/checkpoint.h5", "steps": "1"}
    with Limit(size), pytest.raises(FileError, match=r"cannot write \(.*File too large\)") as error:
        run(**again, **options)
    assert str(error.value).startswith(file)
    assert check_whole(tmp_path / "out") == 2
    run(**again, **options)  # the disk has room again
    assert check_whole(tmp_path / "out") == 3


def test_a_run_that_cannot_write_its_first_step_leaves_the_one_that_it_was_to_replace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(**more):
        simulated({**SCENE, "steps": "2", **more})

    run()
    before = contents(tmp_path / "out")
    for size, every, file in ((9_000, "1", "frames/000001.h5"), (20_000, "0", "checkpoint.h5")):
        with Limit(size), pytest.raises(FileError, match=rf"out/.new/{file}: cannot write \(File too large\)"):
            run(overwrite="true", output_every=every)
        assert contents(tmp_path / "out") == before
    run(overwrite="true", steps="3")
    assert check_whole(tmp_path / "out") == 3
    assert not (tmp_path / "out" / ".new").exists()


def test_of_a_line_that_has_no_room_nothing_stays(tmp_path):
    path = tmp_path / "lines"
    append(path, "1")
    with Limit(10), pytest.raises(OSError, match="File too large"):
        append(path, "3" * 20)
    append(path, "2")
    assert path.read_text() == "1\n2\n"


@pytest.mark.parallel(1, 2, 3)
def test_rows_of_all_ranks_and_rows_that_have_no_room(tmp_path):
    """The file of before stays, and every rank is told."""
    comm, path = MPI.COMM_WORLD, tmp_path / "rows.h5"
    own, none = np.arange(9_000.0).reshape(-1, 3) + comm.rank, np.zeros((0, 2), np.int64)
    some = own[: 10 * comm.rank, 0] > 2.0  # none on the first rank
    rows, shared = {"a/own": own, "none": none, "some": some}, {"text": b"once", "more": own[:5]}
    disk.write_rows(path, comm, rows, shared, {"/": {"format": 1}, "a": {"dt": 0.5}})
    for size in (500, 20_000, 100_000):
        with Limit(size), pytest.raises(FileError, match=r"cannot write \(File too large\)"):
            disk.write_rows(path, comm, {**rows, "again": np.repeat(own, 2, axis=0)}, {}, {})
    comm.Barrier()
    assert [file.name for file in tmp_path.iterdir()] == ["rows.h5"]

    def take(file):
        assert (file.attrs["format"], file["a"].attrs["dt"]) == (1, 0.5)
        return {name: file[name][()] for name in (*rows, *shared)}

    found = disk.read(path, comm, take)
    for name, values in rows.items():
        np.testing.assert_array_equal(found[name], np.concatenate(comm.allgather(values)))
        assert found[name].dtype == values.dtype
    assert found["text"] == b"once"
    np.testing.assert_array_equal(found["more"], np.arange(15.0).reshape(5, 3))


@pytest.fixture
def small_disk(cache, tmp_path):
    """`small_disk(how, *options, ranks)` runs with a file system of its own, mounted with these options, in the folder
    disk, and copies what is there in the end to the folder left. In a name space of its own it needs no rights."""
    (tmp_path / "disk").mkdir()
    shell = [shutil.which("unshare") or "unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]

    def run(how, *options, ranks=1):
        mount = f"mount -t tmpfs -o {how} none disk"
        try:
            subprocess.run([*shell, mount], cwd=tmp_path, check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            pytest.skip("this system lets no user mount a file system of his own")
        script = f'{mount} && "$@"; status=$?; cp -a disk left; exit $status'
        return subprocess.run(
            [*shell, script, "sh", *command(*options, ranks=ranks)],
            cwd=tmp_path, env=environment(cache), capture_output=True, text=True, timeout=120, check=False,
        )

    return run


@pytest.mark.parametrize("ranks", [1, pytest.param(2, marks=[pytest.mark.mpi, pytest.mark.slow])])
def test_a_disk_that_fills_up_ends_the_run(ranks, small_disk, program, tmp_path):
    done = small_disk("size=100k", *SMALL, *EVERY, *LOOSE, "-steps", 20, "-output", "disk/out", ranks=ranks)
    said = one_line(done, 2)
    assert "disk/out/" in said
    assert "cannot write (No space left on device)" in said
    step = check_whole(tmp_path / "left" / "out")
    assert 2 <= step < 20
    again = ("-restart", "left/out/checkpoint.h5", "-steps", 1, "-output", "left/out")
    program(*SMALL, *EVERY, *LOOSE, *again)
    assert check_whole(tmp_path / "left" / "out") == step + 1


def test_a_folder_on_a_disk_that_cannot_be_written_is_refused_before_any_work(program, monkeypatch, tmp_path):
    def read_only(dir):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(dir))

    monkeypatch.setattr(tempfile, "TemporaryFile", read_only)
    done = program(*SMALL, *EVERY, *LOOSE, "-steps", 1, "-output", "disk/out", status=2)
    said = one_line(done, 2)
    for word in ("-output disk/out", "Read-only file system", "allowed is a folder that can be written"):
        assert word in said
    assert done.stdout == ""
    assert not list((tmp_path / "disk" / "out").iterdir())
