"""A train as a Mat of PETSc: arithmetic, options, arguments, files; and the direct solver. Dense matrices are the
measure."""

from __future__ import annotations

import warnings

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from train_solver import Kernel, columns, dense_mat, dense_of, gathered, ready

from pctt import tt
from pctt.disk import FileError, write_rows
from pctt.mat import TensorTrain, axpy, from_entries, inverse, load, save
from pctt.mat.entries import Entries
from pctt.options import OptionError
from pctt.petsc import own_errors
from pctt.tt.apply import cheapest_groups

GRIDS = [(12,), (5, 6), (11,), (3, 1, 7)]  # with and without points that only fill up the digits
EPS = 1e-12
FROBENIUS = PETSc.NormType.FROBENIUS


def of(mat: PETSc.Mat) -> np.ndarray:
    return columns(mat, mat.mult)


def is_matrix(mat: PETSc.Mat, A: np.ndarray, atol: float = 1e-9) -> None:
    """Products, transposed products, diagonal, entries and norm are those of A."""
    np.testing.assert_allclose(of(mat), A, atol=atol)
    np.testing.assert_allclose(columns(mat, mat.multTranspose), A.T, atol=atol)
    np.testing.assert_allclose(gathered(mat.getDiagonal()), np.diag(A), atol=atol)
    np.testing.assert_allclose(dense_of(Entries.of_mat(mat), len(A)), A, atol=atol)
    assert mat.norm(FROBENIUS) == pytest.approx(np.linalg.norm(A), abs=atol)


def diagonal_mat(like: PETSc.Mat, kind: str) -> PETSc.Mat:
    """3 I as a Mat of several types, or something near it."""
    mat = PETSc.Mat().create(comm=like.comm)
    mat.setSizes(like.getSizes())
    mat.setType("constantdiagonal" if kind == "constantdiagonal" else "aij")
    mat.setUp()
    if kind != "constantdiagonal":
        for row in range(*mat.getOwnershipRange()):
            mat[row, row] = 1.0 if kind == "diagonal" and row == 2 else 0.0
        if mat.getOwnershipRange()[0] == 0:
            mat[0, 1] = 1e-9 if kind == "coupled" else 0.0  # a stored zero
    mat.assemble()
    mat.shift(3.0)
    return mat


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("grid", GRIDS)
def test_arithmetic_is_that_of_matrices(grid):
    kernel, other = Kernel(grid, skew=0.3), Kernel(grid, 1.0, 20.0)
    A, B, one = kernel.dense, other.dense, np.eye(len(kernel.dense))
    mat, second = from_entries(kernel, grid, EPS), from_entries(other, grid, EPS)
    is_matrix(mat, A)
    assert mat.isSymmetricKnown() == (True, False)
    assert "ranks" in mat.getPythonContext().compressed.words()
    mat.scale(-0.5)
    is_matrix(mat, -0.5 * A)
    mat.shift(7.0)
    is_matrix(mat, -0.5 * A + 7 * one)
    axpy(mat, 2.0, second)
    is_matrix(mat, -0.5 * A + 7 * one + 2 * B)
    for kind in ("constantdiagonal", "aij"):
        axpy(mat, -1.0, diagonal_mat(mat, kind))
    is_matrix(mat, -0.5 * A + one + 2 * B)
    twice = mat.duplicate(copy=True)
    axpy(twice, 1.0, twice)
    is_matrix(twice, 2 * (-0.5 * A + one + 2 * B))
    left, right = mat.createVecs()
    left.set(2.0)
    right.set(-0.25)
    twice.diagonalScale(left, right)
    is_matrix(twice, 0.5 * A - one - 2 * B)
    twice.diagonalScale(left)
    is_matrix(twice, A - 2 * one - 4 * B)
    mat.axpy(-2.0, second)  # as PETSc calls it
    is_matrix(mat, -0.5 * A + one)
    context, info = mat.getPythonContext(), mat.getInfo(PETSc.Mat.InfoType.LOCAL)
    assert (info["memory"], info["nz_used"]) == (context.bytes, context.bytes / 8)
    mat.scale(0.0)
    mat.shift(2.0)
    is_matrix(mat, 2 * one)


