"""Cone problems with resistance to rolling and spinning."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from pctt import ccp
from pctt.ccp import rolling
from tests.ccp.problems import SELF


def height_by_search(x, mu, rho, sigma):
    """The normal part of the nearest point of the cone to x (6,): the least of a convex function of it."""
    sizes, most = np.array([np.hypot(x[1], x[2]), np.hypot(x[4], x[5]), abs(x[3])]), np.array([mu, rho, sigma])

    def squared_distance(h):
        return (h - x[0]) ** 2 + (np.maximum(sizes - most * h, 0.0) ** 2).sum()

    return minimize_scalar(squared_distance, bounds=(0.0, 10.0), method="bounded", options={"xatol": 1e-9}).x


def test_projection_on_the_product_of_discs():
    rng = np.random.default_rng(0)
    for case in range(60):
        x = rng.standard_normal(6) * [2.0, 1, 1, 1, 1, 1]
        mu, rho, sigma = rng.uniform(0.05, 1.5, 3) * [1.0, case % 3 > 0, case % 2]
        sigma, rho = max(sigma, 1e-7), max(rho, 1e-7)
        out = rolling.project_to(x.reshape(2, 3).copy(), np.array([mu, rho]), np.array([sigma]), np.zeros((2, 3)))
        found = out.ravel()
        assert found[0] == pytest.approx(height_by_search(x, mu, rho, sigma), abs=1e-6)
        sizes = np.hypot(found[1], found[2]), np.hypot(found[4], found[5]), abs(found[3])
        assert (np.array(sizes) <= np.array([mu, rho, sigma]) * found[0] * (1 + 1e-12) + 1e-300).all()
        # the conditions of a projection: what is left is in the polar cone, and orthogonal to the point
        left = x - found
        of_left = np.hypot(left[1], left[2]), np.hypot(left[4], left[5]), abs(left[3])
        assert left[0] + np.dot(of_left, [mu, rho, sigma]) <= 1e-12
        assert abs(left @ found) <= 1e-12


def test_five_cases_of_friction_and_rolling():
    """Those of Siconos: zero, inside, friction, rolling, both."""
    mu, rho = 0.5, 0.25
    for n, t, m, height in (
        (-2.0, 1.0, 1.0, 0.0), (1.0, 0.2, 0.1, 1.0), (1.0, 2.0, 0.1, (1 + mu * 2) / (1 + mu**2)),
        (1.0, 0.1, 2.0, (1 + rho * 2) / (1 + rho**2)), (1.0, 2.0, 2.0, (1 + mu * 2 + rho * 2) / (1 + mu**2 + rho**2)),
    ):  # fmt: skip
        x = np.array([[n, t, 0], [0, 0, m]])
        out = rolling.project_to(x, np.array([mu, rho]), np.zeros(1), np.zeros((2, 3)))
        assert out[0, 0] == pytest.approx(height, abs=1e-15)


def blocks(rng, contacts, bodies):
    """Rows of forces and moments of random contacts as blocks, each between two bodies."""
    pair = np.array([rng.choice(bodies, 2, replace=False) for _ in range(contacts)])
    pair = np.sort(np.concatenate([pair, pair]), axis=1)
    values = rng.standard_normal((4 * contacts, 3, 6))
    return ccp.BlockRows(2 * np.arange(2 * contacts + 1), pair.ravel(), values, bodies)


@pytest.mark.parametrize("law", ccp.LAWS)
def test_solutions_meet_the_law(law):
    rng = np.random.default_rng(1)
    G, r = blocks(rng, 6, 8), rng.standard_normal((12, 3)) - [1, 0, 0]
    mu, rho, sigma = rng.uniform(0.2, 0.6, (3, 6))
    problem = ccp.RollingProblem(SELF, r, mu, rho, sigma, G=G)
    limits = ccp.Limits(1e-8, closing_work=np.inf)
    found = ccp.solve(problem, None, "auto", limits, law=law)
    assert found.converged
    assert found.solver == "apgd"
    figures = ccp.measure(problem, found.impulse)
    residual = figures.coulomb_residual if law == ccp.COULOMB else figures.natural_residual
    assert residual == pytest.approx(found.residual, rel=1e-3)
    assert residual < 1e-8
    g, y = found.impulse, problem.product(found.impulse) + r
    for c in np.flatnonzero(g[:6, 0] > 1e-3 * np.abs(g).max()):
        d, resisted = 6 + c, 0.0
        roll = g[d, 1:], y[d, 1:], rho[c]
        for part, speed, most in ((g[c, 1:], y[c, 1:], mu[c]), roll, (g[d, :1], y[d, :1], sigma[c])):
            assert part @ speed == pytest.approx(-most * g[c, 0] * np.linalg.norm(speed), abs=1e-6)
            resisted += most * np.linalg.norm(speed)
        assert y[c, 0] == pytest.approx(0.0 if law == ccp.COULOMB else resisted, abs=1e-6)
    with pytest.raises(ValueError, match="allowed are auto and apgd"):
        ccp.solve(problem, None, "conic")
    with pytest.raises(ValueError, match="one for each of 6 contacts"):
        ccp.RollingProblem(SELF, r, mu, rho[1:], sigma, G=G)


def test_without_resistance_it_is_the_problem_of_friction():
    rng = np.random.default_rng(2)
    G, r = blocks(rng, 5, 7), rng.standard_normal((10, 3)) - [1, 0, 0]
    mu, none = np.full(5, 0.4), np.zeros(5)
    limits = ccp.Limits(1e-9, closing_work=np.inf)
    with_moments = ccp.solve(ccp.RollingProblem(SELF, r, mu, none, none, G=G), None, "apgd", limits)
    plain = ccp.BlockRows(G.indptr[:6], G.indices[:10], G.blocks[:10], 7)
    alone = ccp.solve(ccp.ConeProblem(SELF, r[:5], mu, G=plain), None, "apgd", limits)
    np.testing.assert_allclose(with_moments.impulse[:5], alone.impulse, atol=1e-6)
    assert not with_moments.impulse[5:].any()
