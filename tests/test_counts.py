"""Speed is tested by counts, which do not depend on the clock: none may grow by more than 15 %.

Problems are of fixed seeds. Counts are sums over several of them, as last bits change one of them a little. Who makes
the methods better puts the new numbers into the table.
"""

from __future__ import annotations

import sys
import tracemalloc
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from petsc4py import PETSc
from problems import SELF, Known, from_graph, heap, random_graph
from train_solver import context, poisson, ready, solve

import pctt.simulation  # now: loops that are made while `steps` counts calls would not work later
from dem.compiled import Loop
from dem.contact_map import ContactMap
from dem.scene import Scene
from dem.shapes import Plane
from pctt import ccp, tt
from pctt.ccp import fclib
from pctt.ccp.newton import by_elimination, factor
from pctt.mat import from_differences
from pctt.tt.conjugate import ConjugateGradients
from pctt.tt.differences import Differences, FastInverse

HARD = sorted((Path(__file__).parent / "ccp" / "hard").glob("*.h5"))
MOST = {  # the sums, as counted
    "methods": {
        "apgd, relaxation, stored": {"iterations": 121},
        "apgd, relaxation, heaps": {"iterations": 912},
        "apgd, relaxation, wide masses": {"iterations": 888},
        "conic, relaxation, stored": {"iterations": 20, "Krylov steps": 40},
        "conic, relaxation, heaps": {"iterations": 102, "Krylov steps": 205},
        "conic, relaxation, wide masses": {"iterations": 102, "Krylov steps": 204},
        "pdip, relaxation, stored": {"iterations": 40, "Krylov steps": 491},
        "pdip, relaxation, heaps": {"iterations": 239, "Krylov steps": 2893},
        "auto, relaxation, stored": {"iterations": 198, "Krylov steps": 16, "Newton steps": 8},
        "auto, relaxation, heaps": {"iterations": 1420, "Krylov steps": 160, "Newton steps": 80},
        "auto, relaxation, wide masses": {"iterations": 1430, "Krylov steps": 162, "Newton steps": 81},
        "barzilai_borwein, relaxation, stored": {"iterations": 200},
        "barzilai_borwein, relaxation, heaps": {"iterations": 1180},
        "gauss_seidel, relaxation, stored": {"iterations": 180},
        "gauss_seidel, relaxation, heaps": {"iterations": 1840},
        "apgd, coulomb, stored": {"iterations": 101},
        "apgd, coulomb, heaps": {"iterations": 962},
        "apgd, coulomb, wide masses": {"iterations": 1157},
        "conic, coulomb, stored": {"iterations": 26, "Krylov steps": 55},
        "conic, coulomb, heaps": {"iterations": 128, "Krylov steps": 264},
        "conic, coulomb, wide masses": {"iterations": 137, "Krylov steps": 284},
        "auto, coulomb, stored": {"iterations": 103},
        "auto, coulomb, heaps": {"iterations": 1067, "Krylov steps": 22, "Newton steps": 11},
        "auto, coulomb, wide masses": {"iterations": 930, "Krylov steps": 24, "Newton steps": 12},
        "barzilai_borwein, coulomb, stored": {"iterations": 380, "more cone problems": 12},
        "barzilai_borwein, coulomb, heaps": {"iterations": 3180, "more cone problems": 117},
        "conic, coulomb, wedged": {"iterations": 103, "Krylov steps": 236},
        "conic, relaxation, wedged": {"iterations": 66, "Krylov steps": 168},
        "auto, 400 contacts": {"iterations": 653},
        "auto, 1e-7": {"iterations": 4400, "Krylov steps": 241, "Newton steps": 120},
        "a jam comes loose": {"iterations": 100, "Krylov steps": 598},
    },
    "systems": {
        "pdip, contact": {"iterations": 87, "Krylov steps": 1225, "PCSetUp": 87, "PCApply": 2549},
        "conic, contact": {"iterations": 41, "Krylov steps": 1021, "PCSetUp": 41, "PCApply": 2125},
        "pdip, body": {"iterations": 87, "Krylov steps": 846, "PCSetUp": 45, "PCApply": 80},
        "conic, body": {"iterations": 42, "Krylov steps": 973, "PCSetUp": 10, "PCApply": 22},
        "pdip, factor": {"iterations": 88, "Krylov steps": 189, "PCSetUp": 88, "PCApply": 189},
        "conic, factor": {"iterations": 41, "Krylov steps": 81, "PCSetUp": 41, "PCApply": 81},
        "pdip, short": {"iterations": 87, "Krylov steps": 980, "fallbacks": 50, "PCSetUp": 136, "PCApply": 2056},
        "conic, short": {"iterations": 41, "Krylov steps": 901, "fallbacks": 48, "PCSetUp": 73, "PCApply": 1884},
        "pdip, petsc": {"iterations": 87, "Krylov steps": 106, "PCSetUp": 87, "PCApply": 106},
        "conic, petsc": {"iterations": 41, "Krylov steps": 81, "PCSetUp": 41, "PCApply": 81},
    },
    "trains": {
        "cross": {"evaluations": 160235, "sweeps": 10, "ranks": 345, "error [1e-4]": 9},
        "inverse": {"ranks": 702, "sweeps": 17, "residual [1e-4]": 48},
    },
    "preconditioners": {
        "a matrix that changes, none": {"steps": 35, "new trains": 4},
        "a matrix that changes, cores": {"steps": 35, "new trains": 4},
        "a matrix that changes, trains": {"steps": 86, "new trains": 2},
        "transforms by choice": {"steps": 11},
        "three quarters of a cosine transform": {"steps": 127},
    },
    "steps": {
        "thrown": {
            "calls of compiled loops": 36266, "contacts of the search": 16022, "pairs in lists": 42084, "new lists": 6,
            "iterations": 5685, "cone problems": 100,
        },
        "halves of products": {"_set_velocities": 8350, "_push": 8090},
        "falling": {
            "calls of compiled loops": 18193, "contacts of the search": 10995, "pairs in lists": 20357, "new lists": 4,
            "iterations": 1998, "Newton steps": 12, "cone problems": 100,
        },
    },
    "flows": {"a sheared cell": {"iterations": 1881}},
    "memory": {"a bed": {"bytes of a grain": 3282}},
    "calls": {
        "ten boxes": {"functions of Python": 20455}, "a pendulum": {"functions of Python": 17647},
        "ten balls at rest": {"functions of Python": 15391},
    },
}  # fmt: skip


