"""Likely mistakes in Python, each with a sentence that says what is allowed."""

from __future__ import annotations

import copy
import re
import warnings

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.together import SceneError
from pctt import Box, Dynamic, Fixed, Glide, Mesh, Plane, Rotation, Scene, Simulation, analysis, measures
from pctt.disk import FileError
from pctt.folder import Folder
from pctt.options import OptionError, read
from pctt.run.settings import Run
from pctt.scenes import Mixer


def falling(**law):
    scene = Scene(0.5, **law)
    scene.add_spheres([[0, 0, 0.3], [1, 0, 0.4]], 0.05, 1500.0, material="glass")
    scene.add_body("floor", [Plane((0, 0, 1))])
    return scene


@pytest.mark.parametrize(("shapes", "motion", "words"), [
    ([Box((1, 1, 1))], Dynamic, r"motion of 'b': the class Dynamic; allowed is one, Dynamic\(...\)"),
    ([Box((1, 1, 1))], "Dynamic", "the motion 'Dynamic': allowed is an object of dem.motion, or one with"),
    (Box((1, 1, 1)), Dynamic(), "shapes of 'b': Box.*; allowed is a list of one or more"),
    ([], Dynamic(), "shapes of 'b': .*; allowed is a list of one or more"),
    ([measures.Block((0, 0, 0), (1, 1, 1))], Dynamic(), "shapes of 'b': Block.* is none; allowed are Plane, .*, Cyl"),
    ([Box], Dynamic(), "shapes of 'b': <class .*> is none; allowed are Plane, Box"),
    ([Box((1, 1, 1))], Fixed(), r"density of 'b', which stands still: allowed is a motion, Dynamic\(\) say"),
])  # fmt: skip
def test_a_body_of_a_class_or_of_no_list_is_refused(shapes, motion, words):
    with pytest.raises(ValueError, match=words):
        falling().add_body("b", shapes, motion, density=1000.0)


def test_what_is_no_region_is_refused():
    sim = Simulation(falling(), dt=0.01)
    sim.step()
    block, whole = measures.Block((0, 0, 0), (1, 1, 1)), np.ones(2, bool)
    for wrong in (whole, Box((1, 1, 1)), None):
        for measure in (measures.fabric, measures.solid_fraction):
            with pytest.raises(ValueError, match="region of a .*: allowed is a Block or a Cylinder of pctt.measures"):
                measure(sim.sample, wrong)
    tube = measures.Cylinder((0, 0, 0), (0, 0, 1), 1.0)
    with pytest.raises(ValueError, match="region of fields: allowed is a Block of pctt.measures, got Cylinder"):
        measures.fields(sim.sample, tube, (2, 2, 2), 0.1)
    with pytest.raises(ValueError, match="region of mixing: allowed is a Block of pctt.measures, got Cylinder"):
        measures.mixing(sim.sample, whole, tube, (2, 2, 2))
    with pytest.raises(ValueError, match=r"region of an outlet: allowed .*, got Box\(half_extents"):
        falling().add_outlet("out", Box((1, 1, 1)))
    with pytest.raises(TypeError, match="measures.stress: allowed is a Sample, such as sim.sample, got Simulation"):
        measures.stress(sim, block)
    with pytest.warns(UserWarning, match="the mask has every grain of the region"):
        measures.mixing(sim.sample, whole, block, (2, 2, 2))


def test_an_attribute_that_a_simulation_does_not_have_is_refused_with_what_it_has():
    sim = Simulation(falling())
    for name in ("dt", "gravity", "figurs"):
        with pytest.raises(AttributeError, match=f"a Simulation has no '{name}' to set; settings are arguments"):
            setattr(sim, name, 0.5)
    sim.figures = {}  # it has
    sim.step()
    for name, found in {"dt": "settings.dt", "grains": "world.grains", "velocitys": "velocities"}.items():
        with pytest.raises(AttributeError, match=f"a Simulation has no attribute '{name}'; did you mean {found}"):
            getattr(sim, name)
    assert sim.copy().steps == 1


