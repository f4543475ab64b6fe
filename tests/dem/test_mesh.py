"""Surfaces of triangles: the search in cells, closest points, contacts of balls and capsules, mass, files."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from cases import advance, contacts_by_key, crude_impulse, force_on, random_quaternions, step
from convex import distance
from mpi4py import MPI

from dem import quaternion
from dem.contact import find_contacts
from dem.contact.meshes import PlacedMesh, capsule_mesh, sphere_mesh
from dem.contact.narrow import Boxes, Capsules, Planes, Spheres, capsule_plane, sphere_box
from dem.mesh import Mesh
from dem.motion import Dynamic, Rotation
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere, Superellipsoid, mass_properties, moved
from dem.start import new_world
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained
from pctt import ccp
from pctt.run.stepper import cone_problem

SELF = MPI.COMM_SELF


def sheet(count=4, width=2.0, rng=None):
    """A flat square at z = 0 in count x count cells of two triangles, with the corners inside moved about."""
    line = np.linspace(-width / 2, width / 2, count + 1)
    vertices = np.stack([*np.meshgrid(line, line, [0.0], indexing="ij")], axis=-1).reshape(-1, 3)
    if rng is not None:
        inner = np.abs(vertices[:, :2]).max(axis=1) < 0.49 * width
        vertices[inner, :2] += rng.uniform(-0.2, 0.2, (int(inner.sum()), 2)) * width / count
    row = np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = row[:-1, :-1], row[1:, :-1], row[1:, 1:], row[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3)
    return Mesh(vertices, triangles)


def block(half=(0.5, 0.4, 0.3), **place):
    """A solid box of twelve triangles."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [three for a, b, c, d in quads for three in ((a, b, c), (a, c, d))]
    return Mesh(signs * np.array(half), triangles, **place)


def on(mesh, center, radius, delta=0.1):
    """Contacts of balls with a mesh at the origin."""
    center = np.atleast_2d(np.asarray(center, float))
    size = np.full(len(center), float(radius))
    placed = PlacedMesh(mesh.surface, mesh.surface.middle, np.eye(3))
    return sphere_mesh(Spheres(center, size), placed, np.full(len(center), delta))


def lying(mesh, center, axis, half_length, radius, delta=0.1):
    """Contacts of a capsule with a mesh at the origin, in the order of their points."""
    axis = np.array([axis], float) / np.linalg.norm(axis)
    core = Capsules(np.array([center], float), axis, np.array([half_length]), np.array([radius]))
    found = capsule_mesh(core, PlacedMesh(mesh.surface, mesh.surface.middle, np.eye(3)), np.array([delta]))
    order = np.lexsort(np.round(found.touch.point, 9).T)
    return found.feature[order], *(values[order] for values in found.touch)


def test_cells_give_all_triangles_within_reach():
    rng = np.random.default_rng(1)
    surface = Mesh.revolved([(0.0, 0), (1, 0.2), (0.7, 2), (0.1, 2.5)], 24).surface
    points = rng.uniform(-1.5, 1.5, (100, 3)) + [0, 0, 0.1]
    reach = rng.choice([0.05, 0.1, 0.4], 100)
    row, triangle = surface.near(points, reach)
    found = set(zip(row.tolist(), triangle.tolist()))
    count = len(surface.triangle)
    rows, all_of_them = np.repeat(np.arange(100), count), np.tile(np.arange(count), 100)
    close = surface.closest(points[rows], all_of_them).distance <= reach[rows]
    assert len(found) == len(row)
    assert set(zip(rows[close].tolist(), all_of_them[close].tolist())) <= found
    assert len(found) < 0.1 * len(rows)


