"""Cone problems in the forms that others have: matrices, operators, masses, elliptic cones, contacts of the plane."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc
from problems import SELF, heap, part
from scipy.sparse.linalg import aslinearoperator, splu

from pctt import ccp
from pctt.ccp import door
from pctt.ccp.registry import MATRIX, SOLVERS

CONTACTS, UNKNOWNS = 10, 23
#: those that no natural residual holds up, which is relative to large impulses
LIMITS = ccp.Limits(1e-8, closing_work=1e-5)
TAKING_PRODUCTS = [name for name, solver in SOLVERS.items() if solver.needs != MATRIX]


class Case:
    """A problem of full rank, its map G with masses M, and the rows of this rank; ``diagonal`` masses are numbers."""

    def __init__(self, seed: int = 0, diagonal: bool = False, comm: MPI.Comm = SELF, width: int = 3):
        rng = np.random.default_rng(seed)
        self.G = rng.normal(size=(width * CONTACTS, UNKNOWNS)) * (rng.random((width * CONTACTS, UNKNOWNS)) < 0.6)
        A = rng.normal(size=(UNKNOWNS, UNKNOWNS))
        self.m = rng.uniform(0.5, 2.0, UNKNOWNS)
        self.M = np.diag(self.m) if diagonal else A @ A.T + np.eye(UNKNOWNS)
        self.N = self.G @ np.linalg.solve(self.M, self.G.T)
        self.r = rng.normal(size=(CONTACTS, width)) - [0.5, *[0.0] * (width - 1)]
        self.mu = rng.uniform(0.1, 1.0, CONTACTS)
        self.comm, self.own, self.unknowns = comm, part(comm, CONTACTS), part(comm, UNKNOWNS)
        self.rows = slice(width * self.own.start, width * self.own.stop)
        near = range(self.own.start, self.own.stop)
        self.blocks = np.array([self.N[width * c :, width * c :][:width, :width] for c in near])

    def mult(self, g):
        return (self.N[self.rows] @ np.concatenate(self.comm.allgather(g.ravel()))).reshape(g.shape)

    def problem(self, **given):
        return ccp.ConeProblem(self.comm, self.r[self.own], self.mu[self.own], **given)

    def velocities(self, result):
        """y of the impulses of all ranks, by the dense N."""
        g = np.concatenate(self.comm.allgather(result.impulse))
        y = (self.N @ g.ravel()).reshape(self.r.shape) + self.r
        assert result.velocity == pytest.approx(y[self.own], abs=1e-9)
        return y


def mat(comm, A, rows, columns, kind="aij"):
    """This rank's rows of a dense array as a Mat."""
    csr, sizes = sp.csr_matrix(A[rows]), [(s.stop - s.start, n) for s, n in zip((rows, columns), A.shape)]
    made = PETSc.Mat().createAIJ(sizes, csr=(csr.indptr, csr.indices, csr.data), comm=comm)
    return made if kind == "aij" else made.convert(kind, PETSc.Mat())


def shell(case):
    class Product:
        def mult(self, mat, x, y):
            y.array_w[:] = case.N @ x.array_r

    return PETSc.Mat().createPython(case.N.shape, Product(), comm=case.comm)


def ksp(case):
    solver = PETSc.KSP().create(case.comm)
    solver.setOperators(mat(case.comm, case.M, case.unknowns, case.unknowns))
    solver.setType("cg")
    solver.pc.setType("jacobi")
    solver.setTolerances(rtol=1e-13)
    return solver


def factor(case):
    return splu(sp.csc_matrix(case.M))


def by_mat(case, kind):
    return mat(case.comm, case.N, case.rows, case.rows, kind)


