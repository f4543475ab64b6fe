"""Trains of this project beside those of torchTT: compression of two kernels, inverses of Laplacians and kernels.
run/study compare_tt [-full]. torchTT (with torch for CPUs) goes into an environment of its own,
~/.cache/pctt/torchtt, or $PCTT_TORCHTT names a Python that has it. Writes results/compare_tt.json. Needs numpy,
scipy and torchTT, no PETSc."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
import torchtt

from pctt import tt

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs" / "examples"))
from integral_problems import fredholm, potential

torch.set_num_threads(1)


def seconds(work: Callable[[], Any]) -> tuple[float, Any]:
    start = time.process_time()
    out = work()
    return time.process_time() - start, out


def laplacian(n: int, dimensions: int) -> tt.Train:
    """Of a grid, exactly: binary digits, one axis after the other."""
    line = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(n, n))
    digits = tt.GridDigits((n,))
    one = tt.compress(_hierarchy(line.tocoo(), digits.modes), 4, 1e-13).train
    unit = tt.identity(digits.modes)
    total = None
    for axis in range(dimensions):
        cores = [core for k in range(dimensions) for core in (one if k == axis else unit).cores]
        total = tt.Train(cores) if total is None else total + tt.Train(cores)
    return total.round(1e-13)


def _hierarchy(line: Any, modes: tuple[int, ...]) -> tt.SparseHierarchy:
    out = tt.SparseHierarchy(line.row, line.col, modes)
    out.set_values(line.data)
    return out


def inverse_by_torch(S: tt.Train, eps: float) -> tt.Train:
    """X of (S x I) vec(X) = vec(I) by torchTT's AMEn, a right inverse."""
    cores = [np.einsum("rijs,kl->rikjls", core, np.eye(core.shape[1])) for core in S.cores]
    shape = [(c.shape[0], c.shape[1] * c.shape[2], c.shape[3] * c.shape[4], c.shape[5]) for c in cores]
    A = torchtt.TT([torch.tensor(c.reshape(s)) for c, s in zip(cores, shape)])
    b = torchtt.TT([torch.tensor(np.eye(m).reshape(1, m * m, 1)) for m in S.rows])
    x = torchtt.solvers.amen_solve(A, b, x0=b, eps=eps, nswp=20, kickrank=4, use_cpp=False)
    return tt.matrix_train([core.numpy() for core in x.cores], S.rows)


def rows_of(name: str, S: tt.Train, eps: float, near_identity: tt.Train | None = None) -> list[dict[str, Any]]:
    """Inverses to the same residual ||I - S X|| / ||I||, ours symmetric, theirs not."""
    scale = 1.0
    if near_identity is not None:
        scale = near_identity.norm() / S.shape[0] ** 0.5

    def ours() -> tt.Train:
        if near_identity is not None:
            return tt.invert_near_identity(near_identity, 200, eps=eps / scale, sweeps=20).train
        return tt.invert(S, 200, eps=eps, sweeps=20).train

    out = []
    for who, work in (("pctt", ours), ("torchTT", lambda: inverse_by_torch(S, eps))):
        took, X = seconds(work)
        out.append({"inverse of": name, "eps": eps, "who": who, "seconds": took, "rank": max(X.ranks),
                    "numbers": X.storage, "residual": tt.residual(S, X)})  # fmt: skip
        print(f"inverse of {name:12} {eps:7.0e} {who:8} {took:8.2f} s  rank {max(X.ranks):4} "
              f"{X.storage:8} numbers  residual {out[-1]['residual']:.1e}", flush=True)  # fmt: skip
    return out


def crosses(name: str, problem: Any, eps: float) -> list[dict[str, Any]]:
    """Compression of the kernel without the identity; errors on fresh samples."""
    digits = tt.GridDigits(problem.grid)
    matrix = tt.EntryMatrix(problem.entries, digits)
    took, found = seconds(lambda: tt.compress_cross(matrix, 200, eps))
    keys, weights = matrix.validation(20000, np.random.default_rng(5))
    values = matrix.lookup(keys)
    squares = np.array([m * m for m in matrix.modes])

    def error(train: tt.Train) -> float:
        at = train.at(np.stack(np.unravel_index(keys, squares)))
        return float(np.sqrt(weights @ (values - at) ** 2 / (weights @ values**2)))

    def theirs() -> tt.Train:
        def function(index: torch.Tensor) -> torch.Tensor:
            key = np.ravel_multi_index(index.numpy().T.astype(np.int64), squares)
            return torch.tensor(matrix.lookup(key))

        T = torchtt.interpolate.dmrg_cross(function, squares.tolist(), eps=eps, nswp=20)
        return tt.matrix_train([core.numpy() for core in T.cores], matrix.modes)

    out = []
    other_took, other = seconds(theirs)
    for who, s, train in (("pctt", took, found.train), ("torchTT", other_took, other)):
        out.append({"cross of": name, "eps": eps, "who": who, "seconds": s, "rank": max(train.ranks),
                    "numbers": train.storage, "error": error(train)})  # fmt: skip
        print(f"cross of   {name:12} {eps:7.0e} {who:8} {s:8.2f} s  rank {max(train.ranks):4} "
              f"{train.storage:8} numbers  error    {out[-1]['error']:.1e}", flush=True)  # fmt: skip
    return out


def main(given: argparse.Namespace) -> None:
    print(f"torchTT {version('torchTT')}, torch {torch.__version__}, one thread, CPU seconds")
    rows: list[dict[str, Any]] = []
    every = (1e-2, 1e-4, 1e-6) if given.full else (1e-2, 1e-4)
    for name, problem in (("Gauss 512^2", fredholm(512)), ("1/r 64^3", potential(64))):
        for eps in every:
            rows += crosses(name, problem, eps)
    laplacians = [("64^2", 64, 2), ("256^2", 256, 2), ("64^3", 64, 3)] + [("128^3", 128, 3)] * given.full
    for name, n, dimensions in laplacians:
        S = laplacian(n, dimensions)
        for eps in every if given.full or n**dimensions < 10_000 else (1e-2,):
            rows += rows_of(name, S, eps)
    for name, problem in (("Gauss 512^2", fredholm(512)), ("1/r 64^3", potential(64))):
        T = tt.compress_cross(tt.EntryMatrix(problem.entries, tt.GridDigits(problem.grid)), 100, 1e-3).train
        rows += rows_of(name, tt.identity(T.rows) + T, 1e-4, T)
    Path("results").mkdir(exist_ok=True)
    Path("results/compare_tt.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    words = argparse.ArgumentParser("run/study compare_tt", description=__doc__)
    words.add_argument("-full", action="store_true", help="also 128^3 and 1e-6 throughout")
    main(words.parse_args())
