"""The examples of the pages of classes. Each runs when the site is built, which shows what it prints. A head names the
classes; a name with a star means all of a module."""

# %% pctt.Simulation
import pctt
from dem.scene import Scene
from dem.shapes import Plane

scene = Scene(friction=0.5)
scene.add_body("floor", [Plane(normal=(0, 0, 1))])
scene.add_spheres([[0, 0, 0.1], [0, 0, 0.3]], radius=0.1, density=2500.0)
sim = pctt.Simulation(scene, dt=0.005, solver="apgd", tol=1e-6)
sim.run(until=0.1)
print("floor bears", -sim.body("floor").force[2], "N of", 9.81 * sim.local.mass.sum(), "N")

# %% pctt.Settings
import pctt
from pctt.scenes import Mixer

settings = pctt.Settings(solver="apgd", tol=1e-3, dt=0.01)
for n in (1, 2):
    with pctt.Simulation(Mixer(n=n), settings) as sim:
        print(len(sim.ids), "spheres:", sim.step()["iterations"], "iterations in the first step")

# %% pctt.simulation.Body
import pctt
from dem.motion import Hinged
from dem.scene import Scene
from dem.shapes import Box

scene = Scene(friction=0.5)
scene.add_spheres([9, 9, 9], radius=0.1, density=2500.0)  # a scene has at least one grain
motor = Hinged(axis=(0, 0, 1), torque=2.0)
scene.add_body("fan", [Box((0.5, 0.1, 0.01))], motor, mass=1.0, inertia=(0.1, 0.1, 0.2))
sim = pctt.Simulation(scene, dt=0.01, delta=0.01)
sim.run(until=1.0)
fan = sim.body("fan")
print("spin", fan.velocity[5], "rad/s")  # torque times time over inertia
sim.change("body fan", torque=-2.0)
sim.run(until=2.0)
print("and back to", abs(round(fan.velocity[5], 9)))

# %% pctt.folder.Folder, pctt.folder.Frame, pctt.folder.Table, pctt.folder.Contacts
import pctt
from pctt.folder import Folder
from pctt.scenes import Mixer

with pctt.Simulation(Mixer(n=1), solver="apgd", dt=0.01, say=lambda text: None) as sim:
    sim.write("results", every=5)
    sim.run(steps=10)

folder = Folder("results")
print("recorded steps", folder.steps)
frame = folder.frame(10)
print("time", frame.time, "s,", len(frame.position), "bodies,", len(frame.contacts.gap), "contacts")
print("radii", set(frame.table.radius[: frame.table.grains]))
print("columns", [name for name in folder.records() if "energy" in name][:3])

# %% pctt.folder.Snapshot
import pctt
from pctt.folder import Snapshot
from pctt.render import Picture
from pctt.scenes import Belt

print("what", Picture.__name__, "draws of a simulation:", Snapshot.__doc__.splitlines()[0])
print("sim.render() makes one of", len(pctt.Simulation(Belt(n=1)).ids), "grains")

# %% dem.measures.Sample, dem.measures.Block, dem.measures.Grains
import numpy as np

import pctt
from dem import measures
from dem.scene import Scene
from dem.shapes import Plane

scene = Scene(friction=0.5)
scene.add_body("floor", [Plane(normal=(0, 0, 1))])
scene.add_spheres([[0, 0, 0.1 + 0.2 * k] for k in range(5)], radius=0.1, density=2500.0)
sim = pctt.Simulation(scene, dt=0.005, solver="apgd", tol=1e-8)
sim.run(steps=20)
sample = sim.sample  # what all measures take
region = measures.Block((-0.1, -0.1, 0.2), (0.1, 0.1, 0.8))
print("vertical stress", round(measures.stress(sample, region)[2, 2]), "Pa in", region.volume, "m^3")
grains = measures.per_grain(sample)
print("coordination", grains.coordination, "net forces", np.round(grains.force[:, 2], 1), "N")

# %% dem.measures.Cylinder
from dem.measures import Cylinder

silo = Cylinder(start=(0, 0, 0), end=(0, 0, 2), radius=0.5)
print("length", silo.length, "m, volume", round(silo.volume, 4), "m^3")

# %% dem.measures.Fields
import pctt
from dem import measures
from dem.scene import Scene

