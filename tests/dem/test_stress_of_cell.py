"""The servo of a periodic cell: its stress, the work of its deformation, and its state."""

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.contact_map.mass import CellMass, InverseMass
from dem.scene import Scene
from dem.shapes import Plane
from dem.step.servo import CLOSING, KEPT, LEADING
from pctt.ccp.delassus import BlockMap
from pctt.scenes import PlaneShear

PRESSURE = 1000.0
OF_RUNS = {"dt": 0.001, "solver": "apgd", "tol": 1e-6}


def packed(comm=MPI.COMM_SELF, stress=(PRESSURE,) * 3, capsules=False, sheared=False, speed=0.02, **more):
    """A dense cell of 64 grains, a little moved and turned from a lattice; contacts close to it."""
    shear = {"shear_rate": 2.0, "shear_gradient": "z"} if sheared else {}
    scene = Scene(
        0.4, (0.0, 0.0, 0.0), stiffness=27000.0, period=(0.0404, 0.0408, 0.0402), stress=stress, **shear, **more
    )
    random = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5
    place = grid * [0.0101, 0.0102, 0.01005] + random.uniform(-4e-5, 4e-5, grid.shape)
    velocity = random.normal(scale=speed, size=place.shape)
    velocity[:, 0] += 2.0 * place[:, 2] * sheared
    if capsules:
        scene.add_capsules(place, 0.0045, 0.0004, 2500.0, velocity=velocity, angular_velocity=(2.0, 1.0, -3.0))
    else:
        scene.add_spheres(place, np.linspace(0.0049, 0.005, len(place)), 2500.0, velocity=velocity)
    return pctt.Simulation(scene, comm=comm, **OF_RUNS)


def stress(sim):
    return np.array([sim.figures[f"stress_{axis}{axis} [Pa]"] for axis in "xyz"])


def error(sim, asked):
    return np.abs(stress(sim) / asked - 1.0).max()


@pytest.mark.slow
def test_isotropic_cell_reaches_its_stress_and_stays():
    sim = packed()
    sim.run(steps=600, stop=lambda sim: error(sim, PRESSURE) < 0.01)
    late = []
    for _ in range(20):
        sim.step()
        late.append(error(sim, PRESSURE))
    assert max(late) < 0.02
    assert sim.period.prod() < 0.0404 * 0.0408 * 0.0402
    asked = np.array([1.0, 1.0, 1.2]) * PRESSURE
    sim.change("cell", stress=asked)
    sim.run(steps=200, stop=lambda sim: error(sim, asked) < 0.01)
    assert error(sim, asked) < 0.01
    sim.change("cell", stress=(None, None, 2.0 * PRESSURE))
    before = sim.period
    sim.run(steps=3)
    np.testing.assert_array_equal(sim.period[:2], before[:2])


def test_loose_cell_closes_affinely():
    """Grains that touch nothing keep their places relative to the cell, and their velocities beside it."""
    scene = Scene(0.4, (0.0, 0.0, 0.0), stiffness=1e4, period=(0.1, 0.1, 0.1), stress=(None, None, PRESSURE))
    place = np.array([[0.02, 0.03, 0.01], [0.05, 0.06, 0.05], [0.07, 0.05, 0.09]])
    scene.add_spheres(place, 0.005, 2500.0)
    sim = pctt.Simulation(scene, **OF_RUNS)
    sim.run(steps=20)
    rate = CLOSING * np.sqrt(PRESSURE / 2500.0) / 0.01
    assert sim.period[2] == pytest.approx(0.1 * (1.0 - 0.001 * rate) ** 20, rel=1e-12)
    np.testing.assert_allclose(sim.positions / sim.period, place / 0.1, rtol=1e-12)
    np.testing.assert_array_equal(sim.velocities, 0.0)


def lattice(start=0.0, strain_rate=None):
    """A simple cubic lattice of spheres that just touch."""
    scene = Scene(0.3, (0.0, 0.0, 0.0), stiffness=1e4, period=(0.04, 0.04, 0.05), stress=(PRESSURE,) * 3,
                  strain_rate=strain_rate, strain_start=start)  # fmt: skip
    grid = np.stack(np.meshgrid(range(4), range(4), range(5), indexing="ij"), axis=-1).reshape(-1, 3)
    scene.add_spheres(0.01 * grid, 0.005, 2500.0)
    return pctt.Simulation(scene, dt=0.001, solver="apgd", tol=1e-10)


