"""Boxes, polyhedra, cylinders and superellipsoids on surfaces of triangles."""

from __future__ import annotations

import numpy as np
import pytest
from cases import contacts_by_key, random_quaternions, step
from mpi4py import MPI
from test_mesh import block, moved_on, sheet

from dem import quaternion
from dem.bodies import BOX, CONVEX, POLYHEDRON
from dem.contact import find_contacts
from dem.contact.convex import solids, solids_planes, solids_solids, supports_of
from dem.contact.meshes import PlacedMesh
from dem.contact.narrow import Planes
from dem.contact.polyhedra import Polyhedra, hulls_of, polyhedra_planes, polyhedra_polyhedra
from dem.contact.solid_meshes import solid_mesh
from dem.mesh import Mesh
from dem.motion import Dynamic, Rotation
from dem.scene import Scene
from dem.shapes import Cylinder, Plane, Sphere, Superellipsoid, polyhedra
from dem.shapes.convex import form
from dem.start import new_world

SELF = MPI.COMM_SELF
ROCK = [(-0.1, -0.1, 0), (0.1, -0.1, 0), (0, 0.12, 0), (0, 0, 0.12), (0.08, 0.08, 0.08), (-0.1, 0.08, 0.08)]
ROUND = (Cylinder(0.1, 0.3), Cylinder(0.3, 0.1), Superellipsoid((0.2, 0.12, 0.09)),
         Superellipsoid((0.25, 0.15, 0.1), (6, 4)))  # fmt: skip
FORMS = (*map(form, ROUND), polyhedra.solid(2.0 * np.array(ROCK)))
HULLS, SUPPORTS = hulls_of(FORMS), supports_of(FORMS)


def on(mesh, kind, center, turn, size, delta):
    """Contacts of shapes with a mesh at the origin."""
    count = len(center)
    body = solids(np.full(count, kind), center, turn, size, HULLS, SUPPORTS)
    placed = PlacedMesh(mesh.surface, mesh.surface.middle, np.eye(3))
    return solid_mesh(body, placed, np.full(count, delta), HULLS)


def boxes(center, turn, half):
    return Polyhedra(center, turn, half, np.zeros(len(center), int), HULLS)


def turns(rng, count, angle):
    """Small ones, after one about the vertical."""
    upright = np.zeros((count, 3))
    upright[:, 2] = rng.uniform(0.0, 6.0, count)
    small = angle * rng.normal(size=(count, 3))
    return quaternion.matrix(quaternion.exponential(small)) @ quaternion.matrix(quaternion.exponential(upright))


def least(found, count):
    gap = np.full(count, np.inf)
    np.minimum.at(gap, found.pair, found.touch.gap)
    return gap


@pytest.mark.parametrize("angle", [0.0, 1e-5, 1e-3, 0.05, 2.0])
def test_a_box_on_a_flat_mesh_touches_as_on_a_plane(angle):
    """Its corners, each once, whichever triangles they are over, from both sides."""
    rng, count = np.random.default_rng(1), 300
    half, turn, side = rng.uniform(0.1, 0.2, (count, 3)), turns(rng, count, angle), rng.choice([-1.0, 1.0], count)
    gap = rng.choice([0.0, 1e-3, -1e-3, 1e-5, -1e-5, 1e-2], count)
    height = (np.abs(turn[:, 2]) * half).sum(axis=1) + gap
    center = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), side * height])
    found = on(sheet(rng=rng), BOX, center, turn, half, 0.02)
    up = side[:, None] * [0.0, 0.0, 1.0]
    plane = polyhedra_planes(boxes(center, turn, half), Planes(up, np.zeros((count, 3))), np.full(count, 0.02))
    mine, right = (np.lexsort((*np.round(each.touch.point.T, 7), each.pair)) for each in (found, plane))
    np.testing.assert_array_equal(found.pair[mine], plane.pair[right])
    for name in ("point", "normal", "gap"):
        np.testing.assert_allclose(getattr(found.touch, name)[mine], getattr(plane.touch, name)[right], atol=1e-12)
    code = found.pair * (found.feature.max() + 1) + found.feature
    assert len(np.unique(code)) == len(code)