scene = Scene(friction=0.5, gravity=(0, 0, 0))
scene.add_spheres([0.5, 0.5, 0.5], radius=0.1, density=2500.0, velocity=(1.0, 0, 0))
sim = pctt.Simulation(scene, dt=0.001)
sim.step()
fields = measures.fields(sim.sample, measures.Block((0, 0, 0), (1, 1, 1)), (20, 20, 20), width=0.2)
cell = 0.05**3
print("mass", fields.density.sum() * cell, "kg, momentum", fields.momentum.sum(axis=(0, 1, 2))[0] * cell, "kg m/s")

# %% dem.measures.Mixing
import numpy as np

import pctt
from dem import measures
from dem.scene import Scene

points = (np.indices((8, 8, 8)).reshape(3, -1).T + 0.5) / 8
scene = Scene(friction=0.5, gravity=(0, 0, 0))
scene.add_spheres(points[points[:, 0] < 0.5], 0.05, 2500.0, material="left")
scene.add_spheres(points[points[:, 0] > 0.5], 0.05, 2500.0, material="right")
sim = pctt.Simulation(scene, dt=0.001)
sim.step()
sample = sim.sample
mixing = measures.mixing(sample, sample.of("left"), measures.Block((0, 0, 0), (1, 1, 1)), (4, 4, 4))
print("two halves apart: Lacey's index", mixing.lacey, "segregation", mixing.intensity)

# %% dem.measures.Profile
import numpy as np

import pctt
from dem import measures
from dem.scene import Scene

heights = np.linspace(0.05, 0.95, 10)
scene = Scene(friction=0.5, gravity=(0, 0, 0))
velocities = np.outer(heights, [1.0, 0, 0])  # a flow that is faster above
scene.add_spheres(np.outer(heights, [0, 0, 1]), 0.04, 2500.0, velocity=velocities)
sim = pctt.Simulation(scene, dt=0.001)
sim.step()
profile = measures.profile(sim.sample, axis=(0, 0, 1), edges=np.linspace(0, 1, 6))
for z, count, velocity in zip(profile.middle, profile.grains, profile.velocity):
    print(f"z = {z:.1f} m: {count:.0f} grains at {velocity[0]:.2f} m/s")

# %% dem.scene.Scene, dem.scene.LargeBody
from dem.scene import Scene
from dem.shapes import Box, Plane

scene = Scene(friction=0.4, gravity=(0, 0, -9.81), restitution=0.2)
scene.set_pair("glass", "steel", friction=0.2)
scene.add_body("floor", [Plane(normal=(0, 0, 1))], material="steel")
scene.add_body("table", [Box((0.5, 0.5, 0.05))], position=(0, 0, 0.5), material="steel")
ids = scene.add_spheres([[0, 0, 1], [0, 0, 2]], radius=0.1, density=2500.0, material="glass")
print("grains", ids, "materials", scene.materials)
print("large bodies", [(body.name, body.position.tolist()) for body in scene.large_bodies])

# %% dem.shapes.Plane
from dem.scene import Scene
from dem.shapes import Plane

scene = Scene(friction=0.5)
scene.add_body("corner", [Plane(normal=(0, 0, 1)), Plane(normal=(1, 0, 0), center=(-0.5, 0, 0))])
print("solid below z = 0 and left of x = -0.5:", len(scene.large_bodies[0].shapes), "half spaces, one body")

# %% dem.shapes.Box
from math import cos, pi, sin

from dem.shapes import Box, mass_properties

tilted = Box(half_extents=(0.5, 0.1, 0.1), quaternion=(cos(pi / 8), 0, sin(pi / 8), 0))  # by 45 degrees about y
mass, centre, inertia = mass_properties([tilted], density=1000.0)
print("mass", mass, "kg; inertia about y", round(inertia[1, 1], 4), "kg m^2")

# %% dem.shapes.Sphere
from math import pi

from dem.shapes import Sphere, mass_properties

mass, centre, inertia = mass_properties([Sphere(0.1), Sphere(0.1, center=(0.4, 0, 0))], density=1000.0)
print("two spheres:", round(mass, 4), "kg =", round(2000 * 4 / 3 * pi * 0.1**3, 4), "kg, centre", centre)

# %% dem.shapes.Capsule
from math import pi

from dem.shapes import Capsule, mass_properties

mass, _, inertia = mass_properties([Capsule(radius=0.1, half_length=0.3)], density=1000.0)
print("mass", round(mass, 3), "kg =", round(1000 * pi * 0.1**2 * (0.6 + 4 / 3 * 0.1), 3), "kg")

# %% dem.shapes.Clump
import pctt
from dem.scene import Scene
from dem.shapes import Clump, Plane

