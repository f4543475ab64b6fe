"""Bodies that are held in part, surfaces that move along themselves, and the scenes of both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem import quaternion
from dem.mesh import Mesh
from dem.motion import Dynamic, Held
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere
from dem.together import SceneError
from pctt.scenes import Belt, Wheel

SELF, WORLD, DT, G, MU = MPI.COMM_SELF, MPI.COMM_WORLD, 0.005, 9.81, 0.3


def simulation(scene, comm=SELF, **more):
    settings = {"dt": DT, "delta": 0.01, "solver": "apgd", "tol": 1e-9}
    return pctt.Simulation(scene, comm=comm, **{**settings, **more})


def rig(motion, floor=False, **more):
    """A ball of 1 kg as a wheel, alone or on a floor."""
    scene = Scene(MU, stiffness=np.inf)
    if floor:
        scene.add_body("floor", [Plane((0, 0, 1))])
    moments = {"mass": 1.0, "inertia": (0.004, 0.004, 0.004)}
    scene.add_body("wheel", [Sphere(0.1)], motion, position=(0, 0, 0.1), **(moments | more))
    scene.add_spheres([0, 50, 0.1], 0.1, 1000.0)
    return scene


# -- held in part -------------------------------------------------------------------------------------------


def test_held_components_are_kept_and_the_others_fall():
    sim = simulation(rig(Held((0.5, 0, None), (0, 2.0, 0), start=0.05), inertia=(1.0, 2.0, 3.0)))
    wheel, places, figures = sim.body("wheel"), [], []
    sim.run(until=0.25, call=lambda sim: (places.append(wheel.position), figures.append(sim.figures)))
    np.testing.assert_allclose(wheel.velocity, [0.5, 0, -G * 0.25, 0, 2.0, 0], atol=1e-12)
    np.testing.assert_allclose(wheel.position[:2], [0.5 * 0.2, 0], atol=1e-14)
    np.testing.assert_allclose(wheel.orientation, quaternion.exponential(np.array([0, 0.4, 0])), atol=1e-13)
    assert [figure["energy_jump [J]"] for figure in figures] == [0.0] * 50
    work = sum(figure["work_of_motions [J]"] for figure in figures)
    assert work == pytest.approx(0.5 * 0.5**2)  # what holds it has set it in motion


@pytest.mark.parametrize("free", ["spin", "way"])
def test_a_wheel_slides_until_it_rolls(free):
    """A driven wheel that is free to go has the acceleration mu g, a towed one is spun up by mu m g R / I."""
    speed, spin = (None, 5.0) if free == "way" else (0.5, None)
    sim = simulation(rig(Held((speed, 0, None), (0, spin, 0)), floor=True))
    wheel, rates, works = sim.body("wheel"), [], []

    def look(sim):
        rates.append(wheel.velocity[0 if free == "way" else 4])
        works.append([sim.figures[name] for name in ("work_of_motions [J]", "friction_loss [J]")])

    sim.run(steps=60, call=look)
    slope, end = (MU * G, 0.5) if free == "way" else (MU * G * 0.1 / 0.004, 5.0)
    np.testing.assert_allclose(rates, np.minimum(slope * DT * np.arange(1, 61), end), rtol=1e-5)
    push = MU * G if free == "way" else -MU * G
    assert sim.kinetic_energy == pytest.approx(0.125 + (0.05 if free == "spin" else 0.0), rel=1e-5)
    # the axle gives mu m g R w in the time in which it slides, half of which is lost; towing gives mu m g v
    time = end / slope
    work, loss = np.sum(works, axis=0)
    assert work == pytest.approx(MU * G * 0.5 * time + (0.125 if free == "spin" else 0.0), abs=MU * G * 0.5 * DT)
    assert loss == pytest.approx(MU * G * 0.25 * time, abs=MU * G * 0.5 * DT)
    first = simulation(rig(Held((speed, 0, None), (0, spin, 0)), floor=True))
    first.step()
    np.testing.assert_allclose(first.body("wheel").force, [push, 0, G], atol=1e-4)


def test_a_held_body_takes_other_values_without_a_jump_and_keeps_them_in_checkpoints(tmp_path):
    scene = rig(Held((None, 0, None), (0, 2.0, 0)), floor=True)
    sim = simulation(scene)
    sim.run(steps=10)
    wheel = sim.body("wheel")
    before = wheel.orientation
    sim.change("body wheel", angular_velocity=(0, -1.0, 0))
    sim.change("load tug", on="wheel", force=(0.1, 0, 0))
    sim.step()
    turned = quaternion.rotation_vector(before, wheel.orientation)
    np.testing.assert_allclose(turned, [0, -DT, 0], atol=1e-13)
    with pytest.raises(ValueError, match="cannot change its motion"):
        sim.change("body wheel", velocity=(0.1, 0, None))
    sim.save(tmp_path / "state.h5")
    again = pctt.Simulation.load(
        tmp_path / "state.h5", scene, dt=DT, delta=0.01, solver="apgd", tol=1e-9, comm=SELF
    )
    for each in (sim, again):
        each.run(steps=5)
    np.testing.assert_array_equal(again.body("wheel").velocity, sim.body("wheel").velocity)
    np.testing.assert_array_equal(again.body("wheel").orientation, sim.body("wheel").orientation)


def test_what_holds_a_body_on_both_sides_makes_no_contact():
    """A wheel between two plates across its axle, which hold it as the rig does."""
    scene = rig(Held((None, 0, None), (0, 2.0, 0)))
    scene.add_body("walls", [Box((1, 0.1, 1), (0, 0.2 * s, 0.1)) for s in (-1, 1)])
    sim = simulation(scene)
    assert sim.step()["contacts"] == 0
    np.testing.assert_allclose(sim.body("wheel").velocity, [0, 0, -G * DT, 0, 2.0, 0], atol=1e-14)


@pytest.mark.parametrize(
    ("values", "more", "words"),
    [
        ({"angular_velocity": (None, None, 0.0)}, {}, "Held.angular_velocity .*: allowed are three numbers"),
        ({"angular_velocity": (None, 1.0, 0.0)}, {}, "allowed are three numbers, three times None"),
        ({"velocity": (0.0, np.nan, None)}, {}, "Held.velocity: NaN"),
        ({"velocity": (0.0, 1.0)}, {}, "Held.velocity must be 3 numbers"),
        ({"start": 2.0, "end": 1.0}, {}, "Held cannot begin at 2 s"),
        ({"velocity": (1.0, 0.0, None)}, {"velocity": (1.0, 0, 2.0)}, "'wheel' is held: its initial velocity must be"),
    ],
)
def test_what_cannot_be_held_is_refused(values, more, words):
    with pytest.raises(ValueError, match=words):
        rig(Held(**values), **more)


# -- belts --------------------------------------------------------------------------------------------------


def test_blocks_and_spheres_on_a_belt_go_as_the_textbook_says():
    scene = Belt(n=2)
    sim = simulation(scene, dt=0.002, tol=1e-8, stiffness=np.inf)
    rows = [sim.step() for _ in range(130)]
    records = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    rate = scene.friction * G
    time = records["time [s]"]
    np.testing.assert_allclose(records["speed_blocks [m/s]"], np.minimum(rate * time, 0.5), rtol=1e-4)
    np.testing.assert_allclose(records["speed_spheres [m/s]"], np.minimum(rate * time, 0.5 * 2 / 7), rtol=1e-3)
    found = scene.analyse(records)
    expected = {"block_acceleration [mu g]": 1.0, "block_speed [belt speeds]": 1.0}
    assert found == pytest.approx({**expected, "sphere_speed [belt speeds]": 2 / 7}, rel=1e-3)
    # the belt gives mu m g v while bodies slide: half of what it gives to blocks becomes their energy
    block, ball = scene.density * 1e-3, scene.density * 4e-3 / 3 * np.pi / 8
    given = 2 * (block * 0.25 + ball * 0.25 * 2 / 7)
    kept = 2 * (0.5 * block * 0.25 + 0.5 * ball * (1 + 5 / 2) * (0.5 * 2 / 7) ** 2)
    assert records["work_of_motions [J]"].sum() == pytest.approx(given, rel=0.01)
    assert records["friction_loss [J]"].sum() == pytest.approx(given - kept, rel=0.02)
    assert records["energy_jump [J]"].max() == 0.0


def on_belt(velocity, tilt=(1.0, 0, 0, 0)):
    scene = Scene(MU, gravity=quaternion.rotate(np.array(tilt), np.array([0, 0, -G])), stiffness=np.inf)
    scene.add_body("belt", [Box((1, 1, 0.1))], quaternion=tilt, surface_velocity=velocity)
    top = quaternion.rotate(np.array(tilt), np.array([0, 0, 0.2]))
    scene.add_boxes([top], (0.1, 0.1, 0.1), 1000.0, quaternions=[tilt])
    return scene


def test_a_surface_velocity_is_that_of_the_body_frame_along_the_surface():
    tilt = quaternion.exponential(np.array([0.3, -0.2, 0.5]))
    faces = lambda place, normal: np.where(normal[:, 2:] > 0.9, [[0.3, 0.4, 7.0]], 0.0)  # noqa: E731
    for velocity in ((0.3, 0.4, -5.0), faces):
        sim = simulation(on_belt(velocity, tuple(tilt)))
        sim.run(steps=10)
        expected = quaternion.rotate(tilt, MU * G * 10 * DT * np.array([0.6, 0.8, 0]))
        np.testing.assert_allclose(sim.velocities[0, :3], expected, atol=1e-5)
        assert not sim.body("belt").velocity.any()


@pytest.mark.parallel(1, 2)
def test_a_belt_changes_its_speed_within_the_loop_and_keeps_it_in_checkpoints(tmp_path):
    scene = on_belt((0.2, 0, 0))
    scene.add_spheres([[x, 0.3, 0.15] for x in np.arange(4) * 0.11 - 0.3], 0.05, 1000.0)
    sim = simulation(scene, WORLD)
    sim.run(steps=20)
    np.testing.assert_allclose(sim.velocities[0, 0], 0.2, rtol=1e-6)
    sim.change("body belt", surface_velocity=(0, -0.1 - WORLD.rank, 0))
    sim.run(steps=5)
    sim.save(tmp_path / "state.h5")
    settings = {"dt": DT, "delta": 0.01, "solver": "apgd", "tol": 1e-9}
    again = pctt.Simulation.load(tmp_path / "state.h5", scene, comm=WORLD, **settings)
    assert tuple(again.body("belt").surface_velocity) == (0.0, -0.1, 0.0)
    for each in (sim, again):
        each.run(steps=25)
    np.testing.assert_array_equal(again.velocities, sim.velocities)
    np.testing.assert_allclose(sim.velocities[0, :3], [0, -0.1, 0], atol=1e-5)


def test_bad_surface_velocities_are_refused():
    with pytest.raises(ValueError, match="surface velocity of 'belt': NaN"):
        on_belt((np.nan, 0, 0))
    sim = simulation(on_belt(lambda place, normal: np.zeros(2)))
    with pytest.raises(SceneError, match="surface velocity of 'belt' must have shape"):
        sim.step()
    with pytest.raises(ValueError, match="a function comes from the scene"):
        sim.change("body belt", surface_velocity=np.sin)


# -- the rig ------------------------------------------------------------------------------------------------


def test_the_wheel_and_its_bed():
    scene = Wheel(n=4, way=1.0)
    built = scene.build()
    assert [body.name for body in built.large_bodies] == ["floor", "walls", "wheel"]
    wheel = built.large_bodies[2]
    corners = np.array([[x, z] for box in wheel.shapes for x in (-1, 1) for z in (-1, 1)])
    assert len(corners) == 4 * scene.bars
    assert np.linalg.norm(np.array(wheel.shapes[0].half_extents)[[0, 2]]) == pytest.approx(scene.wheel_radius)
    assert built.grains().position[:, 2].max() + scene.radius < wheel.position[2] - scene.wheel_radius
    pushed = replace(scene, free=True, drawbar=0.1).build()
    assert pushed.named["load"]["drawbar"].force[0] == pytest.approx(-0.1 * scene.mass * G)
    assert pushed.large_bodies[2].motion.velocity[0] is None
    assert wheel.motion.velocity[0] == pytest.approx(scene.spin * scene.wheel_radius * 0.7)


def test_the_wheel_may_come_from_a_file(tmp_path):
    pytest.importorskip("trimesh", reason="trimesh is not installed (extra `meshes`)")
    profile = [(0, -0.5), (1, -0.5), (1, 0.5), (0, 0.5)]
    wheel = Mesh.revolved(profile, 24)  # about z; files have no pose
    Mesh(np.array(wheel.vertices)[:, [0, 2, 1]] * [1, 1, -1], wheel.triangles).write(tmp_path / "wheel.stl")
    scene = Wheel(n=4, file=str(tmp_path / "wheel.stl"))
    (surface,) = scene.build().large_bodies[2].shapes
    assert np.linalg.norm(np.array(surface.vertices)[:, [0, 2]], axis=1).max() == pytest.approx(scene.wheel_radius)


def test_a_wheel_on_hard_ground_needs_no_torque_and_pulls_no_load():
    """The rig without a bed: a smooth wheel of many bars rolls on the floor."""
    scene = rig(Held((0.2, 0, None), (0, 2.0, 0)), floor=True)
    sim = simulation(scene)
    sim.run(steps=20)
    np.testing.assert_allclose(sim.body("wheel").force, [0, 0, G], atol=1e-4)
    np.testing.assert_allclose(sim.body("wheel").torque, 0, atol=1e-5)
    assert isinstance(scene.large_bodies[1].motion, Dynamic)


@pytest.mark.slow
def test_wheels_of_two_sizes_have_the_same_dimensionless_power():
    """Slonaker et al. (2017): on a bed of the same grains, wheels whose mass, size and spin are scaled together, and
    whose powers differ by a factor of 3.5. Two packings of one size differ by 15 %."""
    one, other = (np.mean([driven(Wheel(n=n, seed=seed))["mean_power"] for seed in (1, 2)]) for n in (7, 10))
    assert one == pytest.approx(other, rel=0.2)


def driven(scene):
    """The means of a wheel that goes to the end of its way from a settled bed."""
    sim, rows = pctt.Simulation(scene, restart="settled", comm=SELF, say=lambda text: None), []

    def end(sim):
        rows.append(sim.figures)
        return sim.figures["way [m]"] > scene.way * scene.wheel_radius

    sim.run(stop=end)
    return scene.analyse({name: np.array([row[name] for row in rows]) for name in rows[0]})
