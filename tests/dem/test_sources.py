"""The grains of sources, and when they are due: distributions, rates, places."""

import numpy as np
import pytest

from dem.geometry.insertion import inserted
from dem.measures import Block
from dem.measures import Cylinder as Tube
from dem.parts.sizes import Listed, Uniform
from dem.parts.sources import Source, Tally, bounds, numbers, points, reach
from dem.scene import Scene
from dem.shapes import Box, Capsule, Clump, Cylinder, Mesh, Plane, Superellipsoid

BLOCK = Block((0, 0, 0), (1, 2, 3))
TUBE = Tube((1, 1, 1), (2, 3, 0), 0.5)
ROCK = np.array([[2, 0, 0], [-1, 0.1, 0], [0, 1.2, 0.2], [0, -1, 0], [0.1, 0, 0.8], [0, 0.2, -1]])
CLUMP = Clump([[0, 0, 0], [1.0, 0, 0], [0, 0.4, 0]], [0.7, 0.7, 0.4])


def source(**given):
    return Source(BLOCK, **{"radius": 0.1, "density": 1000.0, "number_rate": 10.0, **given})


def test_random_numbers_are_uniform_and_know_their_grain_and_source_alone():
    found = numbers("a", 7, np.arange(4000), range(5))
    histogram = np.histogram(found, 50, (0.0, 1.0))[0]
    expected = found.size / 50
    assert ((histogram - expected) ** 2 / expected).sum() < 49 + 4 * np.sqrt(2 * 49)
    correlation = np.corrcoef(np.concatenate([found[:-1].T, found[1:].T]))
    assert np.abs(correlation - np.eye(10)).max() < 0.08
    np.testing.assert_array_equal(numbers("a", 7, np.array([17, 5]), range(2, 4)), found[[17, 5], 2:4])
    for name, seed in (("b", 7), ("a", 8), ("a", -7)):
        assert not np.isin(numbers(name, seed, np.arange(50), range(5)), found).any()


def test_uniform_sizes_have_the_moments_of_theory():
    size = source(radius=Uniform(0.1, 0.3)).grains("a", np.arange(10000)).size[:, 0]
    assert size.min() >= 0.1
    assert size.max() <= 0.3
    assert size.mean() == pytest.approx(0.2, abs=4 * 0.2 / np.sqrt(12 * 10000))
    assert size.var() == pytest.approx(0.2**2 / 12, rel=0.04)


def test_listed_sizes_have_their_shares():
    size = source(radius=Listed((0.1, 0.2, 0.4), (5, 3, 2))).grains("a", np.arange(5000)).size[:, 0]
    counts, expected = np.array([(size == value).sum() for value in (0.1, 0.2, 0.4)]), np.array([2500, 1500, 1000])
    assert counts.sum() == 5000
    assert ((counts - expected) ** 2 / expected).sum() < 13.8  # a chance of 0.001


def test_boxes_and_capsules_have_the_lengths_of_their_shape_times_the_size_and_any_turn():
    boxes = source(shape=Box((1, 2, 3))).grains("a", np.arange(3000))
    np.testing.assert_allclose(boxes.size, np.tile([0.1, 0.2, 0.3], (3000, 1)))
    np.testing.assert_allclose(boxes.mass, 1000 * 8 * 0.006)
    np.testing.assert_allclose(np.linalg.norm(boxes.quaternion, axis=1), 1.0)
    second = np.einsum("ni,nj->ij", boxes.quaternion, boxes.quaternion) / 3000
    np.testing.assert_allclose(second, np.eye(4) / 4, atol=0.02)  # uniform on the sphere
    capsule = source(shape=Capsule(1.0, 2.0))
    np.testing.assert_allclose(reach(capsule.grains("a", np.arange(2))), 0.3)


@pytest.mark.parametrize(("shape", "add", "scales"), [
    (ROCK, Scene.add_polyhedra, True),
    (Superellipsoid((0.3, 0.2, 0.1)), Scene.add_grains, True),
    (Cylinder(0.1, 0.3), Scene.add_grains, True),
    (CLUMP, Scene.add_clumps, False),
], ids=["polyhedra", "superellipsoids", "cylinders", "clumps"])  # fmt: skip
def test_grains_of_a_source_are_those_that_a_scene_has_at_the_start(shape, add, scales):
    """But for their turns, which are uniform."""
    scene = Scene(0.3)
    scene.add_grains([(9, 9, 9)], Cylinder(0.4, 0.4), 1000.0)  # another form has the first number
    sizes = {"radius": Uniform(0.5, 2.0)} if scales else {}
    scene.add_source("rain", BLOCK, shape=shape, density=2000.0, mass_rate=1.0, **sizes)
    came = scene.passages.sources["rain"].grains("rain", np.arange(3000))
    sizes = {"scale": 0.5 + 1.5 * numbers("rain", 0, np.arange(3000), range(1))[:, 0]} if scales else {}
    ids = add(scene, np.zeros((3000, 3)), shape, 2000.0, **sizes)
    there = scene.grains(ids[0])
    for name in ("shape", "size", "mass", "inertia"):
        np.testing.assert_allclose(getattr(came, name), getattr(there, name), rtol=1e-12)
    second = np.einsum("ni,nj->ij", came.quaternion, came.quaternion) / 3000
    np.testing.assert_allclose(second, np.eye(4) / 4, atol=0.02)
    assert set(scene.kinds) == set(scene.grains().shape)
    least, most = scene.passages.sources["rain"].extremes().size
    assert (least <= there.size.min(axis=0)).all()
    assert (there.size.max(axis=0) <= most).all()