pebble = Clump(centres=[(0, 0, 0), (0.1, 0, 0)], radii=[0.1, 0.07])
scene = Scene(friction=0.5)
scene.add_body("floor", [Plane(normal=(0, 0, 1))])
scene.add_clumps([[0, 0, 0.12]], pebble, density=2500.0)
sim = pctt.Simulation(scene, dt=0.005, solver="apgd", tol=1e-6)
sim.run(until=1.5)
print("it lies on both spheres:", len(sim.contacts), "contacts")

# %% dem.shapes.Cylinder
from math import pi

from dem.shapes import Cylinder, mass_properties

mass, _, inertia = mass_properties([Cylinder(radius=0.1, length=0.6)], density=1000.0)
print("mass", round(mass, 3), "kg =", round(1000 * pi * 0.1**2 * 0.6, 3), "kg")

# %% dem.shapes.Superellipsoid
import pctt
from dem.scene import Scene
from dem.shapes import Plane, Superellipsoid

scene = Scene(friction=0.5)
scene.add_body("floor", [Plane(normal=(0, 0, 1))])
scene.add_grains([[0, 0, 0.15]], Superellipsoid((0.2, 0.15, 0.1), exponents=(2, 3)), density=2500.0)
sim = pctt.Simulation(scene, dt=0.005, solver="apgd", tol=1e-6)
sim.run(until=0.5)
print("it lies on its short axis, at", round(sim.positions[0, 2], 3), "m")

# %% dem.mesh.Mesh
from math import pi

from dem.mesh import Mesh

cup = Mesh.revolved([(0, 0), (0.05, 0), (0.06, 0.1)], sides=24)  # a profile of radius and z, turned about z
cup.write("cup.stl")
again = Mesh.read("cup.stl")
print(len(cup.triangles), "triangles, from the file", len(again.triangles))

# %% dem.motion.Dynamic
import pctt
from dem.motion import Dynamic
from dem.scene import Scene
from dem.shapes import Box

scene = Scene(friction=0.5)
scene.add_spheres([9, 9, 9], radius=0.1, density=2500.0)  # a scene has at least one grain
scene.add_body("crate", [Box((0.2, 0.2, 0.2))], Dynamic(), density=500.0, position=(0, 0, 10))
sim = pctt.Simulation(scene, dt=0.01, delta=0.01)
sim.run(until=1.0)
print("falls at", round(sim.body("crate").velocity[2], 6), "m/s after 1 s")

# %% dem.motion.Fixed, dem.motion.Rotation, dem.motion.Oscillation, dem.motion.Glide
from math import pi

import pctt
from dem.motion import Fixed, Glide, Oscillation, Rotation
from dem.scene import Scene
from dem.shapes import Box

scene = Scene(friction=0.5)
scene.add_spheres([9, 9, 9], radius=0.1, density=2500.0)  # a scene has at least one grain
motions = {
    "stand": Fixed(),
    "paddle": Rotation((0, 0, pi)),
    "sieve": Oscillation((0, 0, 1), amplitude=0.1, period=1.0),
    "door": Glide((0, 0, -2.0), start=0.5),
}
for k, (name, motion) in enumerate(motions.items()):
    scene.add_body(name, [Box((0.1, 0.1, 0.1))], motion, position=(k, 0, 0))
sim = pctt.Simulation(scene, dt=0.01, delta=0.01)
sim.run(until=0.75)
for name in motions:
    body = sim.body(name)
    print(f"{name:6} z = {body.position[2]:5.2f} m, spin {body.velocity[5]:.2f} rad/s")

# %% dem.motion.Path
import pctt
from dem.motion import Path
from dem.scene import Scene
from dem.shapes import Box

scene = Scene(friction=0.5)
scene.add_spheres([9, 9, 9], radius=0.1, density=2500.0)  # a scene has at least one grain
way = Path(times=[0.0, 1.0, 2.0], positions=[(0, 0, 0), (1, 0, 0), (1, 0, 2)])
scene.add_body("crane", [Box((0.1, 0.1, 0.1))], way)
sim = pctt.Simulation(scene, dt=0.01, delta=0.01)
sim.run(until=1.5)
print("at 1.5 s:", sim.body("crane").position.round(6).tolist())

# %% dem.motion.Guided
import pctt
from dem.motion import Guided
from dem.scene import Scene
from dem.shapes import Box, Plane

