"""Cone problems in files: FCLIB, read and written, broken files, three published problems."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from problems import SELF, Known, dense_of, from_graph, from_matrix, heap, part

from pctt import ccp, disk
from pctt.ccp import ConeProblem, Limits, delassus, fclib
from pctt.ccp.fclib import FileFormatError, Info, Solution
from pctt.options import OptionError

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
    return dense_of(problem.N)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_local_problem_is_read(tmp_path, kind):
    known, _ = heap(0, 12, 8)
    problem = fclib.read(write_local(tmp_path / "local.hdf5", known, kind), SELF)
    assert np.allclose(dense(problem), known.N, atol=1e-13 * np.abs(known.N).max())
    assert np.array_equal(problem.r, known.r)
    assert np.array_equal(problem.mu, known.mu)
    result = ccp.solve(problem, limits=Limits(1e-6), type="pdip", law=ccp.RELAXATION)
    assert result.converged
    assert ccp.measure(problem, result.impulse).objective == pytest.approx(known.objective, rel=1e-5)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("block_mass", [False, True], ids=["diagonal mass", "block mass"])
def test_a_global_problem_is_read(tmp_path, kind, block_mass):
    path, known, W = write_global(tmp_path / "global.hdf5", kind, block_mass)
    problem = fclib.read(path, SELF)
    assert problem.contact_map is not None  # masses in 6 x 6 blocks: given by the bodies' map
    assert np.allclose(dense(problem), W, atol=1e-12 * np.abs(W).max())
    assert np.allclose(problem.r, known.r, atol=1e-12 * np.abs(known.r).max())
    assert np.array_equal(problem.mu, known.mu)


def replace_mass(path: Path, change) -> np.ndarray:
    """Write another M into a global problem, in triplets; what it was."""
    with h5py.File(path, "a") as file:
        M = _dense_triplets(file["fclib_global/M"])
        del file["fclib_global/M"]
        write_matrix(file["fclib_global"].create_group("M"), change(M), "triplets")
    return M


@pytest.mark.parametrize("form", ["local", "global"])
def test_a_problem_in_the_plane_is_solved_in_space(tmp_path, form):
    """Contacts that slide, stick and open, of a solution that is known: g and y are in the cones and across."""
    rng = np.random.default_rng(1)
    mu, size = rng.uniform(0.2, 0.8, 9), rng.uniform(0.5, 2.0, 9)
    kinds = np.arange(9) % 3
    g = size[:, None] * np.stack([kinds != 2, np.where(kinds == 0, mu, 0.3 * mu * (kinds == 1))], axis=1)
    y = size[:, None] * np.stack([np.where(kinds == 0, mu, 0.7 * (kinds == 2)), -1.0 * (kinds == 0)], axis=1)
    H, M, f = rng.normal(size=(20, 18)), np.diag(rng.uniform(0.5, 2.0, 20)), rng.normal(size=20)
    W = H.T @ np.linalg.solve(M, H)
    q = y.ravel() - W @ g.ravel()
    with h5py.File(tmp_path / "plane.h5", "w") as file:
        group = file.create_group(f"fclib_{form}")
        group["spacedim"], group["vectors/mu"], file["solution/r"] = np.array([2]), mu, g.ravel()
        if form == "local":
            write_matrix(group.create_group("W"), W, "csr")
            group["vectors/q"] = q
        else:
            write_matrix(group.create_group("M"), M, "csc")
            write_matrix(group.create_group("H"), H, "triplets")
            group["vectors/f"], group["vectors/w"] = f, q - H.T @ np.linalg.solve(M, f)
    stored = fclib.load(tmp_path / "plane.h5", SELF)
    np.testing.assert_array_equal(stored.solution, np.hstack([g, np.zeros((9, 1))]))
    assert ccp.measure(stored.problem, stored.solution).natural_residual < 1e-14
    for solver in ("pdip", "conic", "apgd"):
        result = ccp.solve(stored.problem, type=solver, limits=Limits(1e-8), law=ccp.RELAXATION)
        assert result.converged, solver
        np.testing.assert_allclose(result.impulse[:, :2], g, atol=1e-5)


def rolling_spheres(path: Path) -> tuple[Path, np.ndarray]:
    """Spheres that roll on a plane, in a file of Siconos' layout: a row each for normal, two tangents and two rolls.
    The path, and the impulses (n, 5) of Coulomb's law: those of a rolling sphere that a moment slows, as in
    tests/physics/test_rolling_resistance.py."""
    count, R, mass, g, dt, mu, lever = 6, 0.1, 3.0, 9.81, 0.01, 0.5, 0.004
    inertia, speed = 0.4 * mass * R**2, 1.0 + np.arange(count)
    M, H = np.diag(np.tile([mass] * 3 + [inertia] * 3, count)), np.zeros((6 * count, 5 * count))
    velocity = np.zeros((count, 6))
    velocity[:, 0], velocity[:, 4], velocity[:, 2] = speed, speed / R, -g * dt
    for n in range(count):
        arm = np.array([0.0, 0.0, -R])
        frame = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
        H[6 * n : 6 * n + 3, 5 * n : 5 * n + 3] = frame.T
        H[6 * n + 3 : 6 * n + 6, 5 * n : 5 * n + 3] = np.cross(arm, frame).T
        H[6 * n + 3 : 6 * n + 6, 5 * n + 3 : 5 * n + 5] = frame[1:].T
    with h5py.File(path, "w") as file:
        group = file.create_group("fclib_global_rolling")
        group["spacedim"] = np.array([5])
        write_matrix(group.create_group("M"), M, "triplets")
        write_matrix(group.create_group("H"), H, "triplets")
        group["vectors/f"], group["vectors/w"] = M @ velocity.ravel(), np.zeros(5 * count)
        group["vectors/mu"], group["vectors/mu_r"] = np.full(count, mu), np.full(count, lever)
    slower = 5 / 7 * g * lever / R
    alone = [mass * g * dt, -mass * slower * dt, 0.0, 0.0, -lever * mass * g * dt]
    return path, np.tile(alone, (count, 1))


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("solver", ["apgd", "conic"])
def test_a_problem_with_rolling_is_read_and_solved(tmp_path, solver):
    """The frames of all ranks' contacts, in the rows of `pctt.ccp.RollingCones`: forces, then spin and rolls."""
    comm = MPI.COMM_WORLD
    path = tmp_path / "rolling.hdf5"
    if comm.rank == 0:
        rolling_spheres(path)
    comm.Barrier()
    expected = rolling_spheres(tmp_path / f"again {comm.rank}.hdf5")[1][part(comm, 6)]
    stored = fclib.load(path, comm)
    assert stored.form == "FCLIB global rolling"
    limits = Limits(1e-9, closing_work=np.inf, fallback=False)
    found = ccp.solve(stored.problem, None, solver, limits, law=ccp.COULOMB)
    assert found.converged, found.reason
    impulse = np.concatenate(np.split(found.impulse, 2), axis=1)
    np.testing.assert_allclose(impulse[:, [0, 1, 2, 4, 5]], expected, atol=1e-7)
    assert not impulse[:, 3].any()


