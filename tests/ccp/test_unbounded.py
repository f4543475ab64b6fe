"""Cone problems without a solution are named so, and those with large impulses are not."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from problems import SELF, from_graph, from_matrix, heap, matrix

from pctt import ccp
from pctt.ccp import BlockRows, Limits, Status
from pctt.ccp.cones.friction import project
from pctt.ccp.unbounded import why_unbounded

SOLVERS = pytest.mark.parametrize("solver", ["conic", "pdip", "apgd", "auto"])


def squeezed(closing, angle: float, mu: float, compliance: float = 0.0) -> ccp.ConeProblem:
    """A sphere of mass 1 and radius 0.1 in a wedge of two walls, each turned by ``angle`` from facing the other. They
    come nearer at ``closing`` (two speeds)."""
    blocks = []
    for side in (1.0, -1.0):
        normal = np.array([side * np.cos(angle), np.sin(angle), 0.0])
        frame = np.stack([normal, [-normal[1], normal[0], 0.0], [0.0, 0.0, 1.0]])
        blocks.append(np.hstack([frame, np.cross(-0.1 * normal, frame) / (0.1 * np.sqrt(0.4))]))
    G = BlockRows(np.arange(3), np.zeros(2, int), np.array(blocks), 1)
    r = np.array([[-speed, 0.0, 0.0] for speed in closing])
    return ccp.ConeProblem(SELF, r, np.full(2, mu), G=G, compliance=compliance)


@SOLVERS
@pytest.mark.parametrize(
    ("closing", "angle", "mu"),
    [
        ((1.0, 1.0), 0.0, 0.5),
        ((1.0, 1.0), 0.0, 0.0),
        ((1.0, 1.0), 0.3, 0.5),  # friction holds it: the cones have opposite directions, mu > tan 0.3
        ((1.0, 0.0), 0.3, 0.5),
        ((1.0, -0.5), 0.0, 0.5),
    ],
    ids=["between parallel walls", "without friction", "in a wedge", "one wall moves", "one follows too slowly"],
)
def test_a_sphere_that_cannot_get_out_of_closing_walls(solver, closing, angle, mu):
    for units in (1.0, 2.0**20):
        problem = squeezed(np.multiply(closing, units), angle, mu)
        result = ccp.solve(problem, type=solver, limits=Limits(1e-6), law=ccp.RELAXATION)
        assert not result.converged
        assert result.status is Status.UNBOUNDED
        assert result.reason.startswith("unbounded: ")


@SOLVERS
@pytest.mark.parametrize(
    ("closing", "angle", "mu"),
    [
        ((1.0, 1.0), 0.3, 0.2),  # it slips out: mu < tan 0.3
        ((1.0, 1.0), 0.3, 0.305),  # just so: tan 0.3 = 0.30934
        ((1.0, -1.0), 0.0, 0.5),  # the walls move together, and any pressure between them is a solution
        ((1.0, -2.0), 0.0, 0.5),
    ],
    ids=["it slips out", "it just slips out", "walls move together", "one wall flees"],
)
def test_a_sphere_that_can(solver, closing, angle, mu):
    problem = squeezed(closing, angle, mu)
    result = ccp.solve(problem, type=solver, limits=Limits(1e-4), law=ccp.RELAXATION)
    assert result.converged, result.reason
    assert "unbounded" not in result.reason
    assert ccp.measure(problem, result.impulse).natural_residual <= 1.01e-4


@SOLVERS
def test_any_compliance_makes_it_bounded(solver):
    problem = squeezed((1.0, 1.0), 0.0, 0.5, compliance=1e-3)
    result = ccp.solve(problem, type=solver, limits=Limits(1e-7), law=ccp.RELAXATION)
    assert result.converged, result.reason
    # each of both yields with closing speed 1 = C_n g_n
    assert result.impulse[:, 0] == pytest.approx(1.0 / problem.compliance[:, 0], rel=1e-3)


def test_self_stress_of_any_size_is_no_sign_of_it():
    problem = squeezed((1.0, -1.0), 0.0, 0.5)
    for size in (1.0, 1e6, 1e12):
        assert why_unbounded(problem, np.array([[size, 0, 0], [size - 0.1, 0, 0]])) == ""
    known, graph = heap(bodies=4)  # 120 impulses on 24 velocities
    for each in (from_graph(known, graph), from_matrix(known)):
        assert why_unbounded(each, known.g) == ""
        assert why_unbounded(each, np.zeros_like(known.g)) == ""


@pytest.mark.parametrize("seed", range(6))
def test_problems_with_a_solution_are_never_named(seed):
    """Few bodies with many contacts, of a mass ratio of 1e4: much self-stress. Any impulses in the cones."""
    known, graph = heap(seed, bodies=3 + seed, mass_ratio=1e4)
    problem = from_graph(known, graph)
    rng = np.random.default_rng(seed)
    for size in (1e-3, 1.0, 1e3, 1e9):
        g = project(known.g + size * rng.normal(size=known.g.shape), known.mu)
        assert why_unbounded(problem, g) == ""


def body_on(contacts, mass):
    """Blocks of G of one body, for contacts that push it up or down at their place: (sign, place)."""
    normal = [np.array([0.0, 0.0, sign]) for sign, _ in contacts]
    frame = [np.stack([n, [1.0, 0, 0], np.cross(n, [1.0, 0, 0])]) for n in normal]
    turns = [np.cross(place, f) / np.sqrt(0.4) for (_, place), f in zip(contacts, frame)]
    return [np.hstack(pair) / np.sqrt(mass) for pair in zip(frame, turns)]


@SOLVERS
def test_a_heavy_body_is_no_sign_of_it(solver):
    """A sphere of mass ``ratio`` strikes the ground beside fifty of mass 1: it needs the impulse ratio. And one of mass
    1 lies under a press of mass ``ratio`` that comes down: the ground bears both."""
    ratio, down = 1e8, (1.0, np.array([0.0, 0.0, -1.0]))
    blocks = np.array([body_on([down], mass)[0] for mass in [1.0] * 50 + [ratio]])
    r = np.tile([-1.0, 0.0, 0.0], (51, 1))
    beside = ccp.ConeProblem(SELF, r, np.full(51, 0.5), G=BlockRows(np.arange(52), np.arange(51), blocks, 51))
    (light, top), (press,) = body_on([down, (-1.0, np.array([0.0, 0, 1.0]))], 1.0), body_on([(1.0, np.zeros(3))], ratio)
    under = ccp.ConeProblem(
        SELF, np.array([[0.0, 0, 0], [-1.0, 0, 0]]), np.full(2, 0.5),
        G=BlockRows(np.array([0, 1, 3]), np.array([0, 0, 1]), np.array([light, top, press]), 2),
    )  # fmt: skip
    for problem, known in ((beside, ratio), (under, ratio)):
        result = ccp.solve(problem, type=solver, limits=Limits(1e-6), law=ccp.RELAXATION)
        assert result.status is not Status.UNBOUNDED, result.reason
        g = np.zeros_like(problem.r)
        g[:, 0] = known if problem is under else np.append(np.ones(50), ratio)
        assert why_unbounded(problem, g) == ""


@pytest.mark.parametrize("solver", ["pdip", "apgd", "barzilai_borwein", "spectral", "kucera", "gpminres"])
@pytest.mark.parametrize("mass", [1e-7, 1e-8])
def test_a_solution_is_no_sign_of_it_where_a_matrix_knows_no_bodies(solver, mass):
    """A light body between two of mass 1 that close on it."""
    part = 1.0 / mass
    N = np.zeros((6, 6))
    N[::3, ::3] = [[1.0 + part, -part], [-part, 1.0 + part]]
    problem = ccp.ConeProblem(SELF, np.array([[-1.0, 0.0, 0.0]] * 2), np.zeros(2), N=N)
    result = ccp.solve(problem, type=solver, limits=Limits(1e-10, closing_work=np.inf), law=ccp.RELAXATION)
    assert result.converged, result.reason
    assert result.impulse[:, 0] == pytest.approx([1.0, 1.0], rel=1e-2)


@SOLVERS
@pytest.mark.parametrize("speed", [1e-100, 1e-60])
def test_the_unit_of_speeds_does_not_matter(solver, speed):
    problem = squeezed((speed, speed), 0.3, 0.2)
    assert ccp.solve(problem, type=solver, limits=Limits(1e-4), law=ccp.RELAXATION).converged
    problem = squeezed((speed, speed), 0.0, 0.5)
    assert ccp.solve(problem, type=solver, limits=Limits(1e-6), law=ccp.RELAXATION).status is Status.UNBOUNDED


def test_a_problem_given_by_its_matrix_is_recognised_too():
    """Two contacts with N = (1, -1; -1, 1) in their normals."""
    N = np.kron(np.eye(2), np.diag([1.0, 1.0, 1.0]))
    N[0, 3] = N[3, 0] = -1.0
    problem = ccp.ConeProblem(SELF, np.array([[-1.0, 0, 0], [0.5, 0, 0]]), np.full(2, 0.5), N=matrix(SELF, N))
    for solver in ("conic", "pdip", "apgd"):
        result = ccp.solve(problem, type=solver, limits=Limits(1e-6), law=ccp.RELAXATION)
        assert (result.converged, result.reason.split(":")[0]) == (False, "unbounded")


def test_coulombs_law_says_so_at_once():
    result = ccp.solve(squeezed((1.0, 1.0), 0.0, 0.5), type="apgd", limits=Limits(1e-6), law=ccp.COULOMB)
    assert not result.converged
    assert result.reason.startswith("unbounded: ")
    assert result.cone_problems < 20


@pytest.mark.parametrize("solver", ["auto", "apgd", "conic", "pdip", "kucera"])
def test_where_the_relaxation_has_no_solution_and_coulombs_law_has_one(solver):
    """A body between two belts that run against each other, with play: sliding contacts of the relaxation open, on both
    sides by more than the play. By Coulomb's law the lower belt lifts it and rubs, and the upper one is not touched."""
    G = np.zeros((6, 2))  # velocities up and along of a body of mass 1
    G[0], G[1], G[3], G[4] = (1, 0), (0, 1), (-1, 0), (0, 1)
    problem = ccp.ConeProblem(SELF, np.array([[-1.0, 3, 0], [2, -3, 0]]), np.full(2, 0.5), G=G, masses=np.ones(2))
    result = ccp.solve(problem, type=solver, limits=Limits(1e-6), law=ccp.COULOMB)
    assert result.converged, result.reason
    np.testing.assert_allclose(result.impulse, [[1, -0.5, 0], [0, 0, 0]], atol=1e-5)
    relaxed = ccp.solve(problem, type=solver, limits=Limits(1e-6), law=ccp.RELAXATION)
    assert relaxed.status is Status.UNBOUNDED


