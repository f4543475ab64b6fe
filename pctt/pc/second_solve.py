"""A second solve with block Jacobi, after an indefinite preconditioner has spoilt the first."""

from __future__ import annotations

from collections.abc import Callable

from petsc4py import PETSc

_Reason = PETSc.KSP.ConvergedReason
#: Reasons for the end of a Krylov method whose preconditioner is not positive definite.
SPOILT = frozenset(
    {
        _Reason.DIVERGED_BREAKDOWN,
        _Reason.DIVERGED_BREAKDOWN_BICG,
        _Reason.DIVERGED_INDEFINITE_MAT,
        _Reason.DIVERGED_INDEFINITE_PC,
        _Reason.DIVERGED_NANORINF,
        _Reason.DIVERGED_DTOL,
    }
)


def solve_again(
    ksp: PETSc.KSP, block_diagonal: Callable[[PETSc.Mat], PETSc.Mat], P: PETSc.Mat, b: PETSc.Vec, x: PETSc.Vec
) -> bool:
    """Solve again if the KSP has broken down; returns whether this was done. Call it in ``postSolve`` of the
    preconditioner.

    The second solve uses the same method with block Jacobi of P and starts from zero. The KSP gets its outcome.
    """
    if ksp.getConvergedReason() not in SPOILT:
        return False
    again = PETSc.KSP().create(ksp.comm)
    again.setType(ksp.getType())
    again.setPCSide(ksp.getPCSide())
    again.setNormType(ksp.getNormType())
    rtol, atol, divtol, max_it = ksp.getTolerances()
    again.setTolerances(rtol, atol, divtol, max_it)
    again.pc.setType(PETSc.PC.Type.PBJACOBI)
    diagonal = block_diagonal(P)
    again.setOperators(ksp.getOperators()[0], diagonal)
    again.solve(b, x)
    ksp.setIterationNumber(ksp.getIterationNumber() + again.getIterationNumber())
    ksp.setConvergedReason(again.getConvergedReason())
    again.destroy()
    diagonal.destroy()
    return True