N_FORMS = {
    "array": lambda case: case.N[case.rows],
    "csr": lambda case: sp.csr_matrix(case.N[case.rows]),
    "coo": lambda case: sp.coo_matrix(case.N[case.rows]),
    "bsr": lambda case: sp.bsr_matrix(case.N[case.rows], blocksize=(3, 3)),
    "aij": lambda case: by_mat(case, "aij"),
    "dense Mat": lambda case: by_mat(case, "dense"),
}
ON_ONE_RANK = {
    "python Mat": shell,
    "linear operator": lambda case: aslinearoperator(case.N),
}
PRODUCTS = {
    "function": lambda case: ccp.Operator(case.mult, case.blocks),
    "Mat": lambda case: ccp.Operator(by_mat(case, "aij"), case.blocks),
}
MASSES = {
    "array": lambda case: case.M,
    "csr": lambda case: sp.csr_matrix(case.M),
    "Mat": lambda case: mat(case.comm, case.M, case.unknowns, case.unknowns),
    "factor": factor,
    "cho_factor": lambda case: scipy.linalg.cho_factor(case.M),
    "function": lambda case: lambda b: np.linalg.solve(case.M, b),
    "KSP": ksp,
}
NUMBERS = {
    "numbers": lambda case: case.m,
    "diagonal": lambda case: sp.diags(case.m),
    "Vec": lambda case: PETSc.Vec().createWithArray(case.m[case.unknowns].copy(), comm=case.comm),
}


def same(case, given, type="apgd", law=ccp.COULOMB, expected=None):
    """The result in a form; its velocities, which are unique, are those of the dense N on one rank."""
    with case.problem(**given) as problem:
        result = ccp.solve(problem, type=type, law=law, limits=LIMITS)
        assert result.converged, result.reason
        expected = dense(case, law) if expected is None else expected
        assert case.velocities(result) == pytest.approx(expected, abs=2e-5)
    return result


def dense(case, law):
    with ccp.ConeProblem(SELF, case.r, case.mu, N=case.N) as problem:
        result = ccp.solve(problem, type="apgd", law=law, limits=ccp.Limits(1e-10, closing_work=1e-7))
    assert result.converged
    return result.velocity


@pytest.mark.parametrize("law", ccp.LAWS)
@pytest.mark.parametrize("type", SOLVERS)
def test_every_solver_finds_the_same_in_every_form(type, law):
    """Those that read rows of N are refused for operators, before any work."""
    case = Case(diagonal=law == ccp.COULOMB)
    expected = dense(case, law)
    same(case, {"N": N_FORMS["csr" if law == ccp.COULOMB else "dense Mat"](case)}, type, law, expected)
    same(case, {"G": sp.csr_matrix(case.G), "masses": case.m if law == ccp.COULOMB else case.M}, type, law, expected)
    operator = {"N": PRODUCTS["function"](case)}
    if type in TAKING_PRODUCTS:
        same(case, operator, type, law, expected)
    else:
        with case.problem(**operator) as problem, pytest.raises(ValueError, match=f"'{type}' reads rows of N.*allowed"):
            ccp.solve(problem, type=type, law=law)


@pytest.mark.parallel(1, 2)
def test_all_forms_on_any_ranks():
    comm = MPI.COMM_WORLD
    case, light = Case(1, comm=comm), Case(2, True, comm)
    expected, other = dense(case, ccp.COULOMB), dense(light, ccp.COULOMB)
    forms = {**N_FORMS, **PRODUCTS, **(ON_ONE_RANK if comm.size == 1 else {})}
    for make in forms.values():
        same(case, {"N": make(case)}, expected=expected)
    maps = case.G[case.rows], sp.coo_matrix(case.G[case.rows]), mat(comm, case.G, case.rows, case.unknowns)
    for k, make in enumerate(MASSES.values()):
        same(case, {"G": maps[k % 3], "masses": make(case)}, expected=expected)
    for make in NUMBERS.values():
        same(light, {"G": light.G[light.rows], "masses": make(light)}, expected=other)
    expected = dense(case, ccp.RELAXATION)
    same(case, {"N": PRODUCTS["function"](case)}, "conic", ccp.RELAXATION, expected)
    same(case, {"N": case.N[case.rows]}, "pdip", ccp.RELAXATION, expected)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("most", [100, 10_000])
