"""Products with the contact map, in both storages, against dense algebra."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from problems import part, random_graph

from dem.contact_map import BlockRows, CompactRows, ContactMap
from pctt.body_matrix import BodyOperator
from pctt.ccp import ConeProblem
from pctt.ccp.delassus import BlockMap

CLOSE = {"rtol": 1e-13, "atol": 1e-13}


def random_contacts(seed: int, contacts: int, bodies: int, wide: bool) -> tuple[CompactRows, np.ndarray]:
    """Rows of all contacts, with bodies that nothing moves among them, and G as a dense array by its definition."""
    rng = np.random.default_rng(seed)
    body = np.array([rng.choice(bodies, 2, replace=False) for _ in range(contacts)]).reshape(-1, 2)
    body[rng.random(contacts) < 0.2, 1] = -1
    body[rng.random(contacts) < 0.1, 0] = -1
    frame = np.linalg.qr(rng.standard_normal((contacts, 3, 3)))[0]
    arm = rng.standard_normal((contacts, 2, 3))
    root = rng.standard_normal((bodies, 2, 3, 3))
    root = root @ root.transpose(0, 1, 3, 2)
    if not wide:
        root *= np.eye(3)
    G = np.zeros((contacts, 3, bodies + 1, 6))
    for c in range(contacts):
        for side, sign in ((0, -1.0), (1, 1.0)):
            if body[c, side] >= 0:
                place, turning = root[body[c, side]]
                G[c, :, body[c, side], :3] = sign * frame[c] @ place
                G[c, :, body[c, side], 3:] = sign * np.cross(arm[c, side], frame[c]) @ turning
    kept = [0, 1, 2, 4, 5, 8] if wide else [0, 4, 8]
    roots = root.reshape(bodies, 2, 9)[:, :, kept].reshape(bodies, -1)
    rows = CompactRows(frame.reshape(-1, 9), arm.reshape(-1, 6), body, roots, bodies)
    return rows, G[:, :, :bodies].reshape(3 * contacts, 6 * bodies)


def own_part(whole: CompactRows, comm: MPI.Comm, ends=None, body_ends=None) -> CompactRows:
    here, bodies = part(comm, whole.rows, ends), part(comm, whole.columns, body_ends)
    near = (whole.frame[here], whole.arm[here], whole.body[here])
    return CompactRows(*near, whole.root[bodies], bodies.stop - bodies.start)


def blocks_of(rows: CompactRows) -> BlockRows:
    return ContactMap(MPI.COMM_SELF, rows).block_rows


def operator(comm: MPI.Comm, rows: CompactRows | BlockRows) -> ContactMap | BlockMap:
    return (ContactMap if isinstance(rows, CompactRows) else BlockMap)(comm, rows)


def check_part(product: ContactMap, g: np.ndarray) -> None:
    """A map of some contacts alone, with impulses of these."""
    some = np.arange(len(g))[::2]
    part, impulse = product.only(some), np.zeros_like(g)
    impulse[some] = g[some]
    images = [product.image() for _ in range(2)]
    product.find_image(impulse, images[0])
    part.find_image(g[some], images[1])
    np.testing.assert_allclose(images[1], images[0], rtol=1e-12, atol=1e-12)
    every, few = np.empty_like(g), np.empty_like(g[some])
    product.find_velocities(images[0], 0.5 * images[0], 0.6, g, every)
    part.find_velocities(images[0], 0.5 * images[0], 0.6, g[some], few)
    np.testing.assert_allclose(few, every[some], rtol=1e-12, atol=1e-12)


def check(comm: MPI.Comm, rows: CompactRows | BlockRows, G: np.ndarray, here: slice) -> None:
    """All products and blocks of the map of these rows."""
    rng = np.random.default_rng(1)
    contacts, bodies = G.shape[0] // 3, G.shape[1] // 6
    first = sum(comm.allgather(rows.columns)[: comm.rank])
    own = slice(first, first + rows.columns)
    v, g = rng.standard_normal((bodies, 6)), rng.standard_normal((contacts, 3))
    any_H = rng.standard_normal((contacts, 3, 3))
    H = any_H @ any_H.transpose(0, 2, 1)
    product = operator(comm, rows)
    np.testing.assert_allclose(product.velocities(v[own].ravel()), (G @ v.ravel()).reshape(-1, 3)[here], **CLOSE)
    np.testing.assert_allclose(product.momenta(g[here]), (G.T @ g.ravel()).reshape(-1, 6)[own], **CLOSE)
    y = g[here].copy()
    product.add_delassus(g[here], y)
    np.testing.assert_allclose(y - g[here], (G @ G.T @ g.ravel()).reshape(-1, 3)[here], rtol=1e-12, atol=1e-12)
    N = (G @ G.T).reshape(contacts, 3, contacts, 3)[range(contacts), :, range(contacts)]
    np.testing.assert_allclose(product.contact_blocks(), N[here], **CLOSE)
    size = rng.uniform(0.5, 2.0, (contacts, 3))
    y = np.zeros((here.stop - here.start, 3))
    product.scaled(size[here]).add_delassus(g[here], y)
    expected = size.ravel() * (G @ G.T @ (size * g).ravel())
    np.testing.assert_allclose(y, expected.reshape(-1, 3)[here], rtol=1e-12, atol=1e-12)
    y = np.zeros_like(y, dtype=np.float32)
    product.scaled(size[here], np.float32).add_delassus(g[here].astype(np.float32), y)
    close = {"rtol": 1e-4, "atol": 1e-5 * np.abs(expected).max(initial=0.0)}
    np.testing.assert_allclose(y, expected.reshape(-1, 3)[here], **close)

    # the step from z = x + .6 (x - last) to new, by images alone
    x, last, new = rng.standard_normal((3, contacts, 3))
    images = []
    for point in (x, last, new):
        images.append(product.image())
        product.find_image(point[here], images[-1])
    z = x + 0.6 * (x - last)
    y = np.empty_like(g[here])
    product.find_velocities(*images[:2], 0.6, g[here], y)
    close = {"rtol": 1e-12, "atol": 1e-11}
    np.testing.assert_allclose(y - g[here], (G @ G.T @ z.ravel()).reshape(-1, 3)[here], **close)
    energy = comm.allreduce(product.energy_of_step(images[2], *images[:2], 0.6))
    np.testing.assert_allclose(energy, np.square((new - z).ravel() @ G).sum(), rtol=1e-12, atol=1e-11)

    if product.has_parts:
        check_part(product, g[here])

    body = BodyOperator(product)
    x, out = body.mat.createVecs()
    x.array[:] = v[own].ravel()
    for blocks, symmetric in ((H, True), (any_H, False), (H, True)):
        through = np.einsum("cij,cjk->cik", blocks, G.reshape(contacts, 3, 6 * bodies)).reshape(G.shape)
        K = np.eye(6 * bodies) + G.T @ through
        body.update(blocks[here], symmetric)
        body.mat.mult(x, out)
        close = {"rtol": 1e-12, "atol": 1e-12 * np.abs(K).max()}
        np.testing.assert_allclose(out.array.reshape(-1, 6), (K @ v.ravel()).reshape(-1, 6)[own], **close)
        diagonal = K.reshape(bodies, 6, bodies, 6)[range(bodies), :, range(bodies)][own]
        np.testing.assert_allclose(body.mat.getPythonContext().blocks, diagonal, **close)
        body.entries().mat.mult(x, out)
        np.testing.assert_allclose(out.array.reshape(-1, 6), (K @ v.ravel()).reshape(-1, 6)[own], **close)
    for thing in (body, product, x, out):
        thing.destroy()


@pytest.mark.parallel(1, 2, 3, 4)
@pytest.mark.parametrize("wide", [False, True], ids=["diagonal roots", "full roots"])
def test_frames_and_arms(wide):
    comm = MPI.COMM_WORLD
    rows, G = random_contacts(3, 40, 12, wide)
    check(comm, own_part(rows, comm), G, part(comm, 40))


@pytest.mark.parallel(1, 3)
def test_blocks():
    comm = MPI.COMM_WORLD
    graph = random_graph(4, 30, 8, hub=True)
    check(comm, graph.part(comm), graph.dense(), part(comm, 30))


@pytest.mark.parallel(2, 3)
def test_ranks_without_contacts_or_bodies():
    comm = MPI.COMM_WORLD
    rows, G = random_contacts(5, 10, 4, False)
    all_last = [0] * (comm.size - 1)
    ends, body_ends = [*all_last, 10], [*[4] * (comm.size - 1), 4]  # contacts on the last rank, bodies on the first
    check(comm, own_part(rows, comm, ends, body_ends), G, part(comm, 10, ends))


def test_a_number_that_is_none_comes_out():
    """The compiler must not take for granted that there are none."""
    rows, _ = random_contacts(6, 20, 5, False)
    product = ContactMap(MPI.COMM_SELF, rows)
    v = np.zeros((5, 6))
    v[rows.body[0].max(), 4] = np.nan
    assert np.isnan(product.velocities(v)).any()
    assert np.isfinite(product.velocities(np.zeros((5, 6)))).all()


@pytest.mark.parametrize("compact", [True, False])
def test_a_product_repeats_itself_bit_for_bit(compact):
    rows, _ = random_contacts(7, 60, 9, True)
    product = operator(MPI.COMM_SELF, rows if compact else blocks_of(rows))
    g = np.random.default_rng(0).standard_normal((60, 3))
    first, second = np.zeros((2, 60, 3))
    product.add_delassus(g, first)
    product.add_delassus(g, second)
    assert first.tobytes() == second.tobytes()


def test_arrays_of_a_wrong_size_are_refused():
    """The compiled loops would read and write outside of their arrays."""
    rows, G = random_contacts(8, 9, 4, False)
    N = PETSc.Mat().createDense((27, 27), array=G @ G.T, comm=PETSc.COMM_SELF)
    N.assemble()
    for given in ({"G": rows}, {"G": blocks_of(rows)}, {"N": N}):
        with ConeProblem(MPI.COMM_SELF, np.ones((9, 3)), np.ones(9), **given) as problem:
            for wrong in (np.ones((1, 3)), np.ones((10, 3)), np.ones((3, 9)), np.ones(28)):
                for function in (problem.product, problem.momentum, problem.velocity_of):
                    with pytest.raises(ValueError, match="allowed is"):
                        function(wrong)
            with pytest.raises(ValueError, match=r"of the shape \(8, 3\); allowed is \(9, 3\)|broadcast"):
                problem.operator.add_delassus(np.ones((9, 3)), np.zeros((8, 3)))
            assert np.array_equal(problem.momentum(np.ones(27)), problem.momentum(np.ones((9, 3))))


def test_flops_are_logged():
    rows, _ = random_contacts(9, 20, 5, False)
    problem = ConeProblem(MPI.COMM_SELF, np.zeros((20, 3)), np.ones(20), G=rows)
    before = PETSc.Log.getFlops()
    problem.velocity_of(np.zeros((5, 6)))
    assert PETSc.Log.getFlops() - before == 45 * 20 + 6 * 5


OTHER_FORMS = {
    "Fortran": np.asfortranarray,
    "single precision": lambda a: a.astype(np.float32 if a.dtype.kind == "f" else np.int32),
    "lists": np.ndarray.tolist,
    "big-endian": lambda a: a.astype(a.dtype.newbyteorder(">")),
}


@pytest.mark.parametrize("form", OTHER_FORMS)
def test_arrays_of_other_forms(form):
    whole, G = random_contacts(0, 12, 7, wide=False)
    other = OTHER_FORMS[form]
    g = np.random.default_rng(0).standard_normal((12, 3))
    rows = CompactRows(other(whole.frame), other(whole.arm), other(whole.body), other(whole.root), 7)
    blocks = blocks_of(whole)
    for given in (rows, BlockRows(other(blocks.indptr), other(blocks.indices), other(blocks.blocks), 7)):
        product = operator(MPI.COMM_SELF, given)
        close = {"atol": 1e-4} if form == "single precision" else CLOSE
        np.testing.assert_allclose(product.momenta(np.asfortranarray(g)).ravel(), G.T @ g.ravel(), **close)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize(
    ("name", "wrong", "words"),
    [
        ("frame", lambda a: a[:-1], "arm of the rows has the shape"),
        ("arm", lambda a: a[:, :3], "arm of the rows has the shape"),
        ("body", lambda a: a + 7, "but there are 7 bodies"),
        ("body", lambda a: a - 2, "allowed are indices of bodies"),
        ("body", lambda a: a + 0.5, "type float64; allowed is int64"),
        ("root", lambda a: a[1:], "root of the rows has the shape"),
        ("columns", lambda a: a + 1, "root of the rows has the shape"),
    ],
)
def test_rows_that_do_not_fit_are_refused_on_all_ranks(name, wrong, words):
    """The compiled loops would write outside of their arrays; the mistake is on the last rank."""
    comm = MPI.COMM_WORLD
    rows = own_part(random_contacts(0, 12, 7, wide=False)[0], comm)
    if comm.rank == comm.size - 1:
        rows = dataclasses.replace(rows, **{name: wrong(getattr(rows, name))})
    with pytest.raises(ValueError, match=words):
        ContactMap(comm, rows)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("indptr", np.array([0, 2, 1, 2]), "does not ascend"),
        ("indptr", np.array([0, 1, 2, 9]), "does not ascend"),
        ("indices", np.array([0, 5]), "the body 5, but there are 2 bodies"),
        ("indices", np.array([0, -1]), "allowed are indices"),
        ("blocks", np.ones((2, 6, 3)), r"blocks of the rows has the shape \(2, 6, 3\)"),
    ],
)
def test_blocks_that_do_not_fit_are_refused(name, value, words):
    rows = BlockRows(np.array([0, 1, 1, 2]), np.array([0, 1]), np.ones((2, 3, 6)), 2)
    with pytest.raises(ValueError, match=words):
        BlockMap(MPI.COMM_SELF, dataclasses.replace(rows, **{name: value}))
