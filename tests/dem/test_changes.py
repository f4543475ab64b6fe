"""What a run changes by name, what it refuses, and what a checkpoint keeps of it."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import pytest
from mpi4py import MPI

from dem.measures import Block
from dem.model.changes import change, changes, restore
from dem.motion import Dynamic, Glide
from dem.scene import Scene
from dem.shapes import Box, Sphere
from dem.start import new_world


def wired():
    """A world with a part of each kind."""
    scene = Scene(friction=0.3, gravity=(0, 0, 0))
    scene.add_spheres([[0, 0, 0], [1, 0, 0]], 0.1, 1000.0)
    scene.add_body("arm", [Sphere(0.1)], Dynamic(), mass=1.0, inertia=(1, 1, 1), position=(0, 3, 0))
    scene.add_body("belt", [Box((1, 1, 0.1))], position=(0, 0, -3))
    scene.add_load("wind", force=(1, 0, 0))
    scene.add_load("drag", force=lambda time, table: -table.velocity[:, :3])
    scene.add_spring("tie", 0, 1, stiffness=10.0)
    scene.add_joint("axle", "arm", anchor=(0, 3, 0), speed=1.0)
    scene.add_source("rain", Block((0, 5, 0), (1, 6, 1)), radius=0.1, density=1000.0, number_rate=1.0)
    return new_world(scene, MPI.COMM_SELF)


CHANGES = {
    "load wind": {"force": (0, 2, 0), "end": 4.0},
    "load drag": {"torque": (0, 0, 1), "start": 1.0},
    "load tug": {"on": [1], "force": (0, 0, 3.0)},
    "spring tie": {"stiffness": 20.0, "length": 0.5},
    "joint axle": {"target": 0.5, "strength": 3.0, "high": 2.0},
    "source rain": {"mass_rate": 2.0, "velocity": (0, 0, -1)},
    "body belt": {"motion": Glide((1, 0, 0)), "surface_velocity": (0, 1, 0)},
    "pair default, default": {"friction": 0.7},
}


def all_of(world):
    parts = [*world.named.values(), {b.name: b for b in world.large_bodies}]
    return repr([vars(part) for named in parts for part in named.values()] + [world.pairs])


def test_what_is_changed_is_kept_and_restored():
    world, again = wired(), wired()
    for what, values in CHANGES.items():
        before = all_of(world)
        change(world, what, **values)
        assert all_of(world) != before, what
    assert world.named["joint"]["axle"].speed is None  # a target takes its place
    kept = changes(world)
    assert {(kind, name) for kind, names in json.loads(kept).items() for name in names} == world.changed
    restore(again, kept)
    for name in ("wind", "drag", "tug"):
        np.testing.assert_array_equal(again.named["load"][name].torque, world.named["load"][name].torque)
    assert callable(again.named["load"]["drag"].force)  # a law is the scene's
    assert changes(again) == kept
    for kind in ("spring", "joint", "source"):
        assert again.named[kind] == world.named[kind]
    assert again.large_bodies[1].motion == Glide((1, 0, 0))
    assert again.pairs.friction == world.pairs.friction == 0.7


@dataclass(frozen=True)
class Wobbling:
    """A motion of a user, which no checkpoint could name where the scene does not have it."""

    way: float

    def pose(self, time, position, orientation):
        return position + [0, 0, self.way * np.sin(time)], orientation


REFUSED = {
    "lod wind": ({}, "'lod wind': allowed are load, .* did you mean load"),
    "load wnd": ({"force": (0, 0, 1)}, "no load 'wnd'; there are: wind, drag; did you mean wind.*on=... to begin"),
    "load wind": ({"forces": (0, 0, 1)}, "load 'wind': forces cannot be set; allowed are on, force.*mean force"),
    "load drag": ({"force": np.sin}, "force of load drag can be set to numbers within a run"),
    "load new": ({"on": "axle"}, "load 'new': 'axle' is neither a body nor a material"),
    "spring tie": ({"stiffness": -1.0}, "stiffness of a spring must not be negative"),
    "joint axl": ({"speed": 1.0}, "no joint 'axl'; there are: axle; did you mean axle"),
    "joint axle": ({"low": 3.0, "high": 2.0}, "limits of a joint"),
    "source rain": ({"radius": 1.0}, "source 'rain': radius cannot be set; allowed are mass_rate, number_rate"),
    "body blt": ({"motion": Glide((1, 0, 0))}, "no large body 'blt'; there are: arm, belt; did you mean belt"),
    "body arm": ({"motion": Glide((1, 0, 0))}, "cannot change its motion"),
    "body belt": ({"motion": Glide((1, 0, 0)), "velocity": (1, 0, 0)}, "a motion, or parameters of the present one"),
    "pair default": ({"friction": 0.1}, "pair 'default': allowed are two, with a comma between, of default"),
    "pair default, default": ({"friction": -0.1}, "friction must not be negative"),
    "pair default, default ": ({"friction": 0.1}, "allowed are two, with a comma"),
    "cell": ({"stres": (None, None, 1.0)}, "cell: stres cannot be set; .* did you mean stress"),
    "cell ": ({"stress": (None, None, 1.0)}, "stress: the periods of this cell are constant"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_is_refused_and_changes_nothing(what):
    world, (values, words) = wired(), REFUSED[what]
    before = all_of(world)
    with pytest.raises(ValueError, match=words):
        change(world, what, **values)
    assert all_of(world) == before
    assert not world.changed


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"stiffness": 1e5}, "stiffness cannot be set; allowed are friction, .*rolling"),
        ({"rolling": 0.01}, "rolling 0.01: this law begins or ends to act"),
        ({"restitution": 0.5}, "restitution 0.5: this law begins or ends to act"),
        ({"friction": 0.1, "restitution": 2.0}, "restitution must be"),
    ],
)
def test_laws_of_contact_do_not_begin_within_a_run(values, words):
    world = wired()
    with pytest.raises(ValueError, match=words):
        change(world, "pair default, default", **values)
    assert not world.changed


def test_a_motion_that_no_checkpoint_could_name_is_refused():
    world = wired()
    with pytest.raises(ValueError, match=r"cannot change its motion to Wobbling\(.*: allowed are Fixed, .*Glide"):
        change(world, "body belt", motion=Wobbling(1.0))
    assert not world.changed


@pytest.mark.parametrize("text", [
    '{"spring": {"tie": {"stiffness": -1.0}}}', '{"spring": {"tie": {"ends": [0, 1]}}}', '{"spring": {"no": {}}}',
    '{"load": {"new": {"on": "nobody"}}}', '{"joint": {"axle": {"low": 1.0, "high": 0.0}}}',
])  # fmt: skip
def test_what_no_run_can_have_changed_is_refused(text):
    with pytest.raises(ValueError, match="spring|load|limits"):
        restore(wired(), text)
