"""Ctrl-C and its like end a run after a step, with a word on how to go on; what goes on is what would have been."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mpi4py import MPI
from program import EVERY, SMALL, assert_same_bits, command, environment
from test_killed import python_of

from pctt.run import interrupt
from pctt.run.settings import Run

OPTIONS = (*SMALL, *EVERY, "-ccp_type", "apgd", "-ccp_tol", 1e-3)
CASES = [
    pytest.param(signal.SIGINT, 1, id="SIGINT-1"),
    pytest.param(signal.SIGTERM, 2, id="SIGTERM-2", marks=pytest.mark.mpi),
    pytest.param(signal.SIGINT, 2, id="SIGINT-2", marks=[pytest.mark.mpi, pytest.mark.slow]),
]


def interrupted(options, ranks, tmp_path, cache, ready, number):
    """Start a run, wait until `ready`, and send the signal: to the program, or to the mpiexec of run/setup, or where
    there is another, to the last rank. Its exit status, and what it said to the standard error."""
    with subprocess.Popen(
        command(*options, ranks=ranks),
        cwd=tmp_path,
        env=environment(cache),
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=_listen_to_ctrl_c,
    ) as run:
        end = time.monotonic() + 120
        while not ready():
            assert run.poll() is None, "the run ended too early"
            assert time.monotonic() < end, "nothing to wait for came"
            time.sleep(0.002)
        ours = ranks == 1 or Path(sys.executable).with_name("mpiexec").exists()
        target = run.pid if ours else max(python_of(run.pid))
        os.kill(target, number)
        _, said = run.communicate(timeout=120)
    return run.returncode, said


def _listen_to_ctrl_c():
    """A shell has what it starts in the background ignore the signal, and mpiexec inherits this."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize(("number", "ranks"), CASES)
def test_an_interrupted_run_goes_on(number, ranks, program, tmp_path, cache):
    steps, dt = 400, 0.0125
    timed = number == signal.SIGTERM
    length = ("-dt", dt, "-seconds", steps * dt) if timed else ("-steps", steps)
    late = ("-checkpoint_every", steps)  # so that no checkpoint is there but the one that an interrupted run writes
    out = tmp_path / "out"
    rows = out / "steps.jsonl"
    status, said = interrupted(
        (*OPTIONS, *late, *length, "-output", "out"), ranks, tmp_path, cache, rows.exists, number
    )
    assert status == 130, said
    lines = [line for line in said.splitlines() if line.startswith("pctt.run: interrupted")]
    assert len(lines) == 1, said
    found = re.fullmatch(
        r"pctt.run: interrupted after step (\d+); the same command with -restart out/checkpoint.h5 "
        rf"-{'seconds' if timed else 'steps'} (\S+) at its end goes on",
        lines[0],
    )
    done, left = int(found[1]), Run(seconds=float(found[2])).steps_of(dt) if timed else int(found[2])
    assert done + left == steps
    assert left > 0
    assert len(rows.read_text().splitlines()) == done
    if timed:  # SIGTERM ends a run as SIGINT does
        return
    more = min(left, 3)
    program(*OPTIONS, "-output", "out", "-restart", "out/checkpoint.h5", "-steps", more, ranks=ranks)
    program(*OPTIONS, "-output", "whole", "-steps", done + more, ranks=ranks)
    assert_same_bits(out / "state.h5", tmp_path / "whole" / "state.h5")
    assert_same_bits(out / "checkpoint.h5", tmp_path / "whole" / "checkpoint.h5")


def test_signals_end_the_program_at_once_before_its_steps_and_then_after_one(monkeypatch, capsys):
    """A terminal that goes away and the limit of processor time are as others; what Python has made is not taken."""
    before = {number: signal.getsignal(number) for number in interrupt.SIGNALS}
    monkeypatch.setattr(interrupt, "_noted", [])
    monkeypatch.setattr(interrupt, "_taken", set())
    try:
        interrupt.note_signals(MPI.COMM_SELF)
        assert all(signal.getsignal(number) is handler for number, handler in before.items())
        interrupt.take_signals()
        assert all(signal.getsignal(number) is signal.SIG_DFL for number in (signal.SIGINT, signal.SIGTERM))
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # these tests may run under nohup
        interrupt.take_signals()
        interrupt.note_signals(MPI.COMM_SELF)
        for number in (signal.SIGHUP, signal.SIGXCPU):
            os.kill(os.getpid(), number)
            assert signal.getsignal(number) is signal.SIG_DFL  # once more, and it ends at once
        assert capsys.readouterr().err.count("will end after this step; the same signal again ends it at once\n") == 1
        assert interrupt._noted == [signal.SIGHUP, signal.SIGXCPU]
        assert interrupt.is_requested(MPI.COMM_SELF)
        interrupt._taken.clear()
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
        interrupt.take_signals()
        interrupt.note_signals(MPI.COMM_SELF)
        os.kill(os.getpid(), signal.SIGHUP)
        assert interrupt._noted == [signal.SIGHUP, signal.SIGXCPU]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parallel(1, 2)
def test_a_cut_settling_goes_on_where_it_was(program, tmp_path, monkeypatch):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    (tmp_path / "short.py").write_text(
        "from pctt.scenes.mixer import *\n@dataclass(frozen=True)\nclass Short(Mixer):\n    settling_time = 0.25\n"
    )
    short = ("-scene", "short.py", *SMALL)
    program(*short, "-settle", cache=whole)
    (path,) = whole.glob("pctt/*.h5")
    unfinished = cut / "pctt" / path.name.replace(".h5", ".unfinished.h5")
    asked = iter([False] * 4 + [True])
    with monkeypatch.context() as patch:
        patch.setattr(interrupt, "is_requested", lambda comm: next(asked))
        said = program(*short, "-settle", status=130, cache=cut).stderr
    assert re.search(r"settling interrupted after step 5 of \d+; the same command goes on there", said)
    done = program(*short, "-restart", "settled", "-steps", 0, cache=cut)
    assert f"goes on after step 5, from {unfinished}" in done.stdout
    assert not unfinished.exists()
    assert_same_bits(path, cut / "pctt" / path.name)
