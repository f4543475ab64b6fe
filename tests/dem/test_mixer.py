from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from mpi4py import MPI

from dem.contact import find_contacts
from dem.scenes import SCENES, Mixer
from dem.start import new_world

SELF = MPI.COMM_SELF


def test_every_option_has_help_unit_and_default():
    for scene in SCENES.values():
        for option in fields(scene):
            assert option.metadata["help"]
            assert isinstance(option.metadata["unit"], str)
            assert getattr(scene(), option.name) == option.default


@pytest.mark.parametrize("n", [1, 2, 4])
def test_bodies_of_the_paper(n):
    world = new_world(Mixer(n=n).build(), SELF)
    assert world.body_count == (2 * n + 1) ** 3 + 2
    assert [body.name for body in world.large_bodies] == ["box", "mixer"]
    assert set(world.grains.size[:, 0]) == {0.1}
    np.testing.assert_array_equal(world.large.velocity, 0.0)
    np.testing.assert_allclose(world.prescribed_velocity(0.025)[1], [0, 0, 0, 0, 0, np.pi / 3])


def test_particle_density_does_not_depend_on_n():
    assert Mixer(n=8).width / Mixer(n=4).width == pytest.approx(17 / 9)


def test_spheres_start_inside_the_box_above_the_paddle_without_contact():
    scene = Mixer(n=3, perturbation=0.024)
    world = new_world(scene.build(), SELF)
    assert (find_contacts(world, 0.02).gap > 0).all()
    paddle_top = scene.clearance + scene.paddle_height * scene.width
    assert (world.grains.position[:, 2] - scene.radius > paddle_top).all()
    assert (np.abs(world.grains.position[:, :2]) + scene.radius < scene.width / 2).all()


def test_the_seed_decides_the_start():
    np.testing.assert_array_equal(Mixer(seed=3).positions(), Mixer(seed=3).positions())
    shift = Mixer(seed=3).positions() - Mixer(seed=4).positions()
    assert 0.01 < np.abs(shift).max() <= 0.04


def test_settling_time_is_more_than_the_fall():
    assert Mixer().settling_time > np.sqrt(2 * Mixer().positions()[:, 2].max() / 9.81)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n": 0}, "n must be at least 1"),
        ({"radius": -0.1}, "radius must be positive"),
        ({"density": 0.0}, "density must be positive"),
        ({"friction": -1.0}, "friction must not be negative"),
        ({"perturbation": 0.025}, "perturbation 0.025 m must be less than"),
        ({"pitch": 0.2}, "perturbation"),
        ({"gravity": np.nan}, "gravity: NaN"),
        ({"gravity": 0.0}, "gravity must be positive"),
        ({"clearance": 0.15}, "jam"),
        ({"paddle_length": 1.0}, "does not fit"),
        ({"margin": -1.0}, "margin must not be negative"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        Mixer(**options)