@pytest.mark.parallel(1, 3)
def test_copies_do_not_follow_their_original():
    kernel, other = Kernel((5, 6)), Kernel((5, 6), 1.0, 20.0, 0.2)
    mat, second = from_entries(kernel, (5, 6), EPS), from_entries(other, (5, 6), EPS)
    twin, empty = mat.duplicate(copy=True), mat.duplicate(copy=False)
    is_matrix(empty, 0 * kernel.dense)
    mat.scale(3.0)
    is_matrix(twin, kernel.dense)
    second.copy(twin)
    is_matrix(twin, other.dense)
    assert twin.isSymmetricKnown() == (True, False)
    mat.copy(empty)
    is_matrix(empty, 3 * kernel.dense)
    mat.zeroEntries()
    is_matrix(mat, 0 * kernel.dense)
    is_matrix(empty, 3 * kernel.dense)
    is_matrix(empty.duplicate(copy=True), 3 * kernel.dense)


@pytest.mark.parallel(1, 2)
def test_what_a_train_cannot_do_is_refused_in_words(tmp_path):
    mat, other = from_entries(Kernel((5, 6)), (5, 6)), from_entries(Kernel((6, 5)), (6, 5))
    uneven = mat.createVecLeft()
    uneven.set(1.0)
    if uneven.getOwnershipRange()[0] == 0:
        uneven.array[0] = 2.0
    viewer = PETSc.Viewer().createBinary(str(tmp_path / "train"), "w", comm=mat.comm)
    refused = {
        "allowed are constant vectors": lambda: mat.diagonalScale(uneven),
        "allowed is PETSc.NormType.FROBENIUS": lambda: mat.norm(PETSc.NormType.INFINITY),
        "X is a Mat of type .*or a multiple of the identity": lambda: axpy(mat, 1.0, diagonal_mat(mat, "diagonal")),
        "or a multiple of the identity": lambda: axpy(mat, 1.0, diagonal_mat(mat, "coupled")),
        "Y is a Mat of type": lambda: axpy(diagonal_mat(mat, "aij"), 1.0, mat),
        "the same grid": lambda: axpy(mat, 1.0, other),
        "into a Mat of type": lambda: mat.copy(diagonal_mat(mat, "aij")),
        "pctt.mat.save.mat, path. does": lambda: mat.view(viewer),
        "pctt.mat.save: a Mat of type": lambda: save(diagonal_mat(mat, "aij"), tmp_path / "no.h5"),
    }
    for words, attempt in refused.items():
        with pytest.raises(ValueError, match=words), own_errors():
            attempt()
    is_matrix(mat, Kernel((5, 6)).dense, 1e-6)


@pytest.mark.parallel(1, 2, 3)
def test_a_changed_mat_is_preconditioned_as_it_is_now():
    kernel = Kernel((12, 9), 1.0, 6.0)
    mat = from_entries(kernel, (12, 9), 1e-10)
    mat.scale(5.0)
    mat.shift(2.0)
    A = 5 * kernel.dense + 2 * np.eye(108)
    for eps in (1e-2, 1e-11):  # the second is beyond the accuracy of the Mat, so its entries are evaluated
        ksp = ready(mat, rank=100, eps=eps)
        x, y = mat.createVecs()
        x.set(1.0)
        ksp.pc.apply(x, y)
        expected = np.linalg.solve(A, np.ones(108))
        assert np.linalg.norm(gathered(y) - expected) < 20 * eps * np.linalg.norm(expected)


@pytest.mark.parallel(1, 2)
def test_the_cap_of_the_ranks_is_kept_by_symmetric_parts():
    """And the train stays symmetric, and its error is that of the capped train."""
    heights = np.random.default_rng(0).random(64)

    def rough(i, j):
        return (i == j) + np.exp(-np.abs(i - j) / 64 - np.abs(heights[i] - heights[j]))

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        mat = from_entries(rough, (64,), 1e-10, max_rank=7)
    assert len(said) == (mat.comm.rank == 0)
    assert all("is left at rank 7" in str(one.message) for one in said)
    context = mat.getPythonContext()
    assert max(context.ranks) == 7
    T = context.compressed.train
    assert (T - T.T).norm() < 1e-12 * T.norm()
    A = dense_of(rough, 64)
    true = np.linalg.norm(of(mat) - A) / np.linalg.norm(A - A.diagonal().mean() * np.eye(64))
    assert 0.5 * true < context.error < 2 * true