def test_the_numbers_of_a_contact_with_rolling(tmp_path):
    path, _ = rolling_spheres(tmp_path / "rolling.hdf5")
    with h5py.File(path, "a") as file:
        H = _dense_triplets(file["fclib_global_rolling/H"])
        file["solution/r"] = np.arange(30.0)
    stored = fclib.load(path, SELF)
    numbers = np.arange(30.0).reshape(6, 5)
    np.testing.assert_array_equal(stored.solution[:6], numbers[:, :3])
    np.testing.assert_array_equal(stored.solution[6:], np.column_stack([np.zeros(6), numbers[:, 3:]]))
    blocks = (H.T @ np.diag(np.tile([1 / 3.0] * 3 + [1 / 0.012] * 3, 6)) @ H).reshape(6, 5, 6, 5)[range(6), :, range(6)]
    np.testing.assert_allclose(stored.problem.diagonal_blocks[:6], blocks[:, :3, :3])
    np.testing.assert_allclose(stored.problem.diagonal_blocks[6:, 1:, 1:], blocks[:, 3:, 3:])
    with h5py.File(path, "a") as file:
        file["fclib_global_rolling/spacedim"][:] = 3
    with pytest.raises(FileFormatError, match="dimension is 3; allowed is 5"):
        fclib.load(path, SELF)


