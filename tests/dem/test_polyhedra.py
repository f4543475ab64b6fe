"""Convex polyhedra: mass and moments, and contacts against boxes, convex hulls and least squares."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from scipy.optimize import lsq_linear
from scipy.spatial import ConvexHull

from dem import quaternion
from dem.bodies import POLYHEDRON
from dem.contact import find_contacts
from dem.contact.narrow import CORNERS, Spheres
from dem.contact.polyhedra import FLUSH, Polyhedra, hulls_of, polyhedra_polyhedra, spheres_polyhedra
from dem.contact.simplex import ROUND, SNAP
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.shapes.polyhedra import solid
from dem.start import new_world

TETRAHEDRON = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / 3**0.5
OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)])
GOLDEN = 0.5 * (1 + 5**0.5)
DODECAHEDRON = np.concatenate(
    [CORNERS, *(np.roll([(0, a / GOLDEN, b * GOLDEN) for a in (-1, 1) for b in (-1, 1)], k, axis=1) for k in range(3))]
) / 3**0.5


def rock(count, seed, flat=1.0):
    way = np.random.default_rng(seed).normal(size=(count, 3))
    return way / np.linalg.norm(way, axis=1)[:, None] * [1, 1, flat]


def test_volumes_and_moments_of_platonic_solids():
    """Of edge a: volumes a^3 times 1/(6 sqrt 2), sqrt 2 / 3 and (15 + 7 sqrt 5) / 4, moments m a^2 / 20, m a^2 / 10 and
    (39 phi + 28) / 150 m a^2."""
    of_edge = (
        (TETRAHEDRON, 2 * 2**0.5 / 3**0.5, 2**-0.5 / 6, 1 / 20, 6),
        (OCTAHEDRON, 2**0.5, 2**0.5 / 3, 1 / 10, 12),
        (DODECAHEDRON, 2 / (GOLDEN * 3**0.5), (15 + 7 * 5**0.5) / 4, (39 * GOLDEN + 28) / 150, 30),
    )
    for vertices, a, volume, moment, edges in of_edge:
        found = solid(vertices)
        assert len(found.faces.edge) == edges
        np.testing.assert_allclose(found.volume, volume * a**3, rtol=1e-13)
        np.testing.assert_allclose(found.moments, moment * volume * a**5, rtol=1e-12)
        np.testing.assert_allclose(found.place, 0.0, atol=1e-15)


def test_grains_stay_where_their_vertices_were_given():
    """A wedge, scaled and turned, is where it was put; its mass is that of half a brick."""
    wedge = np.array([(0, 0, 0), (3, 0, 0), (3, 0, 2), (0, 1, 0), (3, 1, 0), (3, 1, 2)]) * 0.1
    scene, turn, scale = Scene(0.3), quaternion.normalized(np.array([0.5, -0.4, 0.1, 0.7])), np.array([1.0, 2.0])
    ids = scene.add_polyhedra([(1, 2, 3), (4, 5, 6)], wedge, 1000.0, scale=scale, quaternions=turn)
    scene.add_polyhedra((7, 8, 9), wedge, 500.0)
    assert ids.tolist() == [0, 1]
    assert len(scene.forms) == 1
    grains, form = scene.grains(), scene.forms[0]
    assert (grains.shape == POLYHEDRON).all()
    np.testing.assert_allclose(grains.mass, 3.0 * np.array([1, 8, 0.5]), rtol=1e-13)
    for n in range(2):
        here = grains.position[n] + quaternion.rotate(grains.quaternion[n], scale[n] * form.faces.vertex)
        there = np.array([(1, 2, 3), (4, 5, 6)][n]) + quaternion.rotate(turn, scale[n] * wedge)
        np.testing.assert_allclose(here, there, atol=1e-14)
    np.testing.assert_allclose(form.place, [0.2, 0.05, 0.2 / 3], rtol=1e-13)
    # Of a right triangle of sides b and h about its centroid: m (b^2 + h^2) / 18.
    np.testing.assert_allclose(form.moments.max(), form.volume * (0.3**2 + 0.2**2) / 18, rtol=1e-12)


@pytest.mark.parametrize(
    ("vertices", "match"),
    [
        (TETRAHEDRON[:3], "from 4 to 32"),
        (rock(33, 0), "from 4 to 32"),
        (TETRAHEDRON[:, :2], "must have shape"),
        ([*TETRAHEDRON, (0, 0, 0)], "number 4 is no corner"),
        ([*OCTAHEDRON, (0.5, 0.5, 0)], "number 6 is no corner"),  # on an edge
        ([*CORNERS, (0, 0, 1)], "number 8 is no corner"),  # in a face
        ([*OCTAHEDRON, (1, 0, 0)], "is no corner"),
        ([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], "in a plane"),
        ([(0, 0, 0), (1, 0, 0), (1, 1, np.nan), (0, 1, 0)], "NaN"),
    ],
)
def test_bad_vertices(vertices, match):
    with pytest.raises(ValueError, match=match):
        Scene(0.3).add_polyhedra((0, 0, 0), vertices, 1000.0)


def signed_distance(one, other):
    """Of two hulls of points: the least distance by non-negative least squares (Lawson and Hanson 1974, chapter 23; the
    nnls of scipy 1.15 ends before), and the depth by the hull of the differences."""
    apart = (other[:, None] - one).reshape(-1, 3)
    rows, one_of_all = np.vstack([apart.T, np.ones(len(apart))]), np.array([0, 0, 0, 1.0])
    share = lsq_linear(rows, one_of_all, (0, np.inf), method="bvls", tol=1e-14).x
    gap = np.linalg.norm(share @ apart) / share.sum()
    return gap if gap > 1e-9 else ConvexHull(apart).equations[:, 3].max()


FORMS = tuple(map(solid, (TETRAHEDRON, OCTAHEDRON, DODECAHEDRON, rock(16, 1), rock(7, 2, 0.1), 0.7 * CORNERS)))


def random_pairs(count, seed, delta):
    """Pairs of polyhedra in any position, from overlapping by delta to apart by more."""
    rng = np.random.default_rng(seed)
    sides = []
    for _ in range(2):
        turn = quaternion.matrix(quaternion.normalized(rng.normal(size=(count, 4))))
        scale, hull = np.repeat(rng.uniform(0.3, 1.0, (count, 1)), 3, axis=1), rng.integers(1, 1 + len(FORMS), count)
        sides.append(Polyhedra(rng.normal(size=(count, 3)), turn, scale, hull, hulls_of(FORMS)))
    one, other = sides
    way = quaternion.normalized(rng.normal(size=(count, 4)))[:, :3] + 1e-9
    for n in range(count):
        far, direction = 5.0, way[n] / np.linalg.norm(way[n])
        for _ in range(8):  # conservative advancement
            other.center[n] = one.center[n] + far * direction
            apart = signed_distance(corners(one, n), corners(other, n))
            if apart < 1e-7:
                break
            far -= apart
        other.center[n] = one.center[n] + (far + delta * rng.uniform(-1, 1.3) * 10.0 ** rng.uniform(-7, 0)) * direction
    return one, other


def corners(body, n):
    return body.center[n] + (body.scale[n] * FORMS[body.hull[n] - 1].faces.vertex) @ body.turn[n].T


def test_the_least_gap_of_a_pair_is_its_signed_distance():
    count, delta = 80, 0.05
    one, other = random_pairs(count, 0, delta)
    found = polyhedra_polyhedra(one, other, np.full(count, delta))
    gap, most = np.full(count, np.inf), np.zeros(count)
    np.minimum.at(gap, found.pair, found.touch.gap)
    right = np.array([signed_distance(corners(one, n), corners(other, n)) for n in range(count)])
    thick = np.array([[FORMS[h - 1].size[2] * s[0] for h, s in zip(b.hull, b.scale)] for b in (one, other)]).min(axis=0)
    tolerance = FLUSH * delta + 2 * SNAP * thick
    touching = np.isfinite(gap)
    assert touching[right <= delta - tolerance - 1e-9].all()
    assert not touching[right > delta + 1e-9].any()
    assert (np.abs(gap - right)[touching] <= tolerance[touching] + 1e-9).all()
    assert touching.sum() > 60
    assert (right < 0).sum() > 16
    key = found.pair * one.hulls.features + found.feature
    assert len(np.unique(key)) == len(key)
    # Points are in the middle between the surfaces, but for what is round.
    for c, n in enumerate(found.pair):
        for body, side in ((one, -0.5), (other, 0.5)):
            place = found.touch.point[c] + side * found.touch.gap[c] * found.touch.normal[c]
            most[n] = max(most[n], signed_distance(place[None], corners(body, n)))
    assert (most <= 5 * ROUND * thick).all()


def test_spheres_find_the_closest_point():
    count = 50
    one, other = random_pairs(count, 3, 0.05)
    right = np.array([signed_distance(one.center[n][None], corners(other, n)) for n in range(count)])
    inside = range(0, count, 2)
    right[::2] = [signed_distance(other.center[n][None] + 1e-2, corners(other, n)) for n in inside]
    center = np.where(np.arange(count)[:, None] % 2, one.center, other.center + 1e-2)
    radius = np.random.default_rng(0).uniform(0.1, 0.3, count)
    found = spheres_polyhedra(Spheres(center, radius), other, np.full(count, np.inf))
    np.testing.assert_allclose(found.touch.gap, right - radius, atol=1e-12)
    ahead = (radius + 0.5 * found.touch.gap)[:, None] * found.touch.normal
    np.testing.assert_allclose(found.touch.point, center + ahead, atol=1e-14)


def contacts_of(add, turn, delta=0.02):
    """What two bricks, a floor and a ball have of contacts, of which `add` adds one kind of bricks."""
    scene = Scene(0.3)
    scene.add_body("floor", [Plane((0, 0, 1)), Box((0.1, 0.1, 0.1), (0.26, 0.0, 0.25))])
    half = np.array([0.1, 0.08, 0.05])
    add(scene, [(0, 0, 0.06), (0.05, 0.02, 0.171)], half, [(1, 0, 0, 0), turn])
    scene.add_spheres((0.0, 0.2, 0.171), 0.1, 1000.0)
    found = find_contacts(new_world(scene, MPI.COMM_SELF, overlap=np.inf), delta)
    order = np.lexsort((*np.round(found.point, 9).T, found.b, found.a))
    return [values[order] for values in (found.a, found.b, found.point, found.normal, found.gap)]


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4])
def test_a_brick_of_vertices_is_a_box(angle):
    turn = (np.cos(angle / 2), 0, 0, np.sin(angle / 2))

    def boxes(scene, places, half, turns):
        scene.add_boxes(places, half, 1000.0, quaternions=turns)

    def bricks(scene, places, half, turns):
        scene.add_polyhedra(places, half * CORNERS, 1000.0, quaternions=turns)

    for one, other in zip(contacts_of(boxes, turn), contacts_of(bricks, turn)):
        assert len(one) >= 10
        np.testing.assert_allclose(other, one, atol=1e-12)


def test_a_tetrahedron_on_its_face_touches_the_floor_in_three_corners():
    up = -TETRAHEDRON[0]
    across = np.cross(up, (0, 0, 1))
    turn = quaternion.exponential(np.arccos(up[2]) * across / np.linalg.norm(across))
    scene = Scene(0.3)
    scene.add_body("floor", [Plane((0, 0, -1))])
    scene.add_polyhedra((0, 0, -1 / 3 - 0.001), TETRAHEDRON, 1000.0, quaternions=turn)
    found = find_contacts(new_world(scene, MPI.COMM_SELF), 0.01)
    np.testing.assert_allclose(found.gap, np.full(3, 0.001), atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(found.point[:, :2], axis=1), 8**0.5 / 3, atol=1e-14)


@pytest.mark.parallel(2, 3)
def test_contacts_on_several_ranks():
    def found(comm):
        rng, scene = np.random.default_rng(1), Scene(0.3)
        scene.add_body("floor", [Plane((0, 0, 1), (0, 0, -0.5))])
        for vertices in (TETRAHEDRON, DODECAHEDRON):
            turns, scale = rng.normal(size=(30, 4)), rng.uniform(0.1, 0.2, 30)
            places = rng.uniform(-0.5, 0.5, (30, 3))
            scene.add_polyhedra(places, vertices, 1000.0, scale=scale, quaternions=turns)
        scene.add_spheres(rng.uniform(-0.5, 0.5, (10, 3)), 0.1, 1000.0)
        contacts = find_contacts(new_world(scene, comm, overlap=np.inf), 0.02)
        parts = comm.allgather((contacts.key, contacts.gap, contacts.normal, contacts.point))
        key, *others = (np.concatenate(columns) for columns in zip(*parts))
        order = np.argsort(key)
        return [key[order], *(column[order] for column in others)]

    one, many = found(MPI.COMM_SELF), found(MPI.COMM_WORLD)
    assert len(np.unique(one[0])) == len(one[0]) > 100
    for alone, together in zip(one, many):
        np.testing.assert_array_equal(alone, together)