def test_the_closest_point_of_a_triangle():
    rng = np.random.default_rng(2)
    surface = Mesh(rng.normal(size=(3, 3)), [[0, 1, 2]]).surface
    points = 2.0 * rng.normal(size=(100, 3))
    found = surface.closest(points, np.zeros(100, int))
    share = rng.dirichlet(np.ones(3), 4000)
    sampled = share @ surface.corner[0]
    least = np.linalg.norm(points[:, None] - sampled, axis=2).min(axis=1)
    assert (found.distance <= least + 1e-12).all()
    np.testing.assert_allclose(found.distance, least, atol=0.15)
    np.testing.assert_allclose(np.linalg.norm(points - found.point, axis=1), found.distance, atol=1e-12)
    assert set(found.feature) == set(range(7))  # the face, three edges, three vertices


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("gap", [0.05, 0.0, -0.05])
def test_a_ball_touches_a_flat_mesh_once_wherever_it_is(gap, side):
    rng = np.random.default_rng(3)
    mesh = sheet(rng=rng)
    surface = mesh.surface
    edges = surface.vertex[surface.edge].mean(axis=1)
    places = np.concatenate([rng.uniform(-0.9, 0.9, (500, 3)), surface.vertex, edges, edges + 1e-9])
    places = places[np.abs(places[:, :2]).max(axis=1) < 0.95]
    places[:, 2] = side * (0.3 + gap)
    found = on(mesh, places, 0.3)
    np.testing.assert_array_equal(np.sort(found.pair), np.arange(len(places)))
    np.testing.assert_allclose(found.touch.gap, gap, atol=1e-12)
    np.testing.assert_allclose(found.touch.normal, [[0, 0, -side]] * len(places), atol=1e-6)
    np.testing.assert_allclose(found.touch.point[:, :2], places[found.pair, :2], atol=1e-6)


def test_triangles_whose_corners_meet_the_side_of_another_are_one_flat_surface():
    vertices = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (0, -1, 0), (0, 0.2, 0), (0, 1, 0)]
    halves = [(0, 4, 6), (0, 6, 3), (4, 1, 5), (1, 2, 5), (5, 2, 6)]  # one whole edge from 4 to 6, and two of its parts
    mesh = Mesh(vertices, halves)
    places = np.stack([np.linspace(-0.3, 0.3, 61), np.full(61, 0.17), np.full(61, 0.32)], axis=1)
    found = on(mesh, places, 0.3)
    np.testing.assert_array_equal(np.sort(found.pair), np.arange(61))
    np.testing.assert_allclose(found.touch.gap, 0.02, atol=1e-9)


def test_a_ball_in_a_groove_touches_twice_and_on_a_ridge_once():
    vertices = [(-1, -1, 1), (-1, 1, 1), (0, -1, 0), (0, 1, 0), (1, -1, 1), (1, 1, 1)]
    groove = Mesh(vertices, [(0, 2, 1), (1, 2, 3), (2, 4, 3), (3, 4, 5)])
    above = on(groove, [0, 0, 0.3 * np.sqrt(2) + 0.01], 0.3)
    assert len(above.pair) == len(set(above.feature)) == 2
    np.testing.assert_allclose(above.touch.gap, 0.01 / np.sqrt(2))
    np.testing.assert_allclose(np.abs(above.touch.normal[:, [0, 2]]), np.sqrt(0.5))
    below = on(groove, [0, 0, -0.29], 0.3)
    np.testing.assert_allclose(below.touch.gap, [-0.01])
    np.testing.assert_allclose(below.touch.normal, [[0, 0, 1]], atol=1e-15)


def test_balls_on_a_block_of_triangles_as_on_a_box():
    rng = np.random.default_rng(4)
    half, mesh = np.array([0.5, 0.4, 0.3]), block()
    center = rng.uniform(-0.9, 0.9, (4000, 3))
    center = center[(np.abs(center) > half).any(axis=1)]
    size = np.full(len(center), 0.2)
    place, turn = np.array([1.0, 2, 3]), quaternion.matrix(random_quaternions(rng, 1)[0])
    center = place + center @ turn.T
    balls = Spheres(center, size)
    boxes = Boxes(*(np.repeat(array[None], len(center), 0) for array in (place, turn, half)))
    box = sphere_box(balls, boxes)
    found = sphere_mesh(balls, PlacedMesh(mesh.surface, place, turn), np.full(len(center), 0.05))
    touching = np.flatnonzero(box.gap <= 0.05)
    # A thin part of the block may be within reach behind its near face; the closest contact is that of the box.
    order = np.lexsort((found.touch.gap, found.pair))
    pair, first = np.unique(found.pair[order], return_index=True)
    first = order[first]
    np.testing.assert_array_equal(pair, touching)
    np.testing.assert_allclose(found.touch.gap[first], box.gap[touching], atol=1e-12)
    np.testing.assert_allclose(found.touch.normal[first], box.normal[touching], atol=1e-9)
    np.testing.assert_allclose(found.touch.point[first], box.point[touching], atol=1e-12)
    assert len(found.pair) < 1.02 * len(pair)


