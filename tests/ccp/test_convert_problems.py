"""FCLIB files made of Siconos' text files: every storage against dense algebra, broken files, published problems
(run/study convert_problems)."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from convert_problems import convert, main
from problems import SELF, Known, dense_of, heap

from pctt import ccp
from pctt.ccp import fclib
from pctt.ccp.fclib import FileFormatError, Stored

STORAGES = ["dense", "blocks", "triplets", "columns"]
PROBLEMS = Path(__file__).resolve().parents[3] / "shared" / "problems"
TITLE = "CSparse Version 3.1.9, May 4, 2016.  Copyright (c) Timothy A. Davis, 2006-2016"


def numbers(x) -> str:
    return "".join(f"{value:32.24e} " for value in np.ravel(x)) + "\n"


def matrix(A: np.ndarray, storage: str, block: int = 3) -> str:
    """A matrix as Siconos writes it; ``block``: rows and columns of sparse blocks, the last ones smaller."""
    m, n = A.shape
    head = f"{STORAGES.index(storage) if storage in STORAGES[:2] else 2}\n{m}\n{n}\n"
    if storage == "dense":
        return f"{head}{m}\t{n}\n{numbers(A.T)}"
    if storage == "blocks":
        return head + sparse_blocks(A, block)
    if storage == "triplets":
        i, j = np.nonzero(A)
        lines = [f"    {r} {c} : {A[r, c]:.17g}" for r, c in zip(i, j)]
        return f"{head}1\n{TITLE}\ntriplet: {m}-by-{n}, nzmax: {len(i) + 3} nnz: {len(i)}\n" + "\n".join(lines) + "\n"
    C = sp.csc_matrix(A)
    lines = []
    for j in range(n):
        begin, end = C.indptr[j : j + 2]
        lines.append(f"    col {j} : locations {begin} to {end - 1}")
        lines += [f"      {C.indices[k]} : {C.data[k]:.17g}" for k in range(begin, end)]
    return f"{head}2\n{TITLE}\n{m}-by-{n}, nzmax: {C.nnz} nnz: {C.nnz}, 1-norm: 7.5\n" + "\n".join(lines) + "\n"


def sparse_blocks(A: np.ndarray, size: int) -> str:
    ends = [[*range(size, length, size), length] for length in A.shape]
    begins = [[0, *e[:-1]] for e in ends]
    columns, pointers, blocks = [], [0], []
    for i, last in zip(begins[0], ends[0]):
        for k, (j, end) in enumerate(zip(begins[1], ends[1])):
            if A[i:last, j:end].any():
                values = "".join(f"{value:32.24e}\n" for value in A[i:last, j:end].T.ravel())
                blocks.append(f"{len(blocks)}\n{values}")
                columns.append(k)
        pointers.append(len(blocks))
    lists = ("".join(f"{value}\t" for value in values) for values in (*ends, pointers, columns))
    row_ends, column_ends, index1, index2 = lists
    head = f"{len(blocks)}\n{len(ends[0])}\n{len(ends[1])}\n{row_ends}\n{column_ends}\n"
    return f"{head}{len(pointers)}\n{len(columns)}\n{index1}\n{index2}\n" + "".join(blocks)


def local(known: Known, storage: str = "dense", W: np.ndarray | None = None, more: str = "") -> str:
    W = matrix(known.N if W is None else W, storage)
    return f"3\n{len(known.mu)}\n{W}{numbers(known.r)}{numbers(known.mu)}{more}"


def global_(M: np.ndarray, H: np.ndarray, f, w, mu, storage: str, block: int = 6) -> str:
    matrices = (matrix(A, storage, block) for A in (M, H))
    return f"3\n{len(mu)}\n{''.join(matrices)}{numbers(f)}{numbers(w)}{numbers(mu)}1\n"


def converted(path: Path, text: str) -> Stored:
    """The problem in the FCLIB file that is made of a text file."""
    path.write_text(text)
    target, note = convert(path, path.parent / "fclib")
    assert [file.name for file in target.parent.iterdir()] == [f"{path.stem}.h5"]
    stored = fclib.load(target, SELF)
    target.unlink()
    assert stored.title == path.name
    assert note in ("", *(f"{name} is stored as one triangle, which was mirrored" for name in "WM"))
    return Stored(stored.problem, stored.form, stored.title, note=note)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_local_problem_is_converted(tmp_path, storage):
    known, _ = heap(0, 12, 8)
    with converted(tmp_path / "local.dat", local(known, storage, more="0\n")).problem as problem:
        assert np.array_equal(problem.r, known.r)
        assert np.array_equal(problem.mu, known.mu)
        product = (known.N @ known.g.ravel()).reshape(-1, 3)
        np.testing.assert_allclose(problem.product(known.g), product, atol=1e-12)
        result = ccp.solve(problem, None, "conic", ccp.Limits(1e-8), law=ccp.RELAXATION)
        assert result.converged
        assert ccp.measure(problem, result.impulse).objective == pytest.approx(known.objective, rel=1e-7)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_problem_in_the_plane_gets_a_second_tangent(tmp_path, storage):
    rng = np.random.default_rng(4)
    H, f, w, mu = rng.normal(size=(9, 8)), rng.normal(size=9), rng.normal(size=(4, 2)), rng.uniform(size=4)
    W, q = H.T @ H, w + (H.T @ f).reshape(-1, 2)
    texts = {
        "local": f"2\n4\n{matrix(W, storage, 2)}{numbers(q)}{numbers(mu)}",
        "global": f"2\n4\n{matrix(np.eye(9), storage, 3)}{matrix(H, storage, 2)}{numbers(f)}{numbers(w)}{numbers(mu)}",
    }
    for form, text in texts.items():
        with converted(tmp_path / f"{form}.dat", text).problem as problem:
            found = dense_of(problem.N).reshape(4, 3, 4, 3)
            np.testing.assert_allclose(found[:, :2, :, :2].reshape(8, 8), W, atol=1e-12)
            assert not found[:, 2].any()
            np.testing.assert_allclose(problem.r, np.hstack([q, np.zeros((4, 1))]), atol=1e-12)


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("masses", ["bodies", "coupled", "one triangle", "six digits"])
def test_a_global_problem_is_converted(tmp_path, storage, masses):
    """M of bodies keeps the map of the bodies; M that couples them gives N; M may be symmetric to six digits only."""
    rng = np.random.default_rng(3)
    known, graph = heap(2, 15, 6)
    H = graph.dense().T
    M = np.diag(rng.uniform(0.5, 2.0, len(H)))
    if masses != "bodies":
        M += 0.2 * (np.eye(len(H), k=1) + np.eye(len(H), k=-1))
    f, w = rng.normal(size=len(H)), rng.normal(size=H.shape[1])
    W, q = H.T @ np.linalg.solve(M, H), w + H.T @ np.linalg.solve(M, f)
    stored_as = {"one triangle": np.tril(M), "six digits": M + 1e-6 * np.triu(M, 1)}.get(masses, M)
    stored = converted(tmp_path / "global.txt", global_(stored_as, H, f, w, known.mu, storage))
    assert stored.form == "FCLIB global"
    assert ("one triangle" in stored.note) == (masses == "one triangle")
    accuracy = 1e-5 if masses == "six digits" else 1e-12
    with stored.problem as problem:
        assert (problem.contact_map is not None) == (masses == "bodies")
        np.testing.assert_allclose(problem.r, q.reshape(-1, 3), atol=accuracy * np.abs(q).max())
        product = (W @ known.g.ravel()).reshape(-1, 3)
        np.testing.assert_allclose(problem.product(known.g), product, atol=accuracy * max(10, np.abs(product).max()))


def test_the_two_forms_of_few_contacts_are_told_apart(tmp_path):
    """M and W of one contact are both 3 x 3; numbers may be written as whole ones."""
    W = np.diag([2.0, 3.0, 5.0])
    alone = "3 1 0 3 3 3 3 2 0 0 0 3 0 0 0 5 -1 3 3 1 0"
    stored = converted(tmp_path / "alone.dat", alone)
    assert stored.form == "FCLIB local"
    assert np.array_equal(dense_of(stored.problem.N), W)
    assert np.array_equal(stored.problem.r, [[-1.0, 3.0, 3.0]])
    body = "3 1 0 3 3 3 3 2 0 0 0 3 0 0 0 5  0 3 3 3 3 1 0 0 0 1 0 0 0 1  4 6 10  -1 0 0  0.5"
    stored = converted(tmp_path / "body.dat", body)
    assert stored.form == "FCLIB global"
    np.testing.assert_allclose(dense_of(stored.problem.N), np.diag([1 / 2, 1 / 3, 1 / 5]), rtol=1e-15)
    np.testing.assert_allclose(stored.problem.r, [[1.0, 2.0, 2.0]], rtol=1e-15)


SMALL = heap(0, 4, 3)[0]
TEXT = {storage: local(SMALL, storage) for storage in STORAGES}
M6 = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
GLOBAL = global_(M6, np.ones((6, 12)), np.ones(6), np.ones(12), np.ones(4), "dense")


def word(text: str, index: int, other: str) -> str:
    """Another word in the place of one."""
    at = [found.span() for found in re.finditer(r"\S+", text)][index]
    return text[: at[0]] + other + text[at[1] :]


BROKEN = {
    "nothing": ("", "it ends too early, after 0 of 1 words of the dimension"),
    "a poem": ("Mary had\na little lamb", "the dimension: invalid literal .*Mary"),
    "more contacts": (word(TEXT["dense"], 1, "5"), r"a matrix \(12, 12\) alone, for 5 contacts; allowed"),
    "letters in W": (word(TEXT["dense"], 20, "1.0x"), r"W or M: could not convert .*1\.0x"),
    "cut": (TEXT["dense"][:-60], "it ends too early, after [123] of 4 words of mu"),
    "blocks out of turn": (word(TEXT["blocks"], 39, "3"), "block 3 of W or M; allowed is block 0 here"),
    "columns called triplets": (word(TEXT["columns"], 5, "1"), "the head that CSparse prints of W"),
    "a global problem without q": (GLOBAL[:-700], "it ends too early"),
    "a light body": (word(GLOBAL, 7, "-1"), "mass matrix is not positive"),
}  # fmt: skip


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_file_is_refused_with_a_reason(tmp_path, what):
    text, said = BROKEN[what]
    with pytest.raises(FileFormatError, match=rf"bad\.dat: no Siconos problem: .*(?:{said})") as error:
        converted(tmp_path / "bad.dat", text)
    assert "\n" not in str(error.value)
    assert list((tmp_path / "fclib").iterdir()) == []


def test_the_command_converts_what_it_can_and_names_the_rest(tmp_path, monkeypatch, capsys):
    """Two contacts apart: one is pressed and slides, one opens. The projection of (1, -2, 0) on the cone."""
    text = "3\n2\n0\n6\n6\n6 6\n" + " ".join("1" if i == j else "0" for i in range(6) for j in range(6))
    (tmp_path / "two.dat").write_text(text + "\n-1 2 0  1 0 0\n0.3 0.3\n1\n")
    (tmp_path / "cut.dat").write_text(text[:60])
    monkeypatch.chdir(tmp_path)

    def command(*files):
        monkeypatch.setattr(sys, "argv", ["convert_problems", *files, "-to", "fclib"])
        return (main(), *capsys.readouterr())

    *done, said = command("two.dat", "cut.dat", "absent.dat")
    assert done == [1, "fclib/two.h5\n"]
    cut, absent = said.splitlines()
    assert cut.startswith("run/study convert_problems: cut.dat: no Siconos problem: it ends too early")
    assert "absent.dat" in absent
    with fclib.read(tmp_path / "fclib" / "two.h5", SELF) as problem:
        result = ccp.solve(problem, None, "conic", ccp.Limits(1e-8), law=ccp.RELAXATION)
        objective = ccp.measure(problem, result.impulse).objective
    assert objective == pytest.approx(-0.5 * (1 + 0.3 * 2) ** 2 / 1.09, rel=1e-7)
    status, _, said = command("two.dat", "fclib/two.h5")
    assert status == 1
    assert said.count("fclib/two.h5 is there already, and is not replaced") == 2


# -- published problems ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["GFC3D_TwoRods1", "Rover1040", "NESpheres_10_1", "OneObject-i1028-138.hdf5"])
def test_published_problems_have_one_optimum(tmp_path, name):
    path = PROBLEMS / f"{name}.dat"
    if not path.exists():
        pytest.skip(f"{path} is not here")
    with fclib.read(convert(path, tmp_path)[0], SELF) as problem:
        found = [ccp.solve(problem, None, solver, ccp.Limits(1e-8), law=ccp.RELAXATION) for solver in ("conic", "apgd")]
        assert all(result.converged for result in found)
        one, other = (ccp.measure(problem, result.impulse).objective for result in found)
        assert one == pytest.approx(other, rel=1e-6)


@pytest.mark.slow
def test_a_pile_of_rocks_obeys_the_law_after_a_plateau(tmp_path):
    """`apgd` alone stays at 1.1e-6, or comes below after 50,000 iterations, as its bound of momentum is."""
    path = PROBLEMS / "RockPile_tob1.dat"
    if not path.exists():
        pytest.skip(f"{path} is not here")
    with fclib.read(convert(path, tmp_path)[0], SELF) as problem:
        result = ccp.solve(problem, None, "auto", ccp.Limits(1e-6), law=ccp.COULOMB)
        assert result.converged
        assert result.iterations < 40_000
        assert ccp.measure(problem, result.impulse).coulomb_residual <= 1e-6