scene = Scene(friction=0.5)
scene.add_body("floor", [Plane(normal=(0, 0, 1))])
scene.add_body("press", [Box((0.1, 0.1, 0.1))], Guided((0, 0, 1), force=-50.0), mass=1.0, position=(0, 0, 0.5))
scene.add_spheres([0, 0, 0.1], radius=0.1, density=2500.0)
sim = pctt.Simulation(scene, dt=0.005, solver="apgd", tol=1e-8)
sim.run(until=0.5)
weight = 9.81 * (1.0 + sim.local.mass.sum())
print("floor bears", round(-sim.body("floor").force[2], 3), "N = 50 N and the weights,", round(50 + weight, 3), "N")

# %% dem.motion.Hinged
import pctt
from dem.motion import Hinged
from dem.scene import Scene
from dem.shapes import Box

scene = Scene(friction=0.5)
scene.add_spheres([9, 9, 9], radius=0.1, density=2500.0)  # a scene has at least one grain
servo = Hinged((0, 0, 1), torque=5.0, speed=2.0)  # keeps 2 rad/s with at most 5 N m
scene.add_body("stirrer", [Box((0.3, 0.02, 0.1))], servo, mass=10.0, inertia=(1, 1, 1))
sim = pctt.Simulation(scene, dt=0.01, delta=0.01)
for time in (0.2, 1.0):
    sim.run(until=time)
    print(f"at {time} s: {sim.body('stirrer').velocity[5]:.3f} rad/s")

# %% dem.motion.Held
import pctt
from dem.motion import Held
from dem.scene import Scene
from dem.shapes import Plane, Sphere

scene = Scene(friction=0.5)
scene.add_body("floor", [Plane(normal=(0, 0, 1))])
scene.add_spheres([9, 9, 9], radius=0.1, density=2500.0)  # a scene has at least one grain
axle = Held((None, 0, None), (0, 3.0, 0))  # turns about y at 3 rad/s, free along x and z
scene.add_body("wheel", [Sphere(0.2)], axle, mass=5.0, position=(0, 0, 0.2))
sim = pctt.Simulation(scene, dt=0.005, solver="apgd", tol=1e-8)
sim.run(until=1.0)
print("rolls at", round(sim.body("wheel").velocity[0], 4), "m/s: 3 rad/s times 0.2 m")

# %% dem.parts.contact_law.ContactLaw
import pctt
from dem.scene import Scene

scene = Scene(friction=0.5)
scene.set_pair("rubber", "steel", friction=0.9)
scene.add_spheres([0, 0, 0], 0.1, 2500.0, material="steel")
scene.add_spheres([1, 0, 0], 0.1, 1100.0, material="rubber")
world = pctt.Simulation(scene, dt=0.01).world
print(world.materials)
print(world.pairs.friction)

# %% dem.parts.loads.Load
import pctt
from dem.scene import Scene

scene = Scene(friction=0.5, gravity=(0, 0, 0))
(ball,) = scene.add_spheres([0, 0, 0], radius=0.1, density=1000.0)
scene.add_load("push", on=[ball], force=(2.0, 0, 0), end=0.5)
sim = pctt.Simulation(scene, dt=0.01)
sim.run(until=1.0)
print("speed", sim.velocities[0, 0], "m/s; impulse over mass", 2.0 * 0.5 / sim.local.mass[0])

# %% dem.parts.springs.Spring
from math import pi, sqrt

import pctt
from dem.scene import Scene

scene = Scene(friction=0.5, gravity=(0, 0, 0))
(ball,) = scene.add_spheres([0.1, 0, 0], radius=0.05, density=1000.0)
scene.add_spring("spring", None, ball, anchor=(0, 0, 0), stiffness=20.0, length=0.0)
sim = pctt.Simulation(scene, dt=0.001)
period = 2 * pi * sqrt(sim.local.mass[0] / 20.0)
sim.run(until=period)
print(f"after a period of {period:.3f} s it is back at x = {sim.positions[0, 0]:.4f} m")
print("force of the spring", round(sim.spring_force("spring")[0], 2), "N")

# %% dem.parts.joints.Joint
import pctt
from dem.motion import Dynamic
from dem.scene import Scene
from dem.shapes import Box

scene = Scene(friction=0.5)
scene.add_spheres([9, 9, 9], radius=0.1, density=2500.0)  # a scene has at least one grain
scene.add_body("arm", [Box((0.5, 0.05, 0.05))], Dynamic(), density=500.0, position=(0.5, 0, 0))
scene.add_joint("shoulder", None, "arm", anchor=(0, 0, 0), axis=(0, 1, 0), speed=0.5, strength=100.0)
sim = pctt.Simulation(scene, dt=0.005, delta=0.01)
sim.run(until=1.0)
shoulder = sim.joint("shoulder")
print(f"angle {shoulder.angle:.3f} rad after 1 s at 0.5 rad/s, torque of the motor {shoulder.drive:.2f} N m")

