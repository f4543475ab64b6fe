"""The Delassus matrix against G G' in dense arithmetic, on one rank and several."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc
from problems import SELF, from_graph, heap, matrix, part, random_graph

from dem.contact_map import BlockRows
from pctt.blocks import square_block_matrix
from pctt.ccp import RELAXATION, ConeProblem, Limits, solve
from pctt.ccp.delassus import delassus


def dense(mat) -> np.ndarray:
    rows, columns = mat.getSize()
    if not rows:
        return np.zeros((rows, columns))
    indptr, indices, values = mat.convert("aij").getValuesCSR()
    return sp.csr_matrix((values, indices, indptr), shape=(rows, columns)).toarray()


def test_blocks_are_stored_where_two_contacts_share_a_body_and_nowhere_else():
    graph = random_graph(5, 60, 25)
    touches = np.zeros((graph.contacts, graph.bodies))
    touches[np.repeat(np.arange(graph.contacts), np.diff(graph.indptr)), graph.indices] = 1
    N = delassus(SELF, graph.part(SELF))
    assert N.getInfo()["nz_used"] == 9 * np.count_nonzero(touches @ touches.T)


def test_columns_may_come_in_any_order():
    """Block CSR from a sparse product has its columns unsorted; PETSc takes them sorted only."""
    rng = np.random.default_rng(0)
    blocks = rng.normal(size=(4, 3, 3))
    rows = sp.bsr_matrix((blocks, [2, 0, 1, 2], [0, 2, 3, 4]), shape=(9, 9))
    expected = rows.toarray()
    assert np.allclose(dense(square_block_matrix(SELF, rows)), expected)
    assert np.array_equal(rows.toarray(), expected)  # its argument is as it was


def test_a_problem_needs_one_operator_and_matching_finite_data():
    known, graph = heap()
    G = graph.part(SELF)
    with pytest.raises(ValueError, match="either the map G or the matrix N"):
        ConeProblem(SELF, known.r, known.mu)
    with pytest.raises(ValueError, match="either the map G or the matrix N"):
        ConeProblem(SELF, known.r, known.mu, G=G, N=matrix(SELF, known.N))
    with pytest.raises(ValueError, match=r"mu has the shape \(39,\); allowed is \(40,\) or \(40, 2\), as r has 40"):
        ConeProblem(SELF, known.r, known.mu[1:], G=G)
    for name, value in (("r", np.nan), ("r", np.inf), ("mu", np.nan), ("mu", -0.1)):
        data = {"r": known.r.copy(), "mu": known.mu.copy()}
        data[name][3] = value
        with pytest.raises(ValueError, match=f"{name} is {value} at contact 3.*; allowed are finite numbers"):
            ConeProblem(SELF, data["r"], data["mu"], G=G)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_operators_that_are_no_numbers_are_refused_on_all_ranks(number):
    comm = MPI.COMM_WORLD
    known, graph = heap()
    problem = from_graph(known, graph, comm)
    G = problem.contact_map.source
    values = known.N.copy()
    values[0, 7] = number
    if comm.rank == 0:
        blocks = G.blocks.copy()
        blocks[5, 1, 2] = number
        G = BlockRows(G.indptr, G.indices, blocks, G.columns)
    with pytest.raises(ValueError, match="G has a NaN or an infinite number in"), np.errstate(invalid="ignore"):
        ConeProblem(comm, problem.r, problem.mu, G=G)
    with pytest.raises(ValueError, match="N has a NaN or an infinite number"):
        ConeProblem(comm, problem.r, problem.mu, N=matrix(comm, values))


def test_numbers_that_make_no_sense_are_refused():
    known, graph = heap()
    for compliance in (-1e-3, np.nan, np.inf):
        with pytest.raises(ValueError, match="compliance"):
            ConeProblem(SELF, known.r, known.mu, G=graph.part(SELF), compliance=compliance)
    problem = from_graph(known, graph)
    for words, arguments in (
        ("the solver 'newton': allowed are pdip, conic", {"type": "newton"}),
        ("tol -1: allowed is a number between 0 and 1", {"limits": Limits(-1)}),
        ("tol -1: allowed is a number between 0 and 1", {"limits": {"tol": -1}}),
        ("limits 1e-06: allowed is a dict or a Limits", {"limits": 1e-6}),
        ("chek: no such setting; .* did you mean check", {"options": {"chek": 1}, "type": "apgd"}),
        ("options 3: allowed for apgd is a dict or a APGD", {"options": 3, "type": "apgd"}),
        ("a guess with a NaN", {"guess": np.full_like(known.r, np.nan)}),
    ):
        with pytest.raises(ValueError, match=words):
            solve(problem, **arguments)


def test_shapes_that_do_not_fit_are_refused():
    known, graph = heap()
    G = graph.part(SELF)
    given = {"r": known.r, "mu": known.mu, "G": G}
    for changes, words in (
        ({"mu": known.mu[:, None]}, r"mu has the shape \(40, 1\); allowed is \(40,\) or \(40, 2\)"),
        ({"r": known.r[:, :2]}, "G is of the type BlockRows; allowed for contacts of the plane are a two-dimensional"),
        ({"r": known.r.T}, r"r has the shape \(3, 40\)"),
        ({"r": known.r[1:], "mu": known.mu[1:]}, "G has 40 contacts, but r has 39"),
        ({"G": 3}, "G has the type int"),
        ({"G": None, "N": matrix(SELF, np.eye(9))}, "N has 9 local rows and 9 columns; allowed are 120 rows"),
        ({"point": np.zeros((39, 3))}, r"point has the shape \(39, 3\)"),
        ({"key": np.zeros((40, 1))}, r"key has the shape \(40, 1\)"),
    ):
        with pytest.raises(ValueError, match=words):
            ConeProblem(SELF, **{**given, **changes})
    with pytest.raises(ValueError, match=r"a guess of shape \(119,\); allowed is \(40, 3\)"):
        solve(ConeProblem(SELF, known.r, known.mu, G=G), np.zeros(119), type="pdip", law=RELAXATION)


@pytest.mark.parallel(2)
def test_a_shape_that_does_not_fit_on_one_rank_is_refused_on_all():
    known, graph = heap()
    problem = from_graph(known, graph, MPI.COMM_WORLD)
    mu = problem.mu[1:] if MPI.COMM_WORLD.rank else problem.mu
    with pytest.raises(ValueError, match=r"mu has the shape \(19,\); .*r has 20 contacts \(on rank 1 of 2\)"):
        ConeProblem(MPI.COMM_WORLD, problem.r, mu, G=problem.contact_map.source)


@pytest.mark.parametrize("block", [1, 3])
@pytest.mark.parametrize("kind", ["aij", "baij", "sbaij", "dense"])
@pytest.mark.parametrize("method", ["pdip", "conic", "gauss_seidel"])
def test_N_in_any_format(kind, block, method):
    known, _ = heap()
    N = PETSc.Mat().createDense(known.N.shape, array=known.N + np.eye(len(known.N)), comm=SELF).convert("aij")
    N.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    N = N if kind == "aij" else N.convert(kind, PETSc.Mat())
    N.setBlockSize(block) if kind in ("aij", "dense") else None
    with ConeProblem(SELF, known.r, known.mu, N=N) as problem:
        assert solve(problem, type=method, limits=Limits(1e-6), law=RELAXATION).converged


def test_known_problems_are_what_they_say():
    """The optimality conditions hold for the pairs that the tests of the solvers are built on."""
    for mu in (0.0, 0.4, np.linspace(0, 1, 40)):
        known, graph = heap(mu=mu)
        assert np.linalg.matrix_rank(known.N) < len(known.N)
        assert np.allclose((known.N @ known.g.ravel()).reshape(-1, 3) + known.r, known.y)
        assert (np.hypot(*known.g.T[1:]) <= known.mu * known.g[:, 0] * (1 + 1e-14)).all()
        assert (known.mu * np.hypot(*known.y.T[1:]) <= known.y[:, 0] * (1 + 1e-14)).all()
        assert np.allclose((known.g * known.y).sum(1), 0, atol=1e-14)
        impulse, speed = known.g[:, 0] > 0, np.hypot(*known.y.T[1:]) > 0
        kinds = [(~impulse).sum(), (impulse & ~speed).sum(), (impulse & speed).sum()]  # open, sticking, sliding
        assert min(kinds) >= 8 * bool(np.all(mu))
        g = known.g.ravel()
        assert known.objective == pytest.approx(0.5 * g @ known.N @ g + known.r.ravel() @ g)


@pytest.mark.parallel(1, 2, 3, 4)
def test_delassus_over_the_ranks():
    """Ranks without contacts, ranks that own bodies that they do not touch, bodies all on one rank."""
    comm = MPI.COMM_WORLD
    last = comm.size - 1

    def own(mat, block):
        indptr, indices, values = mat.convert("aij").getValuesCSR()
        return sp.csr_matrix((values, indices, indptr), shape=(len(indptr) - 1, mat.getSize()[1])).toarray()

    for seed, arguments in enumerate([
        {"contacts": 60, "bodies": 25},
        {"contacts": 80, "bodies": 30, "hub": True},
        {"contacts": 40, "bodies": 6},
        {"contacts": 30, "bodies": 12, "one_body": 1.0},
        {"contacts": 3, "bodies": 2},
        {"contacts": 7, "bodies": 1},
        {"contacts": 5, "bodies": 50},
        {"contacts": 0, "bodies": 4},
    ]):
        graph = random_graph(seed, **arguments)
        G = graph.dense()
        N = G @ G.T
        scale = max(1.0, np.abs(N).max(initial=0.0))
        nc, nb = graph.contacts, graph.bodies
        rng = np.random.default_rng(seed)
        partitions = [
            (None, None),
            ([0] * last + [nc], [nb] * comm.size),  # all contacts on the last rank, all bodies on the first
            ([nc] * comm.size, [0] * last + [nb]),  # and the other way round
            (None, [0] * last + [nb]),
            ([*sorted(rng.integers(0, nc + 1, last)), nc], [*sorted(rng.integers(0, nb + 1, last)), nb]),
        ]
        for contact_ends, body_ends in partitions:
            rows = part(comm, nc, contact_ends)
            near = slice(3 * rows.start, 3 * rows.stop)
            local = graph.part(comm, contact_ends, body_ends)
            assert np.allclose(own(delassus(comm, local), 3), N[near], rtol=0, atol=1e-13 * scale)
            count = rows.stop - rows.start
            problem = ConeProblem(comm, np.ones((count, 3)), np.ones(count), G=local)
            g = np.random.default_rng(1).normal(size=3 * nc)
            y = problem.product(g[near].reshape(-1, 3))
            assert np.allclose(y.ravel(), (N @ g)[near], rtol=0, atol=1e-12 * scale)
            v = problem.N.createVecRight()
            v.array[:] = g[near]
            assert np.allclose((problem.N * v).array, (N @ g)[near], rtol=0, atol=1e-12 * scale)
            blocks = N.reshape(nc, 3, nc, 3)[np.arange(nc), :, np.arange(nc)]
            assert np.allclose(problem.diagonal_blocks, blocks[rows], rtol=0, atol=1e-13 * scale)
            assert np.isclose(problem.mean_diagonal, np.diag(N).mean() if nc else 1.0)
            assert problem.size == nc