def test_lattice_gives_way_as_its_springs_do():
    sim = lattice()
    sim.run(steps=60)
    spacing = sim.period / (4, 4, 5)
    np.testing.assert_allclose(spacing, spacing[0], rtol=1e-9)
    assert 1e4 * (0.01 - spacing[0]) == pytest.approx(PRESSURE * spacing[0] ** 2, rel=1e-6)
    np.testing.assert_allclose(stress(sim), PRESSURE, rtol=1e-6)
    np.testing.assert_allclose(np.abs(sim.contacts.force).sum(axis=1), PRESSURE * spacing[0] ** 2, rtol=1e-6)


def test_strain_rate_takes_the_place_of_the_stress():
    sim = lattice(0.03, (None, None, 0.5))
    sim.run(steps=30)
    before = sim.period
    assert before[2] == pytest.approx(1.25 * before[0], rel=1e-9)
    sim.run(steps=10)
    assert sim.period[2] == pytest.approx(before[2] * (1.0 - 0.001 * 0.5) ** 10, rel=1e-12)
    np.testing.assert_allclose(stress(sim)[:2], PRESSURE, rtol=2e-3)
    sim.change("cell", strain_rate=(None, -0.5, 0.0))
    then = sim.period
    sim.run(steps=5)
    assert sim.period[1] == pytest.approx(then[1] * (1.0 + 0.001 * 0.5) ** 5, rel=1e-12)
    assert sim.period[2] == then[2]


def test_stress_is_off_by_the_drag_of_the_cell_alone():
    """The law of the cell: eta E is what the stress lacks, with the kinetic part of the start of the step."""
    sim = packed(sheared=True)
    sim.run(steps=40)
    for _ in range(5):
        before, kept = of_flow(sim), np.clip(KEPT * sim.world.cell.rate, -2.0, 2.0)
        sim.step()
        borne = stress(sim) * sim.period.prod() - of_flow(sim)
        rate, volume = sim.world.cell.rate, sim.period.prod() / np.prod(1.0 + 0.001 * sim.world.cell.rate)
        drag = ((borne + before) / volume - PRESSURE) / (rate - kept)
        fastest = CLOSING * np.sqrt(PRESSURE / 2500.0) / 0.01 + LEADING * 2.0
        np.testing.assert_allclose(drag, PRESSURE / fastest, rtol=0.01)  # spheres of 9.8 to 10 mm


LAWS = [{"rolling": 5e-4, "spinning": 1e-4}, {"cohesion": 0.02, "cohesion_range": 1e-4}]


