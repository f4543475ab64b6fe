"""What a scene refuses, and what it makes."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from dem.bodies import bounding_radius
from dem.motion import Dynamic
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere
from dem.start import new_world

SELF = MPI.COMM_SELF


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0, 0, np.nan]], 0.1, 1000.0), "positions: NaN or infinite"),
        (([[0, 0, np.inf]], 0.1, 1000.0), "positions: NaN or infinite"),
        (([[0, 0]], 0.1, 1000.0), r"positions must have shape \(3,\) or \(1, 3\)"),
        (([[0, 0, 0]], 0.0, 1000.0), "radius must be positive, got 0"),
        (([[0, 0, 0]], [-0.1], 1000.0), "radius must be positive, got -0.1"),
        (([[0, 0, 0]], np.nan, 1000.0), "radius: NaN"),
        (([[0, 0, 0]], [0.1, 0.2], 1000.0), r"radius must have shape \(\) or \(1,\), got \(2,\)"),
        (([[0, 0, 0]], 0.1, -1.0), "density must be positive"),
        (([[0, 0, 0]], 0.1, np.inf), "density: NaN or infinite"),
    ],
)
def test_bad_spheres(arguments, message):
    with pytest.raises(ValueError, match=message):
        Scene(friction=0.3).add_spheres(*arguments)


def test_bad_velocities_boxes_and_friction():
    scene = Scene(friction=0.3)
    with pytest.raises(ValueError, match="velocity: NaN"):
        scene.add_spheres([[0, 0, 0]], 0.1, 1000.0, velocity=(0, np.nan, 0))
    with pytest.raises(ValueError, match=r"velocity must have shape \(3,\) or \(1, 3\)"):
        scene.add_spheres([[0, 0, 0]], 0.1, 1000.0, velocity=[[0, 0, 0], [0, 0, 0]])
    with pytest.raises(ValueError, match="half extents must be positive"):
        scene.add_boxes([[0, 0, 0]], (0.1, 0.0, 0.1), 1000.0)
    with pytest.raises(ValueError, match="half length must be positive, got 0"):
        scene.add_capsules([[0, 0, 0]], 0.1, 0.0, 1000.0)
    with pytest.raises(ValueError, match=r"half length must have shape \(\) or \(1,\), got \(2,\)"):
        scene.add_capsules([[0, 0, 0]], 0.1, [0.1, 0.2], 1000.0)
    with pytest.raises(ValueError, match="zero quaternion"):
        scene.add_boxes([[0, 0, 0]], (0.1, 0.1, 0.1), 1000.0, quaternions=(0, 0, 0, 0))
    with pytest.raises(ValueError, match="friction must not be negative"):
        scene.set_friction(-0.1, "a", "b")
    with pytest.raises(ValueError, match="friction must not be negative"):
        Scene(friction=-0.1)
    with pytest.raises(ValueError, match="gravity: NaN"):
        Scene(friction=0.1, gravity=(0, 0, np.nan))


def test_bad_large_bodies():
    scene = Scene(friction=0.3)
    floor = [Plane((0, 0, 1))]
    scene.add_body("floor", floor)
    with pytest.raises(ValueError, match="distinct names, got 'floor'"):
        scene.add_body("floor", floor)
    with pytest.raises(ValueError, match="has no shape"):
        scene.add_body("empty", [])
    with pytest.raises(ValueError, match="needs either its density or both mass and inertia"):
        scene.add_body("press", [Box((1, 1, 1))], Dynamic())
    with pytest.raises(ValueError, match="mass of 'press' must be positive"):
        scene.add_body("press", [Box((1, 1, 1))], Dynamic(), mass=-1.0, inertia=(1, 1, 1))
    with pytest.raises(ValueError, match="half space has no finite mass"):
        scene.add_body("press", floor, Dynamic(), density=100.0)
    with pytest.raises(ValueError, match="prescribed: it takes no initial velocity"):
        scene.add_body("press", floor, velocity=(0, 0, 1))
    with pytest.raises(ValueError, match="Plane.normal is the zero vector"):
        Plane((0, 0, 0))
    with pytest.raises(ValueError, match="Box.half_extents must be positive"):
        Box((1, -1, 1))
    with pytest.raises(ValueError, match="Sphere.radius must be positive"):
        Sphere(0.0)
    assert [body.name for body in scene.large_bodies] == ["floor"]


def test_capsules_and_the_spheres_that_enclose_them():
    scene = Scene(friction=0.3)
    scene.add_boxes([[0, 0, 0]], (0.3, 0.4, 1.2), 1000.0)
    ids = scene.add_capsules([[0, 0, 2], [0, 0, 4]], 0.1, [0.2, 0.5], [1000.0, 2000.0])
    grains = scene.grains()
    np.testing.assert_array_equal(ids, [1, 2])
    np.testing.assert_allclose(bounding_radius(grains), [1.3, 0.3, 0.6])
    np.testing.assert_allclose(grains.mass[1:], np.pi * 0.01 * np.array([0.4 + 0.4 / 3, 2 * (1.0 + 0.4 / 3)]) * 1000)


def test_an_empty_scene_is_refused():
    scene = Scene(friction=0.3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    with pytest.raises(ValueError, match="empty scene: there is no grain"):
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
    scene.set_friction(0.7, "steel", "glass")
    np.testing.assert_array_equal(first, [0, 1])
    np.testing.assert_array_equal(second, [2])
    grains, large = scene.grains(), scene.large()
    np.testing.assert_array_equal(large.id, [3])
    np.testing.assert_allclose(grains.mass, [4188.79e-3, 33.51032, 24.0], rtol=1e-5)
    np.testing.assert_allclose(grains.inertia[1], [0.4 * 33.51032 * 0.04] * 3, rtol=1e-5)
    np.testing.assert_allclose(grains.inertia[2], [24 / 3 * 0.13, 24 / 3 * 0.10, 24 / 3 * 0.05])
    table = scene.friction_table()
    assert table[grains.material[0], large.material[0]] == table[large.material[0], grains.material[0]] == 0.7
    assert table[grains.material[2], large.material[0]] == 0.3