def test_a_map_whose_N_would_not_fit_is_an_operator(monkeypatch, most):
    monkeypatch.setattr(door, "MOST", most)
    monkeypatch.setattr(door, "BATCH", 6)
    case = Case(3, comm=MPI.COMM_WORLD)
    g = np.random.default_rng(0).normal(size=case.r.shape)[case.own]
    for masses in ("csr", "KSP"):
        problem = case.problem(G=case.G[case.rows], masses=MASSES[masses](case))
        assert problem.has_entries == (most > 100)
        assert problem.diagonal_blocks == pytest.approx(case.blocks)
        assert problem.product(g) == pytest.approx(case.mult(g))


def test_masses_of_joints_keep_N_sparse_and_infinite_ones_do_not_move():
    case = Case(4)
    tree = scipy.linalg.block_diag(*[np.eye(2) + 0.3] * 20)  # twenty robots of two joints
    G = np.kron(np.eye(20), np.ones((3, 2)))
    with ccp.ConeProblem(SELF, np.zeros((20, 3)), np.ones(20), G=G, masses=sp.csr_matrix(tree)) as problem:
        assert len(problem.operator.local.indices) == 20
    m = np.where(np.arange(UNKNOWNS) % 2, np.inf, case.m)
    with case.problem(G=case.G, masses=m) as problem:
        N = case.G @ np.diag(1 / m) @ case.G.T
        g = np.random.default_rng(0).normal(size=case.r.shape)
        assert problem.product(g).ravel() == pytest.approx(N @ g.ravel())


def test_defaults_are_auto_and_coulombs_law():
    case = Case()
    result = ccp.solve(case.problem(N=case.N))
    assert result.law == ccp.COULOMB
    assert result.solver == "apgd"


@pytest.mark.parametrize("kind", ["ilu", "cholesky"])
@pytest.mark.parametrize("type", ["pdip", "conic", "auto"])
def test_a_preconditioner_that_reads_entries_is_refused_for_an_operator(type, kind):
    case = Case()
    PETSc.Options()["ccp_pc_type"] = kind
    with pytest.raises(ValueError, match=f"{kind} reads entries, but N is given by its products; allowed are"):
        ccp.solve(case.problem(N=PRODUCTS["function"](case)), type=type)
    PETSc.Options().delValue("ccp_pc_type")
    newton = ccp.newton_for(SELF, "pdip", compare=ccp.Comparison(SELF, ["none", kind]))
    with pytest.raises(ValueError, match=f"the preconditioner {kind} reads entries"):
        ccp.solve(case.problem(N=PRODUCTS["function"](case)), type="pdip", newton=newton)


@pytest.mark.parametrize("form", ["contact", "kkt", "body"])
def test_newton_systems_go_from_entries_to_products_and_back(form):
    case = Case()
    newton = ccp.newton_for(SELF, "pdip", form)
    limits = ccp.Limits(1e-7, fallback=False)
    for given in [{"N": PRODUCTS["function"](case)}, {"N": case.N}, {"G": case.G, "masses": case.M}] * 2:
        assert ccp.solve(case.problem(**given), None, "pdip", limits, None, newton, ccp.RELAXATION).converged
    newton.destroy()


def check_law(g, y, mu, law):
    """The conditions of optimality in elliptic cones, or of Coulomb's law, by their definition; g, y (nc, 3)."""
    inside = np.divide(g[:, 1:], mu, out=np.zeros_like(mu), where=mu > 0)
    assert (np.abs(g[:, 1:]) * (mu == 0)).max() <= 1e-12
    assert (np.hypot(*inside.T) - g[:, 0]).max() <= 1e-9
    resisted = np.hypot(*(mu * y[:, 1:]).T)
    opening = y[:, 0] + (resisted if law == ccp.COULOMB else 0.0)
    assert (resisted - opening).max() <= 1e-5
    assert np.abs(g[:, 0] * opening + (g[:, 1:] * y[:, 1:]).sum(axis=1)).max() <= 1e-6


