"""The scenes of the package."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from mpi4py import MPI

from dem.contact import find_contacts
from dem.start import new_world
from dem.unconstrained import unconstrained
from pctt.scenes import SCENES, Blade, Drum, Mixer, Shear, Silo

SELF = MPI.COMM_SELF
SMALL = [Blade(n=2), Shear(n=1), Shear(n=2), Mixer(n=2)]
ROUND = [Drum(n=5), Drum(n=4, length=3.0, fill=0.2), Silo(n=3), Silo(n=3, half_angle=90.0)]


@pytest.mark.parametrize(
    ("scene", "count"),
    [(Mixer(n=8), 4915), (Mixer(n=16), 35939), (Blade(n=8), 4915), (Blade(n=16), 35939), (Blade(n=4), 729 + 2)]
    + [(Shear(n=8), 7228), (Shear(n=16), 53364), (Shear(n=4), 1053 + 3)],
)
def test_bodies_of_the_paper(scene, count):
    built = scene.build()
    assert len(built.grains()) + len(built.large_bodies) == count
    assert (built.grains().size[:, 0] == 0.1).all()
    assert built.pairs(1.0).friction == pytest.approx(0.25)


def test_every_option_has_help_unit_and_default():
    for scene in SCENES.values():
        for option in fields(scene):
            assert option.metadata["help"]
            assert isinstance(option.metadata["unit"], str)
            assert getattr(scene(), option.name) == option.default


def test_the_paddle_of_the_mixer_turns_below_all_spheres():
    scene = Mixer(n=3, perturbation=0.024)
    world = new_world(scene.build(), SELF)
    assert [body.name for body in world.large_bodies] == ["box", "mixer"]
    np.testing.assert_allclose(unconstrained(world, 0.025).prescribed[1], [0, 0, 0, 0, 0, np.pi / 3])
    paddle_top = scene.clearance + scene.paddle_height * scene.width
    assert (world.grains.position[:, 2] - scene.radius > paddle_top).all()
    assert scene.settling_time > np.sqrt(2 * scene.positions()[:, 2].max() / 9.81)
    assert Mixer(n=8).width / Mixer(n=4).width == pytest.approx(17 / 9)


def test_the_seed_decides_the_start():
    np.testing.assert_array_equal(Mixer(seed=3).positions(), Mixer(seed=3).positions())
    shift = Mixer(seed=3).positions()[:] - Mixer(seed=4).positions()[:]
    assert 0.01 < np.abs(shift).max() <= 0.04


@pytest.mark.parametrize("scene", [*SMALL, *ROUND], ids=repr)
def test_spheres_start_inside_without_contact(scene):
    world = new_world(scene.build(), SELF)
    assert (find_contacts(world, 0.0 if scene in ROUND else 0.02).gap > 0).all()
    if scene in ROUND:
        assert len(world.grains) == scene.spheres
        across = world.grains.position[:, [0, 2] if isinstance(scene, Drum) else [0, 1]]
        assert np.hypot(*across.T).max() < scene.container_radius - scene.radius
        return
    low, high = scene.domain
    assert (world.grains.position > np.array(low) + scene.radius).all()
    assert (world.grains.position < np.array(high) - scene.radius).all()


@pytest.mark.parametrize("scene", SMALL[:3], ids=repr)
def test_nothing_moves_before_the_end_of_settling(scene):
    world = new_world(scene.build(), SELF)
    dt = 0.01
    world.time = scene.settling_time - dt
    np.testing.assert_allclose(unconstrained(world, dt).prescribed, 0.0, atol=1e-12)
    world.time = scene.settling_time + scene.period / 4 - dt / 2
    world.put_large(world.poses(world.time))
    fastest = np.abs(unconstrained(world, dt).prescribed).max()
    assert fastest == pytest.approx(np.pi * scene.travel / scene.period, rel=1e-4)


def test_the_blade_goes_from_one_end_to_the_other_and_back():
    scene = Blade(n=8)
    blade = scene.build().large_bodies[1]
    half = (scene.period / 2, scene.period)
    start, far, back = (
        blade.motion.pose(scene.settling_time + time, blade.position, blade.quaternion)[0] for time in (0.0, *half)
    )
    np.testing.assert_allclose([start, back], [blade.position] * 2, atol=1e-12)
    gap = scene.end_gap * scene.width + scene.thickness / 2
    assert start[0] == pytest.approx(-scene.length / 2 + gap)
    assert far[0] == pytest.approx(scene.length / 2 - gap)
    np.testing.assert_array_equal(far[1:], start[1:])


def test_walls_of_the_halves_cover_each_other_at_the_greatest_displacement():
    scene = Shear(n=1)
    lower, upper, _ = scene.build().large_bodies
    left, right = (max(x for x in xs) for xs in zip(*((-b.center[0], b.center[0]) for b in upper.shapes[:2])))
    thick = upper.shapes[0].half_extents[0]
    assert left - thick == right - thick == pytest.approx(scene.length / 2)
    assert 2 * thick > scene.travel + 2 * scene.radius
    moved = lower.motion.pose(scene.settling_time + scene.period / 2, lower.position, lower.quaternion)[0]
    np.testing.assert_allclose(moved, [scene.travel, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("scene", "options", "message"),
    [
        (Mixer, {"radius": -0.1}, "radius must be positive"),
        (Mixer, {"perturbation": 0.025}, "perturbation 0.025 m must be less than"),
        (Mixer, {"pitch": 0.2}, "perturbation"),
        (Mixer, {"gravity": np.nan}, "gravity: NaN"),
        (Mixer, {"clearance": 0.15}, "jam"),
        (Mixer, {"paddle_length": 1.0}, "does not fit"),
        (Mixer, {"margin": -1.0}, "margin must not be negative"),
        (Blade, {"n": 1, "clearance": 0.2}, "clearance 0.2 box widths is 0.15 m"),
        (Blade, {"end_gap": 0.01}, "end_gap 0.01 box widths is 0.0225 m"),
        (Blade, {"end_gap": 1.0}, "end_gap 1 box widths leaves"),
        (Blade, {"blade_height": 2.0}, "blade_height 2 box widths"),
        (Shear, {"split": 1.0}, "split 1 bed depths"),
        (Shear, {"wall_friction": -0.1}, "wall_friction must not be negative"),
        (Drum, {"n": 2}, "n must be at least 3"),
        (Drum, {"fill": 0.9}, "fill 0.9 needs .* spheres, but only"),
        (Drum, {"spread": 1.0}, "spread must be from 0 to 0.9"),
        (Drum, {"sides": 3}, "sides must be at least 12"),
        (Drum, {"length": 1.0}, "length must be at least 2"),
        (Silo, {"n": 1}, "n must be at least 3"),
        (Silo, {"outlet": 12.0}, "outlet 12 sphere diameters must be between 1 sphere diameter and the 12"),
        (Silo, {"half_angle": 100.0}, "half_angle must be from 5 to 90, got 100"),
    ],
)
def test_bad_options(scene, options, message):
    with pytest.raises(ValueError, match=message):
        scene(**options)


def test_the_drum_turns_at_its_froude_number_after_settling():
    scene = Drum(n=5, froude=0.04)
    world = new_world(scene.build(), SELF)
    np.testing.assert_array_equal(unconstrained(world, 0.005).prescribed, 0.0)
    world.time = scene.settling_time
    velocity = unconstrained(world, 0.005).prescribed
    np.testing.assert_allclose(velocity[:, 4] ** 2 * scene.container_radius / 9.81, 0.04)


def test_the_gate_of_the_silo_is_away_soon_and_closes_the_outlet_before():
    scene = Silo(n=4)
    world = new_world(scene.build(), SELF)
    silo, gate = (body.shapes[0].surface for body in world.large_bodies[:2])
    assert gate.half[0] == pytest.approx(scene.outlet_radius)
    assert silo.half[0] == pytest.approx(scene.container_radius)
    motion, body = world.large_bodies[1].motion, world.large_bodies[1]
    far = motion.pose(scene.settling_time + 0.1, body.position, body.quaternion)[0]
    np.testing.assert_allclose(far, [0, 0, scene.floor - scene.outlet_radius], atol=1e-12)


def test_the_flow_of_the_silo_is_the_slope_of_its_records():
    scene = Silo(n=3)
    time = np.arange(200) * 0.005
    total = scene.spheres * scene.density * 4 / 3 * np.pi * scene.radius**3
    out = np.clip(0.8 * (time - 0.3), 0.0, total)
    found = scene.analyse({"time [s]": time, "discharged [kg]": out})
    assert found["mass_flow [kg/s]"] == pytest.approx(0.8)
    assert found["beverloo_flow [kg/s]"] == pytest.approx(0.58 * 0.58 * 2500 * 9.81**0.5 * (0.05 - 0.015) ** 2.5)
    assert scene.analyse({"time [s]": time, "discharged [kg]": 0.0 * out}) == {}
