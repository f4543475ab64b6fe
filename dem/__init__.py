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

The packages, each of which imports those before it alone: `dem.geometry` and `dem.contact_map` know no bodies,
`dem.shapes`, `dem.parts` and `dem.scene` describe what there is, `dem.measures` asks samples, `dem.model` holds it on
the ranks, `dem.unconstrained` is the motion without contacts, `dem.contact` finds contacts, `dem.start` begins a run,
`dem.step` makes a step, and `dem.record` says what it shows. All quantities are in SI units.
"""

__all__ = [
    "bodies", "checks", "contact", "contact_map", "experiment", "measures", "mesh", "model", "motion", "packing",
    "parts", "record", "scene", "shapes", "start", "step", "unconstrained",
]  # fmt: skip