@pytest.mark.parametrize("law", ccp.LAWS)
@pytest.mark.parametrize("type", SOLVERS)
def test_friction_per_direction(type, law):
    """Of any two coefficients, of one that is zero, and of both."""
    case = Case(5)
    mu = np.random.default_rng(5).uniform(0.05, 1.0, (CONTACTS, 2))
    mu[:3] = [0.0, 0.5], [0.7, 0.0], [0.0, 0.0]
    given = {"N": case.N}
    if law == ccp.COULOMB:
        products = {"N": ccp.Operator(case.mult, case.blocks)}
        given = products if type in TAKING_PRODUCTS else {"G": case.G, "masses": case.M}
    with ccp.ConeProblem(SELF, case.r, mu, **given) as problem:
        result = ccp.solve(problem, type=type, law=law, limits=LIMITS)
        assert result.converged, result.reason
        case.velocities(result)
        check_law(result.impulse, result.velocity, mu, law)
        again = ccp.measure(problem, result.impulse).natural_residual
        assert again == pytest.approx(result.accuracy.natural_residual, rel=0.1, abs=1e-12)
        again = ccp.solve(problem, result.impulse, type, LIMITS, law=law)
        assert again.iterations <= (0 if type in ("pdip", "conic") else 30)  # it begins at the solution


def test_friction_of_bodies_per_direction():
    known, graph = heap()
    mu = np.stack([known.mu, 0.3 * known.mu], axis=1)
    problem = ccp.ConeProblem(SELF, known.r, mu, G=graph.part(SELF))
    result = ccp.solve(problem, limits=LIMITS)
    assert result.converged
    check_law(result.impulse, result.velocity, mu, ccp.COULOMB)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("law", ccp.LAWS)
def test_equal_friction_in_both_directions_is_that_of_one(law):
    case = Case(6, comm=MPI.COMM_WORLD)
    both = np.stack([case.mu, case.mu], axis=1)[case.own]
    expected = dense(case, law)
    for given in ({"N": case.N[case.rows]}, {"N": ccp.Operator(case.mult, case.blocks)}):
        result = ccp.solve(ccp.ConeProblem(case.comm, case.r[case.own], both, **given), law=law, limits=LIMITS)
        assert case.velocities(result) == pytest.approx(expected, abs=2e-5)


@pytest.mark.parallel(1, 2)
def test_contacts_of_the_plane():
    """They are those of space whose second tangent nothing moves."""
    comm = MPI.COMM_WORLD
    case = Case(7, comm=comm, width=2)
    lift = np.kron(np.eye(CONTACTS), np.eye(3, 2))
    r = (lift @ case.r.ravel()).reshape(-1, 3)
    forms = {
        "N": {"N": case.N[case.rows]},
        "G": {"G": sp.csr_matrix(case.G[case.rows]), "masses": case.M},
        "products": {"N": ccp.Operator(case.mult, case.blocks)},
        "Mat": {"N": mat(comm, case.N, case.rows, case.rows)},
    }
    for law in ccp.LAWS:
        with ccp.ConeProblem(SELF, r, case.mu, N=lift @ case.N @ lift.T) as problem:
            of_space = ccp.solve(problem, type="apgd", law=law, limits=ccp.Limits(1e-10, closing_work=1e-7))
        for name, given in forms.items():
            for type in ("apgd", "conic", "pdip") if comm.size == 1 and name == "G" else ("apgd",):
                result = ccp.solve(case.problem(**given), type=type, law=law, limits=LIMITS)
                assert result.converged
                assert result.impulse.shape == case.r[case.own].shape
                assert (np.abs(result.impulse[:, 1]) <= case.mu[case.own] * result.impulse[:, 0] + 1e-12).all()
                assert case.velocities(result) == pytest.approx(of_space.velocity[:, :2], abs=2e-5)
    problem = case.problem(N=case.N[case.rows], compliance=0.3)
    y = ccp.solve(problem, limits=LIMITS).velocity
    g = ccp.solve(problem, limits=LIMITS).impulse
    every = np.concatenate(comm.allgather(g)).ravel()
    expected = (case.N @ every).reshape(-1, 2)[case.own] + case.r[case.own] + g * [0.3, 0.0]
    assert y == pytest.approx(expected)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("width", [2, 3])