BAD = {
    "eps nan: allowed is a number between 0 and 1": {"eps": np.nan},
    "eps 2: allowed is a number between 0 and 1": {"eps": 2},
    "eps 'a': allowed is a number between 0 and 1": {"eps": "a"},
    "max_rank 0: allowed is a whole number >= 1": {"max_rank": 0},
    r"grid of shape \(2.5,\); allowed is a tuple of whole numbers >= 1": {"grid": (2.5,)},
    r"grid of shape \(0, 5\); allowed is a tuple of whole numbers >= 1": {"grid": (0, 5)},
    r"grid of shape \(\); allowed is a tuple of whole numbers >= 1": {"grid": ()},
    r"grid of shape \(65536, 32768\) with 2147483648 points; allowed are fewer than 2.31": {"grid": (65536, 32768)},
    "too many points for a train": {"grid": (46340, 46339)},
    "attribute entries": {"entries": 3.0},
    "the attribute entries of the Mat is .None": {"entries": None},
}


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("words", BAD)
def test_bad_arguments_are_refused_on_all_ranks(words):
    with pytest.raises(ValueError, match=words):
        from_entries(**{"entries": Kernel((5, 6)), "grid": (5, 6), **BAD[words]})
    if MPI.COMM_WORLD.size > 1:
        mine = BAD[words] if MPI.COMM_WORLD.rank == 1 else {}
        with pytest.raises(ValueError, match="allowed|differ|too many"):
            from_entries(**{"entries": Kernel((5, 6)), "grid": (5, 6), **mine})
    assert MPI.COMM_WORLD.allreduce(1) == MPI.COMM_WORLD.size  # all are here


@pytest.mark.parallel(1, 2)
def test_options_win_over_arguments_and_misspelt_ones_are_refused():
    kernel, database = Kernel((12, 9), width=2.0), PETSc.Options()
    database["mat_tt_eps"] = "1e-2"
    database["fine_mat_tt_eps"] = "1e-9"
    coarse = from_entries(kernel, (12, 9), 1e-6).getPythonContext()
    fine = from_entries(kernel, (12, 9), 1e-6, prefix="fine_").getPythonContext()
    assert fine.error < 1e-8 < 1e-5 < coarse.error < 1e-1
    assert max(coarse.ranks) < max(fine.ranks)
    assert coarse.bytes == 8 * coarse.compressed.train.storage
    database["mat_tt_max_rank"] = "0"
    with pytest.raises(OptionError, match="-mat_tt_max_rank 0: allowed is a whole number"):
        from_entries(kernel, (12, 9))
    del database["mat_tt_max_rank"]
    database["mat_tt_max_rnak"] = "5"
    with pytest.raises(OptionError, match="did you mean -mat_tt_max_rank"):
        from_entries(kernel, (12, 9))
    del database["mat_tt_max_rnak"]
    mat = PETSc.Mat().create()
    mat.setSizes((108, 108))
    mat.setAttr("entries", kernel)
    mat.setAttr("grid", (12, 9))
    database["mat_type"] = "python"
    database["mat_python_type"] = "pctt.mat.TensorTrain"
    mat.setFromOptions()
    mat.setUp()
    assert mat.getPythonContext().options.eps == 1e-2
    is_matrix(mat, kernel.dense, 0.1)


@pytest.mark.parallel(1, 2)
def test_a_function_that_changes_its_arguments_spoils_nothing():
    kernel = Kernel((5, 6))

    def spoils(i, j):
        values = kernel(i, j)
        i += 1
        j[:] = 0
        return values

    mat = from_entries(spoils, (5, 6), EPS)
    mat.scale(2.0)
    axpy(mat, 1.0, from_entries(kernel, (5, 6), EPS))
    is_matrix(mat, 3 * kernel.dense)


class Own:
    """A context that a user has written, with all that a train needs, but without products."""

    def __init__(self, grid: tuple[int, ...], way: str) -> None:
        kernel = Kernel(grid)
        if way == "appctx":
            self.appctx = {"entries": kernel, "grid": grid}
        else:
            self.entries, self.grid = kernel, grid if way == "attributes" else lambda: grid


def own_mat(grid: tuple[int, ...], way: str = "attributes") -> PETSc.Mat:
    n = int(np.prod(grid))
    mat = PETSc.Mat().createPython((n, n), Own(grid, way), comm=PETSc.COMM_WORLD)
    mat.setUp()
    return mat


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("way", ["attributes", "methods", "appctx"])
def test_the_context_of_a_mat_may_give_entries_and_grid(way):
    X = inverse(own_mat((5, 6), way), 1e-10)
    assert X.getPythonContext().compressed.layout.order == "grid"
    np.testing.assert_allclose(of(X), np.linalg.inv(Kernel((5, 6)).dense), atol=1e-8)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("way", ["train", "dense"])