# %% dem.parts.sources.Source, dem.parts.sources.Outlet, dem.parts.sources.Tally, dem.parts.sources.Passages
import pctt
from dem.measures import Block
from dem.scene import Scene

scene = Scene(friction=0.5, stiffness=1e5)
above, below = Block((-0.2, -0.2, 0), (0.2, 0.2, 0.2)), Block((-1, -1, -2), (1, 1, -1))
scene.add_source("feed", above, radius=0.02, density=2500.0, number_rate=50.0)
scene.add_outlet("drain", below)
sim = pctt.Simulation(scene, dt=0.005, solver="apgd")
sim.run(until=1.0)
print(sim.source("feed").count, "came,", sim.outlet("drain").count, "left,", len(sim.ids), "are there")
print("counted are", ", ".join(sim.world.passages.names))

# %% dem.parts.sources.Uniform, dem.parts.sources.Listed
from dem.parts.sources import Listed, Uniform

print("between", Uniform(0.01, 0.02).ends)
sizes = Listed([0.01, 0.03], shares=[0.9, 0.1])  # a tenth of the grains is large
print("of", sizes.values, "the shares", sizes.shares)

# %% dem.experiment.Experiment
from dataclasses import dataclass

import pctt
from dem.experiment import Experiment, option
from dem.scene import Scene
from dem.shapes import Plane


@dataclass(frozen=True)
class Drop(Experiment):
    """A sphere falls on a floor."""

    height: float = option(1.0, "of the fall", unit="m")

    def build(self) -> Scene:
        scene = Scene(friction=0.5)
        scene.add_body("floor", [Plane(normal=(0, 0, 1))])
        scene.add_spheres([0, 0, self.height + 0.1], radius=0.1, density=2500.0)
        return scene

    def record(self, step):
        return {"gap [m]": float(step.world.grains.position[0, 2] - 0.1)}


sim = pctt.Simulation(Drop(height=0.5), dt=0.01)
sim.run(until=0.2)
print("gap", round(sim.figures["gap [m]"], 4), "m after 0.2 s; it was 0.5 m")

# %% dem.experiment.SceneExperiment
from dem.experiment import SceneExperiment
from dem.scene import Scene

scene = Scene(friction=0.5)
print("a scene that is built already, as an experiment:", SceneExperiment(scene).build() is scene)

# %% dem.experiment.SceneFileError
from pathlib import Path

from dem.experiment import SceneFileError, from_file

Path("empty.py").write_text("x = 1\n")
try:
    from_file(Path("empty.py"))
except SceneFileError as error:
    print(error)

# %% pctt.scenes.*
from pctt.scenes import SCENES

for name, scene in SCENES.items():
    built = scene().build()
    print(f"{name:12} {len(built.grains()):5} grains; large bodies: {', '.join(b.name for b in built.large_bodies)}")

# %% dem.model.world.World, dem.contact_map.CompactRows
from mpi4py import MPI

from dem.start import new_world
from pctt.scenes import Mixer

world = new_world(Mixer(n=1).build(), MPI.COMM_SELF)
print(len(world.grains), "grains on this rank,", world.body_count, "bodies in all; time", world.time, "s")

# %% dem.parts.cell.Cell
import pctt
from dem.scene import Scene

cell = {"gravity": (0, 0, 0), "period": (1.0, 1.0, 1.0), "shear_rate": 2.0, "shear_gradient": "z"}
scene = Scene(friction=0.5, **cell)
scene.add_spheres([0.5, 0.5, 0.5], 0.1, 2500.0)
sim = pctt.Simulation(scene, dt=0.01)
sim.run(until=0.25)
cell = sim.world.cell
print("rate", cell.shear_rate, "1/s: the images above are", round(cell.shift, 3), "m further along x")

# %% dem.bodies.Bodies
import pctt
from dem.bodies import is_dynamic
from pctt.scenes import Mixer

table = pctt.Simulation(Mixer(n=1)).local  # one row for each grain of this rank
print(len(table), "rows,", int(is_dynamic(table).sum()), "of them moved by forces")
print("columns", ", ".join(table.columns()))

# %% dem.unconstrained.UnconstrainedMotion
from mpi4py import MPI

from dem.start import new_world
from dem.unconstrained import unconstrained
from pctt.scenes import Mixer

