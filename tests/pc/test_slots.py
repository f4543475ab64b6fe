"""Slots of block rows that come, stay, move and go."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc
from scipy.spatial import cKDTree
from systems import dense
from train_solver import context, operator, ready, solve, solver

from pctt.blocks import square_block_matrix
from pctt.mat.order import places_of
from pctt.pc.slots import Slots

BOX = 16


def cloud(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random points in the unit cube and keys without order."""
    rng = np.random.default_rng(seed)
    return rng.random((count, 3)), rng.permutation(10 * count)[:count]


def springs(points: np.ndarray, keys: np.ndarray | None, block: int = 1, shift: float = 0.5) -> PETSc.Mat:
    """Laplacian of the graph of near points, in blocks; definite by ``shift``."""
    reach = 1.6 * len(points) ** (-1 / 3)
    i, j = cKDTree(points).query_pairs(reach, output_type="ndarray").T
    n = len(points)
    W = sp.coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n))
    W = W + W.T
    L = sp.diags(np.asarray(W.sum(axis=1)).ravel() + shift) - W
    coupling = np.eye(block) + 0.1
    mat = square_block_matrix(PETSc.COMM_SELF.tompi4py(), sp.kron(L, coupling).tobsr((block, block)))
    mat.setAttr("coordinates", points)
    if keys is not None:
        mat.setAttr("key", keys)
    return mat


def slots_of(points: np.ndarray, keys: np.ndarray) -> Slots:
    mat = springs(points, keys)
    return Slots(mat, places_of(mat), BOX)


def follow(slots: Slots, points: np.ndarray, keys: np.ndarray) -> bool:
    mat = springs(points, keys)
    return slots.follow(mat, places_of(mat))


def by_key(slots: Slots, keys: np.ndarray) -> dict[int, int]:
    return dict(zip(keys.tolist(), slots.place.tolist()))


