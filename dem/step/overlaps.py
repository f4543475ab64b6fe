"""How far bodies overlap, over the half thickness of the thinner grain, and what leaves them so."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dem.arrays import Floats, Ints
from dem.bodies import COMPOUND, half_of
from dem.compiled import loop
from dem.exchange import reduced

if TYPE_CHECKING:
    from dem.step import Step


def overlaps(step: Step, large: Floats) -> tuple[float, float]:
    """The greatest overlap at the start of a step, and the greatest that the springs of contacts leave at its end under
    the forces of the step, as parts of half thicknesses; of two large bodies those of the thinner, with the half
    thicknesses `large` (large bodies,) [m]; collective."""
    contacts, system, near = step.contacts, step.system, step.contacts.near
    laws, pairs = (system.stiffness, system.compliance[:, 0]), (contacts.a, contacts.b)
    given = contacts.gap, contacts.linear_gap, step.in_cone, laws, system.dt
    found = deepest(*given, pairs, (near.bodies.shape, near.bodies.size), large, near.grains + near.ghosts)
    return tuple(reduced(step.world.comm, (), found)[1])  # type: ignore[return-value]


@loop
def deepest(
    gap: Floats, linear: Floats, impulse: Floats, laws: tuple[Floats, Floats], dt: float, pairs: tuple[Ints, Ints],
    grains: tuple[Ints, Floats], large: Floats, first: int,
) -> tuple[float, float]:  # fmt: skip
    """`overlaps` of contacts (nc,) of the bodies in the rows a, b, of which those from `first` on are large ones with
    the half thicknesses `large`."""
    (stiffness, compliance), (a, b), (shape, size) = laws, pairs, grains
    start, held = 0.0, 0.0
    for c in range(len(gap)):
        # of an overlap d the part d c dt / (k dt^2 + c dt) is left, and of the impulse g dt C g (`dem.start.stiffness`)
        left = dt * compliance[c] * impulse[c, 0]
        if linear[c] < 0.0 and compliance[c] > 0.0:
            left -= linear[c] * (1.0 - stiffness[c] * dt**2 * compliance[c])
        if gap[c] >= 0.0 and left <= 0.0:
            continue
        half = np.inf
        for n in (a[c], b[c]):
            if shape[n] != COMPOUND:
                half = min(half, half_of(shape[n], size[n]))
        if half == np.inf:
            half = min(large[a[c] - first], large[b[c] - first])
        start, held = max(start, -gap[c] / half), max(held, left / half)
    return start, held