@pytest.mark.parametrize("triangle", [np.triu, np.tril])
@pytest.mark.parametrize("coupled", [False, True], ids=["bodies", "coupled masses"])
def test_one_triangle_of_the_mass_matrix_is_mirrored(tmp_path, triangle, coupled):
    path, known, W = write_global(tmp_path / "global.hdf5", block_mass=True)
    if coupled:
        with h5py.File(path, "a") as file:
            group = file["fclib_global"]
            H, f, w = _dense_triplets(group["H"]), group["vectors/f"][:], group["vectors/w"][:]
        M = 3.0 * np.eye(len(H)) + np.eye(len(H), k=1) + np.eye(len(H), k=-1)
        replace_mass(path, lambda _: triangle(M))
        W, r = H.T @ np.linalg.solve(M, H), w + H.T @ np.linalg.solve(M, f)
    else:
        replace_mass(path, triangle)
        r = known.r.ravel()
    stored = fclib.load(path, SELF)
    assert (stored.problem.contact_map is None) == coupled
    assert np.allclose(dense(stored.problem), W, atol=1e-12 * np.abs(W).max())
    assert np.allclose(stored.problem.r.ravel(), r, atol=1e-12 * np.abs(r).max())
    assert "one triangle" in stored.note


def test_a_mass_matrix_that_is_not_symmetric_is_refused_but_for_rounding(tmp_path):
    path, _, W = write_global(tmp_path / "global.hdf5", block_mass=True)
    assert fclib.load(path, SELF).note == ""

    def off(M: np.ndarray, part: float) -> np.ndarray:
        M = M.copy()
        M[0, 1] += part * np.sqrt(M[0, 0] * M[1, 1])
        return M

    M = replace_mass(path, lambda M: off(M, 1e-13))
    stored = fclib.load(path, SELF)
    assert stored.note == ""
    assert np.allclose(dense(stored.problem), W, atol=1e-10 * np.abs(W).max())
    for other in (off(M, 1e-5), np.where(np.tri(len(M), k=-1) * M != 0, 0.5 * M, M)):
        replace_mass(path, lambda _, other=other: other)
        with pytest.raises(FileFormatError, match=r"global\.hdf5.*mass matrix is not symmetric: M\[\d+, \d+\] = "):
            fclib.read(path, SELF)


def test_the_problem_of_lmgc_whose_mass_matrix_is_one_triangle():
    """Half the sum of M and its mirror would give -0.47490006."""
    path = FCLIB.parent / "problems" / "LMGC_GlobalFrictionContactProblem00046.hdf5"
    if not path.exists():
        pytest.skip(f"{path} is not here; PCTT_FCLIB names the folder beside it")
    stored = fclib.load(path, SELF)
    assert "one triangle" in stored.note
    result = ccp.solve(stored.problem, limits=Limits(1e-8), type="pdip", law=ccp.RELAXATION)
    assert result.converged
    assert ccp.measure(stored.problem, result.impulse).objective == pytest.approx(-0.44168753, abs=1e-8)