@pytest.mark.parametrize("solver", ["conic", "auto"])
def test_impulses_that_grow_by_newtons_method_say_nothing_of_coulombs_law(solver):
    """Of contacts that are drawn with their impulses and velocities, many more than the unknowns."""
    rng = np.random.default_rng(43)
    slip, normal, state = rng.standard_normal((8, 2)), rng.random((2, 8)), np.arange(8) % 3  # open, slides, sticks
    G, slip = rng.standard_normal((24, 5)), slip / np.hypot(*slip.T)[:, None]
    g, y = np.zeros((2, 8, 3))
    g[:, 0], y[:, 0] = (state > 0) * normal[0], (state == 0) * normal[0]
    g[:, 1:] = -0.5 * (g[:, 0] * np.where(state == 2, normal[1], 1.0))[:, None] * slip
    y[:, 1:] = (state < 2)[:, None] * slip
    problem = ccp.ConeProblem(SELF, y - (G @ G.T @ g.ravel()).reshape(-1, 3), np.full(8, 0.5), N=G @ G.T)
    result = ccp.solve(problem, type=solver, limits=Limits(1e-8))
    assert result.converged, result.reason
    assert result.accuracy.coulomb_residual <= 1e-8


def test_a_wedge_that_holds_by_friction_has_no_solution_by_either_way_to_coulombs_law():
    """The sequence of cone problems and the method that is asked after it agree."""
    result = ccp.solve(squeezed((1.0, 1.0), 0.3, 0.5), type="pdip", limits=Limits(1e-6), law=ccp.COULOMB)
    assert result.status is Status.UNBOUNDED
    assert result.asked is not None