@pytest.mark.parametrize("gap", [0.03, 0.0, -0.03])
def test_a_capsule_on_a_flat_mesh_as_on_a_plane(gap):
    rng = np.random.default_rng(5)
    mesh = sheet(rng=rng)
    for _ in range(8):
        axis = np.append(rng.normal(size=2), rng.uniform(-0.05, 0.05))
        center = np.append(rng.uniform(-0.4, 0.4, 2), 0.2 + gap)
        axis /= np.linalg.norm(axis)
        plane = capsule_plane(
            Capsules(center[None], axis[None], np.array([0.3]), np.array([0.2])),
            Planes(np.array([[0.0, 0, 1]]), np.zeros((1, 3))),
            np.array([0.1]),
        )
        _, point, normal, gaps = lying(mesh, center, axis, 0.3, 0.2)
        order = np.lexsort(np.round(plane.touch.point, 9).T)
        np.testing.assert_allclose(gaps, plane.touch.gap[order], atol=1e-12)
        np.testing.assert_allclose(point, plane.touch.point[order], atol=1e-7)
        np.testing.assert_allclose(normal, plane.touch.normal[order], atol=1e-6)


def test_a_capsule_across_a_block_lies_on_two_edges():
    for tilt in (0.0, 0.01):
        _, point, normal, gaps = lying(block(), (0, 0.1, 0.5 + 0.02), (1, 0, tilt), 1.0, 0.2)
        np.testing.assert_allclose(point[:, 0], [-0.5, 0.5], atol=0.01)
        np.testing.assert_allclose(normal, [[0, 0, -1]] * 2, atol=0.02)
        np.testing.assert_allclose(gaps, [0.02 - tilt / 2, 0.02 + tilt / 2], atol=1e-3)
    (_,), _, normal, gaps = lying(block(), (0.5 + 0.3, 0, 0.3 + 0.3), (1, 0, -1), 0.4, 0.4)
    np.testing.assert_allclose(normal, [[-np.sqrt(0.5), 0, -np.sqrt(0.5)]], atol=1e-12)
    np.testing.assert_allclose(gaps, 0.3 * np.sqrt(2) - 0.4)


def test_capsules_are_as_far_from_a_block_of_triangles_as_from_a_box():
    rng = np.random.default_rng(6)
    half, mesh, cases = np.array([0.5, 0.4, 0.3]), block(), 0
    for _ in range(150):
        center, axis = rng.uniform(-1, 1, 3), rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        frame = np.stack([np.zeros(3), np.zeros(3), axis], axis=1)
        gap = distance((center, frame, np.array([0, 0, 0.4]), 0.15), (np.zeros(3), np.eye(3), half, 0.0)) - 0.15
        if gap < -0.14 or abs(gap - 0.05) < 1e-9:
            continue  # cores that meet a box are pushed out of it, and through a surface the shorter way
        _, _, _, gaps = lying(mesh, center, axis, 0.4, 0.15, 0.05)
        assert bool(len(gaps)) == (gap < 0.05)
        if len(gaps):
            assert gaps.min() == pytest.approx(gap, abs=1e-7)
            cases += 1
    assert cases > 20


def test_a_capsule_through_a_face_is_pushed_back_the_shorter_way():
    _, point, normal, gaps = lying(sheet(), (0.1, 0.2, 0.1), (0, 0, 1), 0.3, 0.05)
    np.testing.assert_allclose(point[0], [0.1, 0.2, -0.125], atol=1e-12)
    np.testing.assert_allclose(normal, [[0, 0, -1]])
    np.testing.assert_allclose(gaps, [-0.25])