@pytest.mark.parametrize("more", LAWS)
def test_contacts_of_all_laws_bear_the_stress(more):
    sim = packed(speed=0.005, **more)
    sim.run(steps=500, stop=lambda sim: error(sim, PRESSURE) < 0.01)
    assert error(sim, PRESSURE) < 0.01
    assert abs(sim.figures["time_stepping [J]"]) < 1e-9 * sim.figures["kinetic_energy [J]"]


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("turning", [False, True])
def test_products_with_the_map_of_a_cell_are_those_of_a_matrix(turning):
    comm = MPI.COMM_WORLD
    sim = packed(comm, rolling=5e-4 * turning, spinning=1e-4 * turning)
    sim.run(steps=2)
    system, random = sim.last.system, np.random.default_rng(comm.rank)
    cell = system.cell._replace(root=np.array([2.0, 0.0, 3.0]))
    given = system.contact_map.source
    root, count = given.root, given.rows
    free, G = (system.problem_map.with_mass(mass) for mass in (InverseMass(root), CellMass(comm, root, cell)))
    g, other = random.normal(size=(2, G.rows, 3))
    way = system.contacts.branch(system.near.bodies.position)
    lever = given.frame.reshape(-1, 3, 3) * (way * cell.root)[:, None]
    push = comm.allreduce(np.einsum("cij,ci->j", lever, g[:count]))
    expected = free.velocities(free.momenta(g))
    expected[:count] += lever @ push
    for image in (G.velocities(G.momenta(g)), delassus(G, g), by_images(G, g)):
        np.testing.assert_allclose(image, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    one, two = (comm.allreduce(np.vdot(x, delassus(G, y))) for x, y in ((g, other), (other, g)))
    assert one == pytest.approx(two, rel=1e-9)
    nothing = G.image()
    image = G.image()
    G.find_image(g, image)
    energy = comm.allreduce(G.energy_of_step(image, nothing, nothing, 0.0))
    assert energy == pytest.approx(comm.allreduce(np.vdot(g, expected)), rel=1e-9)
    check_part(G, g, count)
    rows, v = BlockMap(comm, G.block_rows), random.normal(size=(G.columns, 6))
    np.testing.assert_allclose(rows.velocities(v), G.velocities(v), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(rows.momenta(g), G.momenta(g), rtol=1e-9, atol=1e-9)
    blocks = free.contact_blocks()
    blocks[:count] += lever @ lever.transpose(0, 2, 1)
    np.testing.assert_allclose(G.contact_blocks(), blocks, rtol=1e-12, atol=1e-12 * blocks.max(initial=0.0))
    size = random.uniform(1.0, 2.0, g.shape)
    np.testing.assert_allclose(delassus(G.scaled(size), g), size * delassus(G, size * g), rtol=1e-9, atol=1e-9)


def check_part(G, g, count):
    """The map of every second contact alone, with impulses of these."""
    some = np.arange(count)[::2]
    rows = np.concatenate([some, count + some])[: len(some) * len(g) // max(count, 1)]
    part, impulse = G.only(some), np.zeros_like(g)
    impulse[rows] = g[rows]
    image, same, few = G.image(), G.image(), np.zeros_like(g[rows])
    G.find_image(impulse, image)
    part.find_image(g[rows], same)
    np.testing.assert_allclose(same, image, rtol=1e-12, atol=1e-12)
    part.find_velocities(same, same, 0.5, few, few)
    np.testing.assert_allclose(few, by_images(G, impulse)[rows], rtol=1e-9, atol=1e-12)


def delassus(G, g):
    y = np.zeros_like(g)
    G.add_delassus(g, y)
    return y


def by_images(G, g):
    image, y = G.image(), np.zeros_like(g)
    G.find_image(g, image)
    G.find_velocities(image, image, 0.5, np.zeros_like(g), y)
    return y


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("sheared", [False, True])
def test_work_is_stress_times_strain_and_closes_the_balance(sheared):
    sim = packed(MPI.COMM_WORLD, (PRESSURE, None, 3.0 * PRESSURE), sheared=sheared)
    sim.run(steps=3)
    lost = 0.0
    for _ in range(8):
        sim.step()
        rate = sim.world.cell.rate
        assert np.abs(rate[[0, 2]]).min() > 0.0
        lost += sim.figures["friction_loss [J]"] + sim.figures["impact_loss [J]"]
        assert abs(sim.figures["time_stepping [J]"]) < 1e-9 * sim.figures["kinetic_energy [J]"]
        if not sheared:
            kinetic = sim.comm.allreduce(of_motion(sim))
            power = sim.period.prod() * (stress(sim) - kinetic / sim.period.prod()) @ rate
            np.testing.assert_allclose(sim.figures["work_of_motions [J]"], -OF_RUNS["dt"] * power, rtol=1e-9)
    assert lost > 0.0


def of_flow(sim):
    """The kinetic part of the stress, times the volume, beside the flow of the shear."""
    speed = sim.velocities[:, :3] - sim.positions[:, [2, 2, 2]] * [2.0, 0.0, 0.0]
    return sim.local.mass[np.argsort(sim.local.id)] @ (speed - np.average(speed, axis=0, weights=sim.local.mass)) ** 2


def of_motion(sim):
    """The kinetic part of the stress of this rank's grains, times the volume; their mean velocity is zero here."""
    total = sim.comm.allreduce(sim.local.mass.sum())
    mean = sim.comm.allreduce(sim.local.mass @ sim.local.velocity[:, :3]) / total
    return sim.local.mass @ (sim.local.velocity[:, :3] - mean) ** 2


@pytest.mark.parallel(1, 2)
def test_restart_goes_on_with_the_same_bits(tmp_path):
    sim = packed(MPI.COMM_WORLD, (PRESSURE, None, PRESSURE), sheared=True)
    sim.run(steps=6)
    sim.change("cell", stress=(PRESSURE, 2.0 * PRESSURE, PRESSURE))
    sim.run(steps=3)
    sim.save(tmp_path / "state.h5")
    other = pctt.Simulation.load(tmp_path / "state.h5", sim.experiment, comm=MPI.COMM_WORLD, **OF_RUNS)
    for each in (sim, other):
        each.run(steps=4)
    assert np.array_equal(sim.period, other.period)
    assert np.array_equal(sim.world.cell.stress, other.world.cell.stress)
    assert np.array_equal(sim.positions, other.positions)
    assert np.array_equal(sim.velocities, other.velocities)


@pytest.mark.parallel(2, 3)
@pytest.mark.parametrize("more", [{}, {"capsules": True}, *LAWS])
def test_ranks_change_nothing(more):
    alone, together = (packed(comm, sheared=True, **more) for comm in (MPI.COMM_SELF, MPI.COMM_WORLD))
    for sim in (alone, together):
        sim.run(steps=4)
    np.testing.assert_allclose(together.period, alone.period, rtol=1e-5)
    np.testing.assert_allclose(together.positions, alone.positions, atol=1e-6)
    assert len(together.contacts) == len(alone.contacts) > 10


def test_refused():
    def scene(**more):
        built = Scene(0.3, **{"gravity": (0.0, 0.0, 0.0), "period": (0.5,) * 3, "stress": (1e3, None, None), **more})
        built.add_spheres([[0.1, 0.1, 0.1]], radius=0.05, density=1000.0)
        return built

    for more, words in {
        "periods along x, y and z": {"period": (0.5, 0.5, None)},
        "stress needs gravity": {"gravity": (0.0, 0.0, -9.8)},
        "three entries": {"stress": (1e3,)},
        "strain_rate must have three entries": {"strain_rate": (1.0,)},
        "strain_rate needs gravity": {"stress": None, "strain_rate": (1.0, None, None), "gravity": (0.0, 0.0, -9.8)},
        "must be positive": {"stress": (-1e3, None, None)},
    }.items():
        with pytest.raises(ValueError, match=more):
            scene(**words)
    walled = scene()
    walled.add_body("floor", [Plane(normal=(0, 0, 1))])
    with pytest.raises(ValueError, match="'floor': a cell of given stress has grains alone"):
        walled.grains()
    with pytest.raises(ValueError, match="contacts that give way"):
        pctt.Simulation(scene(stiffness=np.inf), dt=0.01)
    with pytest.raises(ValueError, match="periods of this cell are constant"):
        pctt.Simulation(scene(stress=None), dt=0.01).change("cell", stress=(None, None, 1e3))


@pytest.mark.slow
def test_friction_of_plane_shear_grows_with_the_inertial_number():
    slow, fast = flow(0.03, 0.57), flow(0.3, 0.53)
    assert abs(slow / jop(0.03) - 1.0) < 0.2
    assert abs(fast / jop(0.3) - 1.0) < 0.2
    assert fast > slow + 0.05


def flow(inertial, fraction):
    """The friction coefficient of plane shear."""
    sim, shear, pressure = pctt.Simulation(PlaneShear(n=6, inertial=inertial, fraction=fraction), solver="apgd"), [], []

    def keep(sim):
        shear.append(-sim.figures["stress_xz [Pa]"])
        pressure.append(sim.figures["stress_zz [Pa]"])

    sim.run(until=2.0 / sim.world.cell.shear_rate, call=keep)
    late = slice(len(shear) // 2, None)
    assert abs(np.mean(pressure[late]) / PRESSURE - 1.0) < 0.005
    assert np.std(pressure[late]) < 0.02 * PRESSURE
    return np.mean(shear[late]) / np.mean(pressure[late])


def jop(inertial):
    """Of glass beads: Jop, Forterre, Pouliquen, Nature 441 (2006) 727."""
    low, high = np.tan(np.radians([20.9, 32.8]))
    return low + (high - low) / (1.0 + 0.279 / inertial)
