"""What a scene refuses, and what it makes."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from mpi4py import MPI

from dem.arrays import Rule
from dem.bodies import bounding_radius
from dem.mesh import Mesh
from dem.motion import Dynamic, Glide, Guided, Held, Hinged, Oscillation, Path, Rotation
from dem.packing import perturbed
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere
from dem.start import new_world
from dem.start.stiffness import pairs
from dem.start.time_step import fastest, smallest
from pctt.scenes import Mixer

SELF = MPI.COMM_SELF


UP = [0, 0, 1]
FLOOR = [Plane((0, 0, 1))]


def balls(*arguments, **options):
    return lambda scene: scene.add_spheres(*(arguments or (UP, 0.1, 1000.0)), **options)


def body(*arguments, **options):
    return lambda scene: scene.add_body(*arguments, **options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (balls([[0, 0, np.nan]], 0.1, 1000.0), "positions: NaN or infinite"),
        (balls([[0, -1e200, 0]], 0.1, 1000.0), "positions: allowed is up to 1e.150, got -1e.200 in row 0"),
        (balls([[0, 0]], 0.1, 1000.0), r"positions must have shape \(3,\) or \(1, 3\)"),
        (balls([UP], [-0.1], 1000.0), "radius must be positive, got -0.1"),
        (balls([UP], [0.1, 0.2], 1000.0), r"radius must have shape \(\) or \(1,\), got \(2,\)"),
        (balls([UP], 0.1, -1.0), "density must be positive"),
        (balls(velocity=[UP, UP]), r"velocity must have shape \(3,\) or \(1, 3\)"),
        (balls(material=3), "material 3: allowed is a name"),
        (balls(material=[3]), "material 3: allowed is a name"),
        (balls(material=["a", "b"]), "material must be one name or 1 names, got 2"),
        (body("lid", FLOOR, material=None), "material None: allowed is a name"),
        (lambda scene: scene.set_pair("a", 2, friction=0.1), "material 2: allowed is a name"),
        (lambda scene: scene.add_clumps([UP], Sphere(0.1), 1.0), "shape of clumps: allowed is a Clump, got Sphere"),
        (lambda scene: scene.add_boxes([UP], (0.1, 0.0, 0.1), 1000.0), "half extents must be positive"),
        (lambda scene: scene.add_boxes([UP], (1, 1, 1), 1.0, quaternions=(0, 0, 0, 0)), "zero quaternion"),
        (lambda scene: scene.set_pair("a", "b", friction=-0.1), "friction must not be negative"),
        (lambda scene: Scene(friction=0.1, gravity=(0, 0, np.nan)), "gravity: NaN"),
        (lambda scene: Scene(friction=0.1, gravity=-9.81), "gravity must be 3 numbers, got -9.81"),
        (lambda scene: Scene(friction="low"), "friction: allowed are real numbers, got 'low'"),
        (lambda scene: Scene(friction=0.1, stiffness=[1e5]), r"stiffness: allowed is one number, got \[100000.0\]"),
        (balls([UP, [0, 0]], 0.1, 1000.0), r"positions: allowed are real numbers, got \[\[0, 0, 1\], \[0, 0\]\]"),
        (balls([UP], 0.1 + 1j, 1000.0), "radius: allowed are real numbers, got"),
        (lambda scene: Sphere((1.0, 2.0)), r"Sphere.radius: allowed is one number, got \(1.0, 2.0\)"),
        (lambda scene: Glide(UP, start="now"), "start of Glide: allowed are real numbers, got 'now'"),
        (body(3, FLOOR), "large bodies need distinct names, got 3"),
        (lambda scene: scene.add_joint("pin", 0, limits=1.0, anchor=UP), "limits of 'pin': allowed are two numbers"),
        (body("floor", FLOOR), "distinct names, got 'floor'"),
        (body("empty", []), "allowed is a list of one or more"),
        (body("press", [Box((1, 1, 1))], Dynamic()), "needs either its density or both mass and inertia"),
        (body("press", [Box((1, 1, 1))], Dynamic(), mass=-1.0, inertia=(1, 1, 1)), "mass of 'press' must be positive"),
        (body("press", FLOOR, Dynamic(), density=100.0), "half space has no finite mass"),
        (body("press", FLOOR, velocity=(0, 0, 1)), "prescribed: it takes no initial velocity"),
        (body("press", [Sphere(1.0)], Guided(UP), density=1.0, velocity=(0.1, 0, 0)), "be along the guide"),
        (body("press", [Sphere(1.0)], Guided(UP)), "density or both mass"),
        (body("wheel", [Sphere(1.0, (0.1, 0, 0))], Hinged(UP), density=1.0), "its centre of mass must be on the axis"),
        (body("wheel", [Sphere(1.0)], Hinged(UP), density=1.0, velocity=(0, 0, 1)), "be about the hinge"),
        (lambda scene: Plane((0, 0, 0)), "Plane.normal is the zero vector"),
        (lambda scene: Box((1, -1, 1)), "Box.half_extents must be positive"),
        (lambda scene: Sphere(0.0), "Sphere.radius must be positive"),
        (lambda scene: Guided((0, 0, 0)), "Guided.direction is the zero vector"),
        (lambda scene: Guided(UP, speed=1.0), "Guided.force of a servo"),
        (lambda scene: Hinged(UP, torque=-1.0, speed=1.0), "Hinged.torque of a servo"),
        (lambda scene: Glide(UP, start=2.0, end=1.0), "Glide cannot begin at 2 s and end at 1 s"),
        (lambda scene: Rotation((0, 0, np.nan)), "Rotation.velocity: NaN"),
        (lambda scene: Oscillation(UP, 0.1, 0.0), "Oscillation.period must be positive"),
        (lambda scene: Path((0, 2, 1), np.zeros((3, 3))), "must ascend from zero or later, got 0, 2, 1"),
        (lambda scene: Path((0, 2), np.zeros((3, 3))), "2 times but 3 positions"),
    ],
)
def test_bad_arguments_are_refused(call, message):
    scene = Scene(friction=0.3)
    scene.add_body("floor", FLOOR)
    with pytest.raises(ValueError, match=message):
        call(scene)
    assert [body.name for body in scene.large_bodies] == ["floor"]


def test_capsules_and_the_spheres_that_enclose_them():
    scene = Scene(friction=0.3)
    scene.add_boxes([[0, 0, 0]], (0.3, 0.4, 1.2), 1000.0)
    ids = scene.add_capsules([[0, 0, 2], [0, 0, 4]], 0.1, [0.2, 0.5], [1000.0, 2000.0])
    grains = scene.grains()
    np.testing.assert_array_equal(ids, [1, 2])
    np.testing.assert_allclose(bounding_radius(grains), [1.3, 0.3, 0.6])
    np.testing.assert_allclose(grains.mass[1:], np.pi * 0.01 * np.array([0.4 + 0.4 / 3, 2 * (1.0 + 0.4 / 3)]) * 1000)


def by_rule(rule, kinds):
    """A scene of 300 grains in contact with the floor, given by arrays or by rules that make the same rows."""
    rng = np.random.default_rng(5)
    place = np.stack(np.meshgrid(*[np.arange(n) for n in (10, 10, 3)]), axis=-1).reshape(-1, 3) + 0.55
    place += rng.uniform(-0.05, 0.05, place.shape)
    size, turn = rng.uniform(0.15, 0.25, (300, 3)), rng.normal(size=(300, 4))
    velocity = rng.normal(size=(300, 3))
    if rule:
        given = (place, size, turn, velocity)
        place, size, turn, velocity = (Rule(300, lambda a, b, x=x: x[a:b].copy()) for x in given)
    scene = Scene(friction=0.3, restitution=0.5)
    scene.add_body("floor", FLOOR)
    if "spheres" in kinds:
        scene.add_spheres(place, Rule(300, lambda a, b: size[a:b, 0]) if rule else size[:, 0], 1e3, velocity=velocity)
    if "boxes" in kinds:
        above = Rule(300, lambda a, b: place[a:b] + [0, 0, 4]) if rule else place + [0, 0, 4]
        scene.add_boxes(above, size, 2e3, quaternions=turn)
    return scene


@pytest.mark.parallel(1, 3)
def test_grains_by_a_rule_make_the_same_world_as_arrays(ranks, monkeypatch):
    """In parts of any size, of which each rank makes some."""
    monkeypatch.setattr(Rule, "CHUNK", 37)
    comm = MPI.COMM_WORLD
    worlds = [new_world(by_rule(rule, ("spheres", "boxes")), comm) for rule in (False, True)]
    alone = new_world(by_rule(False, ("spheres", "boxes")), SELF)
    for name, column in worlds[1].grains.columns().items():
        np.testing.assert_array_equal(column, getattr(worlds[0].grains, name))
        whole = np.concatenate(comm.allgather(column))
        np.testing.assert_array_equal(whole, getattr(alone.grains, name))  # in the same order too
    assert worlds[1].pairs.stiffness == worlds[0].pairs.stiffness == alone.pairs.stiffness


def test_the_survey_is_that_of_all_grains(monkeypatch):
    monkeypatch.setattr(Rule, "CHUNK", 64)
    scene = by_rule(True, ("spheres",))
    found, grains = scene.survey(), scene.grains()
    assert (found.count, found.mass) == (300, pytest.approx(grains.mass.sum()))
    assert found.radius == pytest.approx(grains.size[:, 0].sum())
    np.testing.assert_allclose(found.spread, 300 * np.cov(grains.position.T, bias=True), rtol=1e-12)
    assert fastest(scene) == pytest.approx(np.linalg.norm(grains.velocity[:, :3], axis=1).max(), rel=1e-12)
    assert smallest(scene) == grains.size[:, 0].min()


LONG = [Box((1.0, 0.1, 0.1)), Sphere(0.2, (1.5, 0, 0))]
MESH = [Mesh([(0, 0.05, 0), (1, 0, 0.05), (2, -0.05, 0)], [(0, 1, 2)])]


@pytest.mark.parametrize(
    ("shapes", "motion", "most"),
    [
        (LONG, Rotation((2.0, 0, 0)), 0.4),  # a long tool about its axis: the ball beside the box
        (LONG, Rotation((2.0, 0, 0), center=(0, 0.3, 0)), 1.0),
        (LONG, Rotation((0, 2.0, 0)), 3.4),
        (LONG, Hinged((1, 0, 0), torque=1.0, speed=-2.0), 0.4),
        (LONG, Held((3.0, None, None), (2.0, 0, 0)), 3.4),
        (MESH, Rotation((2.0, 0, 0)), 0.1),
        (MESH, Rotation((0, 0, 2.0)), 2 * np.hypot(2.0, 0.05)),
        (LONG, Glide((0, 3.0, 4.0)), 5.0),
        (LONG, Path([0, 1, 1.5], [(0, 0, 0), (1, 0, 0), (1, 2, 0)]), 4.0),
        (LONG, Oscillation((0, 0, 1), 0.5, 2.0), 0.5 * np.pi),
        (LONG, Guided((0, 0, 1), force=1.0, speed=-0.5), 0.5),
    ],
)
def test_a_tool_is_as_fast_as_its_fastest_point(shapes, motion, most):
    """So a screw or a drum that turns about its long axis asks for no smaller steps than a short one."""
    scene = Scene(0.3)
    inertia = {"mass": 1.0, "inertia": (1.0, 1.0, 1.0)} if isinstance(motion, Dynamic) else {}
    scene.add_body("tool", shapes, motion, **inertia)
    scene.add_spheres(UP, 0.1, 1000.0)
    assert fastest(scene) == pytest.approx(most, rel=1e-9)


def test_a_scene_of_the_package_takes_no_memory_for_its_grains(monkeypatch):
    """Nor for its time step and stiffness: 43 MB would be the table of all grains."""
    monkeypatch.setattr(Rule, "CHUNK", 2**12)
    tracemalloc.start()
    scene = Mixer(n=30).build()
    assert scene.count == 226_981
    assert pairs(scene).stiffness.max() > 0.0
    assert fastest(scene) > 0.0
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 5e6


def test_a_rule_of_a_million_million_rows_makes_those_that_are_asked_for():
    count = 10**12
    scene = Scene(friction=0.3)
    ids = scene.add_spheres(Rule(count, lambda a, b: np.arange(a, b)[:, None] * [1.0, 0.0, 0.0]), 0.4, 1e3)
    assert (len(ids), scene.first_large) == (count, count)
    last = scene.grains(count - 2, count)
    np.testing.assert_array_equal(last.id, [count - 2, count - 1])
    np.testing.assert_array_equal(last.position[:, 0], [count - 2.0, count - 1.0])
    lattice = perturbed(*[np.arange(10_000.0)] * 3, 0.1, 7)
    np.testing.assert_array_equal(np.round(lattice[count - 2 :]), [[9999, 9999, 9998], [9999, 9999, 9999]])


def test_bad_rows_of_a_rule_are_refused_when_they_are_made():
    scene = Scene(friction=0.3)
    scene.add_spheres(Rule(4, lambda a, b: np.zeros((b - a, 2))), 0.1, 1e3)
    with pytest.raises(ValueError, match=r"positions must have shape \(3,\) or \(4, 3\), got \(4, 2\)"):
        scene.grains()
    with pytest.raises(ValueError, match="positions must have shape"):
        new_world(scene, SELF)
    with pytest.raises(ValueError, match="radius must have 2 rows, got 4"):
        scene.add_spheres(np.zeros((2, 3)), Rule(4, lambda a, b: np.ones(b - a)), 1e3)


def test_an_empty_scene_is_refused():
    scene = Scene(friction=0.3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    with pytest.raises(ValueError, match="empty scene: there is no grain"):
        new_world(scene, SELF)


@pytest.mark.parametrize("leaving", [["floor", "gat"], {"gat"}])
def test_a_leaving_body_that_is_not_there_is_refused(leaving):
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 1]], 0.1, 1000.0)
    scene.leaving = leaving
    scene.add_body("floor", FLOOR)
    scene.add_body("gate", [Sphere(0.1)], position=(0, 0, 2))
    with pytest.raises(ValueError, match=r"leaving: .* no large body 'gat'; allowed are floor, gate; .*mean gate\?"):
        new_world(scene, SELF)


def test_an_overlapping_start_names_the_worst_pair_and_its_depth():
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 1], [0, 0, 1.15], [0, 0, 1.25], [3, 0, 1]], 0.1, 1000.0)
    with pytest.raises(ValueError, match="grain 1 and grain 2 overlap by 0.1 m"):
        new_world(scene, SELF)
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 1], [0, 0, 0.06]], 0.1, 1000.0)
    scene.add_body("ceiling", [Plane((0, 0, -1), (0, 0, 2))])
    scene.add_body("floor", [Plane((0, 0, 1))])
    with pytest.raises(ValueError, match="grain 1 and body 'floor' overlap by 0.04 m"):
        new_world(scene, SELF)
    assert new_world(scene, SELF, overlap=0.5).body_count == 4


def test_a_touch_that_is_overlapping_by_rounding_is_accepted():
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 0.1 * (2 * k + 1)] for k in range(5)], 0.1, 1000.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    assert new_world(scene, SELF).body_count == 6


def test_ids_materials_mass_and_inertia():
    scene = Scene(friction=0.3)
    scene.add_body("floor", [Plane((0, 0, 1))], material="steel")
    first = scene.add_spheres([[0, 0, 1], [0, 0, 2]], [0.1, 0.2], 1000.0, material="glass")
    second = scene.add_boxes([[0, 0, 3]], (0.1, 0.2, 0.3), 500.0, material="steel")
    scene.set_pair("steel", "glass", friction=0.7)
    np.testing.assert_array_equal(first, [0, 1])
    np.testing.assert_array_equal(second, [2])
    grains, large = scene.grains(), scene.large()
    np.testing.assert_array_equal(large.id, [3])
    np.testing.assert_allclose(grains.mass, [4188.79e-3, 33.51032, 24.0], rtol=1e-5)
    np.testing.assert_allclose(grains.inertia[1], [0.4 * 33.51032 * 0.04] * 3, rtol=1e-5)
    np.testing.assert_allclose(grains.inertia[2], [24 / 3 * 0.13, 24 / 3 * 0.10, 24 / 3 * 0.05])
    table = scene.pairs(1.0).friction
    assert table[grains.material[0], large.material[0]] == table[large.material[0], grains.material[0]] == 0.7
    assert table[grains.material[2], large.material[0]] == 0.3


def test_large_bodies_that_overlap_at_the_start_are_refused():
    """By more than 1 % of a half thickness; not those of a joint, of prescribed motions, or that no force can part."""

    def start(motion=None, place=(0.0, 0.0, 0.06), other=(0.9, 0.0, 1.0), joint=False):
        scene = Scene(0.3)
        scene.add_body("floor", [Plane((0, 0, 1))])
        motion = motion or Dynamic()
        given = {"density": 500.0} if isinstance(motion, Dynamic) else {}
        scene.add_body("bar", [Box((0.5, 0.05, 0.05))], motion, position=place, **given)
        scene.add_body("other", [Box((0.5, 0.05, 0.05))], Dynamic(), position=other, density=500.0)
        if joint:
            scene.add_joint("hinge", "bar", "other", anchor=(0.45, 0, 1.0), axis=(0, 1, 0))
        new_world(scene, MPI.COMM_SELF)

    start()
    start(place=(0, 0, 0.0496))
    start(place=(0, 0, 1.0), joint=True)
    start(motion=Glide((1, 0, 0)), place=(0, 0, 0.02))
    start(motion=Hinged((0, 0, 1)), place=(0, 0, 0.02))
    for place, names in (((0, 0, 0.049), "'floor' and body 'bar'"), ((0, 0, 1.0), "'bar' and body 'other'")):
        with pytest.raises(ValueError, match=f"overlapping start: body {names}"):
            start(place=place)
