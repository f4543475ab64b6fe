"""Cylinders and superellipsoids: moments and contacts by closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from convex import signed_distance
from mpi4py import MPI

from dem import quaternion
from dem.bodies import BOX, CAPSULE, CONVEX, POLYHEDRON, SPHERE
from dem.contact import find_contacts
from dem.contact.convex import solids, solids_planes, solids_solids, supports_of
from dem.contact.narrow import CORNERS, Planes
from dem.contact.polyhedra import hulls_of
from dem.motion import Dynamic
from dem.scene import Scene
from dem.shapes import Capsule, Cylinder, Plane, Superellipsoid, described, mass_properties, polyhedra
from dem.shapes.convex import form
from dem.shapes.superellipsoid import supports
from dem.start import new_world

R, L = 0.23, 0.9
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
LYING = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)  # along x
FORMS = tuple(map(form, (
    Cylinder(R, L), Superellipsoid((0.31, 0.24, 0.17)), Superellipsoid((0.2, 0.3, 0.25), (3.0, 5.0)),
    Superellipsoid((R, R, R)),
))) + (polyhedra.solid(CORNERS * [0.4, 0.5, 0.1]), form(Cylinder(R, 0.02)))  # fmt: skip
HULLS, SUPPORTS = hulls_of(FORMS), supports_of(FORMS)


def body(kind, center, turn=UPRIGHT, size=None, scale=1.0):
    size = scale * FORMS[kind - CONVEX if kind >= CONVEX else kind - POLYHEDRON].size if size is None else size
    columns = (np.array([kind]), np.array([center], float), np.array([turn], float), np.array([size], float))
    return solids(columns[0], columns[1], quaternion.matrix(columns[2]), columns[3], HULLS, SUPPORTS)


def ball(center, radius):
    return body(SPHERE, center, size=(radius, 0, 0))


def met(one, other, reach=0.05):
    return solids_solids(one, other, np.array([reach]), HULLS)


def on_plane(one, normal, point, reach=0.05):
    return solids_planes(one, Planes(np.array([normal], float), np.array([point], float)), np.array([reach]), HULLS)


@pytest.mark.parametrize("exponents", [(2.0, 2.0), (3.0, 5.5), (7.0, 2.5)])
def test_volume_and_moments_are_those_of_integrals_over_directions(exponents):
    """In the distance r to the surface: of r^3 / 3, and of r^5 / 5 times squares of the direction."""
    axes = np.array([0.4, 0.25, 0.3])
    n, m = exponents
    node, weight = np.polynomial.legendre.leggauss(200)
    turn, wide = 0.25 * np.pi * (node + 1.0), 0.25 * np.pi * weight
    z, high = 0.5 * (node + 1.0), 0.5 * weight
    flat = np.sqrt(1.0 - z**2)[:, None]
    way = np.stack([flat * np.cos(turn), flat * np.sin(turn), np.broadcast_to(z[:, None], (200, 200))], axis=-1)
    x, y, z = np.moveaxis(way / axes, -1, 0)
    r = ((x**m + y**m) ** (n / m) + z**n) ** (-1.0 / n)
    area = 8.0 * high[:, None] * wide
    second = np.einsum("ij,ij,ijk->k", area, r**5 / 5.0, way**2)
    shape = form(Superellipsoid(axes, exponents))
    np.testing.assert_allclose(shape.volume, (area * r**3 / 3.0).sum(), rtol=1e-5)
    np.testing.assert_allclose(shape.moments, second.sum() - second, rtol=1e-5)
    assert r.max() * (1 - 1e-12) <= shape.size[0] <= r.max() * (1 + 1e-3)


def test_mass_properties_of_a_cylinder_and_an_ellipsoid():
    mass, center, tensor = mass_properties([Cylinder(R, L, center=(1, 2, 3), quaternion=LYING)], 700.0)
    assert mass == pytest.approx(700.0 * np.pi * R**2 * L)
    lateral = mass * (R**2 / 4 + L**2 / 12)
    np.testing.assert_allclose(center, (1, 2, 3))
    np.testing.assert_allclose(tensor, np.diag([mass * R**2 / 2, lateral, lateral]), atol=1e-9 * mass)
    mass, _, tensor = mass_properties([Superellipsoid((0.5, 0.2, 0.3))], 700.0)
    assert mass == pytest.approx(700.0 * 4 / 3 * np.pi * 0.03)
    np.testing.assert_allclose(tensor, mass / 5 * np.diag([0.13, 0.34, 0.29]), atol=1e-9 * mass)


@pytest.mark.parametrize(("place", "gap", "normal"), [
    ((R + 0.2, 0, 0.1), 0.05, (-1, 0, 0)),
    ((0, R + 0.13, -0.2), -0.02, (0, -1, 0)),
    ((0.1, 0.05, L / 2 + 0.16), 0.01, (0, 0, -1)),
    ((R + 0.12, 0, L / 2 + 0.09), 0.0, (-0.8, 0, -0.6)),
    ((R + 0.116, 0, -L / 2 - 0.087), -0.005, (-0.8, 0, 0.6)),
])  # fmt: skip
def test_a_ball_touches_side_end_and_rim_of_a_cylinder(place, gap, normal):
    found = met(ball(place, 0.15), body(CONVEX, (0, 0, 0)))
    np.testing.assert_allclose(found.touch.gap, [gap], atol=1e-12)
    np.testing.assert_allclose(found.touch.normal, [normal], atol=1e-7)
    end = np.array(place) + (0.15 + 0.5 * gap) * np.array(normal)
    np.testing.assert_allclose(found.touch.point, [end], atol=1e-7)


def test_distance_of_an_ellipsoid_and_a_plane():
    axes, turn = np.array(FORMS[1].shape.axes), np.array([0.4, 0.2, 0.7, -0.3])
    turn /= np.linalg.norm(turn)
    normal = np.array([2.0, -1.0, 2.0]) / 3.0
    scale = 1.3
    own = quaternion.rotate(quaternion.conjugate(turn), normal)
    found = on_plane(body(CONVEX + 1, 0.4 * normal, turn, scale=scale), normal, (0, 0, 0), 0.3)
    np.testing.assert_allclose(found.touch.gap, [0.4 - scale * np.linalg.norm(axes * own)], rtol=1e-12)
    lowest = 0.4 * normal - quaternion.rotate(turn, scale * axes**2 * own / np.linalg.norm(axes * own))
    np.testing.assert_allclose(found.touch.point[0] + 0.5 * found.touch.gap * normal, lowest, atol=1e-12)


def test_an_ellipsoid_of_equal_axes_is_a_ball():
    way = np.array([2.0, 3.0, 6.0]) / 7.0
    for gap in (0.03, -0.01):
        place = (2 * R + gap) * way
        for found in (met(body(CONVEX + 3, (0, 0, 0)), body(CONVEX + 3, place)), met(ball((0, 0, 0), R),
                      body(CONVEX + 3, place))):  # fmt: skip
            np.testing.assert_allclose(found.touch.gap, [gap], atol=1e-12)
            np.testing.assert_allclose(found.touch.normal, [way], atol=1e-6)
            np.testing.assert_allclose(found.touch.point, [0.5 * place], atol=1e-6)


@pytest.mark.parametrize("gap", [0.02, 0.0, -0.006])
@pytest.mark.parametrize("other", [1, 2])
def test_superellipsoids_meet_where_their_normals_are_opposite(other, gap):
    normal, turn = np.array([1.0, 4.0, -8.0]) / 9.0, np.array([0.8, 0.1, -0.5, 0.3])
    turn /= np.linalg.norm(turn)
    own, frame = (np.array([*FORMS[k].shape.numbers, 0.0]) for k in (2, other)), quaternion.matrix(turn[None])[0]
    first, second = own
    tip = supports(first, normal[None])[0]
    place = tip + gap * normal - frame @ supports(second, -(frame.T @ normal)[None])[0]
    found = met(body(CONVEX + 2, (0, 0, 0)), body(CONVEX + other, place, turn))
    np.testing.assert_allclose(found.touch.gap, [gap], atol=1e-12)
    np.testing.assert_allclose(found.touch.normal, [normal], atol=1e-6)
    np.testing.assert_allclose(found.touch.point, [tip + 0.5 * gap * normal], atol=1e-6)


def test_a_cylinder_stands_on_six_points_and_lies_on_two():
    tilt = 0.02
    turn = (np.cos(tilt / 2), 0, np.sin(tilt / 2), 0)
    for shift in (0.0, 0.001):
        found = on_plane(body(CONVEX, (0, 0, L / 2 - shift)), (0, 0, 1), (0, 0, 0))
        np.testing.assert_allclose(found.touch.gap, [-shift] * 6, atol=1e-12)
        np.testing.assert_allclose(np.hypot(*found.touch.point[:, :2].T), [R] * 6, atol=1e-12)
    found = on_plane(body(CONVEX, (0, 0, 0.5), turn), (0, 0, 1), (0, 0, 0), 1.0)
    least = 0.5 - L / 2 * np.cos(tilt) - R * np.sin(tilt)
    assert found.touch.gap.min() == pytest.approx(least, abs=1e-12)
    for host in (body(BOX, (0, 0, -0.3), size=(2, 2, 0.3)), body(POLYHEDRON + 4, (0, 0, -0.1))):
        found = met(body(CONVEX, (0, 0, L / 2)), host)
        np.testing.assert_allclose(found.touch.gap, [0] * 6, atol=1e-12)
    found = on_plane(body(CONVEX, (0, 0, R), LYING), (0, 0, 1), (0, 0, 0))
    np.testing.assert_allclose(np.sort(found.touch.point[:, 0]), [-L / 2, L / 2], atol=1e-12)
    found = met(body(CONVEX, (1.8, 0, R - 1e-3), LYING), body(BOX, (0, 0, -0.3), size=(2, 2, 0.3)))
    np.testing.assert_allclose(np.sort(found.touch.point[:, 0]), [1.8 - L / 2, 2.0], atol=1e-3)
    np.testing.assert_allclose(found.touch.gap, [-1e-3] * 2, atol=1e-12)


def test_cylinders_side_by_side_crossed_and_stacked():
    found = met(body(CONVEX, (0, 0, 0)), body(CONVEX, (0.3, 2 * R * 0.8, 0.4)))
    apart = np.hypot(0.3, 1.6 * R)
    np.testing.assert_allclose(found.touch.gap, [apart - 2 * R] * len(found.touch.gap), atol=1e-12)
    np.testing.assert_allclose(np.sort(found.touch.point[:, 2]), [0.4 - L / 2, L / 2], atol=1e-12)
    capsule = body(CAPSULE, (0.1 + R, 0, 0.3), size=(0.1, 0.5, 0))
    found = met(body(CONVEX, (0, 0, 0)), capsule)
    np.testing.assert_allclose(np.sort(found.touch.point[:, 2]), [-0.2, L / 2], atol=1e-12)
    for depth in (-0.01, 1e-4, 0.05):  # the last is deeper than the skins
        found = met(body(CONVEX, (0, 0, 0.1)), body(CONVEX, (0.05, 2 * R - depth, 0), LYING))
        np.testing.assert_allclose(found.touch.gap, [-depth], atol=1e-12)
        np.testing.assert_allclose(found.touch.normal, [(0, 1, 0)], atol=1e-6)
    found = met(body(CONVEX, (0, 0, 0)), body(CONVEX, (0.1, 0, L)))
    assert len(set(found.feature)) == len(found.feature) >= 4
    np.testing.assert_allclose(found.touch.gap, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.touch.normal, [(0, 0, 1)] * len(found.pair), atol=1e-6)
    for x, y in ((0, 0), (0.1, 0)):  # within both ends
        assert (np.hypot(found.touch.point[:, 0] - x, found.touch.point[:, 1] - y) <= R * (1 + 1e-3)).all()


def test_a_cylinder_stands_on_the_side_of_another_on_two_points_whichever_is_the_first():
    standing, lying = body(CONVEX, (0.02, 0.01, L / 2 + R)), body(CONVEX, (0, 0, 0), LYING)
    for first, second, sign in ((standing, lying, -1.0), (lying, standing, 1.0)):
        found = met(first, second)
        np.testing.assert_allclose(found.touch.normal, [(0, 0, sign)] * 2, atol=1e-12)
        np.testing.assert_allclose(found.touch.gap, 0.0, atol=1e-12)
        np.testing.assert_allclose(np.sort(found.touch.point[:, 0]), [0.02 - R, 0.02 + R], atol=0.15 * R)


def test_capsules_are_as_far_from_polyhedra_as_from_boxes():
    rng, plate, cases = np.random.default_rng(6), POLYHEDRON + 4, 0
    for _ in range(200):
        center, turn = rng.uniform(-0.8, 0.8, 3), quaternion.normalized(rng.normal(size=4))
        core = (center, quaternion.matrix(turn), np.array([0, 0, 0.3]), 0.15)
        gap = signed_distance(core, (np.zeros(3), np.eye(3), np.array([0.4, 0.5, 0.1]), 0.0))
        if gap > -0.14:  # cores that meet it are pushed out by the way that shrunk ones foresee
            found = met(body(CAPSULE, center, turn, (0.15, 0.3, 0)), body(plate, (0, 0, 0)))
            assert bool(len(found.pair)) == (gap < 0.05)
            cases += len(found.pair)
            np.testing.assert_allclose(found.touch.gap.min(initial=0.05), min(gap, 0.05), atol=1e-4)  # SNAP
    assert cases > 20
    lying = met(body(CAPSULE, (0.1, 0.05, 0.299), LYING, (0.2, 0.6, 0)), body(plate, (0, 0, 0)))
    np.testing.assert_allclose(lying.touch.gap, [-1e-3] * 2, atol=1e-12)
    np.testing.assert_allclose(np.sort(lying.touch.point[:, 0]), [-0.4, 0.4], atol=2e-4)


@pytest.mark.parametrize("half", [0.3, 3.0, 30.0])
def test_a_thin_disc_goes_over_the_edge_of_a_large_box(half):
    """The normal turns with it. Triangles that give the distance of an edge of metres and of a rim close to it are
    narrow."""
    on_edge, gap = quaternion.exponential(np.array([np.pi / 2, 0, 0])), 1e-4
    floor, normal = body(BOX, (-half, 0, -half), size=(half, half, half)), []
    angles = np.radians(np.linspace(2.0, 88.0, 300))
    away = np.stack([np.sin(angles), 0.0 * angles, np.cos(angles)], axis=1)
    for way in away:
        found = met(body(CONVEX + 5, (R + gap) * way, on_edge), floor).touch
        np.testing.assert_allclose(found.gap, gap, atol=5e-5)
        normal.append(found.normal.mean(axis=0))
    np.testing.assert_allclose(normal, -away, atol=2e-3)


def test_what_is_no_shape_of_grains_is_refused():
    scene = Scene(0.3)
    for shape, message in (
        (Capsule(0.1, 0.1), "allowed are convex shapes"), (Cylinder(0.1, 0.1, center=(1, 0, 0)), "give positions"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            scene.add_grains([(0, 0, 0)], shape, 1000.0)
    for given, message in ((dict(axes=(1, 1, 0)), "axes must be positive"), (dict(axes=(1, 1)), "axes must be 3"),
                           (dict(axes=(1, 1, 1), exponents=(2, 21)), "must be from 2 to 20, got 21")):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            Superellipsoid(**given)


def test_large_bodies_have_such_shapes_and_grains_a_scale():
    scene = Scene(0.3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_body("pin", [Cylinder(0.1, 0.8)], Dynamic(), density=500.0, position=(0, 0, 0.4))
    scene.add_grains([(1, 0, 0.3), (2, 0, 0.6)], Superellipsoid((0.3, 0.2, 0.1)), 900.0, scale=[0.5, 2.0])
    world = new_world(scene, MPI.COMM_SELF)
    assert world.large.mass[1] == pytest.approx(500.0 * np.pi * 0.008)
    np.testing.assert_allclose(world.grains.mass, 900.0 * 4 / 3 * np.pi * 0.006 * np.array([0.125, 8.0]))
    np.testing.assert_allclose(world.grains.size[:, 2], [0.05, 0.2])
    for shape in (Cylinder(0.1, 0.8), Superellipsoid((0.3, 0.2, 0.1), (4, 3))):
        surface = described(shape)
        vertex, (a, b, c) = np.array(surface["vertices"]), np.transpose(surface["triangles"])
        inside = np.einsum("ti,ti->", vertex[a], np.cross(vertex[b], vertex[c])) / 6.0
        assert inside == pytest.approx(form(shape).volume, rel=0.02)  # so its triangles turn left from outside
        assert np.linalg.norm(vertex, axis=1).max() == pytest.approx(form(shape).size[0])


def test_a_flat_side_of_a_superellipsoid_bears_beside_its_closest_point():
    scene = Scene(0.3)
    shape = Superellipsoid((0.3, 0.2, 0.1), (4, 4))
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_grains([(0, 0, 0.1)], shape, 900.0)
    contacts = find_contacts(new_world(scene, MPI.COMM_SELF), 0.01)
    assert len(contacts) == 5
    assert contacts.gap.min() == pytest.approx(0.0, abs=1e-12)
    (x, y), z = np.abs(contacts.point[:, :2].T), 0.1 - contacts.gap
    np.testing.assert_allclose((x / 0.3) ** 4 + (y / 0.2) ** 4 + (z / 0.1) ** 4, 1.0, rtol=1e-9)
