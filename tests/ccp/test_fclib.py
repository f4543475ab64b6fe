"""FCLIB files that the tests write themselves, broken ones, and three published problems."""

from __future__ import annotations

import os
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.sparse as sp
from problems import SELF, Known, heap

from pctt import ccp
from pctt.ccp import Limits, fclib
from pctt.ccp.fclib import FileFormatError

FORMATS = ["triplets", "triplets with duplicates", "csc", "csr"]
FCLIB = Path(os.environ.get("PCTT_FCLIB", Path(__file__).resolve().parents[3] / "shared" / "fclib"))


def write_matrix(group: h5py.Group, A: np.ndarray, kind: str) -> None:
    """A in one of FORMATS; the arrays are longer than they need be, as nzmax may be larger than nz."""
    rows, columns = np.nonzero(A)
    values = A[rows, columns]
    order = np.random.default_rng(0).permutation(len(rows))
    if kind == "triplets with duplicates":  # a third of the entries in two parts
        twice = order[: len(order) // 3]
        rows, columns = np.concatenate([rows, rows[twice]]), np.concatenate([columns, columns[twice]])
        values = np.concatenate([values, np.full(len(twice), 7.0)])
        values[twice] -= 7.0
        order = np.random.default_rng(0).permutation(len(rows))
    if kind.startswith("triplets"):
        nz, i, p, x = len(rows), rows[order], columns[order], values[order]
        p = np.concatenate([p, [0, 0]])
    else:
        packed = sp.csc_matrix(A) if kind == "csc" else sp.csr_matrix(A)
        nz, i, p, x = (-1 if kind == "csc" else -2), packed.indices, packed.indptr, packed.data
    group["i"], group["p"], group["x"] = np.concatenate([i, [0, 0]]), p, np.concatenate([x, [5.0, 5.0]])
    for name, value in {"m": A.shape[0], "n": A.shape[1], "nz": nz, "nzmax": len(rows) + 2}.items():
        group[name] = np.array([value])


def write_local(path: Path, known: Known, kind: str = "triplets", W: np.ndarray | None = None) -> Path:
    with h5py.File(path, "w") as file:
        group = file.create_group("fclib_local")
        group["spacedim"] = np.array([3])
        write_matrix(group.create_group("W"), known.N if W is None else W, kind)
        group["vectors/q"], group["vectors/mu"] = known.r.ravel(), known.mu
    return path


def write_global(path: Path, kind: str = "csc", block_mass: bool = False) -> tuple[Path, Known, np.ndarray]:
    """M v = H r + f, u = H'v + w; the path, the problem's r and mu, and W."""
    rng = np.random.default_rng(3)
    known, graph = heap(2, 15, 6)
    H = graph.dense().T
    M = np.diag(rng.uniform(0.5, 2.0, len(H)))
    if block_mass:
        for k in range(0, len(H), 3):
            A = rng.normal(size=(3, 3))
            M[k : k + 3, k : k + 3] = A @ A.T + np.eye(3)
    f, w = rng.normal(size=len(H)), rng.normal(size=H.shape[1])
    with h5py.File(path, "w") as file:
        group = file.create_group("fclib_global")
        group["spacedim"] = np.array([3])
        write_matrix(group.create_group("M"), M, kind)
        write_matrix(group.create_group("H"), H, kind)
        group["vectors/f"], group["vectors/w"], group["vectors/mu"] = f, w, known.mu
    W = H.T @ np.linalg.solve(M, H)
    q = w + H.T @ np.linalg.solve(M, f)
    return path, Known(W, q.reshape(-1, 3), known.mu, known.g, known.y), W


def dense(problem: ccp.ConeProblem) -> np.ndarray:
    return problem.N.convert("dense").getDenseArray()


@pytest.mark.parametrize("kind", FORMATS)
def test_a_local_problem_is_read(tmp_path, kind):
    known, _ = heap(0, 12, 8)
    problem = fclib.read(write_local(tmp_path / "local.hdf5", known, kind), SELF)
    assert np.allclose(dense(problem), known.N, atol=1e-13 * np.abs(known.N).max())
    assert np.array_equal(problem.r, known.r)
    assert np.array_equal(problem.mu, known.mu)
    result = ccp.solve(problem, limits=Limits(1e-6))
    assert result.converged
    assert ccp.measure(problem, result.impulse).objective == pytest.approx(known.objective, rel=1e-5)


def test_a_matrix_that_is_not_quite_symmetric_is_made_so(tmp_path):
    known, _ = heap(0, 12, 8)
    W = known.N + np.random.default_rng(0).normal(size=known.N.shape) * 1e-3 * (known.N != 0)
    problem = fclib.read(write_local(tmp_path / "local.hdf5", known, W=W), SELF)
    assert np.allclose(dense(problem), 0.5 * (W + W.T), atol=1e-13)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("block_mass", [False, True], ids=["diagonal mass", "block mass"])
def test_a_global_problem_is_read(tmp_path, kind, block_mass):
    path, known, W = write_global(tmp_path / "global.hdf5", kind, block_mass)
    problem = fclib.read(path, SELF)
    assert np.allclose(dense(problem), W, atol=1e-12 * np.abs(W).max())
    assert np.allclose(problem.r, known.r, atol=1e-12 * np.abs(known.r).max())
    assert np.array_equal(problem.mu, known.mu)


def test_bilateral_constraints_are_refused(tmp_path):
    path, _, _ = write_global(tmp_path / "global.hdf5")
    with h5py.File(path, "a") as file:
        write_matrix(file["fclib_global"].create_group("G"), np.eye(3), "csc")
    with pytest.raises(FileFormatError, match=r"global\.hdf5.*bilateral"):
        fclib.read(path, SELF)


def set_(name: str, value):
    def change(file: h5py.File) -> None:
        if name in file:
            del file[name]
        if value is not None:
            file[name] = value

    return change


BROKEN = {
    "no q": set_("fclib_local/vectors/q", None),
    "no W": set_("fclib_local/W", None),
    "no rows of W": set_("fclib_local/W/m", None),
    "a number for W": set_("fclib_local/W", 3.0),
    "words for rows": set_("fclib_local/W/m", "twelve"),
    "an unknown format": set_("fclib_local/W/nz", np.array([-3])),
    "triplets read as CSC": set_("fclib_local/W/nz", np.array([-1])),
    "rows outside W": set_("fclib_local/W/m", np.array([5])),
    "W of another size": set_("fclib_local/W/m", np.array([39])),
    "too few velocities": set_("fclib_local/vectors/q", np.zeros(35)),
    "too few frictions": set_("fclib_local/vectors/mu", np.zeros(11)),
    "two dimensions": set_("fclib_local/spacedim", np.array([2])),
    "nothing for the dimension": set_("fclib_local/spacedim", np.zeros(0, int)),
    "a NaN in q": set_("fclib_local/vectors/q", np.full(36, np.nan)),
    "negative friction": set_("fclib_local/vectors/mu", np.full(12, -0.1)),
    "neither local nor global": set_("fclib_local", None),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_refused_by_name(tmp_path, name):
    path = write_local(tmp_path / "broken.hdf5", heap(0, 12, 8)[0])
    fclib.read(path, SELF)
    with h5py.File(path, "a") as file:
        BROKEN[name](file)
    with pytest.raises(FileFormatError, match=r"broken\.hdf5: no FCLIB problem: ."):
        fclib.read(path, SELF)


def test_values_that_are_no_numbers_are_refused(tmp_path):
    known, _ = heap(0, 12, 8)
    W = known.N.copy()
    W[0, 0] = np.nan
    with pytest.raises(FileFormatError, match="NaN"):
        fclib.read(write_local(tmp_path / "nan.hdf5", known, W=W), SELF)


def test_a_mass_matrix_without_inverse_is_refused(tmp_path):
    for block_mass in (False, True):
        path, _, _ = write_global(tmp_path / "global.hdf5", block_mass=block_mass)
        with h5py.File(path, "a") as file:
            file["fclib_global/M/x"][:] = 1.0 if block_mass else -1.0
        with pytest.raises(FileFormatError, match=r"global\.hdf5"):
            fclib.read(path, SELF)


def test_what_is_no_hdf5_file_is_refused(tmp_path):
    absent, text, cut = (tmp_path / name for name in ("absent.hdf5", "text.hdf5", "cut.hdf5"))
    text.write_text("fclib_local")
    cut.write_bytes(write_local(tmp_path / "whole.hdf5", heap(0, 12, 8)[0]).read_bytes()[:2000])
    for path in (absent, text, cut, tmp_path):
        with pytest.raises(FileFormatError, match=str(path.name)):
            fclib.read(path, SELF)


PROGRAM = """
import sys
from mpi4py import MPI
from pctt import ccp
from pctt.ccp import Limits, fclib

comm = MPI.COMM_WORLD
problem = fclib.read(sys.argv[1], comm)
assert sum(comm.allgather(len(problem.mu))) == problem.size
result = ccp.solve(problem, limits=Limits(1e-6))
figures = ccp.measure(problem, result.impulse)
refused = 0
try:
    fclib.read("absent.hdf5", comm)
except fclib.FileFormatError:
    refused = 1
assert comm.allreduce(refused) == comm.size
if comm.rank == 0:
    print(problem.size, repr(figures.objective))
"""


@pytest.mark.mpi
def test_every_rank_gets_its_part_and_the_same_error(mpirun, tmp_path):
    """Four ranks: with more contacts than ranks, and with fewer."""
    for contacts in (12, 3):
        known, _ = heap(0, contacts, 8)
        path = write_local(tmp_path / "local.hdf5", known)
        size, objective = mpirun(PROGRAM, 4, path).split()
        assert int(size) == contacts
        assert float(objective) == pytest.approx(known.objective, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "contacts", "objective", "velocity_norm"),
    [
        ("LMGC_100_PR_PerioBox-i00361-60-03000", 60, -1.168364218784e5, 3.1195242e-1),
        ("Box_Stacks-i0122-82-5", 82, -2.320918201378e-5, 2.31837e-3),
        ("Spheres-i099-356-679", 356, -2.084946581043e2, 1.0829370),
    ],
)
@pytest.mark.parametrize("solver", ccp.SOLVERS)
def test_published_problems(name, contacts, objective, velocity_norm, solver):
    """The optimum that two unrelated algorithms agree on; scales differ by 1e10 between the files."""
    path = FCLIB / f"{name}.hdf5"
    if not path.exists():
        pytest.skip(f"{path} is not here; PCTT_FCLIB names the folder of the FCLIB files")
    problem = fclib.read(path, SELF)
    result = ccp.solve(problem, type=solver, limits=Limits(1e-7))
    assert result.converged
    figures = ccp.measure(problem, result.impulse)
    assert problem.size == contacts
    assert figures.natural_residual <= 1.01e-7
    assert figures.objective == pytest.approx(objective, rel=1e-7)
    assert figures.velocity_norm == pytest.approx(velocity_norm, rel=1e-4)