free = unconstrained(new_world(Mixer(n=1).build(), MPI.COMM_SELF), dt=0.01)
print("without contacts a grain falls at", round(free.grains[0, 2], 4), "m/s after", free.dt, "s")

# %% dem.contact.Contacts, dem.step.system.ContactSystem, dem.step.Step, dem.step.impulses.ImpulseMemory
import numpy as np
from mpi4py import MPI

from dem.contact import find_contacts
from dem.scene import Scene
from dem.shapes import Plane
from dem.start import new_world
from dem.step import Step, advance
from dem.step.impulses import ImpulseMemory
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained
from pctt import ccp

scene = Scene(friction=0.5, stiffness=np.inf)
scene.add_body("floor", [Plane(normal=(0, 0, 1))])
scene.add_spheres([[0, 0, 0.1], [0, 0, 0.3]], 0.1, 2500.0)
world, dt, memory = new_world(scene, MPI.COMM_SELF), 0.01, ImpulseMemory(MPI.COMM_SELF)
for _ in range(3):
    free = unconstrained(world, dt)
    contacts = find_contacts(world, 0.02, free)
    system = ContactSystem(world, contacts, free, recovery_speed=1.0)
    problem = ccp.ConeProblem(world.comm, system.r, system.mu, G=system.contact_map)
    result = ccp.solve(
        problem, memory.recall(contacts.key, system.frame)[0], "apgd", ccp.Limits(tol=1e-8), law=ccp.RELAXATION
    )
    memory.remember(contacts.key, result.impulse, system.frame)
    step = Step(world, contacts, system, result.impulse)
    print(len(contacts.gap), "contacts, the floor bears", round(-step.force_on("floor")[2], 3), "N")
    advance(world, free, contacts, system.velocity(result.impulse))

# %% dem.contact_map.ContactMap, dem.contact_map.Halo, dem.model.neighbourhood.Neighbourhood
import numpy as np
from mpi4py import MPI

from dem.contact import find_contacts
from dem.start import new_world
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained
from pctt.scenes import Belt

world = new_world(Belt(n=2).build(), MPI.COMM_SELF)
free = unconstrained(world, 0.001)
contacts = find_contacts(world, 0.01, free)
G = ContactSystem(world, contacts, free).contact_map
g, v = np.ones((len(contacts.gap), 3)), np.ones((world.owned, 6))
print("g'(G v) - (G'g)'v =", round(float((g * G.velocities(v)).sum() - (G.momenta(g) * v).sum()), 12))
print(len(contacts.near.bodies), "bodies near this rank,", contacts.near.ghosts, "of them ghosts")

# %% pctt.ccp.ConeProblem, pctt.ccp.Result, pctt.ccp.Status, pctt.ccp.Limits, pctt.ccp.Accuracy
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt import ccp

# one contact of a mass of 2 kg that slides at 3 m/s and falls at 1 m/s: the impulses that stop the fall
N = PETSc.Mat().createDense((3, 3), array=np.eye(3) / 2.0, comm=MPI.COMM_SELF)
problem = ccp.ConeProblem(MPI.COMM_SELF, r=np.array([[-1.0, 3.0, 0.0]]), mu=np.array([0.5]), N=N)
result = ccp.solve(problem, limits=ccp.Limits(tol=1e-10))
print(result.status, "after", result.iterations, "iterations:", result.impulse.round(6), "N s")
accuracy = ccp.measure(problem, result.impulse)
print("Coulomb residual", f"{accuracy.coulomb_residual:.0e}", "closing work", f"{accuracy.closing_work:.0e}")

# %% pctt.ccp.Operator
import numpy as np
from mpi4py import MPI

from pctt import ccp

# eight contacts in a row on an elastic ground: what one is pressed with moves all, the less the farther they are
distance = np.abs(np.subtract.outer(np.arange(8), np.arange(8)))
near = 1.0 / (1.0 + distance**2)
N = ccp.Operator(mult=lambda g: near @ g, blocks=np.tile(np.eye(3), (8, 1, 1)))
problem = ccp.ConeProblem(MPI.COMM_SELF, r=np.tile([-1.0, 0.3, 0.0], (8, 1)), mu=np.full(8, 0.3), N=N)
result = ccp.solve(problem)
print(result.status, "with pressures", result.impulse[:, 0].round(3))

# %% pctt.ccp.FrictionCones, pctt.ccp.RollingCones, dem.contact_map.TurningMap
from mpi4py import MPI

import pctt
from dem.scene import Scene
from dem.shapes import Plane

