"""One file of all that state.h5 links to."""

from __future__ import annotations

import os
import shutil

import h5py
import handmade
import pytest

from pctt.disk import FileError
from pctt.export import write_single
from pctt.folder import Folder
from pctt.look.program import described_steps


def held(path):
    """All data sets and attributes of a file by name, through its links."""
    found = {}

    def collect(group, prefix):
        found.update({f"{prefix}@{name}": str(value) for name, value in group.attrs.items()})
        for name in group:  # not visititems, which does not follow links
            if isinstance(group[name], h5py.Group):
                collect(group[name], f"{prefix}{name}/")
            else:
                found[prefix + name] = (group[name].dtype, group[name].shape, group[name][()].tobytes())

    with h5py.File(path, "r") as file:
        collect(file, "")
    return found


def test_one_file_holds_what_the_links_lead_to(folder, show, tmp_path):
    done = show("export", "-single", tmp_path / "one.h5")
    assert done.stdout == f"4 of 4 recorded steps: {tmp_path}/one.h5\n"
    assert [path.name for path in tmp_path.iterdir()] == ["one.h5"]
    linked = held(folder / "state.h5")
    assert "frames" in linked.pop("@links")
    assert held(tmp_path / "one.h5") == linked
    assert {"@contents", "bodies/shape", "steps/000004/position", "steps/000004/record/@contacts"} < set(linked)
    show("export", "-single", tmp_path / "some.h5", "-first", 2, "-every", 2)
    with h5py.File(tmp_path / "some.h5") as file:
        assert list(file["steps"]) == ["000002", "000004"]


def test_the_files_of_the_run_are_refused_as_target(show, tmp_path):
    made = handmade.write(tmp_path / "made", handmade.FLOOR, steps=2)
    (made / "checkpoint.h5").write_text("what a run goes on from")
    before = {path: path.read_bytes() for path in made.rglob("*") if path.is_file()}
    for name in ("state.h5", "checkpoint.h5", "frames/000002.h5", "../made/state.h5"):
        said = show("export", "-single", made / name, folder=made, status=2).stderr
        assert f"{name}: is a file of the run; allowed is another name" in said
    assert {path: path.read_bytes() for path in made.rglob("*") if path.is_file()} == before
    for _ in range(2):  # a result of the program's own is replaced
        show("export", "-single", made / "one.h5", folder=made)


@pytest.mark.parametrize("other", [("-output", "more"), ("-format", "vtp"), ("-format", "vtkhdf")])
def test_options_of_series_are_refused_beside_one_file(show, tmp_path, other):
    said = show("export", "-single", tmp_path / "one.h5", *other, status=2).stderr
    assert f"{' '.join(other)}: has no effect on the file of -single" in said
    assert not list(tmp_path.iterdir())


def test_a_copy_of_the_links_alone_says_that_it_is_empty(folder, tmp_path):
    shutil.copy(folder / "state.h5", tmp_path)
    with h5py.File(tmp_path / "state.h5") as file:
        with pytest.raises((KeyError, OSError)):  # the link leads nowhere
            file["steps/000004"]
        assert "python -m pctt.export FOLDER -single FILE.h5" in file.attrs["links"]


def test_what_cannot_be_read_or_written_is_named(show, tmp_path):
    made = handmade.write(tmp_path / "made", handmade.FLOOR, steps=2)
    assert "cannot write" in show("export", "-single", tmp_path / "no" / "one.h5", folder=made, status=2).stderr
    (made / "frames" / "000002.h5").write_text("no HDF5 file")
    assert "000002.h5" in show("export", "-single", tmp_path / "one.h5", folder=made, status=2).stderr
    assert [path.name for path in tmp_path.iterdir()] == ["made"]
    (made / "state.h5").unlink()  # as of a run that was killed: it is made again
    show("export", "-single", tmp_path / "one.h5", "-last", 1, folder=made)
    with h5py.File(made / "frames" / "000001.h5", "a") as file:
        file["aside"] = h5py.ExternalLink(str(tmp_path / "one.h5"), "/")
    said = show("export", "-single", tmp_path / "two.h5", "-last", 1, folder=made, status=2).stderr
    assert "aside is a link; allowed are data of the file itself" in said
    assert (tmp_path / "one.h5").exists()


def test_missing_frames_are_told_and_what_is_no_file_is_left_alone(folder, tmp_path):
    whole = tmp_path / "run"
    shutil.copytree(folder, whole)
    (whole / "frames" / "000003.h5").unlink()
    run = Folder(whole)
    run.require_frames()
    assert described_steps(run, [2, 4]) == "2 of 3 recorded steps (missing: 3)"
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileError, match="pipe: cannot write .it is no regular file"):
        write_single(tmp_path / "pipe", run, [2, 4])
    (whole / "steps.jsonl").unlink()
    os.mkfifo(whole / "steps.jsonl")  # nobody writes to it: reading would wait for ever
    assert Folder(whole).lines() == []