def _dense_triplets(group: h5py.Group) -> np.ndarray:
    """A matrix in CSC or in triplets, by the definition of the formats."""
    m, n, nz = (int(group[name][0]) for name in ("m", "n", "nz"))
    i, p, x = (group[name][:] for name in ("i", "p", "x"))
    A = np.zeros((m, n))
    if nz == -1:
        for column in range(n):
            near = slice(p[column], p[column + 1])
            np.add.at(A, (i[near], column), x[near])
    else:
        assert nz >= 0
        np.add.at(A, (i[:nz], p[:nz]), x[:nz])
    return A


def test_parts_of_global_problems_that_do_not_fit_are_refused(tmp_path):
    path, _, _ = write_global(tmp_path / "global.hdf5")
    with h5py.File(path, "a") as file:
        del file["fclib_global/vectors/w"]
        file["fclib_global/vectors/w"] = np.zeros(3)
    with pytest.raises(FileFormatError, match="do not fit together"):
        fclib.read(path, SELF)


@pytest.mark.parametrize("name", ["global G", "local V", "local R"])
def test_bilateral_constraints_are_refused(tmp_path, name):
    form, matrix = name.split()
    path = tmp_path / f"{form}.hdf5"
    if form == "global":
        write_global(path)
    else:
        write_local(path, heap(0, 12, 8)[0])
    with h5py.File(path, "a") as file:
        write_matrix(file[f"fclib_{form}"].create_group(matrix), np.eye(3), "csc")
    with pytest.raises(FileFormatError, match=rf"{form}\.hdf5.*bilateral"):
        fclib.read(path, SELF)


def test_a_problem_with_two_friction_coefficients_is_not_written(tmp_path):
    known = heap(0, 12, 8)[0]
    elliptic = ConeProblem(SELF, known.r, np.stack([known.mu, 0.5 * known.mu], axis=1), N=known.N)
    with pytest.raises(ValueError, match="two friction coefficients a contact; allowed in FCLIB is one"):
        fclib.write_local(tmp_path / "local.hdf5", elliptic)
    assert not (tmp_path / "local.hdf5").exists()


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
    "a number for W": set_("fclib_local/W", 3.0),
    "an unknown format": set_("fclib_local/W/nz", np.array([-3])),
    "rows outside W": set_("fclib_local/W/m", np.array([5])),
    "W of another size": set_("fclib_local/W/m", np.array([39])),
    "too few velocities": set_("fclib_local/vectors/q", np.zeros(35)),
    "two dimensions": set_("fclib_local/spacedim", np.array([2])),
    "a NaN in q": set_("fclib_local/vectors/q", np.full(36, np.nan)),
    "negative friction": set_("fclib_local/vectors/mu", np.full(12, -0.1)),
    "neither local nor global": set_("fclib_local", None),
    "a solution of another size": set_("solution/r", np.ones(35)),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_refused_by_name(tmp_path, name):
    path = write_local(tmp_path / "broken.hdf5", heap(0, 12, 8)[0])
    fclib.read(path, SELF)
    with h5py.File(path, "a") as file:
        BROKEN[name](file)
    with pytest.raises(FileFormatError, match=r"broken\.hdf5: no FCLIB problem: ."):
        fclib.read(path, SELF)


def outside(file: h5py.File, secret: Path, kind: str) -> None:
    """Let the friction coefficients of a local problem come from another file, or by a link."""
    vectors = file["fclib_local/vectors"]
    del vectors["mu"]
    if kind == "external link":
        vectors["mu"] = h5py.ExternalLink(secret, "mu")
    elif kind == "link by a group":
        file["aside"] = h5py.ExternalLink(secret, "/")
        vectors["mu"] = h5py.SoftLink("/aside/mu")
    elif kind == "external storage":
        vectors.create_dataset("mu", (12,), np.float64, external=[(str(secret), 0, 96)])
    else:
        layout = h5py.VirtualLayout((12,), np.float64)
        layout[:] = h5py.VirtualSource(secret, "mu", (12,))
        vectors.create_virtual_dataset("mu", layout)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("kind", ["external link", "link by a group", "external storage", "virtual data set"])