def test_the_same_matrix_with_other_velocities(width):
    case = Case(8, comm=MPI.COMM_WORLD, width=width)
    first = case.problem(G=case.G[case.rows], masses=case.M)
    options = {"type": "pdip", "limits": LIMITS, "law": ccp.RELAXATION}
    before = ccp.solve(first, **options).impulse
    other = first.with_velocities(0.5 * case.r[case.own])
    after = ccp.solve(other, **options)
    assert other.operator is first.operator
    assert 2.0 * case.mult(after.impulse) == pytest.approx(case.mult(before), abs=1e-4)
    assert after.velocity == pytest.approx(case.mult(after.impulse) + 0.5 * case.r[case.own])
    assert ccp.solve(first, **options).impulse == pytest.approx(before)
    for wrong in (case.r[case.own][1:], np.full_like(case.r[case.own], np.nan), np.zeros((5, 4))):
        with pytest.raises(ValueError, match="^r "):
            first.with_velocities(wrong)


class Count:
    """An object of one's own with the members of an `Operator`."""

    def __init__(self, case):
        self.blocks, self.case, self.calls = case.blocks, case, 0

    def mult(self, g):
        self.calls += 1
        return self.case.mult(g)


def test_any_object_with_these_members_is_an_operator():
    case = Case()
    own = Count(case)
    same(case, {"N": own})
    assert own.calls > 10


def refused(words, **given):
    case = Case()
    given = {"r": case.r, "mu": case.mu, **given}
    with pytest.raises(ValueError, match=words):
        ccp.ConeProblem(SELF, **given)


def test_what_is_wrong_is_named():
    case = Case()
    N, G, size = case.N, case.G, len(case.N)
    spoiled, crooked = N.copy(), N.copy()
    spoiled[3, 4] = np.nan
    crooked[2, 7] += 1e-3 * N.max()
    refused(r"N has the shape \(30, 29\); allowed is \(30, 30\)", N=N[:, :-1])
    refused(r"N has the shape \(27, 30\)", N=sp.csr_matrix(N[:-3]))
    refused("N has a NaN or an infinite number", N=spoiled)
    refused("N differs from its transpose by", N=crooked)
    refused("N differs from its transpose by", N=sp.csr_matrix(crooked))
    refused("N differs from its transpose by", N=mat(SELF, crooked, slice(0, size), slice(0, size)))
    refused("N has complex numbers", N=N + 0j)
    refused("N has the type list; allowed are a two-dimensional array, a scipy sparse matrix, a PETSc", N=N.tolist())
    refused("N has the type ndarray", N=N[0])
    refused(r"N.blocks has the shape \(10, 3, 2\)", N=ccp.Operator(case.mult, case.blocks[:, :, :2]))
    refused("N.blocks has a NaN", N=ccp.Operator(case.mult, case.blocks * np.nan))
    refused("N.mult is not symmetric", N=ccp.Operator(lambda g: (crooked @ g.ravel()).reshape(-1, 3), case.blocks))
    refused(r"N.mult returns the shape \(3,\)", N=ccp.Operator(lambda g: np.ones(3), case.blocks))
    refused("N.mult returns a NaN", N=ccp.Operator(lambda g: g * np.nan, case.blocks))
    refused("N.mult has the type int", N=ccp.Operator(3, case.blocks))
    refused(r"G has the shape \(27, 23\); allowed is \(30, n\)", G=G[:-3])
    refused(r"masses: ndarray of shape \(22,\); allowed are \(23,\) or \(23, 23\)", G=G, masses=case.m[1:])
    refused("masses: -1.0 at 0; allowed are numbers > 0", G=G, masses=np.where(np.arange(UNKNOWNS), case.m, -1.0))
    refused("masses: nan at 0", G=G, masses=np.where(np.arange(UNKNOWNS), case.m, np.nan))
    for kind in (np.asarray, sp.csr_matrix):
        refused("masses: a matrix that is not positive definite", G=G, masses=kind(case.M - 20 * np.eye(UNKNOWNS)))
        refused("masses: a matrix that is not positive definite", G=G, masses=kind(np.ones((UNKNOWNS, UNKNOWNS))))
        refused("masses: a matrix that differs from its transpose", G=G, masses=kind(np.triu(case.M)))
    refused("masses: the second part of the factor is an array; allowed", G=G, masses=scipy.linalg.lu_factor(case.M))
    refused("masses: a solve returns a NaN", G=G, masses=lambda b: b * np.nan)
    refused(r"masses: a solve returns the shape \(5,\)", G=G, masses=lambda b: b[:5])
    refused("masses: G M.-1 G' differs from its transpose", G=G, masses=lambda b: np.triu(case.M) @ b)
    refused("masses: N has them already", N=N, masses=case.m)
    refused("mu is -0.5 at contact 4; allowed are finite numbers >= 0", N=N, mu=np.where(np.arange(10) == 4, -0.5, 1))
    refused(r"r is inf at contact 9", N=N, r=np.where(np.arange(30).reshape(10, 3) == 28, np.inf, 1.0))
    refused(r"mu has the shape \(10, 3\); allowed is \(10,\) or \(10, 2\)", N=N, mu=np.ones((10, 3)))
    refused("complex", N=N, r=case.r + 0j)
    refused("compliance of tangents, with friction per", N=N, mu=np.ones((10, 2)), compliance=np.ones((10, 2)))


