"""What a run says, without a run."""

from __future__ import annotations

import sys
from contextlib import suppress

import pytest
from mpi4py import MPI

from pctt.run import report


@pytest.mark.parametrize(
    ("spent", "done", "steps", "words"),
    [
        (2.0, 1, 2, "about 2 s left"),
        (10.0, 4, 4, "about 0 s left"),
        (10.0, 1, 10, "about 1 min 30 s left"),
        (60.0, 1, 200, "about 3 h 19 min left"),
    ],
)
def test_the_time_left_goes_on_as_before(spent, done, steps, words):
    assert report.remaining(spent, done, steps) == words


def test_a_large_overlap_is_a_warning():
    small = {"overlap [m]": 4e-4, "step": 7, "smallest_radius [m]": 0.1}
    assert report.overlap_line(small) == "worst overlap 0.0004 m, 0.4% of the smallest radius, at step 7"
    assert report.overlap_line({**small, "overlap [m]": 6e-3}).startswith("WARNING: worst overlap 0.006 m, 6.0%")


def test_forces_that_may_be_far_off_are_a_warning():
    works = enumerate((1e-3, 2e-2, 4e-3))
    steps = [{"step": 3 + k, "closing_work": work, "opening_work": 0.5 * work} for k, work in works]
    assert report.forces_line(steps, 0.05) == "closing work 4.0e-03 (median), 2.0e-02 at most, in step 4"
    far_off = [*steps, {"step": 9, "closing_work": 0.6, "opening_work": 0.1}]
    opening = [*steps, {"step": 9, "closing_work": 0.0, "opening_work": 0.8}]
    assert report.forces_line(opening, 0.05).startswith("WARNING: opening work 6.0e-03 (median), 8.0e-01 at most")
    assert report.forces_line(far_off, float("inf")).startswith("WARNING: closing work")
    assert "try -ccp_closing_work 0.5" in report.forces_line(far_off, float("inf"))
    assert "try a smaller -ccp_tol" in report.forces_line(far_off, 0.05)


def test_a_terminal_without_room_leaves_the_run_silent(monkeypatch, capsys):
    progress = report.Progress(MPI.COMM_SELF)
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        progress.say("one")
        progress.say("two")
        with suppress(OSError):  # what could not be written is tried again
            full.close()
    assert capsys.readouterr().err.count("says no more, as it cannot write there") == 1
    monkeypatch.setattr(sys, "stdout", None)  # closed by the shell
    report.Progress(MPI.COMM_SELF).say("three")
