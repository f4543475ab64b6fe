"""The state of a world, and one world on any number of ranks."""

from __future__ import annotations

import numpy as np
import pytest
from cases import heap, step
from mpi4py import MPI

from dem.world import World, restart_rows

SELF = MPI.COMM_SELF


def whole_state(world):
    local, replicated = world.state()
    return {k: v.copy() for k, v in local.items()}, {k: v.copy() for k, v in replicated.items()}


def test_a_restored_world_goes_on_the_same_to_the_last_bit():
    scene = heap(1, side=4)
    world = World.from_scene(scene, SELF)
    for _ in range(5):
        step(world)
    local, replicated = whole_state(world)
    restored = World.restore(scene, SELF, local, replicated)
    assert restored.time == world.time
    assert restored.step == 5
    for _ in range(5):
        step(world)
        step(restored)
    for name, column in world.grains.columns().items():
        np.testing.assert_array_equal(getattr(restored.grains, name), column)
    for name, column in world.large.columns().items():
        np.testing.assert_array_equal(getattr(restored.large, name), column)
    assert restored.time == world.time


def test_a_state_of_another_scene_is_refused():
    local, replicated = World.from_scene(heap(1, side=3), SELF).state()
    with pytest.raises(ValueError, match="the state has 27 grains and 4 large bodies, the scene 64 and 4"):
        World.restore(heap(1, side=4), SELF, local, replicated)
    with pytest.raises(ValueError, match="the scene 27 and 0"):
        World.restore(heap(1, side=3, large=False), SELF, local, replicated)


def test_unknown_large_body():
    world = World.from_scene(heap(1, side=3), SELF)
    assert world.large_row("blade") == 1
    with pytest.raises(KeyError, match="no large body 'lid'; there are: walls, blade, ball, slab"):
        world.large_row("lid")


CONTACTS = """
import sys
import numpy as np
from mpi4py import MPI
from cases import contacts_by_key, heap, step
from dem.contact import find_contacts
from dem.world import World
comm = MPI.COMM_WORLD
world = World.from_scene(heap(2, side=6, capsules=True), comm)
for _ in range(2):
    step(world)
contacts = find_contacts(world, float(sys.argv[2]), float(sys.argv[3]))
# Every contact on the rank of its lower body, in order.
owner = contacts.body.min(axis=1)
end = world.slabs[comm.rank + 1] + (len(world.large) if comm.rank == comm.size - 1 else 0)
assert ((world.slabs[comm.rank] <= owner) & (owner < end)).all()
assert (np.lexsort((contacts.key, owner)) == np.arange(len(contacts))).all()
assert (contacts.body[:, 0] == contacts.near.index[contacts.a]).all()
found = contacts_by_key(contacts, comm)
if comm.size > 1:
    assert comm.allreduce(contacts.near.ghosts) > 10
if comm.rank == 0:
    np.savez(sys.argv[1], **found)
"""


@pytest.mark.mpi
@pytest.mark.parametrize(("delta", "dt"), [(0.06, 0.0), (0.01, 0.06)])
def test_the_contacts_are_the_same_on_any_number_of_ranks(delta, dt, mpirun, tmp_path):
    found = []
    for ranks in (1, 2, 3, 4):
        mpirun(CONTACTS, ranks, tmp_path / "contacts.npz", delta, dt)
        found.append(dict(np.load(tmp_path / "contacts.npz")))
    assert len(found[0]["key"]) > 300
    for other in found[1:]:
        for name in ("key", "a", "b", "friction"):
            np.testing.assert_array_equal(other[name], found[0][name])
        for name in ("point", "normal", "gap"):
            np.testing.assert_allclose(other[name], found[0][name], atol=1e-11)


TRAJECTORY = """
import sys
import numpy as np
from mpi4py import MPI
from cases import crude_impulse, grains_by_id, heap, step
from dem.contact import find_contacts
from dem.partition import rebalance
from dem.system import ContactSystem
from dem.world import World
comm = MPI.COMM_WORLD
world = World.from_scene(heap(2, side=5), comm)
for k in range(25):
    step(world)
    rebalance(world, 1.02)
    slab = comm.allgather(world.large.position.tolist())
    assert all(other == slab[0] for other in slab)
system = ContactSystem(world, find_contacts(world, 0.02), 0.005)
impulse = crude_impulse(system)
force = {name: system.force_on(name, impulse) for name in ("walls", "blade", "slab")}
# D is assembled without off-process rows and gives the same velocities.
g, load = system.D.createVecs()
g.setArray(impulse.ravel())
system.D.mult(g, load)
assert load.getLocalSize() == 6 * world.owned
mine = load.getArray().reshape(-1, 6)[: len(world.grains)]
change = (system.velocity(impulse) - system.free_velocity)[: len(world.grains)]
np.testing.assert_allclose(change[:, :3], mine[:, :3] / world.grains.mass[:, None], atol=1e-10)
# G has the global indices of the bodies that D has.
assert system.G.indices.size == 0 or system.G.indices.max() < world.body_count
response = comm.allreduce(float(np.sum((change[:, :3] ** 2 * world.grains.mass[:, None]))))
grains = grains_by_id(world)
if comm.rank == 0:
    np.savez(sys.argv[1], response=response, large=world.large.position, time=world.time,
             **{name: getattr(grains, name) for name in ("position", "quaternion", "velocity")}, **force)
"""


