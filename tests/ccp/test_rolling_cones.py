"""Cone problems with resistance to rolling and spinning."""

import numpy as np
import pytest
from mpi4py import MPI
from scipy.optimize import minimize_scalar

from pctt import ccp
from pctt.ccp.cones import rolling
from tests.ccp.problems import SELF
from tests.ccp.problems import part as part_of


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
        out = rolling.project_to(x.reshape(2, 3).copy(), *np.array([[mu], [rho], [sigma]]), np.zeros((2, 3)))
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
        out = rolling.project_to(x, *np.array([[mu], [rho], [0.0]]), np.zeros((2, 3)))
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
    problem = ccp.ConeProblem(SELF, r, cones=ccp.RollingCones(mu, rho, sigma), G=G)
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
    with pytest.raises(ValueError, match="allowed are conic, auto, apgd"):
        ccp.solve(problem, None, "pdip", law=ccp.RELAXATION)
    with pytest.raises(ValueError, match="allowed is body"):
        ccp.solve(problem, None, "conic", newton=ccp.newton_for(SELF, "conic", "contact"), law=ccp.RELAXATION)
    with pytest.raises(ValueError, match=r"rolling has the shape \(5,\); allowed is \(6,\)"):
        ccp.ConeProblem(SELF, r, cones=ccp.RollingCones(mu, rho[1:], sigma), G=G)


def test_without_resistance_it_is_the_problem_of_friction():
    rng = np.random.default_rng(2)
    G, r = blocks(rng, 5, 7), rng.standard_normal((10, 3)) - [1, 0, 0]
    mu, none = np.full(5, 0.4), np.zeros(5)
    limits = ccp.Limits(1e-9, closing_work=np.inf)
    smooth = ccp.ConeProblem(SELF, r, cones=ccp.RollingCones(mu, none, none), G=G)
    with_moments = ccp.solve(smooth, None, "apgd", limits, law=ccp.RELAXATION)
    plain = ccp.BlockRows(G.indptr[:6], G.indices[:10], G.blocks[:10], 7)
    alone = ccp.solve(ccp.ConeProblem(SELF, r[:5], mu, G=plain), None, "apgd", limits, law=ccp.RELAXATION)
    np.testing.assert_allclose(with_moments.impulse[:5], alone.impulse, atol=1e-6)
    assert not with_moments.impulse[5:].any()


@pytest.mark.parametrize("law", ccp.LAWS)
@pytest.mark.parametrize(("contacts", "bodies"), [(1, 2), (40, 30), (60, 45)])
def test_conic_agrees_with_apgd(law, contacts, bodies):
    """A third of the contacts has no friction, no rolling or no spinning resistance, and half of them yield."""
    rng = np.random.default_rng(contacts)
    G, r = blocks(rng, contacts, bodies), rng.standard_normal((2 * contacts, 3)) - [1, 0, 0]
    some = rng.uniform(0.05, 0.6, (3, contacts)) * (np.arange(3)[:, None] != np.arange(contacts) % 9)
    soft = np.where(np.arange(contacts) % 2, 0.05, 0.0)[:, None] * [1.0, 3.5]
    problem = ccp.ConeProblem(SELF, r, cones=ccp.RollingCones(*some), G=G, compliance=soft)
    limits = ccp.Limits(1e-10, closing_work=np.inf, fallback=False)
    one, other = (ccp.solve(problem, None, name, limits, law=law) for name in ("conic", "apgd"))
    assert one.converged, one.reason
    assert one.iterations < 25
    assert one.fallbacks <= 1  # near 1e-10 rounding decides whether FGMRES is enough
    assert ccp.measure(problem, one.impulse).cone_violation < 1e-12
    velocities = [problem.product(found.impulse) for found in (one, other)]
    np.testing.assert_allclose(*velocities, atol=1e-8 * np.linalg.norm(r))


