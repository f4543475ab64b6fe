"""Runs that are killed at random moments go on as if nothing had happened (run/study torture)."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_a_run_that_is_killed_again_and_again_leaves_what_an_undisturbed_one_does():
    done = subprocess.run(
        [sys.executable, "run/studies/torture.py", "1", "5", "60"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "kills" in done.stdout
    assert "the same to the last bit" in done.stdout