def test_the_inverse_solves_directly(grid, way):
    kernel = Kernel(grid)
    A = kernel.dense
    mat = from_entries(kernel, grid, EPS) if way == "train" else dense_mat(A, grid=grid)
    exact = np.linalg.inv(A)
    for eps in (1e-3, 1e-9):
        X = inverse(mat, eps)
        context = X.getPythonContext()
        T = A / A.diagonal().mean() - np.eye(len(A))
        assert context.residual <= eps
        assert context.error <= 3 * eps * np.linalg.norm(T)
        assert np.linalg.norm(of(X) - exact) <= 3 * eps * np.linalg.norm(T) * np.linalg.norm(exact)
        assert context.bytes == 8 * sum(core.size for core in context.compressed.train.cores)
        assert X.isSymmetricKnown() == (True, True)
    is_matrix(X, exact, 1e-7)
    is_matrix(inverse(X, 1e-9), A, 1e-6)
    X.scale(2.0)
    is_matrix(X, 2 * exact, 1e-7)


@pytest.mark.parallel(1, 2, 3)
def test_the_inverse_is_the_preconditioner_of_pcmat():
    kernel = Kernel((12, 9))
    A = from_entries(kernel, (12, 9), EPS)
    ksp = PETSc.KSP().create(A.comm)
    ksp.setOperators(A, inverse(A, 1e-6))
    ksp.setType("cg")
    ksp.setTolerances(rtol=1e-10)
    ksp.pc.setType("mat")
    x, b = A.createVecs()
    b.array[:] = np.arange(*b.getOwnershipRange())
    ksp.solve(b, x)
    assert ksp.getIterationNumber() <= 2
    np.testing.assert_allclose(gathered(x), np.linalg.solve(kernel.dense, np.arange(108.0)), rtol=1e-7, atol=1e-7)


@pytest.mark.parallel(1, 2)
def test_an_inverse_that_is_not_there_is_refused_in_words():
    grid = (5, 6)
    indefinite = from_entries(Kernel(grid, nugget=-0.5), grid, EPS)
    refused = {
        "not symmetric": lambda: inverse(from_entries(Kernel(grid, skew=0.3), grid)),
        "not positive definite": lambda: inverse(indefinite),
        "mean of its diagonal is <= 0": lambda: inverse(from_entries(Kernel(grid, nugget=-2.0), grid)),
        "without entries": lambda: inverse(diagonal_mat(indefinite, "aij")),
        "a residual of .* is left at rank .*above 2": lambda: inverse(from_entries(Kernel(grid), grid), max_rank=2),
        "the matrix has an error of .* at rank 2": lambda: inverse(own_mat(grid), 1e-9, max_rank=2),
        "eps 0: allowed is": lambda: inverse(indefinite, 0),
        "max_rank 0: allowed is": lambda: inverse(indefinite, max_rank=0),
    }
    for words, attempt in refused.items():
        with pytest.raises(ValueError, match=words):
            attempt()
    assert MPI.COMM_WORLD.allreduce(1) == MPI.COMM_WORLD.size  # all are here


@pytest.mark.parallel(1, 2, 3)
def test_trains_are_saved_and_loaded(tmp_path):
    kernel = Kernel((5, 7), skew=0.2)
    mat = from_entries(kernel, (5, 7), EPS)
    mat.scale(0.5)
    mat.shift(3.0)
    save(mat, tmp_path / "train.h5")
    again = load(tmp_path / "train.h5")
    is_matrix(again, 0.5 * kernel.dense + 3 * np.eye(35))
    assert again.getPythonContext().error == mat.getPythonContext().error
    assert again.getPythonContext().options == mat.getPythonContext().options
    positive = Kernel((5, 7))
    X = inverse(from_entries(positive, (5, 7), EPS), 1e-9)
    save(X, str(tmp_path / "train.h5"))
    loaded = load(tmp_path / "train.h5", mat.comm)
    is_matrix(loaded, np.linalg.inv(positive.dense), 1e-7)
    assert loaded.getPythonContext().residual == X.getPythonContext().residual
    assert loaded.getPythonContext().compressed.words() == X.getPythonContext().compressed.words()
    np.testing.assert_array_equal(of(loaded), of(X))