def test_a_box_over_triangles_whose_corners_meet_the_side_of_another():
    """One whole edge and two of its parts, a triangle without area, and one that is there twice."""
    vertices = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (0, -1, 0), (0, 0.2, 0), (0, 1, 0), (0.5, 0, 0)]
    halves = [(0, 4, 6), (0, 6, 3), (4, 1, 5), (1, 2, 5), (5, 2, 6), (4, 5, 6), (5, 2, 6), (0, 1, 4)]
    rng, count = np.random.default_rng(7), 200
    half, turn = np.tile([0.2, 0.1, 0.1], (count, 1)), turns(rng, count, 1e-4)
    height = (np.abs(turn[:, 2]) * half).sum(axis=1) + rng.choice([1e-3, 0.0, -1e-4], count)
    center = np.column_stack([rng.uniform(-0.3, 0.3, (count, 2)), height])
    found = on(Mesh(vertices, halves), BOX, center, turn, half, 0.02)
    plane = Planes(np.tile([0.0, 0, 1], (count, 1)), np.zeros((count, 3)))
    right = polyhedra_planes(boxes(center, turn, half), plane, np.full(count, 0.02))
    np.testing.assert_allclose(least(found, count), least(right, count), atol=1e-9)
    np.testing.assert_allclose(found.touch.normal, np.tile([0, 0, -1.0], (len(found.pair), 1)), atol=5e-3)
    corners = np.round(np.column_stack([right.pair, right.touch.point]), 6).tolist()
    assert {tuple(row) for row in corners} <= {
        tuple(row) for row in np.round(np.column_stack([found.pair, found.touch.point]), 6).tolist()
    }


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.05, 2.0])
def test_boxes_are_as_far_from_a_block_of_triangles_as_from_a_box(angle):
    """Over its top, its rims and its corners. What is beside an edge by less than its skin may differ by that."""
    rng, count = np.random.default_rng(2), 2000
    size = np.array([0.5, 0.4, 0.3])
    half, turn = rng.uniform(0.05, 0.4, (count, 3)), turns(rng, count, angle)
    height = size[2] + (np.abs(turn[:, 2]) * half).sum(axis=1) + rng.choice([0.0, 1e-3, 1e-5, -1e-5], count)
    center, thick = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), height]), half.min(axis=1)
    found = on(block(size), BOX, center, turn, half, 0.02)
    other = Polyhedra(np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1)), np.tile(size, (count, 1)),
                      np.zeros(count, int), HULLS)  # fmt: skip
    right = polyhedra_polyhedra(boxes(center, turn, half), other, np.full(count, 0.02))
    mine, gap = least(found, count), least(right, count)
    near, both = gap < 0.015, np.isfinite(mine) & np.isfinite(gap)
    assert near.sum() > 1000
    assert np.isfinite(mine[near]).all()
    off = np.abs(mine[both] - gap[both]) / thick[both]
    assert off.max() < 0.03
    assert np.quantile(off, 0.98) < 1e-3
    assert (mine[both] > -2e-5 - 1e-3 * thick[both]).all()
    if angle < 0.01:  # what bears it is what bears it on a box
        many = np.bincount(found.pair, minlength=count) - np.bincount(right.pair, minlength=count)
        assert (many == 0).mean() > 0.95
        assert (many < 0).mean() < 0.01


@pytest.mark.parametrize("number", range(len(FORMS)))
def test_other_solids_are_as_far_from_a_block_of_triangles_as_from_a_box(number):
    """On all of its sides, rims and corners, apart and overlapping; within the skin of sharp edges."""
    rng, count, shape, size = np.random.default_rng(10 + number), 700, FORMS[number], np.array([0.5, 0.4, 0.3])
    kind = (POLYHEDRON if isinstance(shape, polyhedra.Solid) else CONVEX) + number
    turn = np.concatenate([turns(rng, count, angle) for angle in (1e-3, 0.05, 2.0)])
    count = len(turn)
    body = solids(np.full(count, kind), rng.uniform(-0.9, 0.9, (count, 3)), turn, np.tile(shape.size, (count, 1)),
                  HULLS, SUPPORTS)  # fmt: skip
    box = solids(np.full(count, BOX), np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1)),
                 np.tile(size, (count, 1)), HULLS, SUPPORTS)  # fmt: skip
    apart = solids_solids(body, box, np.full(count, 0.4), HULLS)
    order = np.lexsort((apart.touch.gap, apart.pair))
    pair, first = np.unique(apart.pair[order], return_index=True)
    touch = apart.touch.take(order[first])
    pair, touch = pair[touch.gap > 1e-3], touch.take(touch.gap > 1e-3)
    wanted = rng.choice([1e-3, 0.0, -2e-4], len(pair))
    body = body.take(pair)
    body = body._replace(center=body.center + touch.normal * (touch.gap - wanted)[:, None])
    right = least(solids_solids(body, box.take(pair), np.full(len(pair), 0.02), HULLS), len(pair))
    mesh = block(size)
    placed = PlacedMesh(mesh.surface, mesh.surface.middle, np.eye(3))
    mine = least(solid_mesh(body, placed, np.full(len(pair), 0.02), HULLS), len(pair))
    near = right < 0.015
    assert near.sum() > 1000
    off = np.abs(mine - right)[near] / body.thick[near]
    assert off.max() < (1e-3 if body.rounding[0] > 0.0 else 0.03)


