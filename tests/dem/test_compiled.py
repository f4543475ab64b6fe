"""The compiled loops against short formulas of numpy, and on no rows at all."""

from __future__ import annotations

import ast
import importlib
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import numba
import numpy as np
import pytest
from cases import random_quaternions
from numba.core.caching import CompileResultCacheImpl
from numba.core.typing.arraydecl import GetItemBuffer

import dem
import pctt
from dem import quaternion
from dem.arrays import places
from dem.bodies import SPHERE
from dem.compiled import inlined, inner, loop
from dem.contact import broad
from dem.contact.narrow import Spheres, sphere_sphere
from dem.contact.search import contact_frames
from dem.contact.spheres import touch_spheres
from dem.free_motion import free_spin


def sorted_rows(pairs):
    return pairs[np.lexsort(pairs.T[::-1])]


@pytest.mark.parametrize("count", [0, 1, 2, 50, 2000])
@pytest.mark.parametrize("decades", [0, 2])
def test_pairs_in_cells(count, decades):
    rng = np.random.default_rng(count)
    position, radius = rng.uniform(-1, 1, (count, 3)), 10.0 ** rng.uniform(-1.5 - decades, -1.0, count)
    position[::7] *= 1e5  # some far away
    pairs = sorted_rows(broad.close_pairs(position, radius + 0.005))
    close = []
    for i in range(count):
        distance = np.linalg.norm(position[i + 1 :] - position[i], axis=1)
        close += [(i, i + 1 + j) for j in np.flatnonzero(distance <= radius[i] + radius[i + 1 :] + 0.01)]
    np.testing.assert_array_equal(pairs, np.array(close).reshape(-1, 2))