@pytest.mark.parallel(1, 2)
def test_one_squeezed_sphere_among_many_contacts_on_several_ranks():
    comm = MPI.COMM_WORLD
    known, graph = heap()
    problem = from_graph(known, graph, comm)
    # a sphere of its own between two walls, on the last rank
    G, last = problem.contact_map.source, comm.rank == comm.size - 1
    blocks = [np.hstack([side * np.eye(3), np.zeros((3, 3))]) for side in (1.0, -1.0)]
    r, mu, indptr, indices, data = problem.r, problem.mu, G.indptr, G.indices, G.blocks
    if last:
        r, mu = np.concatenate([r, [[-1.0, 0, 0]] * 2]), np.concatenate([mu, [0.5, 0.5]])
        indptr = np.concatenate([indptr, indptr[-1] + np.array([1, 2])])
        indices, data = np.concatenate([indices, [graph.bodies] * 2]), np.concatenate([data, blocks])
    squeezed = ccp.ConeProblem(comm, r, mu, G=BlockRows(indptr, indices, data, G.columns + last))
    words = [ccp.solve(
        squeezed, type=name, limits=Limits(1e-6), law=ccp.RELAXATION
    ).reason.split(":")[0] for name in ("conic", "apgd")]
    assert comm.allgather(words) == [words] * comm.size
    nothing = problem.natural_residual(np.full_like(problem.r, np.nan if comm.rank == 0 else 1.0), problem.r)
    assert words == ["unbounded", "unbounded"]
    assert nothing == np.inf


