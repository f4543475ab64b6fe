"""The first run on a machine compiles the loops, later ones load them: both give the same bits."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import several_ranks

SOLVE = """
import hashlib
import numpy as np
from problems import SELF, random_graph
from test_map_products import random_contacts
from pctt import ccp

frames_and_arms, blocks = random_contacts(0, 70, 30, wide=True)[0], random_graph(0, 70, 30).part(SELF)
for rows, solver, law in ((frames_and_arms, "apgd", "coulomb"), (blocks, "conic", "relaxation")):
    r = np.random.default_rng(1).normal(size=(70, 3))
    with ccp.ConeProblem(SELF, r, np.full(70, 0.5), G=rows) as problem:
        result = ccp.solve(problem, None, solver, ccp.Limits(1e-9, 20, fallback=False), law=law)
        print(hashlib.sha256(result.impulse.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_the_first_run_on_a_machine_has_the_bits_of_the_next(tmp_path):
    here = str(Path(__file__).parent)
    env = several_ranks.environment(NUMBA_CACHE_DIR=str(tmp_path))
    env["PYTHONPATH"] += f":{here}"
    runs = [subprocess.run([sys.executable, "-c", SOLVE], env=env, capture_output=True, text=True) for _ in range(2)]
    first, second = (run.stdout for run in runs)
    assert len(first.splitlines()) == 2, runs[0].stderr
    assert first == second