@pytest.mark.parallel(1, 2)
def test_the_order_of_the_rows_is_saved(tmp_path):
    """The points of the Mat are in a random order; the train goes along a curve through them."""
    kernel = Kernel((5, 7))
    at = np.random.default_rng(0).permutation(35)
    A = kernel.dense[np.ix_(at, at)]
    mat = PETSc.Mat().create(comm=PETSc.COMM_WORLD)
    mat.setSizes((35, 35))
    mat.setType("python")
    mat.setPythonContext(TensorTrain(EPS))
    mat.setAttr("entries", lambda i, j: kernel(at[i], at[j]))
    points = np.stack(np.unravel_index(at, (5, 7)), axis=1) + 0.1 * np.random.default_rng(1).random((35, 2))
    share = [35 // mat.comm.size + (r < 35 % mat.comm.size) for r in range(mat.comm.size)]
    first = sum(share[: mat.comm.rank])
    mat.setAttr("coordinates", points[first : first + share[mat.comm.rank]])
    mat.setUp()
    assert mat.getPythonContext().compressed.layout.order == "morton"
    save(mat, tmp_path / "train.h5")
    is_matrix(load(tmp_path / "train.h5"), A)


@pytest.mark.parallel(1, 2)
def test_a_damaged_file_is_refused_in_one_line(tmp_path):
    path, comm = tmp_path / "train.h5", MPI.COMM_WORLD
    save(from_entries(Kernel((5, 6)), (5, 6)), path)
    whole = path.read_bytes()

    def change(work) -> None:
        comm.Barrier()
        if comm.rank == 0:
            path.write_bytes(whole)
            work()
        comm.Barrier()

    def core() -> None:
        with h5py.File(path, "r+") as file:
            file["cores/1"][0, 0, 0, 0] += 1e-3

    def flip() -> None:
        path.write_bytes(whole[:700] + bytes([whole[700] ^ 4]) + whole[701:])

    def other() -> None:
        write_rows(path, MPI.COMM_SELF, {}, {"x": 1.0}, {"/": {"format": "else"}})

    def parts(change) -> None:
        """As another program might write it, with its checksum."""
        with h5py.File(path, "r") as file:
            arrays = {f"cores/{k}": file[f"cores/{k}"][()] for k in range(len(file["cores"]))}
            values = dict(file.attrs)
        change(arrays, values)
        write_rows(path, MPI.COMM_SELF, {}, arrays, {"/": values})

    ways = {
        "are not those of the grid": [lambda: parts(lambda arrays, values: values.update(grid=(5, 7)))],
        "one for each point of the grid": [lambda: parts(lambda arrays, values: arrays.update(rows=np.arange(29)))],
        "it does not agree with its checksum": [flip],
        "it has no checksum": [core],
        "it is not marked 'pctt train 2'": [other],
        "train.h5: damaged": [lambda: path.write_bytes(whole[: len(whole) // 2]), lambda: path.write_bytes(b"")],
        "No such file": [path.unlink],
    }
    for words, works in ways.items():
        for work in works:
            change(work)
            with pytest.raises(FileError, match=words) as raised:
                load(path)
            assert "\n" not in str(raised.value)
    with pytest.raises(FileError, match="No such file"):
        save(from_entries(Kernel((5, 6)), (5, 6)), tmp_path / "nowhere" / "train.h5")


def test_flops_are_those_of_the_merged_cores():
    """A core of mode m between the ranks r and r' takes 2 n r m r' of them."""
    T = tt.random([2] * 12, 9, [2] * 12)
    whole, part = tt.Apply(T), tt.Apply(T, rows=(0, 2048))
    assert part.flops == pytest.approx(whole.flops / 2)
    merged = tt.merge(T, cheapest_groups(T.rows, T.ranks))
    assert whole.flops == sum(2 * 4096 * core[:, :, 0].size for core in merged.cores)
    PETSc.Log.begin()
    mat = from_entries(Kernel((5, 6)), (5, 6))
    x, y = mat.createVecs()
    before = PETSc.Log.getFlops()
    mat.mult(x, y)
    assert PETSc.Log.getFlops() - before == mat.getPythonContext().compressed._product.flops + 3 * 30