def tally(name: str, results: Iterable[ccp.Result]) -> Counter[str]:
    """The sums over results that all have converged."""
    counts: Counter[str] = Counter()
    for result in results:
        assert result.converged, result.reason
        each = {"iterations": result.iterations, "Krylov steps": result.ksp_its, "fallbacks": result.fallbacks}
        each["more cone problems"] = result.cone_problems - 1
        if result.newton_its != result.iterations:  # of which one costs as much as ten iterations of APGD or more
            each["Newton steps"] = result.newton_its
            each["iterations"] += 9 * result.newton_its
        counts.update({f"{name}: {what}": count for what, count in each.items()})
    return counts


def stored() -> list[tuple[ccp.ConeProblem, np.ndarray]]:
    """Hard steps, with their first guesses."""
    problems = [fclib.load(path, SELF) for path in HARD]
    return [(each.problem, each.guess) for each in problems]


def heaps(count: int = 10, contacts: int = 60, bodies: int = 30, **more) -> list[tuple[ccp.ConeProblem, None]]:
    """Random problems."""
    return [(from_graph(*heap(seed, contacts, bodies, **more)), None) for seed in range(count)]


def wedged(count: int = 8, contacts: int = 60, bodies: int = 6) -> list[tuple[ccp.ConeProblem, None]]:
    """Few bodies that move against many contacts, which may hold each other."""
    problems = []
    for seed in range(count):
        graph = random_graph(seed, contacts, bodies)
        r = graph.dense() @ np.random.default_rng(seed).normal(size=6 * bodies)
        problems.append((from_graph(Known(None, r.reshape(-1, 3), np.full(contacts, 0.3), None, None), graph), None))
    return problems


