"""The compiled loops on cones against short formulas of numpy."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from pctt.ccp import FrictionCones, RollingCones
from pctt.ccp.cones import friction as cone
from pctt.ccp.cones import lorentz as algebra

COUNTS = [0, 1, 7, 256, 1000]  # also of whole strips, and not


def nearest(x, mu):
    """The projection on the cones: of the point on the surface's ray, in the half plane of axis and point."""
    size = np.hypot(x[:, 1], x[:, 2])
    along = np.maximum(x[:, 0] + mu * size, 0.0) / (1 + mu**2)
    turn = np.divide(mu * along, size, out=np.zeros_like(along), where=size > 0)
    surface = np.stack([along, turn * x[:, 1], turn * x[:, 2]], axis=1)
    return np.where(((x[:, 0] >= 0) & (size <= mu * x[:, 0]))[:, None], x, surface)


def accelerated_step(x, last_x, y, compliance, beta, step, mu, opening):
    """What the loop returns, and what it leaves in its last argument."""
    z = x + beta * (x - last_x)
    y_z = y + compliance * z if len(compliance) else y.copy()
    y_z[:, 0] += opening * mu * np.hypot(y_z[:, 1], y_z[:, 2])
    out = nearest(z - step * y_z, mu)
    work = np.vdot(out - z, compliance * (out - z)) if len(compliance) else 0.0
    return work, np.vdot(out - z, out - z), np.vdot(y_z, out - x), out


def errors(x, y, r, step, mu, opening, unit=1.0, size=()):
    x, y = (x * unit / size, y * unit * size) if len(size) else (x, y)
    term = opening * mu * np.hypot(y[:, 1], y[:, 2])
    move, power = nearest(x - step * (y + np.outer(term, [1, 0, 0])), mu) - x, (x * y).sum(axis=1)
    works = x[:, 0] @ np.maximum(-y[:, 0], 0), np.maximum(power, 0).sum(), 0.5 * np.vdot(x, y - r)
    return np.array([np.vdot(move, move), np.vdot(x, x), *works]), np.max(-y[:, 0], initial=0.0)


def times(blocks, x):
    return np.einsum("nij,nj->ni", blocks, x)


def inside(rng, count):
    """Points inside the cones of friction 1, some next to the boundary."""
    x = rng.normal(size=(count, 3))
    x[:, 0] = np.hypot(x[:, 1], x[:, 2]) * (1 + 10.0 ** rng.uniform(-6, 1, count)) + 1e-3
    return x


class Scaling:
    """Products with the W of `scaling` and its inverse, by their definition."""

    def __init__(self, s, z):
        self.parts = self.root, self.eta = algebra.scaling(s, z)

    def times(self, x):
        return self.eta[:, None] * self.by(self.root, x)

    def divide(self, x):
        return self.by(self.root * [1, -1, -1], x) / self.eta[:, None]

    @staticmethod
    def by(root, x):
        return 2 * root * (root * x).sum(axis=1, keepdims=True) - x * [1, -1, -1]


class Sample:
    """Random arguments: points anywhere, on the axis and at the apex, friction that is zero or not."""

    def __init__(self, count: int, seed: int = 0):
        rng = np.random.default_rng(seed)
        mu = rng.uniform(0.05, 2.0, count) * (np.arange(count) % 5 > 0)
        x, dx, y, dy = rng.normal(size=(4, count, 3))
        x[::7] = 0.0
        x[3::7, 1:] = 0.0
        blocks, size = rng.normal(size=(count, 3, 3)), rng.uniform(0.5, 2.0, size=(count, 3))
        self.cases = {
            "project": (cone.project, nearest, (x, mu)),
            "step": (stepped, accelerated_step, (x, dx, y, np.abs(dy), 0.7, 0.3, mu, 1.0)),
            "rigid step": (stepped, accelerated_step, (x, dx, y, dy[:0], 0.7, 0.3, mu, 0.0)),
            "errors": (cone.errors, errors, (x, y, dy, 0.3, mu, 0.0, 0.7, size)),
            "errors of Coulomb's law": (cone.errors, errors, (x, y, dy, 0.3, mu, 1.0, 0.7, size[:0])),
            "times": (cone.times, times, (blocks, x)),
        }  # fmt: skip