def test_mass_of_a_block_of_triangles_as_of_a_box_and_of_a_cone_by_its_formulas():
    pytest.importorskip("trimesh")
    turn = quaternion.exponential(np.array([0.3, -0.4, 0.5]))
    pair, place = (block(center=(1, 2, 3)), Box((0.5, 0.4, 0.3), (1, 2, 3))), np.array([0.2, 0, 1])
    for mesh, box in (pair, [moved(shape, place, turn) for shape in pair]):
        for found, right in zip(mass_properties([mesh], 1000.0), mass_properties([box], 1000.0)):
            np.testing.assert_allclose(found, right, atol=1e-10)
    mass, center, tensor = mass_properties([Mesh.revolved([(0, 0), (2, 0), (0, 3)], 400)], 1.0)
    volume = np.pi * 4 * 3 / 3
    np.testing.assert_allclose(mass, volume, rtol=1e-4)
    np.testing.assert_allclose(center, [0, 0, 0.75], atol=1e-12)
    across = 3 / 20 * volume * (4 + 9 / 4)
    np.testing.assert_allclose(tensor, np.diag([across, across, 0.3 * volume * 4]), rtol=2e-4, atol=1e-10)


def test_meshes_without_mass_are_refused():
    pytest.importorskip("trimesh")
    corners, triangles = block().vertices, block().triangles
    for chosen, words in (
        (triangles[1:], "not closed has no mass: 3 of 18 edges"),
        (np.concatenate([triangles[:1, ::-1], triangles[1:]]), "turned both ways"),
        (triangles[:, ::-1], "normals point inwards"),
    ):
        with pytest.raises(ValueError, match=words):
            mass_properties([Mesh(corners, chosen)], 1.0)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Mesh(np.eye(3), [[0, 1, 3]]), "rows of its 3 vertices, got 0 to 3"),
        (lambda: Mesh(np.zeros((4, 2)), [[0, 1, 2]]), r"shape \(n, 3\), got \(4, 2\)"),
        (lambda: Mesh(np.zeros((4, 3)), [[0.0, 1, 2]]), "must be integers"),
        (lambda: Mesh(np.zeros((4, 3)), [[0, 1, 1]]), "no triangle of the mesh has three corners"),
        (lambda: Mesh.revolved([(1, 0), (1, 1)], 2), "sides of .* must be at least 3"),
        (lambda: Mesh.revolved([(1, 0), (-1, 1)]), "radii of a profile"),
    ],
)
def test_bad_meshes_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_bodies_that_cannot_touch_a_mesh_are_refused():
    scene = Scene(friction=0.3)
    scene.add_body("tool", [block()], Dynamic(), mass=1.0, inertia=(1, 1, 1))
    scene.add_body("wall", [block()], position=(0, 0, -5))
    scene.add_spheres([0, 0, 2], 0.1, 1000.0)
    with pytest.raises(ValueError, match="the mesh of 'wall' cannot touch the mesh of 'tool'"):
        new_world(scene, SELF)


def test_meshes_that_are_joined_or_of_materials_apart_need_no_contacts():
    for joined in (False, True):
        scene = Scene(friction=0.3)
        scene.add_body("lower", [block()], material="steel")
        place = {"position": (0, 0, 0.5), "material": "bronze"}
        scene.add_body("upper", [block()], Dynamic(), mass=1.0, inertia=(1, 1, 1), **place)
        if joined:
            scene.add_joint("elbow", "lower", "upper", kind="hinge", anchor=(0, 0, 0.5), axis=(0, 1, 0))
        else:
            scene.set_pair("steel", "bronze", touching=0.0)
        world = new_world(scene, SELF)
        assert not len(find_contacts(world, 0.1))