scene = Scene(friction=0.5, rolling=0.01)
scene.add_body("floor", [Plane(normal=(0, 0, 1))])
scene.add_spheres([0, 0, 0.1], 0.1, 2500.0, velocity=(1.0, 0, 0), angular_velocity=(0, 10.0, 0))
sim = pctt.Simulation(scene, dt=0.005, solver="apgd", tol=1e-6)
sim.run(until=0.5)
print("slower by", round((1.0 - sim.velocities[0, 0]) / 0.5, 4), "m/s^2; theory:", round(5 / 7 * 9.81 * 0.01 / 0.1, 4))

# %% pctt.ccp.Newton, pctt.ccp.Comparison
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt import ccp

rng, comm = np.random.default_rng(0), MPI.COMM_SELF
A = rng.standard_normal((60, 60))
N = PETSc.Mat().createDense((60, 60), array=A @ A.T, comm=comm)
problem = ccp.ConeProblem(comm, rng.standard_normal((20, 3)), np.full(20, 0.5), N=N)
compare = ccp.Comparison(comm, ["none", "jacobi"])
newton = ccp.newton_for(comm, "pdip", compare=compare)
result = ccp.solve(problem, type="pdip", newton=newton, law=ccp.RELAXATION)
print(result.status, "after", result.newton_its, "Newton systems of the form", newton.form)
for name, figures in compare.summary().items():
    print(name, "solved", figures["converged"], "of", figures["systems"], "systems")
newton.destroy()

# %% dem.contact_map.BlockRows
import numpy as np
from mpi4py import MPI

from dem.contact_map import BlockRows
from pctt import ccp

# a body of 2 kg on the ground: one contact, whose normal is the third axis of the world, and no lever arm
block = np.zeros((3, 6))
block[[0, 1, 2], [2, 0, 1]] = 1 / np.sqrt(2.0)  # rows normal, t1, t2 of D' M^-1/2
rows = BlockRows(indptr=np.array([0, 1]), indices=np.array([0]), blocks=block[None], columns=1)
problem = ccp.ConeProblem(MPI.COMM_SELF, r=np.array([[-0.1, 0.02, 0.0]]), mu=np.array([0.5]), G=rows)
print("impulse that stops it:", ccp.solve(problem, type="conic", law=ccp.RELAXATION).impulse.round(4), "N s")

# %% pctt.ccp.fclib.Info, pctt.ccp.fclib.Solution, pctt.ccp.fclib.Stored
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt import ccp
from pctt.ccp import fclib

N = PETSc.Mat().createDense((3, 3), array=np.eye(3), comm=MPI.COMM_SELF)
problem = ccp.ConeProblem(MPI.COMM_SELF, np.array([[-1.0, 0.2, 0.0]]), np.array([0.5]), N=N)
result = ccp.solve(problem, type="apgd", law=ccp.RELAXATION)
solution = fclib.Solution(r=result.impulse, u=problem.product(result.impulse) + problem.r)
fclib.write_local("one.hdf5", problem, fclib.Info("one contact"), solution=solution)
stored = fclib.load("one.hdf5", MPI.COMM_SELF)
print(stored.title, stored.form, stored.solution.round(4))

# %% pctt.ccp.fclib.FileFormatError
from pathlib import Path

from mpi4py import MPI

from pctt.ccp import fclib

Path("no.hdf5").write_text("no cone problem")
try:
    fclib.read("no.hdf5", MPI.COMM_SELF)
except fclib.FileFormatError as error:
    print(error)

# %% pctt.pc.BlockICC
import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc

n = 100  # diffusion through a square whose cells conduct better or worse by up to six orders of magnitude
k = 10.0 ** np.random.default_rng(0).uniform(-3, 3, (n, n)).ravel()
cell = np.arange(n * n).reshape(n, n)
i, j = (np.concatenate([a.ravel(), b.ravel()]) for a, b in ((cell[1:], cell[:, 1:]), (cell[:-1], cell[:, :-1])))
flow = sp.coo_matrix((2 / (1 / k[i] + 1 / k[j]), (i, j)), shape=(n * n, n * n))
flow = flow + flow.T
A = sp.csr_matrix(sp.diags(np.asarray(flow.sum(axis=1)).ravel() + k * (np.arange(n * n) < n)) - flow)
mat = PETSc.Mat().createAIJ(A.shape, csr=(A.indptr, A.indices, A.data))
x, b = mat.createVecs()
b.set(1.0)
for kind in ("jacobi", "icc", "python"):
    ksp = PETSc.KSP().create()
    ksp.setOperators(mat)
    ksp.setType("cg")
    ksp.setTolerances(rtol=1e-8, max_it=5000)
    ksp.pc.setType(kind)
    if kind == "python":
        ksp.pc.setPythonType("pctt.pc.BlockICC")
    ksp.solve(b, x)
    print(kind, ksp.getIterationNumber(), "iterations")
    if kind == "python":
        print(ksp.pc.getPythonContext().what())
    ksp.destroy()

