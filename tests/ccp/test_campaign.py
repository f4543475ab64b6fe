"""Random cone problems by every solver, against a residual that shares no code with them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from problems import from_graph, from_matrix, heap

from pctt import ccp
from pctt.ccp import Limits

PROBLEMS = 60


def projected(x, mu):
    """The nearest point of a friction cone, in the plane of x and the axis: that on the edge (1, mu), if it is before
    its tip, else the tip; x itself within."""
    tangential = math.hypot(x[1], x[2])
    if tangential <= mu * x[0]:
        return x
    along = max((x[0] + mu * tangential) / (1.0 + mu * mu), 0.0)
    scale = along * mu / tangential if tangential > 0.0 else 0.0
    return np.array([along, scale * x[1], scale * x[2]])


def residual(known, g, law):
    """||g - P(g - s y)|| / ||g||, contact by contact; with the law y_n + mu |y_t| for y_n."""
    y = known.r + (known.N @ g.ravel()).reshape(-1, 3)
    s, total = 1.0 / np.mean(np.diag(known.N)), 0.0
    for c in range(len(g)):
        more = known.mu[c] * math.hypot(y[c, 1], y[c, 2]) if law else 0.0
        total += np.sum((g[c] - projected(g[c] - s * (y[c] + [more, 0.0, 0.0]), known.mu[c])) ** 2)
    return math.sqrt(total) / max(np.linalg.norm(g), 1e-300)


def drawn(rng):
    """A problem of 1 to 50 contacts, and how it is given."""
    contacts, bodies, hub = int(rng.integers(1, 50)), int(rng.integers(2, 20)), bool(rng.random() < 0.2)
    mu = rng.uniform(0.0, rng.choice([0.3, 1.0, 3.0]), contacts) * (rng.random(contacts) < 0.9)
    seed, ratio = int(rng.integers(2**31)), 10.0 ** rng.uniform(0, 4)
    known, graph = heap(seed, contacts, bodies, mu, hub=hub, mass_ratio=ratio)
    return known, from_graph(known, graph) if rng.random() < 0.5 else from_matrix(known)


@pytest.mark.slow
@pytest.mark.parametrize("solver", ccp.SOLVERS)
def test_what_is_called_converged_is(solver):
    """And most problems are solved; the optimum of a relaxation is the known one."""
    rng, solved = np.random.default_rng(7), 0
    for _ in range(PROBLEMS):
        known, problem = drawn(rng)
        tol, law = 10.0 ** rng.uniform(-7, -3), bool(rng.random() < 0.5)
        limits = Limits(tol, max_it=2000, fallback=False)
        with problem:
            result = ccp.solve(problem, type=solver, limits=limits, law=ccp.COULOMB if law else ccp.RELAXATION)
        assert np.isfinite(result.impulse).all()
        if result.converged:
            solved += 1
            assert residual(known, result.impulse, law) <= 1.05 * tol
            if not law:
                y = known.r + (known.N @ result.impulse.ravel()).reshape(-1, 3)
                gained = 0.5 * np.vdot(result.impulse, y + known.r)
                assert gained == pytest.approx(known.objective, rel=1e3 * tol, abs=1e-12)
    assert solved >= PROBLEMS // 2
