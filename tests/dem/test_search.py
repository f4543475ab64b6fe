"""The contact search against all pairs, one by one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from cases import contacts_by_key, heap, random_quaternions, step
from convex import signed_distance
from mpi4py import MPI

from dem import quaternion
from dem.arrays import places
from dem.bodies import BOX, CAPSULE, COMPOUND, SPHERE
from dem.contact import find_contacts
from dem.contact.primitives import most_numbers, primitives
from dem.measures import Block
from dem.motion import Dynamic, Fixed, Glide
from dem.parts.sources import Tally
from dem.scene import Scene
from dem.shapes import Box, Capsule, Clump, Plane, Sphere
from dem.start import new_world
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained

SELF = MPI.COMM_SELF


def found_pairs(world, delta):
    found = contacts_by_key(find_contacts(world, delta), world.comm)
    gaps = {}
    for a, b, gap in zip(found["a"], found["b"], found["gap"]):
        gaps.setdefault((a, b), []).append(gap)
    return {pair: sorted(values) for pair, values in gaps.items()}


def test_normals_point_from_the_first_to_the_second_body():
    world = new_world(heap(2, side=3), SELF)
    for _ in range(10):
        step(world)
    contacts = find_contacts(world, 0.03)
    table = contacts.near.bodies
    assert (table.id[contacts.a] < table.id[contacts.b]).all()
    both_grains = table.id[contacts.b] < world.slabs[-1]
    assert 10 < both_grains.sum() < len(contacts)
    offset = table.position[contacts.b] - table.position[contacts.a]
    assert (np.einsum("ij,ij->i", contacts.normal, offset)[both_grains] > 0).all()
    floor = np.isin(contacts.b, np.flatnonzero(table.id == world.slabs[-1]))
    assert (
        np.einsum("ij,ij->i", contacts.normal, contacts.point - table.position[contacts.a])[floor] > 0
    ).all()


def test_friction_is_that_of_the_pair_of_materials():
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 0.1], [1, 0, 0.1]], 0.1, 1000.0, material="glass")
    scene.add_spheres([[0, 0, 0.3]], 0.1, 1000.0, material="steel")
    scene.add_body("floor", [Plane((0, 0, 1))], material="wood")
    scene.set_pair("steel", "glass", friction=0.7)
    scene.set_pair("wood", "glass", friction=0.5)
    found = contacts_by_key(find_contacts(new_world(scene, SELF), 0.01), SELF)
    assert list(zip(found["a"], found["b"], found["friction"])) == [(0, 2, 0.7), (0, 3, 0.5), (1, 3, 0.5)]


def test_keys_are_unique_and_persist_while_contacts_do():
    world = new_world(heap(4, capsules=True), SELF)
    known = {}
    kept = 0
    for _ in range(20):
        found = contacts_by_key(step(world), SELF)
        assert len(set(found["key"])) == len(found["key"])
        for key, a, b in zip(found["key"], found["a"], found["b"]):
            kept += key in known
            assert known.setdefault(key, (a, b)) == (a, b)
    assert kept > len(known)


@pytest.mark.parametrize("seed", [1, 2])
def test_search_sees_what_may_touch_within_the_step(seed):
    """Against a search far beyond all that a step can bring."""
    world, delta, dt = new_world(heap(seed, side=4, capsules=True), SELF), 0.01, 0.05
    far = find_contacts(world, 1.0)
    system, table = ContactSystem(world, far, unconstrained(world, dt)), far.near.bodies
    found = find_contacts(world, delta, unconstrained(world, dt))
    seen = {tuple(pair) for pair in found.body}
    assert {tuple(pair) for pair in far.body[far.gap <= delta]} <= seen
    # what the free motion brings together, by the gaps that the contact problem sees
    late = (far.gap > delta) & (dt * system.r[:, 0] <= 0.0)
    assert late.sum() > 30
    assert {tuple(pair) for pair in far.body[late]} <= seen
    # what comes together as one of two grains is stopped
    speed = np.linalg.norm(table.velocity[:, :3] + dt * world.gravity, axis=1)
    stopped = (far.b < len(world.grains)) & (far.gap <= dt * np.maximum(speed[far.a], speed[far.b]))
    assert (stopped & ~late & (far.gap > delta)).sum() > 30
    assert {tuple(pair) for pair in far.body[stopped]} <= seen


def test_margins_of_two_bodies_meet():
    """Half of delta each, or a quarter more than the way of a grain, or the way of a large body."""
    scene = Scene(friction=0.3, gravity=(0, 0, 0))
    velocity = [[0, 0, 0], [3.0, 0, 0], [0, 0, 0], [0, 0, 0]]
    scene.add_spheres([[0, 0, 0], [0.25, 0, 0], [0, 1, 0], [0.25, 1, 0]], 0.1, 1000.0, velocity=velocity)
    scene.add_body("tool", [Box((0.01, 0.1, 0.1))], Glide((-3.0, 0, 0)), position=(0.4, 1, 0))
    world = new_world(scene, SELF)

    def pairs(delta, dt):
        free = unconstrained(world, dt) if dt else None
        found = contacts_by_key(find_contacts(world, delta, free), SELF)
        return list(zip(found["a"], found["b"]))

    assert pairs(0.02, 0.0) == []
    assert pairs(0.02, 0.0099) == []  # gaps 0.05, margins 0.01 + 0.037; from the tool 0.04, 0.01 + 0.0297
    assert pairs(0.02, 0.0101) == [(3, 4)]
    assert pairs(0.02, 0.0106) == [(3, 4)]
    assert pairs(0.02, 0.0107) == [(0, 1), (3, 4)]


def test_threshold_is_inclusive_and_gap_is_signed():
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 0], [0, 0, 2.5], [5, 0, 0], [5, 0, 1.99]], 1.0, 1000.0)
    world = new_world(scene, SELF, overlap=0.1)
    np.testing.assert_allclose(np.sort(find_contacts(world, 0.5).gap), [-0.01, 0.5])
    np.testing.assert_allclose(find_contacts(world, 0.49).gap, [-0.01])
    with pytest.raises(ValueError, match="delta"):
        find_contacts(world, -0.1)


def primitives_of(world):
    """All shapes but half spaces: (id of the body, centre, frame, half extents of the core, radius)."""
    found = []
    for table, row in itertools.chain(*([(t, r) for r in range(len(t))] for t in (world.grains, world.large))):
        if table is world.large:
            parts = world.large_bodies[row].shapes
        else:
            size = table.size[row]
            make = {SPHERE: lambda r, *_: Sphere(r), BOX: lambda *h: Box(h), CAPSULE: lambda r, h, _: Capsule(r, h)}
            parts = [make[int(table.shape[row])](*size)]
        for part in parts:
            if isinstance(part, Plane):
                continue
            turn = np.array(getattr(part, "quaternion", (1.0, 0.0, 0.0, 0.0)))
            frame = quaternion.matrix(quaternion.multiply(table.quaternion[row], turn))
            center = table.position[row] + quaternion.rotate(table.quaternion[row], np.array(part.center))
            half = np.array(getattr(part, "half_extents", (0.0, 0.0, getattr(part, "half_length", 0.0))))
            found.append((table.id[row], (center, frame, half, getattr(part, "radius", 0.0))))
    return found


def crowd(seed, side=4):
    """Turned grains of three kinds on a jittered lattice, so close that many overlap, and four large bodies."""
    rng = np.random.default_rng(seed)
    scene = Scene(friction=0.3)
    grid = 0.2 * np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3)
    spheres, boxes, capsules = np.split(rng.permutation(grid + rng.uniform(-0.02, 0.02, grid.shape)), [24, 44])
    scene.add_spheres(spheres, rng.uniform(0.08, 0.11, len(spheres)), 1000.0)
    half, turns = rng.uniform(0.05, 0.1, (len(boxes), 3)), random_quaternions(rng, len(boxes))
    scene.add_boxes(boxes, half, 1000.0, quaternions=turns)
    radius, half_length = rng.uniform(0.05, 0.07, (2, len(capsules)))
    turns = random_quaternions(rng, len(capsules))
    scene.add_capsules(capsules, radius, half_length, 1000.0, quaternions=turns)
    turns = random_quaternions(rng, 4)
    parts = [Box((0.3, 0.2, 0.1), (0.1, 0, 0), turns[0]), Capsule(0.1, 0.2, (-0.3, 0, 0), turns[1])]
    for name, place, motion, density in (
        ("low", (0.3, 0.3, -0.3), Fixed(), None),
        ("high", (0.3, 0.3, 0.9), Dynamic(), 500.0),
        ("top", (0.3, 0.3, 1.2), Dynamic(), 500.0),
        ("side", (0.3, 1.0, 0.9), Fixed(), None),
    ):
        scene.add_body(name, [*parts, Sphere(0.1, (0.2, 0.2, 0))], motion, position=place, density=density)
    return new_world(scene, SELF, overlap=np.inf)


@pytest.mark.parametrize("seed", [1, 2])
def test_pairs_of_any_shapes_touch_where_optimisation_says(seed):
    delta, world = 0.03, crowd(seed)
    free = {world.large.id[1], world.large.id[2]}
    expected = {}
    for (i, one), (j, other) in itertools.combinations(primitives_of(world), 2):
        reach = sum(np.linalg.norm(body[2]) + body[3] for body in (one, other)) + delta
        both_large = min(i, j) >= world.slabs[-1]
        if i == j or (both_large and not {i, j} & free) or np.linalg.norm(one[0] - other[0]) > reach:
            continue
        gap, pair = signed_distance(one, other), (min(i, j), max(i, j))
        expected[pair] = min(gap, expected.get(pair, np.inf))
    found = {pair: gaps[0] for pair, gaps in found_pairs(world, delta).items()}
    kinds = np.append(world.grains.shape[np.argsort(world.grains.id)], world.large.shape)
    met = {tuple(sorted((kinds[i], kinds[j]))) for i, j in found}
    assert met == set(itertools.combinations_with_replacement((SPHERE, BOX, COMPOUND, CAPSULE), 2))
    assert found.keys() <= {pair for pair, gap in expected.items() if gap <= delta}
    assert found.keys() >= {pair for pair, gap in expected.items() if gap <= 0.9 * delta - 1e-4}
    deep = 0.0
    for pair, gap in found.items():
        if gap > -0.04:  # the cores of capsules do not overlap
            assert gap == pytest.approx(expected[pair], abs=0.1 * delta + 2e-4)
        deep = min(deep, gap)
    assert deep < -0.02


def press_scene(motion):
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 5]], 0.1, 1000.0)
    scene.add_body("walls", [Plane((0, 0, 1)), Plane((1, 0, 0), (-1, 0, 0)), Box((0.1, 1, 1), (1.1, 0, 1))])
    mass = {"density": 500.0} if isinstance(motion, Dynamic) else {}
    scene.add_body("press", [Box((0.995, 0.5, 0.2)), Sphere(0.1, (0, 0, 0.4))], motion, position=(0, 0, 0.2), **mass)
    scene.add_body("ram", [Capsule(0.1, 0.5, (0, 0, 1.3))])
    return new_world(scene, SELF)


def test_a_free_large_body_touches_other_large_bodies():
    world = press_scene(Dynamic())
    contacts = find_contacts(world, 0.01)
    found = contacts_by_key(contacts, SELF)
    pairs = list(zip(found["a"], found["b"]))
    assert pairs.count((1, 2)) == 4 + 4 + 4  # floor, wall and side box
    assert pairs.count((2, 3)) == 1  # ball under the ram
    assert len(pairs) == 13
    assert len(set(found["key"])) == 13
    np.testing.assert_allclose(np.sort(np.abs(found["gap"])), [0] * 5 + [0.005] * 8, atol=1e-12)
    np.testing.assert_array_equal(contacts.owned, [0])


def test_a_search_changes_nothing_in_the_world():
    world = new_world(heap(1, side=3), SELF)
    before, tables = dict(vars(world)), [dict(table.columns()) for table in (world.grains, world.large)]
    assert find_contacts(world, 0.02, unconstrained(world, 0.01)).owned.any()
    assert vars(world) == before
    for table, columns in zip((world.grains, world.large), tables):
        assert all(column is columns[name] for name, column in table.columns().items())


def test_a_lost_grain_is_an_error():
    world = new_world(heap(1, side=3), SELF)
    world.grains.position[4, 1] = np.nan
    with pytest.raises(FloatingPointError, match="no finite position or velocity at step 0"):
        find_contacts(world, 0.02)


def test_keys_tell_the_contacts_of_a_million_million_grains_apart():
    near = find_contacts(new_world(heap(1, side=2, boxes=False), SELF), 0.0).near
    features = primitives(near, [], 10**12).hulls.features
    most = most_numbers(features)
    with pytest.raises(ValueError, match=f"their contacts have no keys; allowed are {most} together"):
        primitives(near, [], most + 1)
    last = np.arange(10**12 - 3, 10**12)
    key = np.concatenate([one + 1j * (last * features + features - 1) for one in last])
    np.testing.assert_array_equal(places(key, key[::-1]), np.arange(9)[::-1])
    assert places(key, key[:1] - 1j).tolist() == [-1]


def test_the_keys_of_clumps_that_sources_let_in_are_counted():
    scene, region = Scene(0.3), Block((0, 0, 0), (1, 1, 1))
    clump = Clump(0.1 * np.arange(300).reshape(100, 3), np.full(100, 0.05))
    for name, shape in {"clumps": clump, "boxes": 0.1 * np.indices((2, 2, 2)).reshape(3, -1).T}.items():
        scene.add_source(name, region, shape=shape, density=1.0, number_rate=1.0)
    scene.add_clumps([(0, 0, 0)], clump, 1.0)
    world = new_world(scene, SELF)
    assert find_contacts(world, 0.0).near.grains == 1
    world = new_world(scene, SELF)
    world.passages.tallies["clumps"] = Tally(count=10**12 - 1)
    with pytest.raises(ValueError, match="their contacts have no keys"):
        find_contacts(world, 0.0)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("period", [None, (1.2, 1.2, None)])
def test_a_search_among_some_grains_finds_their_contacts_alone(period):
    """Those of every third grain, with other grains, images and walls, and of large bodies with each other."""
    scene, rng = Scene(0.5, period=period), np.random.default_rng(8)
    places = np.indices((6, 6, 3)).reshape(3, -1).T * 0.2 + 0.1
    scene.add_boxes(places + rng.uniform(-0.01, 0.01, places.shape), (0.085, 0.075, 0.08), 1e3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_body("block", [Box((0.1, 0.1, 0.1))], position=(0.6, 0.6, 0.75))

    def third(near):
        return near.bodies.id[: near.grains + near.ghosts] % 3 == 0

    world = new_world(scene, MPI.COMM_WORLD)
    every, some = (contacts_by_key(find_contacts(world, 0.04, among=of), world.comm) for of in (None, third))
    grains, a, b = world.slabs[-1], every["a"], every["b"]
    wanted = ((a % 3 == 0) & (a < grains)) | ((b % 3 == 0) & (b < grains))
    assert 50 < wanted.sum() < 0.8 * len(wanted)
    for name in ("key", "a", "b", "gap"):
        assert np.array_equal(every[name][wanted], some[name])