def stepped(x, last_x, y, compliance, beta, step, mu, opening):
    out = np.zeros_like(x)
    return *cone.accelerated_step(x, last_x, y, compliance, beta, step, mu, opening, out), out


NAMES = list(Sample(0).cases)


def parts(returned):
    return [np.asarray(part) for part in (returned if isinstance(returned, tuple) else (returned,))]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("count", COUNTS)
def test_a_loop_gives_what_its_formula_gives(name, count):
    loop, formula, arguments = Sample(count).cases[name]
    for one, other in zip(parts(loop(*arguments)), parts(formula(*arguments))):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-12 * np.abs(other).max(initial=1.0))


@pytest.mark.parametrize("name", NAMES[:3])
@pytest.mark.parametrize("count", COUNTS)
def test_a_loop_in_single_precision_stays_in_it(name, count):
    loop, formula, arguments = Sample(count).cases[name]
    rounded = [a.astype(np.float32) if isinstance(a, np.ndarray) else a for a in arguments]
    for one, other in zip(parts(loop(*rounded)), parts(formula(*arguments))):
        assert one.ndim == 0 or one.dtype == np.float32
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * np.abs(other).max(initial=1.0))


@pytest.mark.parametrize("name", NAMES)
def test_a_number_that_is_none_stays_none(name):
    """A NaN at any place of any argument, wherever the formula has one."""
    loop, formula, arguments = Sample(6).cases[name]
    for k, argument in enumerate(arguments):
        for place in range(np.size(argument) if isinstance(argument, np.ndarray) else 0):
            broken = [a.copy() if isinstance(a, np.ndarray) else a for a in arguments]
            broken[k].flat[place] = np.nan
            for one, other in zip(parts(loop(*broken)), parts(formula(*broken))):
                assert np.isnan(one[np.isnan(other)]).all(), (k, place)


def test_sums_of_a_problem_from_its_cones():
    x, y = np.random.default_rng(0).normal(size=(2, 4, 3))
    mu = np.array([0.5, 0.0, 0.3, 2.0])
    cones = FrictionCones(mu)
    term = np.stack([mu * np.hypot(y[:, 1], y[:, 2]), 0 * mu, 0 * mu], axis=1)
    for coulomb, target in ((False, x - 0.3 * y), (True, x - 0.3 * (y + term))):
        np.testing.assert_allclose(cones.move(x, y, 0.3, coulomb), nearest(target, mu) - x, atol=1e-14)
        for one, other in zip(cones.errors(x, y, x, 0.3, coulomb), errors(x, y, x, 0.3, mu, coulomb)):
            np.testing.assert_allclose(one, other)
    open_ones = (x[:, 0] <= 0) & (y[:, 0] - term[:, 0] > 0.1)
    assert np.array_equal(cones.active(x, x, y, 0.1), ~open_ones)
    sums, most = FrictionCones(np.zeros(0)).errors(x[:0], y[:0], x[:0], 0.3, True)
    assert most == 0.0
    assert not any(sums)