def test_files_are_read_written_scaled_and_refused(tmp_path):
    pytest.importorskip("trimesh")
    mesh = Mesh.revolved([(0.0, 0), (10, 0), (10, 20), (0, 20)], 16)
    mesh.write(tmp_path / "wheel.stl")
    read = Mesh.read(tmp_path / "wheel.stl", 1e-3, center=(0, 0, 1))
    assert len(read.vertices) == len(mesh.vertices)  # the corners of the file are one vertex again
    np.testing.assert_allclose(mass_properties([read], 1.0)[0], 1e-9 * mass_properties([mesh], 1.0)[0], rtol=1e-6)
    mesh.write(tmp_path / "wheel.obj")
    np.testing.assert_allclose(Mesh.read(tmp_path / "wheel.obj").surface.half, [10, 10, 10])
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1e-8, 0), (1, 1, 0), (0, 1, 1e-8)]
    (tmp_path / "near.obj").write_text("\n".join([*("v {} {} {}".format(*c) for c in corners), "f 1 2 3", "f 4 5 6"]))
    assert len(Mesh.read(tmp_path / "near.obj").vertices) == 4
    (tmp_path / "words.stl").write_text("no mesh")
    (tmp_path / "cut.stl").write_bytes((tmp_path / "wheel.stl").read_bytes()[:1000])
    for name, words in (
        ("words.stl", "words.stl: cannot be read as a mesh .*neither an STL file of text"),
        ("cut.stl", "cut.stl: cannot be read as a mesh .*says that it has 64 triangles, but only 18"),
        ("none.stl", "none.stl: no such file"),
    ):
        with pytest.raises(ValueError, match=words):
            Mesh.read(tmp_path / name)
    with pytest.raises(ValueError, match="scale of .*wheel.stl must be positive"):
        Mesh.read(tmp_path / "wheel.stl", 0.0)


TETRAHEDRON = np.array([(0, 0, 0), (3, 0, 0), (0, 2, 0), (0, 0, 1)], float)
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]