def test_a_copy_of_a_scene_knows_the_shapes_of_its_sources():
    scene = Scene(0.3)
    for name, shape in {"clumps": CLUMP, "rocks": ROCK}.items():
        scene.add_source(name, BLOCK, shape=shape, density=1.0, number_rate=1.0)
    other = scene.copy()
    for given in (scene, other):
        assert given.kinds == [form.BASE + n for n, form in enumerate(given.forms)]
        assert all(source.shape is given.forms[source.number] for source in given.passages.sources.values())


def test_points_are_uniform_in_their_region():
    random = np.random.default_rng(0).random((20000, 3))
    for region in (BLOCK, TUBE):
        found, (low, high) = points(region, random), bounds(region)
        assert region.contains(found).all()
        assert (found >= low - 1e-12).all()
        assert (found <= high + 1e-12).all()
    along, across = TUBE._split(points(TUBE, random) - np.array(TUBE.start))
    assert (across**2).sum(axis=1).mean() == pytest.approx(0.5**2 / 2, rel=0.02)  # of a disc
    assert along.var() == pytest.approx(TUBE.length**2 / 12, rel=0.03)


def test_as_many_are_due_as_rate_times_time():
    given, mass = source(start=1.0, end=3.0, number_rate=10.0, most=15), np.ones(100)
    due = [given.due(time, Tally(), mass) for time in (0.0, 1.0, 1.1, 1.95, 2.0, 3.0, 9.0)]
    assert due == [0, 0, 1, 9, 10, 15, 15]
    assert given.due(2.0, Tally(count=4), mass) == 6
    by_mass = source(number_rate=None, mass_rate=2.0)
    assert by_mass.due(3.0, Tally(), np.full(100, 0.5)) == 12
    assert by_mass.due(3.0, Tally(mass=5.0), np.full(100, 0.75)) == 1


def test_a_changed_rate_counts_from_its_time_on_and_keeps_what_was_due():
    first, mass, tally = source(start=1.0, end=3.0), np.ones(100), Tally(count=4, mass=4.0)  # 6 more found no place
    faster = first.changed(2.0, tally, number_rate=20.0, velocity=(0, 0, -1))
    assert [faster.amount(time) for time in (2.0, 2.5, 3.0, 9.0)] == pytest.approx([10, 20, 30, 30])
    assert faster.due(2.0, tally, mass) == 6
    assert faster.grains("a", np.arange(2)).velocity[0, 2] == -1.0
    shut = faster.changed(2.5, tally, number_rate=0.0)
    assert shut.amount(9.0) == pytest.approx(20)
    by_mass = first.changed(2.0, tally, mass_rate=3.0)
    assert [by_mass.amount(time) for time in (2.0, 3.0)] == pytest.approx([4, 7])
    early, late = (first.changed(time, Tally(), number_rate=20.0) for time in (0.5, 9.0))
    assert [early.amount(time) for time in (1.0, 2.0)] == pytest.approx([0, 20])
    assert late.amount(9.0) == pytest.approx(20)
    with pytest.raises(ValueError, match="either a mass_rate"):
        first.changed(2.0, tally, mass_rate=1.0, number_rate=1.0)


def test_spheres_go_to_their_first_free_place_and_the_queue_stops_at_the_first_without():
    place = np.zeros((4, 2, 3))
    place[:, :, 0] = [[0, 3], [0.5, 1], [0.1, 0.2], [9, 9]]
    taken = inserted(place, np.ones((4, 2), bool), np.full(4, 0.4), np.array([[3.1, 0, 0]]), np.array([0.2]))
    assert taken.tolist() == [0, 1, -1, -1]
    free = np.array([[False, True], [True, True], [True, True], [True, True]])
    taken = inserted(place, free, np.full(4, 0.4), np.zeros((0, 3)), np.zeros(0))
    assert taken.tolist() == [1, 0, -1, -1]  # the first leaves its place to the second