def test_the_scaling_is_that_of_nesterov_and_todd():
    rng = np.random.default_rng(0)
    s, z = inside(rng, 200), inside(rng, 200)
    s[:5, 1:] = z[:5, 1:] = 0.0
    W = Scaling(s, z)
    np.testing.assert_allclose(W.times(z), W.divide(s), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(W.divide(W.times(s)), s, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("tangential", [1e-9, 0.3])
@pytest.mark.parametrize("normal", [1e-9, 1e-3, 0.3, 10.0])
@pytest.mark.parametrize("coulomb", [False, True])
@pytest.mark.parametrize("rolls", [False, True])
def test_blocks_of_cones_that_share_a_normal_number(rolls, coulomb, normal, tangential):
    """B = A' T^-1 W^-2 A and X = (B + C)^-1 by their definitions, and the parts of a step that need no product with
    W^-2."""
    rng, count = np.random.default_rng(0), 60
    mu = rng.uniform(0.05, 1.5, (3, count)) * (rng.random((3, count)) > 0.2)
    cones = RollingCones(*mu) if rolls else FrictionCones(mu[0])
    lorentz = cones.lorentz()
    rows = len(lorentz.mask)
    A = np.stack([lorentz.apply(e.reshape(rows, 3)).ravel() for e in np.eye(3 * rows)], axis=1)
    known = np.diag(lorentz.mask.ravel())
    z = rng.normal(size=(lorentz.number * count, 3))
    np.testing.assert_allclose(lorentz.transpose(z).ravel(), A.T @ z.ravel(), atol=1e-12)
    g = known @ rng.normal(size=3 * rows)
    np.testing.assert_allclose(lorentz.impulses((A @ g).reshape(-1, 3)).ravel(), g, atol=1e-12)
    np.testing.assert_allclose(lorentz.transpose(lorentz.right_inverse(g.reshape(-1, 3))).ravel(), g, atol=1e-12)

    there = np.abs(A).sum(axis=1).reshape(-1, 3) > 0
    s, z = (inside(rng, len(there)) * there for _ in range(2))
    u = np.zeros_like(s)
    if coulomb:
        u[:, 1:] = z[:, 1:] / np.maximum(np.hypot(z[:, 1], z[:, 2]), 1e-300)[:, None]
    W = Scaling(s, z)
    inverse = np.stack([W.divide(W.divide(np.tile(e, (len(s), 1)))) for e in np.eye(3)], axis=2)
    turned = inverse.copy()
    turned[:, 0] -= np.einsum("cj,cjk->ck", u, inverse)
    dense = np.zeros((len(s), 3, len(s), 3))
    dense[range(len(s)), :, range(len(s))] = turned
    dense = dense.reshape(3 * len(s), -1)
    B, soft = A.T @ dense @ A, np.full(count, normal)
    along = tangential * rng.uniform(0.5, 2.0, (lorentz.number, count))
    C = np.zeros((rows, 3))
    C[:count] = np.stack([soft, along[0], along[0]], axis=1)
    if rolls:
        C[count:] = np.stack([along[2], along[1], along[1]], axis=1)
    arrow = lorentz.arrow(*W.parts, u, soft, along.ravel())
    barriers = lorentz.barriers(*W.parts, u, 1.0, np.zeros((count, lorentz.width)))

    def whole(blocks):
        """The matrix of blocks, in rows."""
        numbers = cones.joined(np.arange(3 * rows).reshape(rows, 3)).astype(int)
        out = np.zeros((3 * rows, 3 * rows))
        out[numbers[:, :, None], numbers[:, None, :]] = blocks
        return out

    size = np.abs(B).max()
    np.testing.assert_allclose(known @ whole(barriers) @ known / size, B / size, atol=1e-12)
    there = known.diagonal() > 0
    X, system = whole(arrow.X), B + np.diag(C.ravel())
    assert not X[~there].any()
    assert not X[:, ~there].any()
    X, system = X[np.ix_(there, there)], system[np.ix_(there, there)]
    assert np.abs(X @ system - np.eye(len(X))).max() <= 1e-12 * max(1.0, np.abs(X).max()) * np.abs(system).max()

    f, r = W.times(rng.normal(size=s.shape) * (np.abs(A).sum(axis=1).reshape(-1, 3) > 0)) - s, g.reshape(-1, 3)
    alone = arrow.uncoupled(f, r)
    expected = (A.T @ dense @ f.ravel() - g)[there]
    off = system @ alone.ravel()[there] - expected
    assert np.abs(off).max() <= 1e-11 * np.abs(system).max() * np.abs(alone).max()
    ds = lorentz.apply(alone)
    straight = dense @ (f - ds).ravel()
    dz = arrow.dual_step((A.T @ straight).reshape(-1, 3), f, ds)
    np.testing.assert_allclose(dz.ravel(), straight, atol=1e-9 * np.abs(straight).max())


def test_pairs_on_the_central_path():
    rng = np.random.default_rng(0)
    x, tau = rng.normal(size=(100, 3)), rng.uniform(0.1, 2.0, 100)
    x[:3], x[3:6, 1:] = 0.0, 0.0
    s, z = algebra.central_pair(x, tau, 1e-6)
    np.testing.assert_allclose(s - tau[:, None] * z, x, atol=1e-14)
    np.testing.assert_allclose(jordan_product(s, z), np.tile([1e-6, 0, 0], (100, 1)), atol=1e-14)


def jordan_product(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    out = x[:, :1] * y + y[:, :1] * x
    out[:, 0] = (x * y).sum(axis=1)
    return out


@pytest.mark.parametrize("slides", [0.0, 1.0])
def test_right_hand_sides_of_a_step_by_their_definitions(slides):
    rng = np.random.default_rng(0)
    s, z = inside(rng, 100), inside(rng, 100)
    w, ds, dz = rng.normal(size=(3, 100, 3))
    u = slides * rng.normal(size=(100, 3)) * [0, 1, 1]
    W = Scaling(s, z)
    c, f = algebra.right_hand_sides(*W.parts, z, u, w), algebra.uncoupled_changes(*W.parts, s, w)
    expected = W.divide(w) - z
    expected[:, 0] -= (u * expected).sum(axis=1)
    np.testing.assert_allclose(c, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(f, W.times(w) - s, rtol=1e-9, atol=1e-9)
    change = W.divide(W.divide(ds))
    change[:, 0] -= (u * change).sum(axis=1)
    np.testing.assert_allclose(algebra.subtract_inverse_squared(*W.parts, u, w, ds), w - change, rtol=1e-9, atol=1e-9)

    aim = [0.3, 0, 0] - jordan_product(W.divide(ds), W.times(dz))
    centred = jordan_product(W.times(z), algebra.mehrotra_correction(*W.parts, z, ds, dz, 0.3))
    np.testing.assert_allclose(centred, aim, rtol=1e-6, atol=1e-6)
    after = jordan_product(W.times(z) + 0.5 * W.divide(ds), W.times(z) + 0.5 * W.times(dz))
    low, high = 0.1, 1.0
    moved = after + jordan_product(W.times(z), algebra.gondzio_correction(*W.parts, z, ds, dz, 0.5, low, high))
    for x, sign in ((moved, 1.0), (moved, -1.0)):
        length = np.hypot(after[:, 1], after[:, 2])
        along = (x * after)[:, 1:].sum(axis=1) / np.maximum(length, 1e-300)  # the directions stay
        value, before = x[:, 0] + sign * along, after[:, 0] + sign * length
        np.testing.assert_allclose(value, np.maximum(np.clip(before, low, high), before - high), rtol=1e-6, atol=1e-6)


def test_a_loop_takes_arrays_of_other_layouts():
    x, mu = np.random.default_rng(0).normal(size=(10, 3)), np.full(10, 0.5)
    frozen = x.copy()
    frozen.flags.writeable = False
    expected = cone.project(x, mu)
    for other in (np.asfortranarray(x), np.repeat(x, 2, axis=0)[::2], frozen):
        np.testing.assert_allclose(cone.project(other, mu), expected, rtol=1e-14)


def test_numba_is_imported_at_the_first_call_only():
    code = "import sys, pctt.ccp, pctt.run.simulate; assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