@pytest.mark.parametrize("law", ccp.LAWS)
@pytest.mark.parametrize("solver", ["pdip", "conic", "auto", "apgd", "kucera"])
def test_a_contact_that_no_impulse_moves(solver, law):
    """N has zeros in its rows: it must not close. With the relaxation it must not slide either; a small block of N is
    no zero."""
    rng = np.random.default_rng(0)
    B = rng.normal(size=(15, 20))
    r, limits = rng.normal(size=(5, 3)), Limits(1e-8)

    def solved(small, fixed):
        B[6:9] = small * rng.normal(size=(3, 20))
        r[2] = fixed
        return ccp.solve(ccp.ConeProblem(SELF, r, np.full(5, 0.4), N=B @ B.T), None, solver, limits, law=law)

    closes = solved(0.0, [-0.3, 0.1, 0.2])
    assert closes.status is Status.UNBOUNDED
    assert "no impulse moves 1 contacts, which close" in closes.reason
    slides = solved(0.0, [0.1, 0.6, 0.8])
    if law == ccp.COULOMB:
        assert slides.final
        assert slides.status is not Status.UNBOUNDED
    else:
        assert slides.status is Status.UNBOUNDED
    assert solved(0.0, [0.5, 0.6, 0.8]).converged
    assert solved(1e-4, [-0.3, 0.1, 0.2]).converged