def test_a_time_that_is_past_is_no_end():
    sim = Simulation(falling(), dt=0.01)
    sim.run(until=0.05)
    sim.run(until=sim.time)
    assert sim.steps == 5
    for past in (0.02, -np.inf, np.nan):
        words = rf"run\(until={past}\): the time is 0.05 s already; allowed is a later one"
        with pytest.raises(OptionError, match=words):
            sim.run(until=past)
    sim.run(until=np.inf, stop=lambda sim: sim.steps == 7)
    for every in (0, -1, 2.5):
        with pytest.raises(OptionError, match=rf"run\(every={every}\): allowed are whole numbers from 1 on"):
            sim.run(steps=1, every=every)
    with pytest.raises(OptionError, match=r"run\(every=10\): is for call=...; write\(every=...\) is for the recorded"):
        sim.run(steps=1, every=10)
    assert sim.steps == 7


def test_unused_materials_and_rolling_of_more_than_a_radius_are_told():
    scene = falling(rolling=0.06)
    scene.set_pair("glas", "glass", friction=0.1)
    words = r"no body has the material .glas.; did you mean glass\?; rolling or spinning of 0.06 m"
    with pytest.warns(UserWarning, match=words):
        Simulation(scene)
    scene = falling(rolling=0.04)
    scene.set_pair("default", "glass", friction=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulation(scene)


def bare(friction=0.5, density=1500.0, away=0.0, **law):
    scene = Scene(friction, **law)
    scene.add_spheres([away, 0, 0.3], 0.05, density)
    return scene


def floored(**given):
    scene = bare(**given)
    scene.add_body("floor", [Plane((0, 0, 1))])
    return scene


def poured():
    scene = floored()
    region = measures.Block((0, 0, 1), (1, 1, 2))
    scene.add_source("rain", region, radius=0.05, density=2.5, number_rate=1.0)
    return scene


def walled():
    scene = bare()
    scene.add_body("walls", [Plane((1, 0, 0), (-1, 0, 0)), Plane((0, -1, 0), (0, 1, 0))])
    return scene


def repeated(*period):
    return bare(period=period)


def in_millimetres():
    scene = floored()
    scene.add_body("wheel", [Mesh.revolved([(0, 0), (100, 0), (100, 50)], 8)], Rotation((0, 0, 1)), position=(0, 0, 99))
    return scene


def tooled(density=1000.0, anchor=(0, 0, 3)):
    scene = floored()
    scene.add_body("arm", [Box((0.5, 0.1, 0.1))], Dynamic(), density=density, position=(0, 0, 2))
    scene.add_joint("axle", "arm", anchor=anchor)
    return scene


def hung():
    scene = bare()
    scene.add_spring("rope", None, 0, stiffness=10.0)
    return scene


def drained():
    scene = bare()
    scene.add_outlet("below", measures.Block((-1, -1, -2), (1, 1, -1)))
    return scene


@pytest.mark.parametrize(("scene", "words"), [
    (floored(density=2.5), "a density of 2.5 kg/m.3: is it in g/cm.3"),
    (poured(), "a density of 2.5 kg/m.3: is it in g/cm.3"),
    (tooled(density=7.8), "a density of 7.8 kg/m.3: is it in g/cm.3"),
    (tooled(anchor=(0, 800, 0)), "an anchor of the joint 'axle' is 800 m away from 'arm': is it in mm"),
    (floored(friction=30.0), "friction 30: is it an angle in degrees"),
    (floored(static_friction=26.6), "friction 26.6: is it an angle in degrees"),
    (in_millimetres(), "the mesh of 'wheel' is 200 m long: is it in mm, scale=1e-3"),
    (floored(away=-1e12), r"grains are up to 1e\+12 m away .* apart by 0.00012 m .* too coarse for .* 0.0025 m"),
    (floored(away=1e9), ""),
    (bare(), "the grains fall for ever, as no part of a large body is below them: a floor is"),
    (walled(), "the grains fall for ever"),
    (repeated(1.0, 1.0, None), "the grains fall for ever"),
    (repeated(None, None, 1.0), ""),  # they do, and are seen to
    (floored(density=1e9), r"a density of 1e\+09 kg/m.3: no solid has more than 22600"),
    (floored(stiffness=1.0), "contacts are so soft that .* half thicknesses. What helps: a larger stiffness="),
    (tooled(), ""),
    (floored(), ""), (floored(friction=150.0), ""), (hung(), ""), (drained(), ""), (bare(gravity=(0, 0, 0)), ""),
])  # fmt: skip
def test_what_is_likely_a_mistake_is_told_before_the_first_step(scene, words):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", UserWarning)
        Simulation(scene)
    found = [str(each.message) for each in told if each.category is UserWarning]
    assert len(found) == bool(words), found
    assert all(re.match(words, each) for each in found), found


def test_friction_and_contact_distances_beyond_the_rest_of_the_scene():
    """With a coefficient of 1000 and the usual tolerance a sphere that should roll may go backwards."""
    with pytest.raises(OptionError, match="friction 1000 with tol 0.0005: .* allowed is up to 200"):
        Simulation(floored(friction=1e3))
    with pytest.warns(UserWarning, match=r"delta 100 m is more than the greatest grain, 0.1 m: .* 0.0025 m, is usual"):
        sim = Simulation(falling(), delta=100.0)
    with pytest.warns(UserWarning, match=r"^dt 1e-06 s is 7e\+03 times less than this scene needs, .*; take 0.0071 s"):
        Simulation(falling(), dt=1e-6)
    with pytest.raises(ValueError, match="friction 1000 with tol"):
        sim.change("pair glass, default", friction=1e3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulation(falling(), delta=0.1, dt=1e-5)


def test_calls_with_what_they_cannot_take(tmp_path):
    scene = falling()
    scene.add_spring("rope", 0, 1, stiffness=1.0)
    sim = Simulation(scene, dt=0.01)
    idle = falling()
    idle.add_spring("idle", None, "floor", stiffness=1.0)
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    sim.run(steps=1, call=None)
    for words, call in {
        r"run\(call=...\) 3: allowed is a function": lambda: sim.run(steps=1, call=3),
        r"run\(until=...\): allowed is one number": lambda: sim.run(until=[1, 2]),
        "spring 'idle': the motions of the world and 'floor' are prescribed, so it holds": lambda: Simulation(idle),
        "positions: allowed are real numbers, got None": lambda: Scene(0.5).add_spheres(None, 0.1, 1500.0),
        "no spring 'x'; there are: rope": lambda: sim.spring_force("x"),
        "body floor: no values; allowed are some by name": lambda: sim.change("body floor"),
        "change 3: allowed is a kind and a name": lambda: sim.change(3, speed=1.0),
        r"load\(''\): allowed is the name of a file": lambda: Simulation.load("", scene),
        r"save\(3\): allowed is the name of a file": lambda: sim.save(3),
        "restart 3: allowed is the name of a checkpoint": lambda: Simulation(scene, restart=3),
        r"scale of .*a.obj: allowed is one number, got \(1, 2\)": lambda: Mesh.read(tmp_path / "a.obj", scale=(1, 2)),
        "file of a mesh 3: allowed is the name of a file": lambda: Mesh.read(3),
        "n 1.5: allowed is a whole number": lambda: Mixer(n=1.5),
        "radius '0.1': allowed is a number": lambda: Mixer(radius="0.1"),
        "comm 3: allowed is a communicator of mpi4py": lambda: Simulation(scene, comm=3),
        "period must have three entries, for x, y and z, got 1.0": lambda: Scene(0.5, period=1.0),
        "friction None: allowed is a number >= 0": lambda: Scene(None),
        "overwrite 'no': allowed is true or false": lambda: sim.write(tmp_path / "run", overwrite="no"),
        "decay 0: allowed is a number above 0, up to 1": lambda: Simulation(scene, solver="apgd", options={"decay": 0}),
    }.items():
        with pytest.raises(ValueError, match=words):
            call()
    with pytest.raises(TypeError, match="run: there is no argument 'time'; allowed are until, steps, stop, every"):
        sim.run(time=1.0)


@pytest.mark.parametrize("name", ["restart", "problem", "dump_problem", "compare", "output"])
def test_an_option_without_a_value_is_refused(name):
    with pytest.raises(OptionError, match=f"^-{name}: allowed is "):
        read(Run, {name: ""})


@pytest.mark.parametrize(("motion", "told"), [
    (Glide((5.1, 0, 0)), True), (Glide((4.9, 0, 0)), False),
    (Rotation((0, 0, 20.0)), True), (Rotation((0, 0, 8.0)), False),
])  # fmt: skip
@pytest.mark.parametrize("changed", [False, True])
def test_a_tool_that_passes_a_grain_in_a_step_is_told_once(motion, told, changed):
    """Grains have radii of 5 cm, of which it goes two in 20 ms with 5 m/s; its corner is 0.354 m from the axis."""
    scene = falling()
    still = type(motion)((0, 0, 0))
    scene.add_body("blade", [Box((0.25, 0.25, 0.01))], still if changed else motion, position=(0, 0, 9))
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always", UserWarning)
        sim = Simulation(scene, dt=0.02)
        if changed:
            sim.run(steps=2)
            sim.change("body blade", motion=motion)
        sim.run(steps=45)
    found = [str(each.message) for each in seen if "blade goes with" in str(each.message)]
    assert len(found) == told
    words = r"dt 0.02 s is too large: blade goes with (5.1|7.07) m/s, by 2.* half thicknesses of the grains in a step"
    assert all(re.match(words, each) for each in found)


def test_a_scene_that_a_simulation_has_stays_as_it_is():
    """Its copy does not."""
    scene = falling()
    sim = Simulation(scene)
    words = "a simulation was made of this scene, and would not see the change; allowed are scene.copy"
    for change in (
        lambda scene: scene.add_spheres([0, 0, 1], 0.05, 1500.0),
        lambda scene: scene.set_pair("glass", "glass", friction=0.1),
        lambda scene: scene.add_body("lid", [Plane((0, 0, -1), (0, 0, 2))]),
        lambda scene: setattr(scene, "gravity", (0, 0, 0)),
    ):
        with pytest.raises(ValueError, match=words):
            change(scene)
    with pytest.raises(ValueError, match="read-only"):
        scene.gravity[2] = 0.0
    other = copy.copy(scene)
    other.gravity[:] = 0.0
    other.add_spheres([0, 0, 1], 0.05, 1500.0)
    assert (scene.count, other.count, scene.copy().count) == (2, 3, 2)
    with Simulation(other, dt=0.01) as floats:
        floats.step()
        assert len(floats.positions) == len(sim.positions) + 1
        assert not floats.velocities.any()
    assert Simulation(scene, dt=0.01).copy().step()["contacts"] == 0


def test_names_that_a_scene_does_not_have_are_refused():
    scene = falling()
    with pytest.raises(AttributeError, match="a Scene has no 'gravty' to set; did you mean gravity?"):
        scene.gravty = (0, 0, 0)
    with pytest.raises(TypeError, match="add_body: there is no argument 'dencity'; .*; did you mean density?"):
        scene.add_body("b", [Box((1, 1, 1))], Dynamic(), dencity=1e3)
    with pytest.raises(OptionError, match="tolerance: no such setting; .*; did you mean tol?"):
        Simulation(scene, tolerance=1e-4)
    with pytest.raises(OptionError, match="time_step: no such setting; .*; did you mean dt?"):
        Simulation(scene, time_step=1e-4)
    with pytest.raises(AttributeError, match="module 'pctt' has no attribute 'Simulaton'; did you mean Simulation?"):
        pctt.Simulaton  # noqa: B018


@pytest.mark.parallel(2)
def test_arrays_of_a_simulation_cannot_be_written_to():
    sim = Simulation(falling())
    sim.step()
    floor, local = sim.body("floor"), sim.local
    arrays = [sim.positions, sim.velocities, sim.orientations, sim.ids, floor.position, floor.velocity]
    arrays += [sim.contacts.gap, sim.contacts.point, local.position, local.velocity]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    before = sim.positions
    sim.step()
    assert (before[:, 2] > sim.positions[:, 2]).all()  # and are no views


@pytest.mark.parallel(2)
def test_other_figures_than_those_of_a_checkpoint_are_told(tmp_path):
    """By their names, with both values; the laws of now hold, the masses of before."""
    sim = Simulation(falling(stiffness=1e5), dt=0.01)
    sim.step()
    sim.save(tmp_path / "a.h5")
    scene = Scene(0.1, gravity=(0, 0, -1.62), stiffness=1e5)
    scene.add_spheres([[0, 0, 0.3], [1, 0, 0.4]], 0.05, 3000.0, material="glass")
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.set_pair("glass", "default", friction=0.2)
    mass = 2 * 1500 * 4 / 3 * np.pi * 0.05**3
    words = r"friction 0.5, now 0.1, friction of glass with default 0.5, now 0.2, gravity z .* -9.81, now -1.62, "
    words += rf"mass of the grains .kg. {mass:.5g}, now {2 * mass:.5g}; gravity and laws of contact are those of now"
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", UserWarning)
        loaded = Simulation.load(tmp_path / "a.h5", scene, dt=0.01)
    if MPI.COMM_WORLD.rank == 0:
        assert re.search(words, str(told[0].message))
    loaded.step()
    np.testing.assert_allclose(loaded.velocities[:, 2], -0.01 * (9.81 + 1.62), rtol=1e-9)
    np.testing.assert_allclose(loaded.local.mass, mass / 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulation.load(tmp_path / "a.h5", falling(stiffness=1e5), dt=0.01)


@pytest.mark.parallel(2)
def test_overlaps_at_the_start_are_told_with_their_number_and_the_place_of_the_worst():
    scene = falling()
    scene.add_spheres([[0, 0, 0.38], [1, 0, 0.46], [5, 5, 0.05]], 0.05, 1500.0)
    words = r"grain 1 and grain 3 overlap by 0.04 m at \(1, 0, 0.43\) m, 0.8 half.*, as at 1 other contacts. What helps"
    with pytest.raises(OptionError, match=words):
        Simulation(scene)


@pytest.mark.parallel(2)
@pytest.mark.parametrize(("name", "first", "other"), [
    ("dt", 0.01, 0.02), ("stiffness", None, 1e5), ("solver", "apgd", "auto"), ("fallback", True, False),
    ("options", {"check": 10}, {"check": 11}),
])  # fmt: skip
def test_other_settings_on_one_rank_are_refused_on_all(name, first, other):
    given = {"solver": "apgd"} | {name: other if MPI.COMM_WORLD.rank else first}
    with pytest.raises(OptionError, match=f"^{name} .* on rank 1, and .* on rank 0; allowed are the same settings"):
        Simulation(falling(), **given)


def test_the_first_step_that_is_not_solved_is_told():
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", UserWarning)
        sim = Simulation(pressed(), dt=0.01, solver="apgd", max_it=1, tol=1e-8, fallback=False, overlap=0.1)
        sim.run(steps=3)
    assert not sim.figures["converged"]
    (words,) = (str(each.message) for each in told)
    assert re.match(r"step 1: NOT CONVERGED: Coulomb residual .*: 1 iterations. Later ones have converged=False", words)


def pressed():
    scene = Scene(0.5)
    scene.add_spheres([[0, 0, 0.05], [0.09, 0, 0.09], [0, 0.02, 0.148]], 0.05, 1500.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    return scene


def test_messages_speak_python(tmp_path):
    with pytest.raises(OptionError, match="^every -1: allowed is a whole number >= 0"):
        Simulation(falling()).write(tmp_path / "none", every=-1)
    for hard in (-1, 1.5):
        with pytest.raises(OptionError, match=rf"write\(hard={hard}\): allowed are whole numbers from 0 on"):
            Simulation(falling()).write(tmp_path / "none", hard=hard)
    with pytest.raises(OptionError, match="^delta 0.001 m: bodies attract each other up to"):
        Simulation(falling(cohesion=1.0, cohesion_range=0.01), delta=1e-3)
    with pytest.raises(OptionError, match=f"^problems {tmp_path}/all: files have no rolling and spinning"):
        Simulation(falling(rolling=0.01)).write(tmp_path / "none", problems=tmp_path / "all")
    with Simulation(falling(), dt=0.01) as sim:
        sim.write(tmp_path / "out")
        sim.step()
    words = rf"^{tmp_path}/out: holds a run .*, overwrite=True .*, or Simulation.load\('{tmp_path}/out/checkpoint.h5', "
    with pytest.raises(FileError, match=words):
        Simulation(falling()).write(tmp_path / "out")
    scene = falling()
    scene.add_spheres([0, 0, 0.31], 0.05, 1500.0)
    with pytest.raises(OptionError, match=f"^{tmp_path}/out/checkpoint.h5: the state has 2 grains .*, the scene 3"):
        Simulation.load(tmp_path / "out" / "checkpoint.h5", scene)
    with pytest.raises(OptionError, match='^the scene: overlapping .* What helps: overlap="relax" opens'):
        Simulation(scene)
    with pytest.raises(OptionError, match="^the scene: has no settling_time"):
        Simulation(falling(), restart="settled")
    with Simulation(Mixer(n=1), comm=MPI.COMM_SELF) as sim:
        sim.save(tmp_path / "mixer.h5")
    with pytest.raises(OptionError, match=f"^n 2: {tmp_path}/mixer.h5 was made with n 1; allowed is the same"):
        Simulation.load(tmp_path / "mixer.h5", Mixer(n=2))


@pytest.mark.parallel(2)
def test_other_calls_on_other_ranks_are_told():
    sim, first = Simulation(falling(), dt=0.01), MPI.COMM_WORLD.rank == 0
    with pytest.raises(SceneError, match="rank 0 at step of a Simulation, rank 1 at position of a Simulation"):
        sim.step() if first else sim.positions
    sim.step()
    whole = measures.Block((0, 0, 0), (1, 1, 1))
    with pytest.raises(SceneError, match="rank 0 at a measure, rank 1 at change of a Simulation"):
        measures.fabric(sim.sample, whole) if first else sim.change("body floor", motion=Fixed())


def test_a_source_that_never_has_room_is_told_once():
    scene = floored()
    for name, low in (("buried", -2.0), ("rain", 1.0)):
        region = measures.Block((0, 0, low), (1, 1, low + 1))
        scene.add_source(name, region, radius=0.05, density=1500.0, number_rate=1e3, most=3)
    sim = Simulation(scene, dt=1e-3)
    with pytest.warns(UserWarning, match="source 'buried' makes no grain in 100 steps") as told:
        sim.run(steps=110)
    assert [sim.source(name).count for name in ("buried", "rain")] == [0, 3]
    assert sum("makes no grain" in str(each.message) for each in told) == 1


def test_calls_that_come_too_late_or_for_what_is_not_there(tmp_path):
    scene = floored()
    scene.add_body("mesh", [Mesh.revolved([(0, 0), (1, 0)], 8)], position=(0, 0, -1))
    with Simulation(scene, dt=0.01) as sim:
        sim.write(tmp_path / "run", every=2)
        sim.run(steps=4)
    folder = Folder(tmp_path / "run")
    closed = "this simulation is closed; allowed is copy"
    with pytest.raises(FileError, match="no step 3 in <Folder .*: 2 recorded steps, 2 to 4>"):
        folder.frame(3)
    for words, call in {
        f"step: {closed}": sim.step,
        f"write: {closed}": lambda: sim.write(tmp_path / "other"),
        f"change: {closed}": lambda: sim.change("body floor", motion=Fixed()),
        r"folder 'run': allowed is a pctt.folder.Folder, such as": lambda: analysis.sample("run", 4),
        "fields 3: allowed are those of dem.measures": lambda: analysis.write_fields(tmp_path / "a.vtkhdf", 3),
        "mask: allowed is a Block, a Cylinder, or True or": lambda: measures.stress(sim.sample, ((0, 0, 0), (1, 1, 1))),
        r"region of a fabric tensor: .*, got \[True\]": lambda: measures.fabric(sim.sample, np.ones(1, bool)),
        "a.xyz: allowed is a name that ends in .stl or": lambda: Mesh.revolved([(0, 0), (1, 0)], 8).write("a.xyz"),
    }.items():
        with pytest.raises(ValueError, match=words):
            call()
    sim.copy().step()
    assert not (tmp_path / "other").exists()


def test_files_go_to_a_folder_that_is_named():
    with pytest.raises(OptionError, match=r"write\(''\): allowed is the name of a folder"):
        Simulation(falling()).write("")