def test_round_shapes_on_a_flat_mesh_touch_as_on_a_plane():
    rng, count = np.random.default_rng(3), 300
    mesh = sheet(rng=rng)
    for number, shape in enumerate(FORMS[: len(ROUND)]):
        turn = turns(rng, count, 2.0)
        size = np.tile(shape.size, (count, 1))
        far = solids(np.full(count, CONVEX + number), np.zeros((count, 3)), turn, size, HULLS, SUPPORTS)
        up = Planes(np.tile([0.0, 0, 1], (count, 1)), np.tile([0.0, 0, -9], (count, 1)))
        lowest = least(solids_planes(far, up, np.full(count, 99.0), HULLS), count) - 9.0
        gap = rng.choice([0.0, 1e-3, -1e-3, 5e-3], count)
        center = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), gap - lowest])
        found = on(mesh, CONVEX + number, center, turn, size, 0.01)
        np.testing.assert_allclose(least(found, count), gap, atol=1e-9)
        np.testing.assert_allclose(found.touch.normal, np.tile([0.0, 0, -1], (len(found.pair), 1)), atol=1e-9)


def test_a_box_in_a_groove_touches_both_sides_and_one_that_has_gone_through_both_too():
    mesh = Mesh([(-1, -1, 1), (-1, 1, 1), (0, -1, 0), (0, 1, 0), (1, -1, 1), (1, 1, 1)],
                [(0, 2, 1), (1, 2, 3), (2, 4, 3), (3, 4, 5)])  # fmt: skip
    turn = quaternion.matrix(quaternion.exponential(np.array([[0.0, np.pi / 4, 0.0]])))
    half = np.array([[0.1, 0.3, 0.2]])
    for gap in (1e-3, 0.0, -5e-4):
        one, other = half[0, 0] + gap, half[0, 2] + gap  # from the sides
        center = np.array([[np.sqrt(0.5) * (other - one), 0.013, np.sqrt(0.5) * (one + other)]])
        found = on(mesh, BOX, center, turn, half, 0.01)
        np.testing.assert_allclose(found.touch.gap, gap, atol=1e-12)
        left = found.touch.normal[:, 0] < 0.0
        assert left.sum() == (~left).sum() == 4
        np.testing.assert_allclose(np.abs(found.touch.normal[:, [0, 2]]), np.sqrt(0.5), atol=1e-12)


def slid(floor, add):
    """Places and velocities of the grains after they slid over a floor."""
    scene = Scene(friction=0.3)
    scene.add_body("floor", [floor])
    add(scene)
    world = new_world(scene, SELF)
    list(moved_on(world, 25, tol=1e-5))  # twice as many contacts on one line as bear it: smaller ones take long
    order = np.argsort(world.grains.id)
    return world.grains.position[order], world.grains.velocity[order]