@pytest.mark.parallel(2)
def test_what_is_wrong_on_one_rank_is_refused_on_all():
    case = Case(comm=MPI.COMM_WORLD)
    one = case.comm.rank == 1
    N, G = case.N[case.rows].copy(), case.G[case.rows]
    N[2, 7] += one * N.max()
    alone = mat(SELF, case.N[case.rows, case.rows], slice(0, 15), slice(0, 15))
    for words, given in (
        ("N differs from its transpose", {"N": N}),
        (r"N has the shape .*on rank 1", {"N": N[one:]}),
        ("G has 22 columns on one rank, and more on another", {"G": G[:, one:]}),
        ("masses: .*on rank 1", {"G": G, "masses": case.m[one:]}),
        ("N is a Mat on other ranks", {"N": alone}),
    ):
        with pytest.raises(ValueError, match=words):
            case.problem(**given)


@pytest.mark.parallel(2)
def test_ranks_that_give_other_kinds_or_fail_alone_end_together():
    case = Case(comm=MPI.COMM_WORLD)
    one = case.comm.rank == 1
    N, G, point = case.N[case.rows], case.G[case.rows], np.zeros((len(case.r[case.own]), 3))
    whole = mat(case.comm, case.N, case.rows, case.rows)
    for words, given in (
        ("N is not given on some ranks, and a matrix on others", {"G": G} if one else {"N": N}),
        ("N is an object of PETSc on some ranks, and a matrix", {"N": N if one else whole}),
        ("N is a function or a factor on some ranks, and a matrix", {"N": N if one else ccp.Operator(case.mult, 0)}),
        ("masses is not given on some", {"G": G} | ({"masses": case.m} if one else {})),
        ("masses is a matrix on some ranks, and a vector on", {"G": G, "masses": case.M if one else case.m}),
        ("point is not given", {"G": G, "point": point if one else None}),
        ("by either the map G or the matrix N .*on rank 1", {} if one else {"N": N}),
    ):
        with pytest.raises(ValueError, match=words):
            case.problem(**given)

    for good in (0, 8):  # it fails as the problem is made, and as it is solved
        scale = iter([1.0] * good + ["none" if one else 1.0] * 99)
        failing = ccp.Operator(lambda g, scale=scale: case.mult(g) * next(scale), case.blocks)
        with pytest.raises(RuntimeError, match=r"N.mult: .*TypeError: .*on rank 1"):
            ccp.solve(case.problem(N=failing), None, "apgd", LIMITS)
    with pytest.raises(RuntimeError, match=r"masses: KeyError: 'one' \(on rank 1\)"):
        case.problem(G=G, masses=lambda b: {}["one"] if one else b)
    with pytest.raises(RuntimeError, match=r"monitor: KeyError: 'one' \(on rank 1\)"):
        ccp.solve(case.problem(N=N), monitor=lambda *at: {}["one"] if one else None)
    with pytest.raises(ValueError, match=r"a guess of no numbers.*on rank 1"):
        ccp.solve(case.problem(N=N), "none" if one else None)