@pytest.mark.parametrize("period", [None, np.array([2.0, 2.0, np.inf])])
def test_inserted_spheres_are_apart(period):
    random = np.random.default_rng(1)
    place, radius = random.uniform(0, 2, (150, 60, 3)), random.uniform(0.05, 0.15, 150)
    taken = inserted(place, np.ones((150, 60), bool), radius, np.full((1, 3), 1.0), np.array([0.3]), period)
    count = int((taken >= 0).sum())
    assert count > 50
    center = np.concatenate([[[1.0, 1.0, 1.0]], place[np.arange(count), taken[:count]]])
    radius = np.concatenate([[0.3], radius[:count]])
    way = center[:, None] - center
    if period is not None:
        way[..., :2] -= 2.0 * np.round(way[..., :2] / 2.0)
    gap = np.linalg.norm(way, axis=2) - radius[:, None] - radius
    assert gap[~np.eye(count + 1, dtype=bool)].min() >= 0.0


@pytest.mark.parametrize(("given", "words"), [
    ({"number_rate": None}, "either a mass_rate"),
    ({"mass_rate": 1.0}, "either a mass_rate"),
    ({"number_rate": -1.0}, "rate of a source must not be negative"),
    ({"radius": (0.1, -0.1)}, "size of a grain must be positive"),
    ({"radius": Uniform(0.1, 0.2), "density": 0.0}, "density of a source must be positive"),
    ({"start": 2.0, "end": 1.0}, "Source cannot begin at 2 s and end at 1 s"),
    ({"most": 0}, "at least 1"),
    ({"radius": None}, "needs a shape, or the radius of its spheres"),
    ({"seed": 1.5}, "seed of a source 1.5: allowed is a whole number from 0 on"),
    ({"seed": -1}, "seed of a source -1: allowed is"),
    ({"seed": None}, "seed of a source None: allowed is"),
])  # fmt: skip
def test_bad_sources_are_refused(given, words):
    with pytest.raises(ValueError, match=words):
        source(**given)


@pytest.mark.parametrize(("given", "words"), [
    ({"shape": "box"}, "allowed are a Sphere, Box, .* or vertices .*, got str"),
    ({"shape": Plane((0, 0, 1))}, "shape of a source: .*, got Plane"),
    ({"shape": Mesh.revolved([(0.0, 0.0), (1.0, 1.0)], 4)}, "shape of a source: .*, got Mesh"),
    ({"shape": Box((1, 1, 1), center=(1, 0, 0))}, "its center and quaternion must be those of its frame"),
    ({"shape": Cylinder(1.0, 1.0, center=(1, 0, 0))}, "its center and quaternion must be those of its frame"),
    ({"shape": np.zeros((3, 3))}, "vertices must have shape"),
    ({"shape": np.eye(5, 3)}, "is no corner of their hull|in a plane"),
    ({"shape": CLUMP, "radius": 2.0}, "radius of a source: 2; its shape has one size, so allowed is 1, or none"),
    ({"shape": CLUMP, "radius": Uniform(1.0, 2.0)}, "radius of a source: 1 to 2; its shape has one size"),
])  # fmt: skip
def test_what_is_no_shape_of_grains_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        Scene(0.3).add_source("rain", BLOCK, density=1.0, number_rate=1.0, **given)


def test_a_misspelt_argument_is_told_with_the_nearest_one():
    with pytest.raises(TypeError, match="add_source: there is no argument 'rate'; .*; did you mean mass_rate"):
        Scene(0.3).add_source("rain", BLOCK, radius=0.1, density=1.0, rate=1.0)
    with pytest.raises(ValueError, match="perod: .*; did you mean period"):
        Scene(0.3, perod=(1, 1, 1))


def test_bad_distributions_regions_and_names_are_refused():
    with pytest.raises(ValueError, match="the second must not be less"):
        Uniform(0.2, 0.1)
    with pytest.raises(ValueError, match="Uniform.low: allowed is one number"):
        Uniform((0.1, 0.2), 0.3)
    with pytest.raises(ValueError, match="Block.low must be 3 numbers, got 0"):
        Block(0, 1)
    with pytest.raises(ValueError, match="most grains of a source: allowed are real numbers, got 'a'"):
        source(most="a")
    with pytest.raises(ValueError, match="2 sizes of grains with 1 shares"):
        Listed((0.1, 0.2), (1.0,))
    scene = Scene(0.3)
    scene.add_outlet("out", BLOCK)
    with pytest.raises(ValueError, match="distinct names"):
        scene.add_source("out", BLOCK, radius=0.1, density=1.0, mass_rate=1.0)
    with pytest.raises(ValueError, match=r"allowed is a Block or a Cylinder"):
        scene.add_outlet("other", (0, 1))
    with pytest.raises(ValueError, match="empty scene"):
        scene.grains()
