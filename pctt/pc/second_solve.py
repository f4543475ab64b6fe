"""A solve that an indefinite preconditioner has spoilt, made again with block Jacobi."""

from __future__ import annotations

from collections.abc import Callable

from petsc4py import PETSc

_Reason = PETSc.KSP.ConvergedReason
#: Ends of a Krylov method that a preconditioner which is not positive definite brings about.
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
    """Within ``postSolve`` of a preconditioner: where its KSP has broken down, solve by the same method with block
    Jacobi of P from zero, and give the KSP the outcome. Whether that was done."""
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