@pytest.mark.parametrize(
    "add",
    [
        lambda scene: scene.add_boxes([(-1, 0, 0.1)], (0.15, 0.1, 0.1), 1000.0, velocity=(2, 0.3, 0)),
        lambda scene: scene.add_polyhedra([(-1, 0, 0)], ROCK, 1000.0, velocity=(1.5, 0.3, 0)),
        pytest.param(
            lambda scene: scene.add_grains([(-1, 0, 0.1)], Cylinder(0.15, 0.2), 1000.0, velocity=(2, 0.3, 0)),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["box", "polyhedron", "cylinder"],
)
def test_what_slides_over_the_edges_of_a_flat_mesh_goes_on_as_on_a_plane(add):
    """Also where the sides of triangles meet corners of others."""
    plane, rng = slid(Plane((0, 0, 1)), add), np.random.default_rng(4)
    parts = [sheet(count, 0.8, rng) for count in (3, 5, 4)]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    strips = Mesh(
        np.concatenate([part.vertices + [0.8 * k - 1.0, 0, 0] for k, part in enumerate(parts)]),
        np.concatenate([part.triangles + first for part, first in zip(parts, starts)]),
    )
    for floor in (sheet(12, 4.0, rng), strips):
        mesh = slid(floor, add)
        np.testing.assert_allclose(mesh[0], plane[0], atol=1e-4)
        np.testing.assert_allclose(mesh[1], plane[1], atol=1e-4)
    assert abs(plane[0][0, 0] + 1.0) > 0.2


def test_a_box_leaves_a_table_over_its_rim_without_being_caught():
    scene = Scene(friction=0.0)
    scene.add_body("table", [block((0.5, 0.5, 0.2), center=(0, 0, -0.2))])
    scene.add_boxes([(0.0, 0.03, 0.05)], (0.1, 0.1, 0.05), 1000.0, velocity=(1.0, 0.0, 0.0))
    world = new_world(scene, SELF)
    for _ in moved_on(world, 90):
        assert world.grains.velocity[0, 0] > 0.999
        if world.grains.position[0, 0] < 0.49:
            np.testing.assert_allclose(world.grains.position[0, 2], 0.05, atol=1e-5)
    assert world.grains.position[0, 2] < -0.2  # it tips over the rim and falls


def test_a_tool_of_triangles_rests_on_boxes():
    scene = Scene(friction=0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_body("tool", [block()], Dynamic(), mass=480.0, inertia=(40.0, 54.4, 65.6), position=(0, 0, 0.51))
    scene.add_boxes([(x, y, 0.1) for x in (-0.4, 0.35) for y in (-0.3, 0.3)], (0.2, 0.15, 0.1), 1000.0)
    world = new_world(scene, SELF)
    list(moved_on(world, 30))
    np.testing.assert_allclose(world.large.position[1], [0, 0, 0.5], atol=1e-3)
    np.testing.assert_allclose(world.grains.velocity, 0.0, atol=1e-6)


def mixture():
    """All kinds of grains in a turning drum with a free ball."""
    rng = np.random.default_rng(5)
    scene = Scene(friction=0.4)
    profile = [(0.0, -0.49), (0.7, -0.49), (0.7, 0.49), (0.0, 0.49)]
    scene.add_body("drum", [Mesh.revolved(profile, 12)], Rotation((0.3, 1.0, 0)))
    scene.add_body("ball", [Sphere(0.1)], Dynamic(), density=500.0, position=(0.57, 0, 0), velocity=(1, 0, 0))
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    places = 0.22 * (grid - 1.5) + rng.uniform(-0.01, 0.01, grid.shape) - [0, 0, 0.05]
    speeds, quaternions = rng.normal(size=places.shape), random_quaternions(rng, len(places))

    def those(k):
        return {"quaternions": quaternions[k::5], "velocity": speeds[k::5]}

    scene.add_boxes(places[::5], (0.07, 0.05, 0.06), 1000.0, **those(0))
    scene.add_polyhedra(places[1::5], 0.7 * np.array(ROCK), 1000.0, **those(1))
    scene.add_grains(places[2::5], Cylinder(0.06, 0.12), 1000.0, **those(2))
    scene.add_grains(places[3::5], Superellipsoid((0.09, 0.07, 0.05), (3, 2)), 1000.0, **those(3))
    scene.add_capsules(places[4::5], 0.05, 0.04, 1000.0, **those(4))
    return scene


def test_keys_of_solids_on_meshes_are_distinct():
    found = find_contacts(new_world(mixture(), SELF, overlap=10.0), 0.1)
    drum = found.b >= len(found.near.bodies) - 2
    assert drum.sum() > 40
    assert len(np.unique(found.key)) == len(found)


@pytest.mark.parallel(3)
def test_on_several_ranks_solids_have_the_contacts_with_meshes_that_they_have_on_one():
    worlds = [new_world(mixture(), comm) for comm in (SELF, MPI.COMM_WORLD)]
    touched = 0
    for _ in range(4):
        one, many = (contacts_by_key(step(world, delta=0.03), world.comm) for world in worlds)
        np.testing.assert_array_equal(one["key"], many["key"])
        for name in ("point", "normal", "gap"):
            np.testing.assert_allclose(one[name], many[name], atol=1e-8)
        touched += np.count_nonzero(one["b"] == len(worlds[0].grains))
    assert touched > 20
