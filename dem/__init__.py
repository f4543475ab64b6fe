"""Mechanics of rigid grains with contact and friction, in non-smooth time stepping; no solver.

The loop of a simulation, on any number of ranks::

    world = new_world(scene, comm)
    while world.time < end:
        free = unconstrained(world, dt)
        contacts = find_contacts(world, delta, free)
        system = ContactSystem(world, contacts, free, recovery_speed)
        impulse = ...  # (nc, 3) of the contacts, by a solver of yours or by `pctt.ccp.solve`
        advance(world, free, contacts, system.velocity(impulse))
        rebalance(world)

Import from the modules: `dem.scene`, `dem.shapes`, `dem.motion` describe what there is; `dem.start`, `dem.world`,
`dem.bodies`, `dem.partition` and `dem.neighbourhood` hold it on the ranks; `dem.unconstrained`, `dem.contact`,
`dem.system` with `dem.contact_map`, `dem.step` and `dem.impulses` are the time step; `dem.experiment` is what the
program needs of a scene; `dem.record`, `dem.measures` and `dem.analysis` say what steps and runs show. All quantities
are in SI units.
"""

__all__ = [
    "analysis", "bodies", "checks", "contact", "contact_law", "contact_map", "experiment", "impulses", "joints",
    "loads", "measures", "mesh", "motion", "neighbourhood", "packing", "partition", "record", "scene", "shapes",
    "sources", "springs", "start", "step", "stiffness", "system", "time_step", "unconstrained", "world",
]  # fmt: skip