def test_a_problem_that_takes_data_from_another_file_is_refused(tmp_path, kind):
    path, secret = tmp_path / "strange.hdf5", tmp_path / "secret.h5"
    if MPI.COMM_WORLD.rank == 0:
        write_local(path, heap(0, 12, 8)[0])
        with h5py.File(secret, "w") as file:
            file["mu"] = np.full(12, 0.3)
        with h5py.File(path, "a") as file:
            outside(file, secret, kind)
    MPI.COMM_WORLD.Barrier()
    with pytest.raises(FileFormatError, match=r"strange\.hdf5: .*(is a link|in other files); allowed are data of"):
        fclib.read(path, MPI.COMM_WORLD)


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
        words = "text.hdf5: no FCLIB problem: it is not HDF5; run/study convert_problems" if path == text else path.name
        with pytest.raises(FileFormatError, match=words):
            fclib.read(path, SELF)


# -- writing -----------------------------------------------------------------------------------------------


def random_solution(known: Known, n: int | None = None) -> Solution:
    rng = np.random.default_rng(5)
    u = (known.N @ known.g.ravel()).reshape(-1, 3) + known.r
    return Solution(known.g, u, None if n is None else rng.normal(size=n))


@pytest.mark.parallel(1, 2, 4)
@pytest.mark.parametrize("given", ["G", "N"])
def test_a_local_problem_is_written_and_read_again(tmp_path, given):
    comm, path = MPI.COMM_WORLD, tmp_path / "local.h5"
    known, graph = heap(0, 12, 8)
    mine = part(comm, 12)
    problem = from_matrix(known, comm) if given == "N" else from_graph(known, graph, comm)
    problem.point = np.random.default_rng(0).random((12, 3))[mine]
    solution, guess = Solution(known.g[mine], known.y[mine]), Solution(2 * known.g[mine], known.r[mine])
    fclib.write_local(path, problem, Info("a heap", "of \u00b5 0.1 to 1", "random"), solution, guess)
    assert [file.name for file in tmp_path.iterdir()] == ["local.h5"]
    stored = fclib.load(path, comm)
    for name, whole in (("r", known.r), ("mu", known.mu)):
        assert np.array_equal(getattr(stored.problem, name), whole[mine])
    assert np.array_equal(stored.problem.point, problem.point)
    assert np.array_equal(stored.solution, known.g[mine])
    assert np.array_equal(stored.guess, 2 * known.g[mine])
    assert (stored.form, stored.title) == ("FCLIB local", "a heap")
    product = (known.N @ known.g.ravel()).reshape(-1, 3)[mine]
    assert np.allclose(stored.problem.product(known.g[mine]), product, atol=1e-11)
    alone = fclib.read(path, SELF)
    assert np.allclose(dense(alone), known.N, atol=1e-13 * np.abs(known.N).max())
    with pytest.raises(OSError, match=r"nowhere/local\.h5: cannot write"):
        fclib.write_local(tmp_path / "nowhere" / "local.h5", problem)
    with pytest.raises(ValueError, match="info 'a title': allowed is a Info .*; solution .*: allowed is a Solution"):
        fclib.write_local(tmp_path / "other.h5", problem, "a title", known.g[mine])
    with pytest.raises(FileFormatError, match="absent"):
        fclib.read(tmp_path / "absent.h5", comm)