def binary_stl(count=4, head=b"solid by some program", corners=TETRAHEDRON):
    rows = np.zeros(4, [("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("colour", "<u2")])
    rows["corner"] = corners[FACES]
    return head.ljust(80) + np.uint32(count).tobytes() + rows.tobytes()


def text_stl(name="part", corners=TETRAHEDRON):
    lines = [f"solid {name}"]
    for face in FACES:
        lines += [" facet normal 0 0 0", "  outer loop"]
        lines += ["   vertex {:.7e} {:.7e} {:.7e}".format(*corner) for corner in corners[[*face]]]
        lines += ["  endloop", " endfacet"]
    return "\n".join([*lines, f"endsolid {name}", ""]).encode()


@pytest.mark.parametrize("data", [
    binary_stl(), binary_stl() + bytes(21), text_stl(), text_stl().replace(b"\n", b"\r"), text_stl().upper(),
    text_stl().replace(b"\n", b"\r\n"), text_stl().replace(b".", b","), b"\xef\xbb\xbf\n" + text_stl(),
    text_stl("vertex of a caf\xe9" * 40), binary_stl(corners=TETRAHEDRON * 1e-25),
    binary_stl(corners=TETRAHEDRON + 4096),
], ids=range(11))  # fmt: skip
def test_stl_files_of_other_programs_are_read_whole(tmp_path, data):
    (tmp_path / "a.STL").write_bytes(data)
    mesh = Mesh.read(tmp_path / "a.STL")
    assert (len(mesh.triangles), len(mesh.vertices)) == (4, 4)
    spans = np.ptp(mesh.vertices, axis=0)
    np.testing.assert_allclose(spans / spans[2], [3, 2, 1], rtol=1e-6)


@pytest.mark.parametrize(("data", "words"), [
    (binary_stl()[:-1], "says that it has 4 triangles, but only 3 are there: it is truncated"),
    (binary_stl(2), "says that it has 2 triangles, but 100 bytes follow them"),
    (binary_stl(corners=np.where(TETRAHEDRON == 2, np.nan, TETRAHEDRON)), "triangle 1 of 4 has a corner that is NaN"),
    (text_stl()[:-40], "line 27: it ends with 12 corners of 4 triangles and 0 endsolid: it is truncated"),
    (text_stl().replace(b"3.0000000e+00", b"inf", 1), "line 6: 'vertex inf .*allowed are three finite numbers"),
    (b"", "the file is empty"),
    (b"solid a\nendsolid a\n", "has no triangle"),
], ids=range(7))  # fmt: skip
def test_damaged_stl_files_are_refused_with_the_place(tmp_path, data, words):
    (tmp_path / "a.stl").write_bytes(data)
    with pytest.raises(ValueError, match=f"a.stl: .*{words}"):
        Mesh.read(tmp_path / "a.stl")


TETRA = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
LATER = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -1 -2\nv 0 0 1\nf 1 2 4\nf -4 -1 3\nf 2 3 4\n"  # counted back from the line


@pytest.mark.parametrize("text", [
    TETRA.replace(" ", "\t"), "\ufeff" + TETRA, TETRA.replace("\n", "\r\n"), TETRA.replace("\n", " # of a tool\n"),
    TETRA.replace("f 1 ", "f 1 \\\n "), LATER, LATER.replace("f", "usemtl grey\nvn 0 0 1\nf"),
], ids=range(7))  # fmt: skip
def test_obj_files_of_many_kinds_hold_the_same_solid(tmp_path, text):
    (tmp_path / "a.obj").write_bytes(text.encode())
    mesh = Mesh.read(tmp_path / "a.obj", 1e-3)
    corner = mesh.surface.corner + mesh.surface.middle
    assert len(corner) == 4
    np.testing.assert_allclose(np.linalg.det(corner).sum() / 6, 1e-9 / 6)


@pytest.mark.parametrize("first", range(6))
def test_a_face_that_bends_inwards_is_cut_within_itself(tmp_path, first):
    """A prism of an L, whatever corner its faces begin with."""
    ell = np.roll([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], -first, axis=0)
    lines = [f"v {x} {y} {z}" for z in (0, 1) for x, y in ell] + ["f 6 5 4 3 2 1", "f 7 8 9 10 11 12"]
    lines += [f"f {k + 1} {(k + 1) % 6 + 1} {(k + 1) % 6 + 7} {k + 7}" for k in range(6)]
    (tmp_path / "ell.obj").write_text("\n".join(lines))
    corner = Mesh.read(tmp_path / "ell.obj").surface.corner
    twice = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_allclose(0.5 * np.linalg.norm(twice, axis=1).sum(), 2 * 3 + 8)
    np.testing.assert_allclose(np.linalg.det(corner).sum() / 6, 3.0)


@pytest.mark.parametrize(("text", "words"), [
    (TETRA.replace("f 1 3 2", "f 0 3 2"), "line 5: 'f 0 3 2': allowed are three or more corners, from 1 on"),
    (TETRA.replace("f 1 3 2", "f 1 3"), "line 5: 'f 1 3': allowed are three or more corners"),
    (TETRA.replace("f 1 3 2", "f -5 3 2"), "line 5: 'f -5 3 2': allowed are three or more corners"),
    (TETRA.replace("f 1 3 2", "f 1 9 2"), "line 5: corner 9, where there are 4: the file is damaged or truncated"),
    (TETRA.replace("v 1 0 0", "v 1 0"), "line 2: 'v 1 0': allowed are three finite numbers"),
    (TETRA.replace("v 1 0 0", "v 1 nan 0"), "line 2: 'v 1 nan 0': allowed are three finite numbers"),
    ("".join(f"v {x} {y} 0\n" for x, y in ((0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)))
     + "f 1 2 3 4 5 6 7 8\n", "line 9: a face of 8 corners of which none sees all others; allowed are triangles"),
    ("v 0 0 0\n", "has no triangle"),
], ids=range(8))  # fmt: skip
def test_damaged_obj_files_are_refused_with_the_place(tmp_path, text, words):
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(ValueError, match=f"a.obj: .*{words}"):
        Mesh.read(tmp_path / "a.obj")


def test_a_closed_solid_with_texture_has_a_mass(tmp_path):
    """Its corners have other texture coordinates in each face, so that a reader makes three vertices of one place."""
    pytest.importorskip("trimesh")
    lines = ["v {} {} {}".format(*corner) for corner in TETRAHEDRON] + [f"vt 0.{k} 0.5" for k in range(12)]
    lines += ["mtllib none.mtl", "usemtl red"]
    lines += ["f " + " ".join(f"{v + 1}/{3 * n + k + 1}" for k, v in enumerate(face)) for n, face in enumerate(FACES)]
    (tmp_path / "solid.obj").write_text("\n".join(lines))
    mesh = Mesh.read(tmp_path / "solid.obj")
    assert len(mesh.vertices) == 4
    np.testing.assert_allclose(mass_properties([mesh], 1000.0)[0], 1000.0)


def test_without_trimesh_a_mesh_has_contacts_but_no_mass_and_no_file(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    assert len(on(block(), [0, 0, 0.39], 0.1).pair) == 1
    (tmp_path / "block.ply").write_text("ply\n")
    for call in (lambda: Mesh.read(tmp_path / "block.ply"), lambda: mass_properties([block()], 1.0)):
        with pytest.raises(ValueError, match="by trimesh, which is not there: pip install"):
            call()


def moved_on(world, steps, dt=0.01, tol=1e-9):
    """After each step by Coulomb's law the system and its impulses."""
    for _ in range(steps):
        free = unconstrained(world, dt)
        system = ContactSystem(world, find_contacts(world, 0.01, free), free)
        with cone_problem(system, SELF) as problem:
            result = ccp.solve(problem, None, "apgd", ccp.Limits(tol), law=ccp.COULOMB)
        advance(world, system.motion, system.contacts, system.velocity(result.impulse))
        yield system, result.impulse


def rolled(scene):
    """Places (steps, 3) and velocities (steps, 6) of the only grain."""
    world = new_world(scene, SELF)
    return np.array([[*world.grains.position[0], *world.grains.velocity[0]] for _ in moved_on(world, 40)])


def thrown(floor):
    scene = Scene(friction=0.5)
    scene.add_body("floor", [floor])
    scene.add_spheres([-0.8, 0.013, 0.1], 0.1, 1000.0, velocity=(2.5, 0.02, 0))
    return scene


def test_a_ball_that_rolls_over_edges_goes_straight_on_as_on_a_plane():
    mesh = rolled(thrown(sheet(7, rng=np.random.default_rng(7))))
    plane = rolled(thrown(Plane((0, 0, 1))))
    np.testing.assert_allclose(mesh, plane, atol=1e-6)
    np.testing.assert_allclose(mesh[-1, 3], 2.5 * 5 / 7, rtol=1e-6)  # slides, then rolls


@pytest.mark.parametrize("shape", ["sphere", "capsule", "box", "ellipsoid"])
def test_fast_grains_do_not_fly_through_a_sheet(shape):
    """They go two radii in a step; from below as from above."""
    scene = Scene(friction=0.5, gravity=(0, 0, 0))
    scene.add_body("sheet", [sheet(5)])
    places, velocity = [[0.03, 0.04, 0.4], [0.5, 0.2, -0.55]], np.array([[0, 0, -20.0], [0, 1.0, 20.0]])
    if shape == "sphere":
        scene.add_spheres(places, 0.1, 1000.0, velocity=velocity)
    elif shape == "box":
        scene.add_boxes(places, (0.1, 0.1, 0.1), 1000.0, velocity=velocity)
    elif shape == "ellipsoid":
        scene.add_grains(places, Superellipsoid((0.12, 0.11, 0.1)), 1000.0, velocity=velocity)
    else:
        scene.add_capsules(places, 0.1, 0.1, 1000.0, quaternions=(0.5, 0.5, 0.5, 0.5), velocity=velocity)
    world = new_world(scene, SELF)
    order = np.argsort(world.grains.id)
    list(moved_on(world, 5))
    np.testing.assert_allclose(world.grains.position[order, 2], [0.1, -0.1], atol=2e-3)


def test_a_solid_of_triangles_falls_and_rests_on_a_plane():
    scene = Scene(friction=0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_body("tool", [block()], Dynamic(), mass=480.0, inertia=(40.0, 54.4, 65.6), position=(0, 0, 0.32))
    scene.add_spheres([0, 5, 0.1], 0.1, 1000.0)
    world = new_world(scene, SELF)
    *_, (system, impulse) = moved_on(world, 30)
    np.testing.assert_allclose(world.large.position[1], [0, 0, 0.3], atol=1e-3)
    force = force_on(world, system, "floor", impulse)
    np.testing.assert_allclose(force[2], -9.81 * (480 + 4 / 3 * np.pi), rtol=1e-5)


def test_keys_of_meshes_are_distinct():
    rng = np.random.default_rng(8)
    scene = Scene(friction=0.3)
    turned = tuple(random_quaternions(rng, 1)[0].tolist())
    scene.add_body("first", [Sphere(0.1, (0, 0, 3)), sheet(12), block(center=(0, 0, -2), quaternion=turned)])
    scene.add_body("second", [Plane((0, 0, 1), (0, 0, -5))], Rotation((0, 0, 1)))
    grid = 0.21 * (np.stack(np.meshgrid(*[np.arange(8)] * 2), axis=-1).reshape(-1, 2) - 3.5)
    for height in (0.1, -0.1):
        scene.add_spheres(np.column_stack([grid, np.full(64, height)]), 0.1, 1000.0)
    scene.add_capsules([0, 0, 0.25], 0.04, 0.1, 1000.0, quaternions=turned)
    world = new_world(scene, SELF, overlap=10.0)
    contacts = find_contacts(world, 0.05)
    assert len(contacts) > 128
    assert len(np.unique(contacts.key)) == len(contacts)
    system = ContactSystem(world, contacts, unconstrained(world, 1e-9))
    advance(world, system.motion, system.contacts, system.velocity(crude_impulse(system)))
    np.testing.assert_array_equal(np.sort(find_contacts(world, 0.05).key), np.sort(contacts.key))


def tumbler():
    """Spheres and capsules in a turning drum with a wheel that turns, and a ball that is free to move."""
    rng = np.random.default_rng(9)
    scene = Scene(friction=0.4)
    profile = [(0.0, -0.49), (0.7, -0.49), (0.7, 0.49), (0.0, 0.49)]
    scene.add_body("drum", [Mesh.revolved(profile, 12)], Rotation((0.3, 1.0, 0)))
    wheel = Mesh.revolved([(0, -0.185), (0.22, -0.185), (0.22, 0.185), (0, 0.185)], 9)
    scene.add_body("wheel", [wheel], Rotation((1.0, 2.0, 3.0), (0, 0, 0.35)), position=(0, 0, 0.35))
    scene.add_body("ball", [Sphere(0.1)], Dynamic(), density=500.0, position=(0.57, 0, 0), velocity=(1, 0, 0))
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    places = 0.22 * (grid - 1.5) + rng.uniform(-0.01, 0.01, grid.shape) - [0, 0, 0.05]
    places = places[np.linalg.norm(places - [0, 0, 0.35], axis=1) > 0.27]
    speeds = rng.normal(size=places.shape)
    scene.add_spheres(places[::2], 0.09, 1000.0, velocity=speeds[::2])
    turns = random_quaternions(rng, len(places[1::2]))
    scene.add_capsules(places[1::2], 0.05, 0.04, 1000.0, quaternions=turns, velocity=speeds[1::2])
    return scene


@pytest.mark.parallel(3)
def test_on_several_ranks_meshes_have_the_contacts_that_they_have_on_one():
    worlds = [new_world(tumbler(), comm) for comm in (SELF, MPI.COMM_WORLD)]
    touched = np.zeros(3)
    for _ in range(4):
        one, many = (contacts_by_key(step(world, delta=0.03), world.comm) for world in worlds)
        np.testing.assert_array_equal(one["key"], many["key"])
        for name in ("a", "b"):
            np.testing.assert_array_equal(one[name], many[name])
        for name in ("point", "normal", "gap"):
            np.testing.assert_allclose(one[name], many[name], atol=1e-8)
        touched += [np.count_nonzero(one["b"] == len(worlds[0].grains) + k) for k in range(3)]  # drum, wheel, ball
    assert (touched > 0).all()


def test_of_a_fine_surface_few_triangles_are_near():
    """A ball of twenty triangles' size finds those around it, and not all of 45,000."""
    n = 151
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, n), np.linspace(-1.0, 1.0, n), indexing="ij")
    i = np.arange(n * (n - 1)).reshape(n - 1, n)[:, :-1].ravel()
    triangles = np.concatenate([np.stack([i, i + n, i + n + 1], axis=1), np.stack([i, i + n + 1, i + 1], axis=1)])
    surface = Mesh(np.stack([x, y, 0.1 * x * y], axis=-1).reshape(-1, 3), triangles).surface
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (20, 3)) * [1.0, 1.0, 0.1]
    reach = np.full(20, 0.13)
    row, triangle = surface.near(points, reach)
    within = surface.closest(points[row], triangle).distance <= reach[row]
    assert len(row) < 1.3 * np.count_nonzero(within)
    every = np.arange(len(triangles))
    for k in range(3):
        true = np.flatnonzero(surface.closest(np.tile(points[k], (len(every), 1)), every).distance <= 0.13)
        assert set(true) == set(triangle[(row == k) & within])
