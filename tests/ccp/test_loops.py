"""The compiled loops on cones against short formulas of numpy."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from pctt.ccp import cone
from pctt.ccp.accuracy import _nearest_in_cone
from pctt.ccp.interior import lorentz

COUNTS = [0, 1, 7, 256, 1000]  # also of whole strips, and not


def projected_move(x, y, step, mu):
    return _nearest_in_cone(x - step * y, mu) - x


def accelerated_step(x, last_x, y, last_y, beta, step, mu, opening):
    """What the loop returns, and what it leaves in its last argument."""
    z, y_z = x + beta * (x - last_x), y + beta * (y - last_y)
    y_z[:, 0] += opening * mu * np.hypot(y_z[:, 1], y_z[:, 2])
    out = _nearest_in_cone(z - step * y_z, mu)
    return np.vdot(out - z, out - z), np.vdot(y_z, out - x), out


def accelerated_curvature(new_x, x, last_x, new_y, y, last_y, beta):
    return np.vdot(new_x - x - beta * (x - last_x), new_y - y - beta * (y - last_y))


def times(blocks, x):
    return np.einsum("nij,nj->ni", blocks, x)


def scaling(root, eta):
    """W (nc, 3, 3)."""
    return eta[:, None, None] * (2 * root[:, :, None] * root[:, None, :] - np.diag([1.0, -1.0, -1.0]))


def barrier_blocks(direction, eta, spread, scale, compliance, proximal):
    u, v = direction.T
    one, zero = np.ones_like(u), np.zeros_like(u)
    axes = np.moveaxis(np.array([[one, u, v], [one, -u, -v], [zero, v, -u]]), 2, 0)
    axes /= np.linalg.norm(axes, axis=2)[:, :, None]
    values = 1 / np.stack([eta * spread, eta / spread, eta], axis=1) ** 2
    inverse_square = np.einsum("nki,nk,nkj->nij", axes, values, axes)  # W^-2
    sides = scale[:, :, None] * scale[:, None, :]
    whole = np.linalg.inv(inverse_square + compliance[:, None, None] * np.eye(3))
    return (inverse_square + proximal * np.eye(3)) * sides, whole / sides, whole @ inverse_square


class Sample:
    """Random arguments: points anywhere, on the axis and at the apex, friction that is zero or not."""

    def __init__(self, count: int, seed: int = 0):
        rng = np.random.default_rng(seed)
        mu = rng.uniform(0.05, 2.0, count) * (np.arange(count) % 5 > 0)
        x, dx, y, dy, z, dz = rng.normal(size=(6, count, 3))
        x[::7] = 0.0
        x[3::7, 1:] = 0.0
        a, sizes = rng.uniform(0.1, 2.0, (3, count)), rng.uniform(0.1, 2.0, (count, 3))
        angle = rng.uniform(0, 2 * np.pi, count)
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        blocks = rng.normal(size=(count, 3, 3))
        self.cases = {
            "project": (cone.project, _nearest_in_cone, (x, mu)),
            "move": (cone.projected_move, projected_move, (x, y, 0.3, mu)),
            "step": (stepped, accelerated_step, (x, dx, y, dy, 0.7, 0.3, mu, 1.0)),
            "curvature": (cone.accelerated_curvature, accelerated_curvature, (x, dx, z, y, dy, dz, 0.7)),
            "times": (cone.times, times, (blocks, x)),
            "scale": (lorentz.scale, lambda root, eta, x: times(scaling(root, eta), x), (x, a[0], y)),
            "unscale": (lorentz.unscale, unscale, (hyperbolic(x), a[0], y)),
            "barrier": (lorentz.barrier_blocks, barrier_blocks, (direction, a[0], 1 + a[1], sizes, a[2], 0.1)),
        }  # fmt: skip


def stepped(x, last_x, y, last_y, beta, step, mu, opening):
    out = np.zeros_like(x)
    return *cone.accelerated_step(x, last_x, y, last_y, beta, step, mu, opening, out), out


def unscale(root, eta, x):
    return times(np.linalg.inv(scaling(root, eta)), x)


def hyperbolic(x):
    """Points with x_0^2 - |x_1:|^2 = 1, for which the scaling has a simple inverse."""
    return np.column_stack([np.sqrt(1 + x[:, 1] ** 2 + x[:, 2] ** 2), x[:, 1:]])


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


@pytest.mark.parametrize("name", NAMES[:4])
@pytest.mark.parametrize("count", COUNTS)
def test_a_loop_in_single_precision_stays_in_it(name, count):
    loop, formula, arguments = Sample(count).cases[name]
    rounded = [a.astype(np.float32) if isinstance(a, np.ndarray) else a for a in arguments]
    for one, other in zip(parts(loop(*rounded)), parts(formula(*arguments))):
        assert one.ndim == 0 or one.dtype == np.float32
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * np.abs(other).max(initial=1.0))


@pytest.mark.parametrize("name", NAMES[:-1])
def test_a_number_that_is_none_stays_none(name):
    """A NaN at any place of any argument, wherever the formula has one."""
    loop, formula, arguments = Sample(6).cases[name]
    for k, argument in enumerate(arguments):
        for place in range(np.size(argument) if isinstance(argument, np.ndarray) else 0):
            broken = [a.copy() if isinstance(a, np.ndarray) else a for a in arguments]
            broken[k].flat[place] = np.nan
            for one, other in zip(parts(loop(*broken)), parts(formula(*broken))):
                assert np.isnan(one[np.isnan(other)]).all(), (k, place)


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