def test_the_layout_is_that_of_fclib(tmp_path):
    """What FCLIB's reader in C takes for granted: types, sizes, a zero at the end of strings, v of a global problem."""
    known, _ = heap(0, 12, 8)
    fclib.write_local(tmp_path / "l.h5", from_matrix(known), Info("a title"), random_solution(known))
    with h5py.File(tmp_path / "l.h5") as file:
        W = file["fclib_local/W"]
        for name in ("m", "n", "nz", "nzmax"):
            assert W[name].shape == (1,)
            assert W[name].dtype == np.int32
        assert W["nz"][0] == W["nzmax"][0] == len(W["i"]) == len(W["p"]) == len(W["x"]) == np.count_nonzero(known.N)
        assert W["i"].dtype == W["p"].dtype == np.int32
        assert np.allclose(_dense_triplets(W), known.N, atol=1e-14)
        assert file["fclib_local/spacedim"][0] == 3
        assert file["fclib_local/info/title"].id.get_type().get_size() == len("a title") + 1
        assert set(file["fclib_local/info"]) == {"title", "description", "math_info"}
        assert set(file["solution"]) == {"u", "r"}
        assert "guesses" not in file
        assert np.allclose(file["solution/u"][:], known.y.ravel(), atol=1e-12)


@pytest.mark.parametrize("bodies_alone", [True, False], ids=["6 x 6 masses", "coupled masses"])
def test_a_global_problem_is_written_and_read_again(tmp_path, bodies_alone):
    rng = np.random.default_rng(2)
    known, graph = heap(2, 15, 6)
    H = graph.dense().T
    n = len(H)
    M = np.kron(np.eye(6), np.ones((6, 6))) if bodies_alone else np.ones((n, n))
    roots = rng.normal(size=(n, n)) * np.tril(M)
    M = roots @ roots.T + np.eye(n)
    f, w = rng.normal(size=n), rng.normal(size=(15, 3))
    state = random_solution(known, n)
    matrices = sp.csr_matrix(M), sp.csr_matrix(H.T)
    fclib.write_global(tmp_path / "g.h5", SELF, *matrices, f, w, known.mu, Info("bodies"), state, state)
    stored = fclib.load(tmp_path / "g.h5", SELF)
    assert (stored.problem.contact_map is not None) == bodies_alone
    W = H.T @ np.linalg.solve(M, H)
    assert np.allclose(dense(stored.problem), W, atol=1e-12 * np.abs(W).max())
    q = w.ravel() + H.T @ np.linalg.solve(M, f)
    assert np.allclose(stored.problem.r.ravel(), q, atol=1e-12 * np.abs(q).max())
    assert np.array_equal(stored.solution, known.g)
    with h5py.File(tmp_path / "g.h5") as file:
        group = file["fclib_global"]
        assert np.array_equal(_dense_triplets(group["H"]), H)
        assert np.array_equal(_dense_triplets(group["M"]), M)
        assert np.array_equal(group["vectors/f"][:], f)
        assert np.array_equal(group["vectors/w"][:], w.ravel())
        assert np.array_equal(file["solution/v"][:], state.v)
        assert set(file["guesses/1"]) == {"u", "r", "v"}
        assert file["guesses/number_of_guesses"][0] == 1