@pytest.mark.mpi
def test_the_trajectory_is_the_same_on_any_number_of_ranks(mpirun, tmp_path):
    results = []
    for ranks in (1, 2, 3, 4):
        mpirun(TRAJECTORY, ranks, tmp_path / "end.npz")
        results.append(dict(np.load(tmp_path / "end.npz")))
    assert np.abs(results[0]["slab"]).max() > 0
    for other in results[1:]:
        for name, value in results[0].items():
            np.testing.assert_allclose(
                other[name], value, atol=1e-8 * max(1.0, np.abs(value).max()), err_msg=name
            )


SAVE = """
import sys
import numpy as np
from mpi4py import MPI
from cases import grains_by_id, heap, step
from dem.world import World, restart_rows
comm = MPI.COMM_WORLD
scene = heap(3, side=4)
def save(world, name):
    local, replicated = world.state()
    parts = comm.gather(local)
    if comm.rank == 0:
        grains = {f"grains_{key}": np.concatenate([part[key] for part in parts]) for key in local}
        np.savez(name, **grains, **replicated)
if sys.argv[1] == "start":
    world = World.from_scene(scene, comm)
    for _ in range(4):
        step(world)
    save(world, "middle.npz")
else:
    data = dict(np.load("middle.npz"))
    rows = restart_rows(data["slabs"], comm)
    local = {key[7:]: value[rows] for key, value in data.items() if key.startswith("grains_")}
    world = World.restore(scene, comm, local, {k: v for k, v in data.items() if not k.startswith("grains_")})
    assert (grains_by_id(world).id == np.arange(64)).all()
for _ in range(4):
    step(world)
save(world, sys.argv[2])
"""


@pytest.mark.mpi
def test_restart_is_bitwise_on_the_same_ranks_and_close_on_others(mpirun, tmp_path):
    mpirun(SAVE, 2, "start", "direct.npz")
    direct = dict(np.load(tmp_path / "direct.npz"))
    for ranks in (1, 2, 3, 4):
        mpirun(SAVE, ranks, "again", "again.npz")
        again = dict(np.load(tmp_path / "again.npz"))
        if ranks == 2:
            for name, value in direct.items():
                np.testing.assert_array_equal(again[name], value, err_msg=name)
        one, other = np.argsort(direct["grains_id"]), np.argsort(again["grains_id"])
        for name in ("grains_position", "grains_velocity", "grains_quaternion"):
            np.testing.assert_allclose(again[name][other], direct[name][one], atol=1e-9, err_msg=name)


ERRORS = """
import numpy as np
from mpi4py import MPI
from dem.contact import find_contacts
from dem.partition import rebalance
from dem.scene import Scene
from dem.shapes import Plane
from dem.system import ContactSystem
from dem.stepper import advance
from dem.world import World
comm = MPI.COMM_WORLD

def expect(error, text, call):
    try:
        call()
    except error as problem:
        assert text in str(problem), problem
    else:
        raise AssertionError(f"no {error.__name__}")

# Errors that one rank sees are raised by all.
scene = Scene(friction=0.3)
scene.add_spheres([[0.3 * k, 0, 1.0] for k in range(20)], 0.1, 1000.0)
scene.add_body("floor", [Plane((0, 0, 1))])
world = World.from_scene(scene, comm)
if comm.rank == comm.size - 1:
    world.grains.position[0] = np.nan
expect(FloatingPointError, "no finite position", lambda: find_contacts(world, 0.01))
scene.add_spheres([[0.05, 0, 1.0]], 0.1, 1000.0)
expect(ValueError, "grain 0 and grain 20 overlap by 0.15 m", lambda: World.from_scene(scene, comm))
boxes = Scene(friction=0.3)
boxes.add_boxes([[0, 0, 0], [0.15, 0, 0], [5, 0, 0]], (0.1, 0.1, 0.1), 1000.0)
expect(ValueError, "grain 0 and grain 1 overlap by 0.05 m", lambda: World.from_scene(boxes, comm))

# One body on many ranks, without and with a contact.
for height in (5.0, 0.1):
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, height]], 0.1, 1000.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    world = World.from_scene(scene, comm)
    for _ in range(3):
        contacts = find_contacts(world, 0.01)
        system = ContactSystem(world, contacts, 0.01)
        impulse = np.zeros((len(contacts), 3))
        impulse[:, 0] = world.grains.mass[0] * 9.81 * 0.01 if len(world.grains) else 0.0
        assert system.D.getSize() == (12, 3 * comm.allreduce(len(contacts)))
        force = system.force_on("floor", impulse)
        advance(world, system.velocity(impulse), 0.01)
        rebalance(world)
    assert comm.allreduce(len(contacts)) == (height < 1)
    if height < 1:
        np.testing.assert_allclose(force[2], -1000 * 4 / 3 * np.pi * 0.1**3 * 9.81)
        assert comm.allreduce(float(np.abs(world.grains.velocity).sum())) < 1e-12
"""


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 3, 4])
def test_errors_reach_all_ranks_and_one_body_is_enough(mpirun, ranks):
    mpirun(ERRORS, ranks)


def test_restart_rows_cover_all_grains_once():
    assert restart_rows(np.array([0, 7]), SELF) == slice(0, 7)
    assert restart_rows(np.array([0, 3, 7]), SELF) == slice(0, 7)
