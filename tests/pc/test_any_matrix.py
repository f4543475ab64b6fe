"""The preconditioners with matrices of any kind, bad input, and programs that end in an error."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from systems import contact_matrix, contacts
from train_solver import context, poisson, ready, report, solve, solver

from pctt.blocks import block_diagonal
from pctt.ccp import ConeProblem
from pctt.mat import axpy, inverse, save
from pctt.pc.mat import is_symmetric
from pctt.petsc import own_errors


@contextmanager
def refused(words: str, error: type[Exception] = ValueError) -> Iterator[None]:
    """An error in these words, which newer releases of petsc4py wrap into one of PETSc."""
    with pytest.raises(error, match=words), own_errors():
        yield


def filled(kind: str) -> PETSc.Mat:
    """A contact matrix as a Mat of this type."""
    mat = contact_matrix(*contacts(40, 30))
    points = np.random.default_rng(0).random((40, 3))
    if kind == "sbaij":
        mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    mat = mat if kind == "baij" else mat.convert(kind, PETSc.Mat())
    if mat.getBlockSize() != 3:
        mat.setBlockSize(3)
    mat.setAttr("coordinates", points)
    return mat


@pytest.mark.parametrize("rank", ["1", "30"])
def test_all_types_of_matrices_give_the_same_preconditioner(rank):
    its = []
    for kind in ("baij", "aij", "sbaij", "dense"):
        ksp = solver(filled(kind), rank=rank)
        for _ in range(2):  # the second time with new values
            count, left = solve(ksp)
            assert left < 1e-7
            mat = ksp.getOperators()[0]
            mat.scale(2.0)
            ksp.setOperators(mat)
        its.append(count)
    assert max(its) - min(its) <= 2


def unready_mats() -> dict[str, PETSc.Mat]:
    """Mats with which PETSc's own functions may end in a segmentation fault, by what they are."""
    sized, unassembled = PETSc.Mat().create(), PETSc.Mat().createAIJ((6, 6), nnz=1)
    sized.setSizes((6, 6))
    unassembled.setValue(0, 0, 1.0)
    destroyed = PETSc.Mat().createAIJ((6, 6), nnz=1).destroy()
    lack = "has no type or no sizes"
    return {"never created": PETSc.Mat(), "or is destroyed": destroyed, lack: sized, "is not assembled": unassembled}


@pytest.mark.parametrize("kind", ["BlockICC", "TensorTrain"])
def test_a_matrix_that_is_not_ready_is_refused_by_all_that_take_one(kind):
    good = filled("aij")
    x, b = good.createVecs()
    r, mu = np.ones((2, 3)), np.ones(2)
    for words, mat in unready_mats().items():
        ksp = PETSc.KSP().create()
        ksp.setOperators(good, mat)
        ksp.pc.setType("python")
        ksp.pc.setPythonType(f"pctt.pc.{kind}")
        with refused(f"pctt.pc.{kind}: the Mat " + ("" if mat.handle else "has no type or no sizes")):
            ksp.solve(b, x)
        ksp.destroy()
        for call in (inverse, lambda mat: save(mat, "file.h5"), lambda mat: axpy(mat, 1.0, mat), block_diagonal):
            with refused(words):
                call(mat)
        for given in ({"N": mat}, {"G": mat, "masses": np.ones(6)}, {"G": np.eye(6), "masses": mat}):
            with refused(f"is a Mat that .*{words}"):
                ConeProblem(MPI.COMM_SELF, r, mu, **given)
    with refused("pctt.mat.inverse: the Mat is a str; allowed is an assembled Mat"):
        inverse("mat")
    for masses in (PETSc.Vec(), PETSc.Vec().create(), PETSc.KSP(), PETSc.KSP().create()):
        with refused(f"masses is a {type(masses).__name__} that "):
            ConeProblem(MPI.COMM_SELF, r, mu, G=np.eye(6), masses=masses)


def test_a_matrix_without_entries_or_of_another_shape_is_refused():
    shell = PETSc.Mat().createPython((9, 9), type("Shell", (), {"mult": lambda *_: None})())
    shell.setUp()
    with refused("type python has no entries to read; allowed are aij.*any Mat with the attribute entries"):
        solver(shell).setUp()
    wide = PETSc.Mat().createAIJ((6, 9), nnz=1)
    wide.assemble()
    with refused("6 rows and 9 columns; allowed is a square one"):
        solver(wide).pc.setUp()


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.full((64, 2), np.nan), "have a NaN"),
        (np.zeros((63, 2)), r"shape \(63, 2\)"),
        (np.zeros((64, 4)), r"shape \(64, 4\)"),
        (np.zeros(64), r"shape \(64,\)"),
        ([["a"]] * 64, "are no numbers"),
    ],
)
def test_bad_coordinates_are_refused_at_set_up(points, words):
    mat = poisson(8)
    mat.setAttr("coordinates", points)
    ksp = solver(mat)
    with refused(f"{words}.*allowed are finite numbers of shape"):
        ksp.setUp()


@pytest.mark.parametrize("scale", [1e-290, 1.0, 1e290])
def test_symmetry_does_not_depend_on_units(scale):
    mat = filled("dense")
    mat.scale(scale)
    assert is_symmetric(mat)
    mat.setValue(0, 1, 10.0 * abs(mat.getValue(0, 0)))
    mat.assemble()
    assert not is_symmetric(mat)


