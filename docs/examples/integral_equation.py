"""A Fredholm equation on a square whose matrix nobody stores: its entries are a function::

    python docs/examples/integral_equation.py 256 integral_equation.png

The number is that of points along a side. `fredholm.py` beside this file compares it with other ways to solve it.
"""

from __future__ import annotations

import sys

import numpy as np
import petsc4py

petsc4py.init([sys.argv[0]])
from petsc4py import PETSc

from pctt.mat import from_entries


def main(n: int, picture: str = "") -> tuple[int, float]:
    """Solve u(x) + 100 int exp(-|x - y|^2 / 2 w^2) u(y) dy = f(x), w = 0.1, f = 1 in the left half and 0 in the right
    one; iterations and residual."""
    grid = (n, n)

    def entries(i, j):  # integer arrays (p,) in, numbers (p,) out
        x, y = (np.array(np.unravel_index(k, grid)) / n for k in (i, j))
        return (i == j) + 100 / n**2 * np.exp(-((x - y) ** 2).sum(axis=0) / 0.02)

    A = from_entries(entries, grid, eps=1e-9, comm=PETSc.COMM_SELF)
    ksp = PETSc.KSP().create(A.comm)
    ksp.setOperators(A)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=1e-8)
    ksp.pc.setType("python")
    ksp.pc.setPythonType("pctt.pc.TensorTrain")
    ksp.setFromOptions()
    x, b = A.createVecs()
    b.array[:] = np.repeat(np.arange(n) < n // 2, n)
    ksp.solve(b, x)
    iterations, residual = ksp.getIterationNumber(), ksp.getResidualNorm() / b.norm()
    train = A.getPythonContext().compressed.train
    size = 8 * train.storage
    print(f"{n * n} unknowns: {iterations} iterations, residual {residual:.1e}; the matrix is {size} bytes")
    ksp.destroy()
    if picture:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(figsize=(5, 4))
        shown = axes.imshow(x.array.reshape(n, n).T, origin="lower", extent=(0, 1, 0, 1))
        figure.colorbar(shown, label="u")
        figure.savefig(picture, dpi=100)
    return iterations, residual


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