def test_every_row_has_a_slot_of_its_own_and_the_spare_ones_are_spread():
    points, keys = cloud(1000)
    slots = slots_of(points, keys)
    assert len(np.unique(slots.place)) == 1000
    assert slots.capacity % BOX == 0
    assert 1040 <= slots.capacity <= 1100
    in_box = np.bincount(slots.place // BOX, minlength=slots.capacity // BOX)
    assert in_box.min() >= BOX - 3
    assert in_box.max() <= BOX


def test_rows_that_stay_keep_their_slots_whatever_comes_and_goes():
    points, keys = cloud(1000)
    slots = slots_of(points, keys)
    before = by_key(slots, keys)
    rng = np.random.default_rng(1)
    stay = np.sort(rng.permutation(1000)[:970])
    new_points, new_keys = rng.random((25, 3)), 10_000 + np.arange(25)
    mixed = rng.permutation(995)  # rows come in another order
    points = np.concatenate([points[stay], new_points])[mixed]
    keys_then = np.concatenate([keys[stay], new_keys])[mixed]
    assert follow(slots, points, keys_then)
    after = by_key(slots, keys_then)
    assert all(after[key] == before[key] for key in keys[stay].tolist())
    assert len(set(after.values())) == 995


def test_new_rows_get_slots_near_their_neighbours():
    points, keys = cloud(2000)
    slots = slots_of(points, keys)
    twins = np.arange(0, 2000, 100)  # new rows where these are
    more = np.concatenate([points, points[twins]])
    follow(slots, more, np.concatenate([keys, 50_000 + twins]))
    off = np.abs(slots.place[2000:] // BOX - slots.place[twins] // BOX)
    assert off.max() <= 2


def test_rows_that_move_far_move_to_another_slot():
    points, keys = cloud(1000)
    slots = slots_of(points, keys)
    before = slots.place.copy()
    wanderers, hosts = np.array([3, 500]), np.array([700, 10])
    moved = points + 1e-6
    moved[wanderers] = points[hosts]
    assert follow(slots, moved, keys)
    others = np.setdiff1d(np.arange(1000), wanderers)
    assert np.array_equal(slots.place[others], before[others])
    assert np.abs(slots.place[wanderers] // BOX - before[hosts] // BOX).max() <= 2


@pytest.mark.parametrize("what", ["too many", "too many in one place", "strangers", "another rank refuses"])
def test_what_does_not_fit_changes_nothing(what, monkeypatch):
    points, keys = cloud(1000)
    slots = slots_of(points, keys)
    before = slots.place.copy()
    more = {"too many": slots.capacity - 999, "too many in one place": slots.capacity - 1000}.get(what, 0)
    crowd = np.full((more, 3), 0.01) + 1e-4 * np.arange(more)[:, None]
    if what == "too many":
        crowd = np.random.default_rng(2).random((more, 3))
    points, names = np.concatenate([points, crowd]), np.concatenate([keys, 20_000 + np.arange(more)])
    if what == "strangers":
        names = 20_000 + names
    with monkeypatch.context() as patched:
        if what == "another rank refuses":
            patched.setattr("pctt.pc.slots.on_all", lambda comm, here: False)
        assert not follow(slots, points, names)
    assert np.array_equal(slots.place, before)
    assert follow(slots, *cloud(1000))  # and it still knows the rows that it had
    assert np.array_equal(slots.place, before)


def test_rows_of_the_same_name_never_share_a_slot():
    points, keys = cloud(200)
    slots = slots_of(points, keys)
    keys[7] = keys[8]
    assert not follow(slots, points, keys)


@pytest.mark.parametrize("variant", ["own", "unscaled"])
@pytest.mark.parametrize("block", [1, 3])
def test_empty_slots_leave_the_preconditioner_as_it_is(block, variant):
    """With full ranks the train is the inverse, whether there are empty slots or not."""
    points, keys = cloud(40)
    identity = np.eye(40 * block)
    for names in (keys, None):
        mat = springs(points, names, block)
        ksp = ready(mat, rank=400, eps=1e-12, variant=variant)
        pc = context(ksp)
        assert pc.rank == 400, pc.account.fallbacks
        assert (pc.made.slots.size > 40) == (names is not None)
        A = dense(mat)
        assert np.linalg.norm(operator(ksp) @ A - identity) < 0.05 * np.linalg.norm(identity)


def contact_steps(count: int, share: float = 0.02) -> tuple[PETSc.Mat, PETSc.Mat]:
    """The matrices of two steps: a share of the rows is replaced, the rest moves a little."""
    points, keys = cloud(count)
    rng = np.random.default_rng(5)
    new = rng.permutation(count)[: int(share * count)]
    later, names = points + 1e-4 * rng.standard_normal(points.shape), keys.copy()
    later[new], names[new] = rng.random((len(new), 3)), 100_000 + new
    return springs(points, keys), springs(later, names)


def follow_up(ksp: PETSc.KSP, mat: PETSc.Mat) -> None:
    ksp.reset()
    ksp.setOperators(mat)
    ksp.setUp()


@pytest.mark.parametrize(("reuse", "reused"), [("none", 0), ("cores", 1), ("trains", 0)])
def test_reuse_goes_as_far_as_asked(reuse, reused):
    """A warm start is no worse than a cold one."""
    first, second = contact_steps(1000)
    ksp = ready(first, rank=8, reuse=reuse)
    opening, compression = context(ksp).made.inverse, context(ksp).made.compression
    follow_up(ksp, second)
    made, account = context(ksp).made, context(ksp).account
    assert (account.reused, account.resets) == (reused, 0)
    assert (made.inverse is opening) == (account.kept == 1) == (reuse == "trains")
    assert (made.hierarchy is None) == (reuse == "trains")  # block pairs are not listed for nothing
    cold = ready(second, rank=8)
    if reuse == "cores":
        assert made.compression.passes < compression.passes
        assert made.compression.error <= 1.02 * context(cold).made.compression.error
        assert made.inverse.residual <= 1.5 * context(cold).made.inverse.residual
    its, residual = solve(ksp)
    assert residual < 1e-7
    assert its <= 1.2 * solve(cold)[0] + 1


def test_an_overflow_makes_a_new_tree():
    ksp = ready(springs(*cloud(600)), rank=4, reuse="cores")
    follow_up(ksp, springs(*cloud(800)))
    assert (context(ksp).account.resets, context(ksp).account.reused) == (1, 0)
    assert context(ksp).made.slots.size >= 800
    assert solve(ksp)[1] < 1e-7


@pytest.mark.parallel(1, 3)
def test_rows_that_change_ranks(ranks):
    """A grid of points, cut into slabs whose borders move; rows enter and leave every rank."""
    comm, n = MPI.COMM_WORLD, 16
    line = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(n, n))
    A = sp.kronsum(line, line, format="csr")

    def matrix(keep, offset):
        part = A[keep][:, keep]
        border = [len(keep) * r // comm.size + offset * (0 < r < comm.size) for r in range(comm.size + 1)]
        border = border if offset < len(keep) else [0] + [len(keep)] * comm.size
        own = slice(border[comm.rank], border[comm.rank + 1])
        mat = square_block_matrix(comm, part[own].tobsr((1, 1)))
        mat.setAttr("coordinates", np.stack(np.divmod(keep[own], n), axis=1))
        mat.setAttr("key", keep[own])
        return mat

    everything = np.arange(n * n)
    ksp = solver(matrix(everything[:-8], 0), rank=6, reuse="cores")
    solve(ksp)
    pc = context(ksp)
    for offset, keep in ((3, everything[4:-4]), (-3, everything[8:]), (n**3, everything)):  # n^3: all on the first rank
        ksp.reset()
        ksp.setOperators(matrix(keep, offset))
        ksp.setUp()
        its, residual = solve(ksp)
        assert pc.rank == 6, pc.account.fallbacks
        assert its < 70
        assert residual < 1e-6
        trains = comm.allgather([core.sum() for core in pc.made.inverse.applied.cores])
        assert all(np.array_equal(train, trains[0]) for train in trains)
    # for the last matrix the first rank of several has no room for all
    assert (pc.account.resets, pc.account.reused) == ((0, 3) if ranks == 1 else (1, 2))
