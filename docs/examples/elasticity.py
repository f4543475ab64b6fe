"""A cantilever in plane strain bends under its weight: two unknowns per node, several preconditioners::

    python docs/examples/elasticity.py 16 elasticity.png

The number is that of elements along the height; there are four times as many along the length.
"""

from __future__ import annotations

import sys

import numpy as np
import petsc4py

petsc4py.init([sys.argv[0]])
from petsc4py import PETSc
from poisson import PRECONDITIONERS, solve

POISSON_RATIO = 0.3


def element() -> np.ndarray:
    """The stiffness (8, 8) of a square bilinear element of Young's modulus 1, by 2 x 2 Gauss points."""
    nu = POISSON_RATIO
    elastic = np.array([[1 - nu, nu, 0], [nu, 1 - nu, 0], [0, 0, 0.5 - nu]]) / ((1 + nu) * (1 - 2 * nu))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    stiffness = np.zeros((8, 8))
    for point in corners / np.sqrt(3):
        slopes = corners * (1 + corners[:, ::-1] * point[::-1]) / 2  # (4, 2), of the shape functions, times the side
        strain = np.zeros((3, 8))
        strain[0, ::2], strain[1, 1::2] = slopes.T
        strain[2, ::2], strain[2, 1::2] = slopes[:, 1], slopes[:, 0]
        stiffness += strain.T @ elastic @ strain / 4
    return stiffness


def cantilever(high: int) -> tuple[PETSc.Mat, PETSc.Vec, np.ndarray]:
    """Stiffness of the free nodes, their loads, and their places (nodes, 2); the left end is clamped."""
    along, up = np.meshgrid(np.arange(1, 4 * high + 1), np.arange(high + 1), indexing="ij")
    places = np.stack([along, up], axis=-1).reshape(-1, 2)
    size = 2 * len(places)
    mat = PETSc.Mat().createAIJ((size, size), bsize=2, nnz=18, comm=PETSc.COMM_SELF)
    b, local = mat.createVecLeft(), element()
    for i in range(4 * high):
        for j in range(high):
            nodes = np.array([(i + dx - 1) * (high + 1) + j + dy for dx, dy in ((0, 0), (1, 0), (1, 1), (0, 1))])
            nodes[[i == 0, False, False, i == 0]] = -1  # PETSc ignores negative rows
            mat.setValuesBlocked(nodes.astype(np.int32), nodes.astype(np.int32), local, PETSc.InsertMode.ADD_VALUES)
            loads = 2 * nodes[nodes >= 0] + 1
            b.setValues(loads.astype(np.int32), np.full(len(loads), -0.25 / high**2), PETSc.InsertMode.ADD_VALUES)
    mat.assemble()
    b.assemble()
    mat.setOption(PETSc.Mat.Option.SPD, True)
    mat.setAttr("coordinates", places.astype(float))
    return mat, b, places / high


def main(high: int, picture: str = "") -> dict[str, int]:
    """Solve, print the iterations of each preconditioner and the deflection of the free end, and draw it. The height is
    1, and so are Young's modulus and the weight of a unit of volume; beams of theory have no shear."""
    mat, b, places = cantilever(high)
    iterations = {}
    for name, options in PRECONDITIONERS.items():
        x, iterations[name] = solve(mat, b, options)
        bend = x.array.reshape(-1, 2)
        print(f"{name:24} {iterations[name]:5} iterations, deflection of the end {-bend[-1, 1]:.4f}")
    print(f"{'':41} by beam theory {4**4 / 8 * 12 * (1 - POISSON_RATIO**2):.4f}")
    if picture:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(figsize=(6, 3))
        moved = (places + 0.5 * bend / np.abs(bend).max()).reshape(4 * high, high + 1, 2)
        size = np.linalg.norm(bend, axis=1).reshape(4 * high, high + 1)
        shown = axes.pcolormesh(moved[..., 0], moved[..., 1], size, shading="gouraud")
        axes.set_aspect("equal")
        figure.colorbar(shown, label="displacement", orientation="horizontal")
        figure.savefig(picture, dpi=100)
    return iterations


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
