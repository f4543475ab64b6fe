"""Steps that are hard for interior points: grains between the mixer's paddle and its walls, and a jam come loose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from problems import from_graph, heap

from pctt import ccp
from pctt.ccp import fclib

SELF = MPI.COMM_SELF
FOLDER = Path(__file__).parent / "hard"


@pytest.mark.parametrize("contacts", [65, 78])
@pytest.mark.parametrize("solver", ["pdip", "conic"])
def test_steps_of_the_mixer(solver, contacts):
    """Solves that are accurate only in proportion to the right-hand side, which contacts that open dominate, leave
    velocities that no step can make up for once complementarity has fallen."""
    stored = fclib.load(FOLDER / f"mixer_{contacts}contacts.h5", SELF)
    result = ccp.solve(stored.problem, stored.guess, type=solver, limits=ccp.Limits(1e-4), law=ccp.RELAXATION)
    assert result.converged
    assert ccp.measure(stored.problem, result.impulse).natural_residual <= 1e-4
    assert result.iterations <= 40  # measured: 17 and 18 of pdip, about ten of conic
    assert result.fallbacks == 0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("solver", ["pdip", "conic"])
def test_the_impulses_of_a_jam_come_loose_are_no_worse_than_no_guess(solver, seed):
    known, graph = heap(seed, bodies=30)
    problem = from_graph(known, graph)
    guess = np.zeros_like(known.g)
    guess[:, 0] = 1e6 * np.random.default_rng(seed).uniform(0.5, 2.0, len(guess))
    cold = ccp.solve(problem, type=solver, limits=ccp.Limits(1e-4), law=ccp.RELAXATION)
    jammed = ccp.solve(problem, guess, type=solver, limits=ccp.Limits(1e-4), law=ccp.RELAXATION)
    assert cold.converged
    assert jammed.converged
    assert jammed.iterations <= cold.iterations + 5