@pytest.mark.parametrize("scale", [1e-310, 1e-150, 1e150, 1e300])
def test_numbers_whose_squares_leave_double_precision_are_refused(scale):
    case = Case()
    one, words = case.problem(N=case.N), "squares of velocities or impulses leave the range of double precision"
    with pytest.raises(ValueError, match=words):
        case.problem(N=scale * case.N)
    with pytest.raises(ValueError, match=words):
        one.with_velocities(scale * case.r)
    with pytest.raises(ValueError, match=words):
        ccp.ConeProblem(SELF, scale * case.r, case.mu, N=case.N)


@pytest.mark.parametrize("power", [-300, 300])
def test_units_within_the_range_change_nothing(power):
    """Powers of two have no rounding, and nothing closes where r is zero."""
    case, size = Case(), 2.0**power
    first, other = (ccp.solve(case.problem(N=c * case.N), limits=LIMITS) for c in (1.0, size))
    assert first.converged
    assert other.converged
    assert np.array_equal(size * other.impulse, first.impulse)
    assert not ccp.solve(case.problem(N=size * case.N).with_velocities(0.0 * case.r)).impulse.any()


def test_friction_that_the_tolerance_does_not_resolve_is_refused():
    """A contact would count as closed by the slip that the tolerance leaves."""
    case = Case()
    problem = ccp.ConeProblem(SELF, case.r, 1e8 * case.mu, N=case.N)
    with pytest.raises(ValueError, match=r"mu .*e\+07 with tol 0.0001: .*allowed is up to 1e\+03"):
        ccp.solve(problem)
    assert ccp.solve(problem, law=ccp.RELAXATION, limits={"max_it": 1}).status is not ccp.Status.BREAKDOWN


def test_calls_with_what_they_cannot_take():
    case = Case()
    problem = case.problem(N=case.N)
    for words, call in {
        "the problem 3: allowed is a ConeProblem": lambda: ccp.solve(3),
        "the problem None: allowed is a ConeProblem": lambda: ccp.measure(None, case.r),
        "newton 'body': allowed is what newton_for": lambda: ccp.solve(problem, newton="body"),
        r"the solver \['apgd'\]: allowed are": lambda: ccp.solve(problem, type=["apgd"]),
        "the solver 'none': allowed are": lambda: ccp.newton_for(SELF, "none"),
        "monitor 3: allowed is a function": lambda: ccp.solve(problem, monitor=3),
        "aim -1: allowed is a number above 0": lambda: ccp.solve(problem, limits={"aim": -1}),
        "cones are of the type list": lambda: ccp.ConeProblem(SELF, case.r, cones=[0.5], N=case.N),
        r"not the first column of N.blocks\[0\]": lambda: case.problem(N=ccp.Operator(case.mult, 2.0 * case.blocks)),
        "comm .*: allowed is a communicator of mpi4py": lambda: ccp.ConeProblem(case.r, case.mu, N=case.N),
    }.items():
        with pytest.raises(ValueError, match=words):
            call()
    for words, call in {
        r"solve: there is no argument 'tol'; .*; limits has it: limits={'tol': ...}": lambda: ccp.solve(problem, tol=1),
        "solve: there is no argument 'gues'; .*; did you mean guess": lambda: ccp.solve(problem, gues=case.r),
        "ConeProblem: there is no argument 'M'; allowed are comm, r": lambda: ccp.ConeProblem(SELF, case.r, M=case.N),
    }.items():
        with pytest.raises(TypeError, match=words):
            call()


def test_an_operator_may_change_its_argument():
    case = Case()

    def in_place(g):
        g[:] = case.mult(g)
        return g

    one, other = (ccp.solve(case.problem(N=ccp.Operator(mult, case.blocks))) for mult in (case.mult, in_place))
    assert np.array_equal(one.impulse, other.impulse)
