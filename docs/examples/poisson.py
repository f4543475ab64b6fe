"""Poisson's equation on a square, by conjugate gradients with several preconditioners::

    python docs/examples/poisson.py 64 poisson.png

The first number is that of grid points along a side; the picture needs matplotlib.
"""

from __future__ import annotations

import sys

import numpy as np
import petsc4py

petsc4py.init([sys.argv[0]])
from petsc4py import PETSc

PRECONDITIONERS = {
    "none": {"pc_type": "none"},
    "incomplete Cholesky": {"pc_type": "icc"},
    "algebraic multigrid": {"pc_type": "gamg"},
    "tensor train, rank 24": {
        "pc_type": "python", "pc_python_type": "pctt.pc.TensorTrain", "pc_tt_rank": "24",
    },
}  # fmt: skip


def laplacian(n: int) -> PETSc.Mat:
    """The five-point stencil on n x n points inside the unit square, with the coordinates that order a train."""
    mat = PETSc.Mat().createAIJ((n * n, n * n), nnz=5, comm=PETSc.COMM_SELF)
    for row in range(n * n):
        i, j = divmod(row, n)
        near = [(i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)]
        columns = [a * n + b for a, b in near if 0 <= a < n and 0 <= b < n]
        mat.setValues(row, [row, *columns], [4.0] + [-1.0] * len(columns))
    mat.assemble()
    mat.setOption(PETSc.Mat.Option.SPD, True)
    mat.setAttr("coordinates", np.stack(np.divmod(np.arange(n * n), n), axis=1))
    return mat


def solve(mat: PETSc.Mat, b: PETSc.Vec, options: dict[str, str], rtol: float = 1e-8) -> tuple[PETSc.Vec, int]:
    """The solution by conjugate gradients with a preconditioner of these options, and the iterations."""
    database = PETSc.Options()
    for name, value in options.items():
        database.setValue(name, value)
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOperators(mat)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=rtol, max_it=10_000)
    ksp.setFromOptions()
    for name in options:
        database.delValue(name)
    x = mat.createVecRight()
    ksp.solve(b, x)
    if ksp.getConvergedReason() < 0:
        raise RuntimeError(f"no convergence with {options['pc_type']}: reason {ksp.getConvergedReason()}")
    iterations = ksp.getIterationNumber()
    ksp.destroy()
    return x, iterations


def main(n: int, picture: str = "") -> dict[str, int]:
    """Solve -Laplace u = 1 with u = 0 on the boundary; the iterations of each preconditioner."""
    mat = laplacian(n)
    b = mat.createVecLeft()
    b.set(1.0 / (n + 1) ** 2)
    iterations = {}
    for name, options in PRECONDITIONERS.items():
        x, iterations[name] = solve(mat, b, options)
        print(f"{name:24} {iterations[name]:5} iterations, greatest u {x.max()[1]:.6f}")
    if picture:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(figsize=(5, 4))
        shown = axes.imshow(x.array.reshape(n, n), origin="lower", extent=(0, 1, 0, 1))
        figure.colorbar(shown, label="u")
        figure.savefig(picture, dpi=100)
    return iterations


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
