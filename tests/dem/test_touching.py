"""Shapes that might meet have contacts, or their scene is refused."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from mpi4py import MPI

from dem.contact import find_contacts
from dem.mesh import Mesh
from dem.motion import Dynamic
from dem.scene import Scene
from dem.shapes import Box, Capsule, Clump, Plane, Sphere
from dem.start import new_world

CUBE = np.array(list(itertools.product((-0.1, 0.1), repeat=3)))
TETRAHEDRON = 0.1 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
GRAINS = {
    "spheres": lambda scene, place: scene.add_spheres(place, 0.1, 1000.0),
    "boxes": lambda scene, place: scene.add_boxes(place, (0.1, 0.1, 0.1), 1000.0),
    "capsules": lambda scene, place: scene.add_capsules(place, 0.1, 0.1, 1000.0),
    "clumps": lambda scene, place: scene.add_clumps(place, Clump([(0, 0, 0), (0.05, 0, 0)], [0.1, 0.1]), 1000.0),
    "polyhedra": lambda scene, place: scene.add_polyhedra(place, TETRAHEDRON, 1000.0),
}
TRIANGLES = [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6),
             (0, 6, 4), (1, 5, 7), (1, 7, 3)]  # fmt: skip
SHAPES = {
    "box": Box((0.1, 0.1, 0.1)), "sphere": Sphere(0.1), "capsule": Capsule(0.1, 0.1), "mesh": Mesh(CUBE, TRIANGLES),
    "plane": Plane((-1, 0, 0), (-0.1, 0, 0)),
}  # fmt: skip
APART = [0.19, 0.003, 0.002]  # what is here touches what is there


def body(scene, name, shape, place, **given):
    scene.add_body(name, [shape], position=place, **given)


def pairs():
    for one, other in itertools.combinations_with_replacement(GRAINS, 2):
        yield f"{one}, {other}", (lambda s, n=one: GRAINS[n](s, [0, 0, 0])), (lambda s, n=other: GRAINS[n](s, APART))
    for one, other in itertools.product(GRAINS, SHAPES):
        yield (
            f"{one}, {other}", (lambda s, n=one: GRAINS[n](s, [0, 0, 0])),
            (lambda s, n=other: body(s, "other", SHAPES[n], APART)),
        )  # fmt: skip
    free = {"motion": Dynamic(), "mass": 1.0, "inertia": (1, 1, 1)}
    for one, other in itertools.combinations_with_replacement(SHAPES, 2):
        if (one, other) != ("plane", "plane"):
            yield (
                f"{one}, {other} of bodies", (lambda s, n=one: body(s, "one", SHAPES[n], (0, 0, 0), **free)),
                (lambda s, n=other: body(s, "other", SHAPES[n], APART)),
            )  # fmt: skip


#: What has no contacts: the narrow phase knows none.
REFUSED = {"mesh, mesh of bodies"}


@pytest.mark.parametrize(("name", "one", "other"), pairs(), ids=lambda value: value if isinstance(value, str) else "")
def test_what_may_meet_touches_or_is_refused(name, one, other):
    scene = Scene(0.3)
    one(scene)
    other(scene)
    if name in REFUSED:
        with pytest.raises(ValueError, match=r"cannot touch .*: allowed are spheres"):
            new_world(scene, MPI.COMM_SELF, overlap=10.0)
    else:
        assert len(find_contacts(new_world(scene, MPI.COMM_SELF, overlap=10.0), 0.02))


def test_a_scene_with_clumps_and_polyhedra_knows_each_by_its_number():
    scene, rng = Scene(0.3), np.random.default_rng(1)
    for k, (kind, scale) in enumerate(itertools.product((TETRAHEDRON, CUBE), (1.0, 2.0))):
        scene.add_clumps([[k, 0, 0]], Clump([(0, 0, 0), (0.1 * (k + 1), 0, 0)], [0.1, 0.1]), 1000.0)
        scene.add_polyhedra([[k, 3, 0]], kind, 1000.0, scale=scale, quaternions=rng.normal(size=4))
    grains = scene.grains()
    assert len(scene.forms) == 6
    for shape, size in zip(grains.shape, grains.size):
        (form,) = (form for n, form in enumerate(scene.forms) if form.BASE + n == shape)
        assert size[0] / form.size[0] == pytest.approx(size[1] / form.size[1])
    assert len(find_contacts(new_world(scene, MPI.COMM_SELF), 0.01)) == 0