def methods(patch: pytest.MonkeyPatch) -> Counter[str]:
    """All methods with either law; fixed points of De Saxce's terms by a method without the law."""
    counts: Counter[str] = Counter()
    problems = {"stored": stored(), "heaps": heaps(), "wide masses": heaps(mass_ratio=1e3)}
    cases = [(ccp.RELAXATION, each) for each in ("apgd", "conic", "pdip", "auto", "barzilai_borwein", "gauss_seidel")]
    cases += [(ccp.COULOMB, each) for each in ("apgd", "conic", "auto", "barzilai_borwein")]
    for law, method in cases:
        limits = ccp.Limits(1e-5 if method in ("conic", "pdip") else 1e-4)
        dear = method in ("barzilai_borwein", "pdip", "gauss_seidel")
        for name, each in list(problems.items())[: 2 if dear else 3]:
            solved = (ccp.solve(*given, type=method, law=law, limits=limits) for given in each)
            counts += tally(f"{method}, {law}, {name}", solved)
    for law in ccp.LAWS:
        solved = (ccp.solve(*given, type="conic", law=law, limits=ccp.Limits(1e-6)) for given in wedged())
        counts += tally(f"conic, {law}, wedged", solved)
    exact = (ccp.solve(*given, type="auto", law=law, limits=ccp.Limits(1e-7)) for given in heaps() for law in ccp.LAWS)
    counts += tally("auto, 1e-7", exact)
    larger = (ccp.solve(*given, type="auto", law=law) for given in heaps(3, 400, 200) for law in ccp.LAWS)
    counts += tally("auto, 400 contacts", larger)
    loose = []
    for seed, (problem, _) in enumerate(heaps(4, bodies=50)):
        guess = np.zeros_like(problem.r)
        guess[:, 0] = 1e6 * np.random.default_rng(seed).uniform(0.5, 2.0, len(guess))
        loose += [ccp.solve(problem, guess, type=method, law=ccp.RELAXATION) for method in ("pdip", "conic")]
    return counts + tally("a jam comes loose", loose)


def systems(patch: pytest.MonkeyPatch) -> Counter[str]:
    """Newton systems of one object for several problems, in each form, by Krylov methods, factors and fallbacks."""
    patch.setattr(by_elimination, "FEW", 0)
    PETSc.Log.begin()
    events = {name: PETSc.Log.Event(name) for name in ("PCSetUp", "PCApply")}
    before = events["PCSetUp"].getPerfInfo()["count"]
    pc = PETSc.PC().create(SELF)
    pc.setOperators(PETSc.Mat().createDense((1, 1), array=[[1.0]], comm=SELF))
    pc.setUp()
    if events["PCSetUp"].getPerfInfo()["count"] == before:
        pytest.skip("an error in a set-up, of another test, has ended PETSc's counts in this process")
    counts: Counter[str] = Counter()
    cases = {
        "contact": ("contact", {}), "body": ("body", {}), "factor": ("body", {"EASY": 0.1}),
        "short": ("contact", {"ccp_ksp_max_it": 12}), "petsc": ("body", {"ccp_pc_type": "cholesky"}),
    }  # fmt: skip
    for name, (form, changes) in cases.items():
        for method in ("pdip", "conic"):
            with pytest.MonkeyPatch.context() as more:
                for key, value in changes.items():
                    if key.startswith("ccp_"):
                        PETSc.Options()[key] = value
                    else:
                        more.setattr(factor, key, value)
                newton = ccp.Newton(SELF, form)
                before = {event: log.getPerfInfo()["count"] for event, log in events.items()}
                problems = [*stored(), *heaps(2, 100, 50, mass_ratio=100.0)]
                solved = [
                    ccp.solve(*given, type=method, law=ccp.RELAXATION, newton=newton, limits=ccp.Limits(1e-5))
                    for given in problems
                ]
                counts += tally(f"{method}, {name}", solved)
                for event, log in events.items():
                    counts[f"{method}, {name}: {event}"] = log.getPerfInfo()["count"] - before[event]
                newton.destroy()
                for key in changes:
                    PETSc.Options().delValue(key)
    return counts