def test_a_file_that_cannot_be_written_leaves_what_was_there(tmp_path, monkeypatch):
    def full(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(disk, "flush", full)
    problem = from_matrix(heap(0, 12, 8)[0])
    path = tmp_path / "there.h5"
    path.write_text("old")
    with pytest.raises(OSError, match=r"there\.h5: cannot write \(No space left"):
        fclib.write_local(path, problem)
    assert [file.read_text() for file in tmp_path.iterdir()] == ["old"]


# -- crowded bodies ----------------------------------------------------------------------------------------


@pytest.fixture
def crowded(monkeypatch):
    """A problem with a body of 11 contacts and more, where N has a low-rank term, and its N."""
    monkeypatch.setattr(delassus, "DENSE", 10)
    known, graph = heap(1, 30, 12, hub=True)
    problem = ConeProblem(SELF, known.r, known.mu, G=graph.part(SELF), compliance=1e-3)
    assert problem.has_dense_columns
    return problem, graph


def test_a_global_problem_with_a_crowded_body_is_the_same_when_read_again(tmp_path, crowded):
    problem, graph = crowded
    H = graph.dense().T
    zeros, ones = np.zeros(len(H)), np.eye(len(H))
    path = tmp_path / "global.h5"
    matrices = sp.csr_matrix(ones), sp.csr_matrix(H.T)
    fclib.write_global(path, SELF, *matrices, zeros, problem.r, problem.mu, compliance=problem.compliance[:, 0])
    again = fclib.read(path, SELF)
    assert again.has_dense_columns
    x = np.random.default_rng(0).normal(size=problem.r.shape)
    np.testing.assert_allclose(again.product(x), problem.product(x), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(again.diagonal_blocks, problem.diagonal_blocks, rtol=1e-12, atol=1e-12)


def test_a_crowded_body_is_refused_where_it_would_fill_the_matrix(tmp_path, crowded):
    """N without its low-rank term would be another problem."""
    with pytest.raises(ValueError, match="would fill N; allowed is"):
        fclib.write_local(tmp_path / "file", crowded[0])
    assert list(tmp_path.iterdir()) == []


def test_gauss_seidel_refuses_a_crowded_body(crowded):
    with pytest.raises(OptionError, match="^solver gauss_seidel: a body has"):
        ccp.solve(crowded[0], type="gauss_seidel", law=ccp.RELAXATION)


# -- several ranks ---------------------------------------------------------------------------------------


@pytest.mark.parallel(2, 4)
def test_a_global_problem_of_several_ranks(tmp_path):
    comm = MPI.COMM_WORLD
    known, graph = heap(0, 12, 8)
    mine, bodies, H = part(comm, 12), part(comm, 8), graph.dense().T
    rows, masses, f = slice(6 * bodies.start, 6 * bodies.stop), 1.0 + np.arange(48), np.arange(48.0)
    M, D = sp.diags(masses).tocsr()[rows], sp.csr_matrix(H.T[3 * mine.start : 3 * mine.stop])
    path, g = tmp_path / "global.h5", known.g[mine]
    fclib.write_global(path, comm, M, D, f[rows], known.r[mine], known.mu[mine], point=g)
    problem = fclib.load(path, comm).problem
    assert problem.contact_map is not None
    assert np.array_equal(problem.mu, known.mu[mine])
    assert np.array_equal(problem.point, g)
    W, r = H.T @ (H / masses[:, None]), known.r.ravel() + H.T @ (f / masses)
    assert np.allclose(problem.r, r.reshape(-1, 3)[mine], atol=1e-12)
    assert np.allclose(problem.product(g), (W @ known.g.ravel()).reshape(-1, 3)[mine], atol=1e-11)


# -- published problems ------------------------------------------------------------------------------------


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
    result = ccp.solve(problem, type=solver, limits=Limits(1e-7), law=ccp.RELAXATION)
    assert result.converged
    figures = ccp.measure(problem, result.impulse)
    assert problem.size == contacts
    assert figures.natural_residual <= 1.01e-7
    assert figures.objective == pytest.approx(objective, rel=1e-7)
    assert figures.velocity_norm == pytest.approx(velocity_norm, rel=1e-4)


@pytest.mark.parametrize("softest", [0.0, 0.03])
def test_compliance_is_kept_beside_the_rigid_matrix(tmp_path, softest):
    known, graph = heap(0, 12, 8)
    compliance = np.linspace(0.0, softest, len(known.mu))
    problem = ccp.ConeProblem(SELF, known.r, known.mu, G=graph.part(SELF), compliance=compliance)
    path = tmp_path / "problem"
    fclib.write_local(path, problem)
    again = fclib.load(path, SELF).problem
    assert again.yields == (softest > 0)
    np.testing.assert_array_equal(again.compliance, problem.compliance)
    np.testing.assert_allclose(dense(again) - np.diag(again.compliance.ravel()), known.N, atol=1e-12)
