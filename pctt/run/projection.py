"""Positions without overlaps, after a step whose forces are those of the contacts that touch.

In the paper's step a contact that closes within the step acts from its start: it bears load while it is still open, on
the average for half a step. The work of that load on the way which is left is lost in impacts, in proportion to dt. So
forces on tools are too large in large steps, by 20 to 25 % where a tool goes a quarter of a radius in a step.

Here forces act in the contacts that touch at the start of the step alone (`dem.system.touching`). Bodies may then run
into each other, and their positions are moved apart by a second problem, without friction and without effect on
velocities: the least change w of the velocities with which positions go on, in the norm of the masses, that leaves no
contact closer than its gap and its spring allow. In the next step these contacts touch.

Source: Acary, "Projected event-capturing time-stepping schemes for nonsmooth mechanical systems with unilateral contact
and Coulomb's friction", Comput. Methods Appl. Mech. Eng. 256 (2013).
"""

from __future__ import annotations

import numpy as np

from dem.arrays import places
from dem.system import ContactSystem
from pctt import ccp
from pctt.ccp.cone import Array

LIMITS = ccp.Limits(tol=1e-3, closing_work=np.inf, fallback=False)  # what is left is projected in the next step


def projected(every: ContactSystem, touching: ContactSystem, found: ccp.Result) -> tuple[Array, int]:
    """The mass-scaled momenta (owned, 6) of w, and the iterations that they took; collective.

    every: the contacts that must not overlap; touching: those with forces, whose problem was solved by ``found``.
    """
    r = np.zeros_like(every.r)
    r[:, 0] = (every.contact_map.velocities(found.momentum) + every.r)[:, 0]
    held = found.impulse[: len(touching.key), 0]  # by springs; moments come behind
    r[places(every.key, touching.key), 0] += touching.compliance[:, 0] * held
    G, free = every.contact_map, np.zeros(len(r))
    problem = ccp.ConeProblem(G.comm, r, free, G=G, point=every.point, key=every.key, compliance=every.compliance[:, 0])
    result = ccp.solve(problem, None, "apgd", LIMITS)
    return result.momentum, result.iterations