def test_conic_finds_the_impulse_of_a_contact_alone():
    """With N = 1, g is the projection of -r for the relaxation."""
    rng = np.random.default_rng(5)
    count = 30
    r, some = rng.standard_normal((2 * count, 3)), rng.uniform(0.1, 1.0, (3, count))
    rows = 2 * count
    G = ccp.BlockRows(np.arange(rows + 1), np.arange(rows), np.tile(np.eye(3, 6), (rows, 1, 1)), rows)
    problem = ccp.ConeProblem(SELF, r, cones=ccp.RollingCones(*some), G=G)
    found = ccp.solve(
        problem, None, "conic", ccp.Limits(1e-10, closing_work=np.inf, fallback=False), law=ccp.RELAXATION
    )
    assert found.converged, found.reason
    exact = rolling.project_to(-r, *some, np.zeros_like(r))
    np.testing.assert_allclose(found.impulse, exact, atol=1e-9)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("law", ccp.LAWS)
def test_conic_does_not_depend_on_the_ranks(law):
    comm, count, bodies = MPI.COMM_WORLD, 40, 30
    rng = np.random.default_rng(6)
    G, r = blocks(rng, count, bodies), rng.standard_normal((2 * count, 3)) - [1, 0, 0]
    some = rng.uniform(0.1, 0.6, (3, count))
    limits = ccp.Limits(1e-9, closing_work=np.inf, fallback=False)
    alone = ccp.solve(ccp.ConeProblem(SELF, r, cones=ccp.RollingCones(*some), G=G), None, "conic", limits, law=law)
    here = part_of(comm, count)
    rows = np.r_[here, count + np.arange(count)[here]]
    near = np.concatenate([2 * rows[:, None] + [0, 1]], axis=1).ravel()
    own = part_of(comm, bodies)
    mine = ccp.BlockRows(2 * np.arange(len(rows) + 1), G.indices[near], G.blocks[near], own.stop - own.start)
    problem = ccp.ConeProblem(comm, r[rows], cones=ccp.RollingCones(*some[:, here]), G=mine)
    found = ccp.solve(problem, None, "conic", limits, law=law)
    assert found.converged, found.reason
    np.testing.assert_allclose(found.impulse, alone.impulse[rows], atol=1e-6)


@pytest.mark.parametrize("coulomb", [False, True])
@pytest.mark.parametrize(("precision", "near"), [(np.float32, 2e-5), (np.float64, 1e-12)])
def test_loops_over_many_contacts_do_what_arrays_do(precision, near, coulomb):
    """More contacts than a strip of the loops has, and not a whole number of strips."""
    rng, count = np.random.default_rng(9), 700
    some = (rng.uniform(0.0, 0.6, (3, count)) * (np.arange(3)[:, None] != np.arange(count) % 9)).astype(precision)
    cones, shape = ccp.RollingCones(*some), (2 * count, 3)
    x, last, y, soft = (rng.standard_normal(shape).astype(precision) for _ in range(4))
    x, out, soft = cones.project(x, x), np.empty_like(x), abs(soft)
    soft[count:] = 0.0  # moments have no compliance
    found = cones.accelerated_step(x, last, y, soft, 0.4, 0.3, coulomb, out)
    z = x + precision(0.4) * (x - last)
    gradient = y + soft * z
    assert np.allclose(out, z + cones.move(z, gradient, 0.3, coulomb), atol=near)
    if coulomb:
        gradient[:count, 0] += cones.de_saxce(gradient)
    expected = (soft * (out - z) ** 2).sum(), ((out - z) ** 2).sum(), (gradient * (out - x)).sum()
    if precision is np.float64:
        assert found == pytest.approx(expected, rel=1e-10)
        r, size = rng.standard_normal(shape), rng.uniform(0.5, 2.0, shape)
        sums, fastest = cones.errors(x, y, r, 0.3, coulomb, (2.0, size))
        g, v = x * (2.0 / size), y * (2.0 * size)
        power, closing = (g * v).sum(axis=1).reshape(2, -1).sum(axis=0), np.maximum(-v[:count, 0], 0.0)
        works = g[:count, 0] @ closing, np.maximum(power, 0.0).sum(), 0.5 * (g * (v - r)).sum()
        move = np.square(cones.move(g, v, 0.3, coulomb)).sum()
        assert sums == pytest.approx((move, (g * g).sum(), *works), rel=1e-10)
        assert fastest == closing.max()