def trains(patch: pytest.MonkeyPatch) -> Counter[str]:
    """Ranks, evaluations and sweeps of trains, and steps of conjugate gradients with them."""
    counts: Counter[str] = Counter()

    def entries(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        apart = np.subtract(np.unravel_index(i, (32, 32)), np.unravel_index(j, (32, 32))) / 32
        return 2.0 * (i == j) + np.exp(-np.sqrt((apart**2).sum(axis=0)) / 0.3)

    for seed in range(5):
        rng = np.random.default_rng(seed)
        cross = tt.compress_cross(tt.EntryMatrix(entries, tt.GridDigits((32, 32))), 30, 1e-3, rng=rng)
        line = sp.diags([-1.0, 2.0 + 0.1 * rng.random(32), -1.0], [-1, 0, 1], shape=(32, 32))
        laplacian = (sp.kronsum(line, line) + sp.identity(1024) / 32).toarray()
        inverse = tt.invert(tt.decompose_matrix(laplacian, (2,) * 10, eps=1e-12), 60, sweeps=20, eps=1e-3, rng=rng)
        counts["cross: evaluations"] += cross.evaluations
        counts["cross: sweeps"] += cross.sweeps
        counts["cross: ranks"] += sum(cross.train.ranks)
        counts["cross: error [1e-4]"] += round(1e4 * cross.error)
        counts["inverse: ranks"] += sum(inverse.train.ranks)
        counts["inverse: sweeps"] += inverse.sweeps
        counts["inverse: residual [1e-4]"] += round(1e4 * inverse.residual)
    return counts


def preconditioners(patch: pytest.MonkeyPatch) -> Counter[str]:
    """Steps of conjugate gradients with trains that are kept or new, and with transforms."""
    counts: Counter[str] = Counter()
    for reuse in ("none", "cores", "trains"):
        mat = poisson(24)
        ksp = ready(mat, rank=10, reuse=reuse)
        for shift in (0.0, 0.3, 0.0, 0.0, 1.0, 0.0, 0.0, 3.0):
            mat.shift(shift)
            steps, left = solve(ksp)
            assert left < 1e-6
            counts[f"a matrix that changes, {reuse}: steps"] += steps
        account = context(ksp).account
        counts[f"a matrix that changes, {reuse}: new trains"] = account.setups - account.kept
    for length in (1.0, 10.0):
        ksp = ready(from_differences(lambda s, length=length: np.exp(-np.sqrt((s**2).sum(axis=0)) / length), (24, 20)))
        counts["transforms by choice: steps"] += solve(ksp)[0]
        away = np.sqrt((np.indices((40, 40)) ** 2.0).sum(axis=0)) / (3 * length)
        a = Differences.of_even((1 + away) * np.exp(-away))
        b, mean = np.random.default_rng(0).standard_normal(1600), FastInverse(a, (("cosine", 0.75), ("sine", 0.25)))
        run = ConjugateGradients(a.times, b, mean.solve)
        while run.norms[-1] > 1e-8 * run.norms[0]:
            run.step()
        counts["three quarters of a cosine transform: steps"] += len(run.norms)
    return counts


def steps(patch: pytest.MonkeyPatch) -> Counter[str]:
    """Of a falling, then a resting heap: what the search finds, how often it looks, and what is called."""
    counts: Counter[str] = Counter()

    def counted(self, *arguments):
        counts[f"{name}: calls of compiled loops"] += 1
        return self.compiled(*arguments)

    def half_of_products(name):
        half = getattr(ContactMap, name)

        def found(self, *arguments):
            counts[f"halves of products: {name}"] += 1
            half(self, *arguments)

        return found

    patch.setattr(Loop, "__call__", counted)
    for name in ("_set_velocities", "_push"):
        patch.setattr(ContactMap, name, half_of_products(name))
    for name, seed in (("thrown", 0), ("thrown", 1), ("falling", 2), ("falling", 3)):
        rng = np.random.default_rng(seed)
        scene = Scene(friction=0.4)
        grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        place = 0.105 + 0.21 * grid + rng.uniform(-0.005, 0.005, grid.shape)
        speed = rng.normal(0, 2.0, grid.shape) * (name == "thrown")
        scene.add_spheres(place, 0.1, 1000.0, velocity=speed)
        scene.add_body("walls", [Plane((0, 0, 1)), *(Plane(n, p) for n, p in WALLS)])
        with pctt.Simulation(scene, dt=0.005, say=lambda _: None) as sim:
            for _ in range(50):
                before = sim.world.lists
                sim.run(steps=1)
                lists = sim.world.lists
                counts[f"{name}: contacts of the search"] += len(sim.last.contacts)
                counts[f"{name}: pairs in lists"] += len(lists.own.other) + len(lists.away.other)
                counts[f"{name}: new lists"] += lists is not before
                counts[f"{name}: iterations"] += sim.figures["iterations"]
                counts[f"{name}: Newton steps"] += sim.figures["newton_its"]
                counts[f"{name}: cone problems"] += sim.figures["cone_problems"]
    return counts


def flows(patch: pytest.MonkeyPatch) -> Counter[str]:
    """Iterations where most contacts slide, and too much momentum makes impulses swing."""
    scene = Scene(0.5, (0.0, 0.0, 0.0), period=(0.06,) * 3, shear_rate=6.0, stress=(None, 1000.0, None))
    grid = np.stack(np.meshgrid(*[np.arange(5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    place = 0.006 + 0.012 * grid + np.random.default_rng(0).uniform(-0.001, 0.001, grid.shape)
    scene.add_spheres(place, 0.005, 2500.0)
    with pctt.Simulation(scene, dt=0.0015, solver="apgd", say=lambda _: None) as sim:
        sim.run(steps=40)
        counts: Counter[str] = Counter()
        for _ in range(20):
            sim.step()
            counts["a sheared cell: iterations"] += sim.figures["iterations"]
    return counts


def calls(patch: pytest.MonkeyPatch) -> Counter[str]:
    """What steps of few bodies call, as their seconds are those of calls: boxes that land on each other and come to
    rest, a pendulum, and balls at rest. Later versions of Python and numpy call less."""
    counts: Counter[str] = Counter()

    boxes, pendulum, rest = (Scene(friction=0.5) for _ in range(3))
    for scene in (boxes, rest):
        scene.add_body("floor", [Plane((0, 0, 1))])
    boxes.add_boxes([[0.0, 0.1 * (k % 2), 0.101 + 0.202 * k] for k in range(10)], (0.1, 0.1, 0.1), 1000.0)
    pendulum.add_spheres([[0.5, 0.0, 0.0]], 0.1, 1000.0)
    pendulum.add_joint("pin", 0, kind="ball", anchor=(0.0, 0.0, 0.0))
    rest.add_spheres([[0.21 * k, 0.0, 0.1] for k in range(10)], 0.1, 1000.0)
    for name, scene in (("ten boxes", boxes), ("a pendulum", pendulum), ("ten balls at rest", rest)):
        with pctt.Simulation(scene, dt=0.002, say=lambda _: None) as sim:
            sim.copy().run(steps=20)  # so that loops are compiled
            called: Counter[str] = Counter()
            before = sys.getprofile()
            sys.setprofile(lambda frame, event, argument, called=called: called.update((event,)))
            try:
                sim.run(steps=20)
            finally:
                sys.setprofile(before)
            counts[f"{name}: functions of Python"] = called["call"]
    return counts


def memory(patch: pytest.MonkeyPatch) -> Counter[str]:
    """The most that steps of a bed of spheres hold at once, with all that there is of its state."""
    scene, side = Scene(friction=0.4), 10
    place = 0.1 + 0.2002 * np.indices((side, side, side)).reshape(3, -1).T
    scene.add_spheres(place + np.random.default_rng(0).uniform(-5e-4, 5e-4, place.shape), 0.1, 1000.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    with pctt.Simulation(scene, dt=0.005, say=lambda _: None) as sim:
        sim.copy().run(steps=3)  # so that loops are compiled
        tracemalloc.start()  # of numpy's arrays and of those of compiled loops
        try:
            sim.copy().run(steps=3)
            most = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    return Counter({"a bed: bytes of a grain": most // side**3})


WALLS = [((1, 0, 0), (0, 0, 0)), ((-1, 0, 0), (0.84, 0, 0)), ((0, 1, 0), (0, 0, 0)), ((0, -1, 0), (0, 0.84, 0))]


GROUPS = (methods, systems, trains, preconditioners, flows, steps, calls, memory)


@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group.__name__)
def test_no_count_has_grown(group, monkeypatch):
    most = {f"{of}: {what}": count for of, row in MOST[group.__name__].items() for what, count in row.items()}
    options = PETSc.Options()
    before = options.getAll()
    counts = group(monkeypatch)
    for name in options.getAll().keys() - before.keys():  # those of the solvers, which other tests would obey
        options.delValue(name)
    found = {name: count for name, count in counts.items() if count or name in most}
    grown = {name: (most.get(name), count) for name, count in found.items() if count > 1.15 * most.get(name, 0) + 1}
    assert not grown, "(in the table, counted)"
    assert not most.keys() - found.keys(), "not counted any more"
