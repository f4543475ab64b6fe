"""The compiled loops on cones against the numpy functions in whose place they run."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

import numpy as np
import pytest

from pctt import compiled
from pctt.ccp import cone
from pctt.ccp.interior import lorentz

needs_numba = pytest.mark.skipif(not compiled.available(), reason="numba is not installed")
MODULES = {"cone": cone, "lorentz": lorentz}
COUNTS = [0, 1, 7, 256, 1000]  # also of whole strips, and not


class Sample:
    """Random arguments of the functions: points anywhere, on the axis and at the apex, friction that is zero or not."""

    def __init__(self, count: int, seed: int = 0):
        rng = np.random.default_rng(seed)
        self.count = count
        self.mu = rng.uniform(0.05, 2.0, count) * (np.arange(count) % 5 > 0)
        self.x, self.dx, self.y, self.dy, self.z, self.dz = rng.normal(size=(6, count, 3))
        self.x[::7] = 0.0
        self.x[3::7, 1:] = 0.0
        self.blocks = rng.normal(size=(count, 3, 3))
        self.positive = rng.uniform(0.1, 2.0, (3, count))
        self.sizes = rng.uniform(0.1, 2.0, (count, 3))
        angle, depth = rng.uniform(0, 2 * np.pi, (2, count)), 1 - 10.0 ** -rng.uniform(0, 12, (2, count))
        unit = np.stack([np.ones_like(angle), depth * np.cos(angle), depth * np.sin(angle)], axis=2)
        self.s = unit[0] * self.positive[0, :, None]  # inside the cones of friction 1, some by little
        self.s[::3, 1:] = 0.0
        self.inside = self.s * np.stack([np.ones(count), self.mu, self.mu], axis=1)
        self.direction = np.ascontiguousarray(unit[0, :, 1:])

    def arguments(self) -> dict[str, tuple]:
        """By module and function."""
        a = self.positive
        return {
            "cone.project_to": (self.x, self.mu, np.zeros_like(self.x)),
            "cone.projected_move": (self.x, self.y, 0.3, self.mu),
            "cone.accelerated_step": (self.x, self.dx, self.y, self.dy, 0.7, 0.3, self.mu, 1.0, np.zeros_like(self.x)),
            "cone.accelerated_curvature": (self.x, self.dx, self.z, self.y, self.dy, self.dz, 0.7),
            "cone.times": (self.blocks, self.x),
            "cone.step_to_boundary": (self.inside, self.dx, self.mu),
            "cone.step_to_zero": (a[0], np.ascontiguousarray(self.dx[:, 0])),
            "lorentz.step_to_boundary": (self.s, self.dx),
            "lorentz.scale": (self.x, a[0], self.y),
            "lorentz.unscale": (self.x, a[0], self.y),
            "lorentz.barrier_blocks": (self.direction, a[0], 1 + a[1], self.sizes, a[2], 0.1),
        }


NAMES = list(Sample(0).arguments())
IN_SINGLE = ["cone.project_to", "cone.projected_move", "cone.accelerated_step", "cone.accelerated_curvature"]
EVERY = pytest.mark.parametrize("name", NAMES)
# what is left of numbers close to the boundary is a root of rounding
TOLERANCES = {"lorentz.step_to_boundary": 1e-6, "cone.step_to_boundary": 1e-6}


def both(name: str, arguments: tuple) -> list[list[np.ndarray]]:
    """What the loop and the numpy function return and leave in their last argument."""
    module, function = name.split(".")
    plain = getattr(MODULES[module], function).__wrapped__
    found = []
    for call in (compiled.loop_of(plain), plain):
        own = tuple(a.copy() if isinstance(a, np.ndarray) else a for a in arguments)
        with np.errstate(all="ignore"):
            returned = call(*own)
        parts = returned if isinstance(returned, tuple) else (returned,)
        found.append([np.asarray(part) for part in (*parts, own[-1])])
    return found


@needs_numba
@EVERY
@pytest.mark.parametrize("count", COUNTS)
def test_a_loop_gives_what_numpy_gives(name, count):
    for one, other in zip(*both(name, Sample(count).arguments()[name])):
        assert one.shape == other.shape
        assert one.dtype == other.dtype
        size = np.abs(other[np.isfinite(other)]).max(initial=1.0)
        np.testing.assert_allclose(one, other, rtol=TOLERANCES.get(name, 1e-12), atol=1e-13 * size)


@needs_numba
@pytest.mark.parametrize("name", [name for name in NAMES if name in IN_SINGLE])
@pytest.mark.parametrize("count", COUNTS)
def test_a_loop_in_single_precision_stays_in_it(name, count):
    arguments = Sample(count).arguments()[name]
    rounded = tuple(a.astype(np.float32) if isinstance(a, np.ndarray) else a for a in arguments)
    for one, other in zip(both(name, rounded)[0], both(name, arguments)[1]):
        assert one.ndim == 0 or one.dtype == np.float32
        size = np.abs(other).max(initial=1.0)
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * size)


@needs_numba
@EVERY
def test_a_number_that_is_none_stays_none(name):
    """Where numpy gives NaN the loop does, for a NaN at any place of any argument."""
    arguments = Sample(6).arguments()[name]
    for k, argument in enumerate(arguments):
        if not isinstance(argument, np.ndarray):
            continue
        for place in range(argument.size):
            broken = [a.copy() if isinstance(a, np.ndarray) else a for a in arguments]
            broken[k].flat[place] = np.nan
            for one, other in zip(*both(name, tuple(broken))):
                assert np.array_equal(np.isnan(one), np.isnan(other)), (k, place)


@needs_numba
def test_every_loop_is_compared():
    for name, module in MODULES.items():
        loops = import_module(f"{module.__name__}_loops")
        found = {f"{name}.{key}" for key, value in vars(loops).items() if hasattr(value, "py_func") and key[0] != "_"}
        assert found == {listed for listed in NAMES if listed.startswith(f"{name}.")}


@needs_numba
def test_a_loop_is_compiled_once_for_each_precision():
    """Arrays of another type, order or place go to numpy, with the same result."""
    x, mu = np.random.default_rng(0).normal(size=(10, 3)), np.full(10, 0.5)
    frozen = x.copy()
    frozen.flags.writeable = False
    expected = cone.project(x, mu)
    for other in (np.asfortranarray(x), np.repeat(x, 2, axis=0)[::2], frozen):
        np.testing.assert_allclose(cone.project(other, mu), expected, rtol=1e-14)
    signatures = compiled.loop_of(cone.project_to.__wrapped__).signatures
    assert len({str(signature) for signature in signatures}) == len(signatures) <= 2


def test_without_numba_numpy_does_the_work(monkeypatch):
    x, mu = np.random.default_rng(0).normal(size=(10, 3)), np.full(10, 0.5)
    expected = cone.project(x, mu)
    monkeypatch.setattr(compiled, "available", lambda: False)
    monkeypatch.setattr(compiled, "loop_of", lambda function: pytest.fail("the loop was asked for"))
    np.testing.assert_allclose(cone.project(x, mu), expected, rtol=1e-14)


def test_numba_is_imported_at_the_first_call_only():
    code = "import sys, pctt.ccp; assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