def test_pairs_of_spheres_that_touch_to_rounding_and_of_concentric_ones():
    grid = np.stack(np.meshgrid(*[0.2 * np.arange(6)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    assert len(broad.close_pairs(grid, np.full(len(grid), 0.1))) == 3 * 5 * 36
    assert len(broad.close_pairs(np.zeros((5, 3)), np.ones(5))) == 10


def test_contacts_of_spheres():
    """Of pairs that are near enough, concentric ones too."""
    rng = np.random.default_rng(2)
    center, size = rng.uniform(-0.4, 0.4, (60, 3)), rng.uniform(0.05, 0.1, (60, 3))
    center[1] = center[0]
    i, j = np.triu_indices(60, 1)
    delta = rng.uniform(0.0, 0.1, len(i))
    whole = sphere_sphere(Spheres(center[i], size[i, 0]), Spheres(center[j], size[j, 0]))
    near = np.flatnonzero(whole.gap <= delta)
    assert 20 < len(near) < len(i)
    kind, turn = np.full(60, SPHERE), np.tile([1.0, 0, 0, 0], (60, 1))
    pair, *touch, others = touch_spheres(kind, center, turn, size, i, j, delta)
    assert len(others) == 0
    np.testing.assert_array_equal(pair, near)
    for column, expected in zip(touch, whole.take(near)):
        np.testing.assert_allclose(column, expected, atol=1e-14)


def test_operations_round_each_for_themselves():
    """To the bits of numpy: a fused product would differ, and with it a run from the same run in another process."""
    normal = np.random.default_rng(3).normal(size=(20000, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    x, y, z = normal.T
    sign = np.copysign(1.0, z)
    p = -1.0 / (sign + z)
    q = x * y * p
    expected = [x, y, z, 1.0 + sign * x * x * p, sign * q, -sign * x, q, sign + y * y * p, -y]
    np.testing.assert_array_equal(contact_frames(normal).reshape(-1, 9), np.stack(expected, axis=1))


@pytest.mark.parametrize("turn", [1e-9, 0.01, 0.3])
def test_free_spins_keep_the_angular_momentum(turn):
    """Also of rods and plates and of bodies at rest; a body that is lost spoils no other."""
    rng, dt = np.random.default_rng(0), 0.01
    moments = np.concatenate([rng.uniform(0.5, 1.0, (40, 3)), [[1.0, 1.0, 1e-3], [0.5, 0.5, 1.0], [1.0, 1.0, 1.0]]])
    spin = rng.normal(size=(43, 3)) * turn / dt
    spin[:3] = [[0.0], [np.nan], [np.inf]]
    frame = random_quaternions(rng, 43)
    after, _ = free_spin(frame, spin, moments, dt, np.zeros_like(spin))
    assert not after[0].any()
    assert not np.isfinite(after[1:3]).any()

    def momentum(w, way):
        """In the world, in the middle of the step before (way -1) and of this one (1)."""
        middle = quaternion.multiply(quaternion.exponential(way * dt / 2 * w), frame[3:])
        return quaternion.rotate(middle, moments[3:] * quaternion.rotate(quaternion.conjugate(middle), w))

    np.testing.assert_allclose(momentum(after[3:], 1), momentum(spin[3:], -1), rtol=1e-5, atol=1e-5 * turn / dt)


def test_damaged_machine_code_is_made_anew(tmp_path, monkeypatch):
    (tmp_path / "twice.py").write_text(
        "from dem.compiled import loop\n\n@loop\ndef twice(x: float) -> float:\n    return 2.0 * x\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "code"))
    module = importlib.import_module("twice")
    assert module.twice(1.5) == 3.0
    files = [path for path in (tmp_path / "code").rglob("twice*") if path.is_file()]
    assert {path.suffix for path in files} == {".nbi", ".nbc"}
    for path in files:
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
        with pytest.warns(UserWarning, match="is damaged .* and made anew"):
            assert importlib.reload(module).twice(1.5) == 3.0
        assert importlib.reload(module).twice(1.5) == 3.0


def test_machine_code_is_that_of_all_that_a_loop_reaches(tmp_path, monkeypatch):
    """After changes of other files, which keep their lengths and their times: functions by name and by attribute, of a
    closure and of another function, constants, and the order of fields."""
    sources = {
        "__init__": "",
        "deep": """
            from dem.compiled import inlined
            SIZE = 5.0
            @inlined
            def times(x): return 2.0 * x""",
        "vectors": """
            from collections import namedtuple
            import numpy as np
            from dem.compiled import inlined
            from small import deep
            FACTOR, TABLE = 3.0, np.array([0.0, 4.0])
            Pair = namedtuple("Pair", ["first", "other"])
            @inlined
            def one(x): return 1.0
            @inlined
            def twice(x): return deep.times(x)""",
        "loops": """
            from dem.compiled import loop
            from small import vectors
            from small.vectors import FACTOR, Pair, twice
            def shifted_by(shift):
                @loop
                def shifted(x): return twice(x) + shift(x)
                return shifted
            shifted = shifted_by(vectors.one)
            @loop
            def tuples(x): return twice(x), vectors.twice(x), FACTOR * x, vectors.TABLE[1] * x, vectors.deep.SIZE * x
            @loop
            def leading(pair): return pair.first
            def ask(): return [*tuples(1.0), shifted(1.0), leading(Pair(1.0, 2.0))]
            def compiled():
                return sum(sum(f.compiled.stats.cache_misses.values()) for f in (tuples, shifted, leading))""",
    }
    package = tmp_path / "small"
    package.mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("sys.dont_write_bytecode", True)  # Python's own files are found by length and time

    def write(name, text):
        (package / f"{name}.py").write_text(textwrap.dedent(text))
        os.utime(package / f"{name}.py", (1e9, 1e9))

    def ask():
        for name in [name for name in sys.modules if name.split(".")[0] == "small"]:
            del sys.modules[name]
        loops = importlib.import_module("small.loops")
        return loops.ask(), loops.compiled()

    for name, text in sources.items():
        write(name, text)
    assert ask() == ([2, 2, 3, 4, 5, 3, 1], 3)
    assert ask() == ([2, 2, 3, 4, 5, 3, 1], 0)
    for name, old, new, answers, compiled in [
        ("deep", "2.0 * x", "7.0 * x", [7, 7, 3, 4, 5, 8, 1], 2),
        ("deep", "SIZE = 5.0", "SIZE = 6.0", [2, 2, 3, 4, 6, 3, 1], 1),
        ("vectors", "= 3.0", "= 9.0", [2, 2, 9, 4, 5, 3, 1], 1),
        ("vectors", "4.0]", "8.0]", [2, 2, 3, 8, 5, 3, 1], 1),
        ("vectors", "return 1.0", "return 6.0", [2, 2, 3, 4, 5, 8, 1], 1),
        ("vectors", '["first", "other"]', '["other", "first"]', [2, 2, 3, 4, 5, 3, 2], 1),
    ]:
        assert old in sources[name]
        write(name, sources[name].replace(old, new))
        assert ask() == (answers, compiled), f"{old} -> {new}"
        write(name, sources[name])
    code = "from small import loops; print(loops.ask(), loops.compiled())"
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{Path(dem.__file__).parents[1]}", "PYTHONHASHSEED": "7"}
    process = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert process.stdout.split("]")[1].strip() == "0"  # another process finds the same, and that of the first sources
    assert ask() == ([2, 2, 3, 4, 5, 3, 1], 0)


def test_machine_code_that_was_installed_is_read_where_nobody_can_write(tmp_path, monkeypatch):
    """As in a container: neither the folder of the source nor, in the second round, that of the user can be written."""
    (tmp_path / "thrice.py").write_text(
        "from dem.compiled import loop\n\n@loop\ndef thrice(x: float) -> float:\n    return 3.0 * x\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    module = importlib.import_module("thrice")
    assert module.thrice(1.5) == 4.5
    assert {path.suffix for path in (tmp_path / "__pycache__").iterdir()} >= {".nbi", ".nbc"}

    def refuse(locator):
        raise OSError("read-only file system")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    for locator in CompileResultCacheImpl._locator_classes[1:3]:  # numba tries these two in turn
        monkeypatch.setattr(locator, "ensure_cache_path", refuse)
        module = importlib.reload(module)
        assert module.thrice(1.5) == 4.5
        assert sum(module.thrice.compiled.stats.cache_hits.values()) == 1
        assert module.thrice(2) == 6  # what was not installed is compiled


def test_a_loop_runs_where_numba_may_not_compile(monkeypatch):
    """As with NUMBA_DISABLE_JIT, for those who debug a loop; on one rank alone the others would wait for ever."""
    monkeypatch.setattr("numba.core.config.DISABLE_JIT", 1)

    @loop
    def doubled(x):
        return 2.0 * x

    assert doubled(3.0) == 6.0


@pytest.mark.parametrize("kind", [inner, inlined])
def test_what_loops_alone_call_runs_in_python_too(kind):
    """As Python: there is no machine code for it."""

    @kind
    def double(x):
        return 2.0 * x

    @loop
    def four_times(x):
        return double(double(x))

    assert four_times(1.0) == 4.0
    assert double(np.ones(2)).tolist() == [2.0, 2.0]


def test_a_loop_has_nine_parameters_at_most():
    for path in (file for folder in (dem, pctt) for file in Path(folder.__file__).parent.rglob("*.py")):
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if re.search("@(loop|inner|inlined)", text) else ():
            marks = {ast.unparse(mark) for mark in getattr(node, "decorator_list", ())}
            if marks & {"loop", "inner", "inlined"}:
                assert len(node.args.args + node.args.kwonlyargs) <= 9, f"{path.name}: {node.name}"


@pytest.mark.parametrize("order", ["the same", "with gaps", "reversed", "random", "none in common", "empty"])
def test_places_of_keys_are_found_in_any_order(order):
    rng = np.random.default_rng(3)
    keys = np.unique(rng.integers(0, 2**40, 900) + 1j * rng.integers(0, 2**40, 900))[:800]
    asked = {
        "the same": keys, "reversed": keys[::-1].copy(), "random": rng.permutation(keys), "none in common": keys + 0.5j,
        "with gaps": np.insert(np.delete(keys, slice(100, 300)), [50, 50, 400], [1j, 2j, 3j]), "empty": keys[:0],
    }[order]  # fmt: skip
    known = {key: place for place, key in enumerate(keys.tolist())}
    np.testing.assert_array_equal(places(keys, asked), [known.get(key, -1) for key in asked.tolist()])
    np.testing.assert_array_equal(places(asked[:0], keys), -1)


def test_the_type_of_an_index_is_found_once(monkeypatch):
    """numba would ask for it at each place in each loop."""
    asked, find = [], GetItemBuffer.generic
    monkeypatch.setattr(GetItemBuffer, "generic", lambda self, *given: asked.append(given) or find(self, *given))
    loop(lambda x: x)(0)  # imports what remembers

    @numba.njit
    def trace(x, i):
        return x[i, i, i, i] + x[i, i, i, i + 1] + x[i, i, i + 1, i]

    x = np.arange(81, dtype=np.int16).reshape(3, 3, 3, 3)
    assert [trace(x, 1), numba.njit(lambda x, i: x[i, i, i, i] - x[0, i, i, i])(x, 1)] == [40 + 41 + 43, 27]
    assert len(asked) == 2  # of i, i, i, i and 0, i, i, i
