"""Mechanics of rigid grains with contact and friction, in non-smooth time stepping; no solver.

The loop of a simulation, on any number of ranks::

    world = new_world(scene, comm)
    while world.time < end:
        contacts = find_contacts(world, delta, dt)
        system = ContactSystem(world, contacts, dt, recovery_speed)
        impulse = solve(system)
        advance(world, system.velocity(impulse), dt)
        rebalance(world)

`dem.scene`, `dem.shapes` and `dem.motion` describe what there is, `dem.experiment` is what the program needs of it, and
`dem.scenes` has ready-made ones. `dem.record` and `dem.analysis` say what steps and runs show. All quantities are in SI
units.
"""