def test_a_matrix_that_is_not_symmetric_is_said_to_be_so():
    mat = poisson(8)
    assert is_symmetric(mat)
    mat[0, 1] = -3.0
    mat.assemble()
    assert not is_symmetric(mat)
    ksp = solver(mat, rank=8)
    with pytest.warns(UserWarning, match="not symmetric"):
        ksp.setUp()
    assert "not symmetric" in report(ksp)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solver(poisson(8)).setUp()
        solver(mat, rank="auto").setUp()  # which makes no train


@pytest.mark.parametrize("method", ["cg", "bcgs", "minres"])
def test_a_solve_that_a_train_has_spoilt_is_made_again(method):
    """With a train of which half the entries have another sign: the solve at hand succeeds, and the next as well."""
    mat = poisson(16)
    ksp = ready(mat, method, rank=6)
    assert context(ksp).rank == 6
    spoil = context(ksp).made.slots.unscaled
    sign = np.nan if method == "bcgs" else np.resize([1.0, -1.0], 256)
    context(ksp).made.slots.unscaled = lambda z: sign * spoil(z)
    for _ in range(2):
        assert solve(ksp)[1] < 1e-6
        assert ksp.getConvergedReason() > 0
    assert "solved again" in report(ksp)
    assert context(ksp).what() == "rank 1: block Jacobi"


CRASH = """
import sys
import petsc4py
petsc4py.init(sys.argv)
from petsc4py import PETSc

mat = PETSc.Mat().createAIJ((60, 60), nnz=1)
for i in range(60):
    mat[i, i] = 2.0
mat.assemble()
ksp = PETSc.KSP().create()
ksp.setOperators(mat)
ksp.pc.setType("python")
ksp.pc.setPythonType("pctt.pc.TensorTrain")
PETSc.Options()["pc_{option}"] = "7"
ksp.setFromOptions()
x, b = mat.createVecs()
ksp.setUp()
if {solved}:
    ksp.solve(b, x)
held = [ksp, ksp.pc, ksp.pc.getPythonContext()]
held.append(held)
raise RuntimeError("the user's own error")
"""
ENDS = {
    "after a solve": ({"solved": True}, "RuntimeError: the user's own error"),
    "a bad option": ({"option": "tt_rnak"}, "pc_tt_rnak: no such option"),
}


@pytest.mark.parametrize("end", ENDS)
def test_an_error_of_the_user_ends_in_its_own_words(end):
    """And not in a crash of the interpreter that takes a living KSP with it."""
    changes, words = ENDS[end]
    source = CRASH.format(**{"option": "unused", "solved": False, **changes})
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1, done.stderr
    assert words in done.stderr
    assert "Traceback" in done.stderr
    assert "Segmentation" not in done.stderr


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("kind", ["nest", "python"])
def test_a_matrix_without_entries_gets_its_diagonal(kind):
    mat = poisson(8)
    factor = mat.createVecLeft()
    factor.array[:] = 1.0 + np.arange(*mat.getOwnershipRange())
    mat.diagonalScale(factor, factor)
    expected, _ = solve(solver(mat, rank="1"))
    if kind == "nest":
        other = PETSc.Mat().createNest([[mat]])
    else:
        methods = {"mult": lambda s, m, x, y: mat.mult(x, y), "getDiagonal": lambda s, m, v: mat.getDiagonal(v)}
        other = PETSc.Mat().createPython(mat.getSizes(), type("Shell", (), methods)(), comm=mat.comm)
        other.setUp()
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        its, left = solve(solver(other, rank="auto"))
    assert its == expected
    assert left < 1e-7
    assert any("its diagonal is used" in str(one.message) for one in heard) == (mat.comm.rank == 0)


def line(n: int, ring: bool = False) -> PETSc.Mat:
    """The Laplacian of n points on a line, with a shift, or of a ring, with its null space."""
    mat = PETSc.Mat().createAIJ((n, n), nnz=3)
    for i in range(*mat.getOwnershipRange()):
        mat.setValue(i, i, 2.0 if ring else 2.1)
        for j in (i - 1, i + 1):
            if ring or 0 <= j < n:
                mat.setValue(i, j % n, -1.0)
    mat.assemble()
    if ring:
        mat.setNullSpace(PETSc.NullSpace().create(constant=True))
    return mat


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("n", [33, 101, 147, 200])
@pytest.mark.parametrize(
    "options",
    [{"order": "natural"}, {"order": "natural", "variant": "unscaled"}, {"ring": True}],
    ids=["in order", "unscaled", "null space"],
)
def test_numbers_of_rows_that_a_train_pads(n, options):
    ring = "ring" in options
    mat = line(n, ring)
    ksp = solver(mat, rank="20", **{name: value for name, value in options.items() if name != "ring"})
    x, b = mat.createVecs()
    b.array[:] = np.cos(np.arange(*mat.getOwnershipRange()))
    if ring:
        mat.getNullSpace().remove(b)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # that there is no train
        ksp.solve(b, x)
    assert (b - mat * x).norm() < 1e-6 * b.norm()
