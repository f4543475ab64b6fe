"""Sparse matrices that have nothing to do with contacts, by conjugate gradients to 1e-8 with several preconditioners:

    run/study sparse [-names A,B]

Iterations, and CPU seconds of set-up and solve; the losers too. Writes results/sparse.json, and without words (half a
minute) its table of docs/preconditioners.md.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import scipy.sparse as sp
from shared import ROOT, Row, Table, markdown, parser, record, replace_table, say_machine

NAMES = "none,pbjacobi,icc,gamg,bic,bic:0.02"
RNG = np.random.default_rng(0)


def laplacian(*sizes: int, weights: tuple[float, ...] = (1.0, 1.0, 1.0)) -> sp.csr_matrix:
    """The second differences on a grid, Dirichlet, with a weight for each axis."""
    total = sp.csr_matrix((1, 1))
    for n, weight in zip(sizes, weights):
        along = weight * sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(n, n))
        total = sp.kron(total, sp.identity(n)) + sp.kron(sp.identity(total.shape[0]), along)
    return sp.csr_matrix(total)


def jumps(n: int) -> sp.csr_matrix:
    """Diffusion through a square whose cells conduct better or worse by up to six orders of magnitude."""
    k, cell = 10.0 ** RNG.uniform(-3, 3, n * n), np.arange(n * n).reshape(n, n)
    i, j = (np.concatenate([a.ravel(), b.ravel()]) for a, b in ((cell[1:], cell[:, 1:]), (cell[:-1], cell[:, :-1])))
    flow = sp.coo_matrix((2 / (1 / k[i] + 1 / k[j]), (i, j)), shape=(n * n, n * n))
    flow = flow + flow.T
    return sp.csr_matrix(sp.diags(np.asarray(flow.sum(axis=1)).ravel() + k * (np.arange(n * n) < n)) - flow)


def several(n: int, unknowns: int) -> sp.csr_matrix:
    """So many unknowns in each point of a cube, which couple to each other."""
    root = RNG.standard_normal((unknowns, unknowns))
    A = sp.kron(laplacian(n, n, n), root @ root.T + 0.1 * np.eye(unknowns))
    return sp.csr_matrix(A + 1e-3 * sp.identity(A.shape[0]))


HEADS = {"pbjacobi": "block Jacobi", "icc": "`icc`", "gamg": "`gamg`", "bic": "`BlockICC`"}
HEADS["bic:0.02"] = "with tau = 0.02"
CASES = {  # matrix, unknowns in a point, shape of the grid
    "Poisson, 256^2": lambda: (laplacian(256, 256), 1, (256, 256)),
    "Poisson, 40^3": lambda: (laplacian(40, 40, 40), 1, (40, 40, 40)),
    "-u_xx - 0.001 u_yy, 128^2": lambda: (laplacian(128, 128, weights=(1.0, 1e-3, 0.0)), 1, (128, 128)),
    "diffusion, jumps of 1e6, 128^2": lambda: (jumps(128), 1, (128, 128)),
    "3 unknowns a point, 20^3": lambda: (several(20, 3), 3, (20, 20, 20)),
    "6 unknowns a point, 14^3": lambda: (several(14, 6), 6, (14, 14, 14)),
}


def solved(A: sp.csr_matrix, unknowns: int, shape: tuple[int, ...], name: str) -> Row:
    """The figures of a preconditioner: a PC type, or bic with the drop tolerance behind a colon."""
    from petsc4py import PETSc

    mat = PETSc.Mat().createAIJ(A.shape, csr=(A.indptr, A.indices, A.data))
    mat.setBlockSize(unknowns)
    mat.setOption(PETSc.Mat.Option.SPD, True)
    mat.setAttr("coordinates", np.indices(shape).reshape(len(shape), -1).T.astype(float))
    ksp, (kind, _, tau) = PETSc.KSP().create(), name.partition(":")
    ksp.setOperators(mat)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=1e-8, max_it=5000)
    ksp.pc.setType("python" if kind == "bic" else kind)
    if kind == "bic":
        ksp.pc.setPythonType("pctt.pc.BlockICC")
        PETSc.Options()["pc_bic_tau"] = tau or "0.05"
        ksp.setFromOptions()
    x, b = mat.createVecs()
    b.array[:] = np.random.default_rng(1).standard_normal(len(b.array))
    times = [time.process_time()]
    ksp.setUp()
    times.append(time.process_time())
    ksp.solve(b, x)
    times.append(time.process_time())
    what = ksp.pc.getPythonContext().what() if kind == "bic" else ""
    return {
        "method": name, "its": ksp.getIterationNumber(), "converged": ksp.getConvergedReason() > 0,
        "residual": (b - mat * x).norm() / b.norm(), "setup_s": times[1] - times[0], "solve_s": times[2] - times[1],
        "what": what,
    }  # fmt: skip


def write_page(rows: list[Row]) -> None:
    """The table of docs/preconditioners.md, the least number of iterations of a matrix bold."""
    lines = []
    for case in CASES:
        its = {row["method"]: row["its"] for row in rows if row["case"] == case}
        least = min(its.values())
        lines.append([case, *(f"**{its[name]:,}**" if its[name] == least else f"{its[name]:,}" for name in HEADS)])
    page, head = ROOT / "docs" / "preconditioners.md", "**Other matrices.**"
    replace_table(page, head, markdown(["matrix", *HEADS.values()], lines))


if __name__ == "__main__":
    words = parser("sparse", __doc__)
    words.add_argument("-names", default=NAMES, help="with commas between")
    given, about, rows = words.parse_args(), say_machine(), list[Row]()
    table = Table(
        case=("case", "<30"), method=("method", "9"), its=("its", "5d"), residual=("residual", "9.1e"),
        setup_s=("setup_s", "8.2f"), solve_s=("solve_s", "8.2f"), what=("what", "<24"),
    )  # fmt: skip
    for case, make in CASES.items():
        matrix = make()
        for name in given.names.split(","):
            solved(*matrix, name)  # the first time compiles
            rows.append({"case": case, **solved(*matrix, name)})
            table.add(rows[-1])
    record("sparse", about, rows)
    if len(sys.argv) == 1:
        write_page(rows)