@pytest.mark.parametrize("law", ccp.LAWS)
@pytest.mark.parametrize("solver", ccp.SOLVERS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_an_indefinite_N_is_a_status(solver, law):
    for seed, share in ((0, 1e-2), (2, 1.0)):
        rng = np.random.default_rng(seed)
        A = rng.normal(size=(12, 12))
        values, V = np.linalg.eigh(A @ A.T)
        values[:4] = -share * values[-1]
        N = V @ np.diag(values) @ V.T
        result = ccp.solve(ccp.ConeProblem(SELF, rng.normal(size=(4, 3)), np.full(4, 0.5), N=N), type=solver, law=law)
        assert isinstance(result.status, Status)
        assert np.isfinite(result.impulse).all()
        assert not result.converged, result.reason
    N = np.eye(6)
    N[0, 0] = -1.0
    result = ccp.solve(ccp.ConeProblem(SELF, -np.ones((2, 3)), np.full(2, 0.5), N=N), type=solver, law=law)
    assert result.status in (Status.UNBOUNDED, Status.BREAKDOWN), result.reason


@pytest.mark.parametrize("given", ["matrix", "operator", "masses"])
@pytest.mark.parametrize("solver", ["auto", "pdip", "gauss_seidel"])
def test_no_solver_converges_silently_where_N_is_indefinite(solver, given):
    """Its one negative direction is of a contact that opens: no iterate meets it."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(90, 40))
    N = A @ A.T
    r = rng.normal(size=(30, 3)) - [0.5, 0, 0]
    r[4] = [50.0, 0, 0]
    free = ccp.solve(ccp.ConeProblem(SELF, r, np.full(30, 0.4), N=N), type="conic", law=ccp.RELAXATION)
    assert free.converged
    assert free.states[4] == 0
    N[12:15] = N[:, 12:15] = 0.0
    N[[12, 13, 14], [12, 13, 14]] = [100.0, 100.0, -1.0]
    if given == "operator":
        if solver == "gauss_seidel":
            return
        N = ccp.Operator(lambda g: (dense @ g.ravel()).reshape(-1, 3), np.array(diagonal(dense := N)))
    made = {"N": N} if given != "masses" else {"G": np.eye(90), "masses": lambda b: N @ b}
    result = ccp.solve(ccp.ConeProblem(SELF, r, np.full(30, 0.4), **made), type=solver, law=ccp.RELAXATION)
    assert result.status is Status.BREAKDOWN
    assert "N is indefinite" in result.reason
    if given == "matrix":  # without friction nothing moves along the tangents
        smooth = ccp.ConeProblem(SELF, r, np.where(np.arange(30) == 4, 0.0, 0.4), **made)
        assert ccp.solve(smooth, type=solver, law=ccp.RELAXATION).converged


def test_the_curvature_is_looked_for_once_for_all_load_steps():
    products = []
    dense = np.diag(np.arange(1.0, 31.0))
    mult = ccp.Operator(lambda g: products.append(0) or (dense @ g.ravel()).reshape(-1, 3), np.array(diagonal(dense)))
    problem = ccp.ConeProblem(SELF, np.tile([-1.0, 0.2, 0.0], (10, 1)), np.full(10, 0.4), N=mult)
    counts = []
    for load in (1.0, 1.5, 2.0):
        products.clear()
        assert ccp.solve(problem.with_velocities(load * problem.r), None, "apgd", law=ccp.RELAXATION).converged
        counts.append(len(products))
    assert counts[0] >= counts[1] + 10
    assert counts[1] == counts[2]


def diagonal(N):
    return [N[3 * c : 3 * c + 3, 3 * c : 3 * c + 3] for c in range(len(N) // 3)]


@pytest.mark.parametrize("seed", [11, 12, 13])
@pytest.mark.parametrize("solver", ["auto", "apgd"])
def test_steps_meet_a_negative_direction_that_lanczos_has_missed(solver, seed):
    rng = np.random.default_rng(seed)
    values = 10.0 ** rng.uniform(-6, 0, 300)
    values[:2] = 1.0, -0.08
    Q = np.linalg.qr(rng.standard_normal((300, 300)))[0]
    N = (Q * values) @ Q.T
    given = ccp.Operator(lambda g: (N @ g.ravel()).reshape(-1, 3), np.array(diagonal(N)))
    problem = ccp.ConeProblem(SELF, rng.normal(size=(100, 3)), np.full(100, 0.5), N=given)
    problem._curvature.append(0.0)
    result = ccp.solve(problem, type=solver, law=ccp.RELAXATION)
    assert result.status in (Status.BREAKDOWN, Status.UNBOUNDED)
    assert "N is indefinite" in result.reason