# %% pctt.pc.TensorTrain
import numpy as np
from petsc4py import PETSc

from pctt.mat import from_differences


def covariance(s):  # differences of grid indices (2, p)
    return np.exp(-np.hypot(s[0] - 0.5 * s[1], s[1]) / 10)


A = from_differences(covariance, (60, 50))
A.shift(0.01)  # a nugget
x, b = A.createVecs()
b.set(1.0)
for kind in ("none", "python"):
    ksp = PETSc.KSP().create()
    ksp.setOperators(A)
    ksp.setType("cg")
    ksp.setTolerances(rtol=1e-8)
    ksp.pc.setType(kind)
    if kind == "python":
        ksp.pc.setPythonType("pctt.pc.TensorTrain")
    ksp.solve(b, x)
    print(kind, ksp.getIterationNumber(), "iterations")
    ksp.destroy()

# %% pctt.mat.TensorTrain
import numpy as np

from pctt.mat import from_entries, inverse

grid = (64, 64)


def entries(i, j):
    x, y = (np.array(np.unravel_index(k, grid)) / 64 for k in (i, j))
    return (i == j) + 50 / 64**2 * np.exp(-((x - y) ** 2).sum(axis=0) / 0.02)


A = from_entries(entries, grid, eps=1e-9)
context = A.getPythonContext()
print(A.getSize()[0], "rows in", context.bytes, "bytes, ranks up to", max(context.ranks))
print("a solve with its inverse leaves", f"{inverse(A).getPythonContext().error:.0e}")

# %% pctt.tt.Train, pctt.tt.Apply
import numpy as np

from pctt import tt

x = np.linspace(0, 1, 1024)
train = tt.decompose(np.sin(8 * x), eps=1e-10, modes=(4, 4, 4, 4, 4))
print("1024 numbers in", train.storage, "with ranks", train.ranks)
matrix = tt.random((4, 4), rank=2, columns=(4, 4), rng=np.random.default_rng(0))
v = np.ones(16)
print("a product is off by", f"{np.abs(tt.Apply(matrix)(v) - matrix.full() @ v).max():.0e}")

# %% pctt.tt.EntryMatrix, pctt.tt.GridDigits, pctt.tt.Cross, pctt.tt.Inverse
import numpy as np

from pctt import tt

digits = tt.GridDigits((32, 32))


def entries(i, j):
    x, y = (np.array(np.unravel_index(k, (32, 32))) / 32 for k in (i, j))
    return (i == j) + 0.05 * np.exp(-((x - y) ** 2).sum(axis=0) / 0.02)


matrix = tt.EntryMatrix(entries, digits)  # T of A = c (I + T)
cross = tt.compress_cross(matrix, max_rank=40, eps=1e-6)
inverse = tt.invert_near_identity(cross.train, max_rank=40, eps=1e-4)
print(f"cross: rank {max(cross.train.ranks)}, error {cross.error:.0e}, {cross.evaluations} entries of {32**4}")
print(f"inverse: rank {max(inverse.train.ranks)}, residual {inverse.residual:.0e}")

# %% pctt.tt.SparseHierarchy, pctt.tt.Compression
import numpy as np

from pctt import tt

n = 64  # the second difference on a line
rows = np.r_[np.arange(n), np.arange(n - 1), np.arange(1, n)]
columns = np.r_[np.arange(n), np.arange(1, n), np.arange(n - 1)]
matrix = tt.SparseHierarchy(rows, columns, modes=(4, 4, 4))
matrix.set_values(np.r_[np.full(n, 2.0), np.full(2 * n - 2, -1.0)])
compression = tt.compress(matrix, max_rank=5, eps=1e-10)
print("ranks", compression.train.ranks, "error", f"{compression.error:.0e}")

# %% pctt.options.OptionError
import pctt
from pctt.options import OptionError
from pctt.scenes import Mixer

try:
    pctt.Simulation(Mixer(n=1), solver="apgf")
except OptionError as error:
    print(error)

# %% pctt.options.Description
from pctt.options import describe
from pctt.run.settings import Settings

for described in describe(Settings, "ccp_")[:3]:
    print(described.name, described.default, "-", described.help)
