"""The train under every Krylov method: the true residual is what the method gives with products in double precision."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from petsc4py import PETSc
from train_solver import Kernel
from train_solver import left as left_over

from pctt.mat import from_entries
from pctt.pc.tensor_train import REFINING, UNHARMED

METHODS = (
    "cg", "fcg", "pipecg", "pipefcg", "gmres", "gmres right", "fgmres", "gcr", "minres", "symmlq", "bcgs",
    "bcgs right", "fbcgs", "tfqmr", "cgne", "lsqr", "chebyshev", "richardson",
)  # fmt: skip
TOLERANCES = (1e-4, 1e-8, 1e-12)


@pytest.fixture(scope="module")
def mat():
    return from_entries(Kernel((24, 24), 8.0, 10.0), (24, 24), 1e-13)


def made(mat: PETSc.Mat, precision: str) -> PETSc.PC:
    """The preconditioner, which all methods share."""
    PETSc.Options()["pc_tt_rank"] = "100"
    pc = PETSc.PC().create(mat.comm)
    pc.setOperators(mat)
    pc.setType("python")
    pc.setPythonType("pctt.pc.TensorTrain")
    pc.setFromOptions()
    context = pc.getPythonContext()
    context.options = replace(context.options, precision=precision)
    pc.setUp()
    return pc


def true_residual(mat: PETSc.Mat, pc: PETSc.PC, method: str, rtol: float) -> tuple[float, bool]:
    """||b - A x|| / ||b||, and whether the method says that it converged."""
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setPC(pc)
    ksp.setOperators(mat)
    name, _, side = method.partition(" ")
    ksp.setType(name)
    if side:
        ksp.setPCSide(PETSc.PC.Side.RIGHT)
    ksp.setTolerances(rtol=rtol, max_it=200)
    x, b = mat.createVecs()
    b.array[:] = np.random.default_rng(0).standard_normal(mat.getSize()[0])[slice(*b.getOwnershipRange())]
    ksp.solve(b, x)
    return left_over(ksp, x, b), ksp.getConvergedReason() > 0


@pytest.mark.parallel(1, 2)
def test_no_method_ends_with_a_larger_residual_than_with_double_precision(mat, ranks):
    double, auto = made(mat, "double"), made(mat, "auto")
    assert auto.getPythonContext().rank > 1
    for method in METHODS if ranks == 1 else ("cg", "gmres", "fgmres", "minres"):
        for rtol in TOLERANCES:
            expected, converged = true_residual(mat, double, method, rtol)
            left, also = true_residual(mat, auto, method, rtol)
            assert also == converged, (method, rtol)
            assert left <= 3 * max(expected, rtol), (method, rtol, left, expected)


def test_single_precision_everywhere_would_be_wrong(mat):
    """So the test above can fail."""
    single = made(mat, "single")
    left, converged = true_residual(mat, single, "gmres", 1e-12)
    assert converged
    assert left > 1e-10


def test_the_view_says_which_precision_was_used(mat, capfd):
    pc = made(mat, "auto")
    for method, word in (("cg", "single"), ("gmres", "double"), ("fgmres", "single"), ("minres", "double")):
        true_residual(mat, pc, method, 1e-6)
        pc.view()
        assert f"{word} precision" in capfd.readouterr().out


def test_a_method_within_another_preconditioner_uses_double_precision(mat):
    """Else GMRES around it would see a preconditioner that is not linear."""
    assert "richardson" in REFINING
    assert "gmres" not in UNHARMED
    PETSc.Options().insertString("-pc_type ksp -ksp_ksp_type richardson -ksp_ksp_max_it 2 -ksp_ksp_norm_type none")
    PETSc.Options().insertString("-ksp_pc_type python -ksp_pc_python_type pctt.pc.TensorTrain -ksp_pc_tt_rank 100")
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOperators(mat)
    ksp.setType("gmres")
    ksp.setTolerances(rtol=1e-12, max_it=50)
    ksp.setFromOptions()
    x, b = mat.createVecs()
    b.set(1.0)
    ksp.solve(b, x)
    assert ksp.pc.getKSP().pc.getPythonContext().rank > 1
    assert left_over(ksp, x, b) < 3e-12
