"""Cone problems without a solution: impulses that grow without limit while the objective falls.

They come from bodies that are pushed into each other and cannot escape: a grain squeezed by closing walls, or a wedge
held by friction between them. The natural residual does not show it: it falls like 1 / ||g||.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from dem.compiled import loop
from dem.contact_map import find_halo
from dem.exchange import broadcast
from pctt.arrays import TINY, Array, tangential
from pctt.ccp.delassus import ColumnMap, sums_of

if TYPE_CHECKING:
    from pctt.ccp.problem import ConeProblem

ROUNDED = 1e-4  # of the greatest eigenvalue of N: below it a negative one is of rounded digits, -1e-5 of five


def why_unbounded(problem: ConeProblem, g: Array, y: Array | None = None) -> str:
    """The reason, in words, if the direction d = g / ||g|| of impulses g (nc, 3) in the cones shows that the problem is
    unbounded; else "". At most one product with N, none if the caller has their velocities y = N g + r.

    A solution has velocities y = G v + r in the dual cones, so that d.y >= 0 and ||v|| >= -r.d / ||G'd||. In an
    unbounded problem impulses grow along a d with G'd = 0 and r.d < 0, and this bound is infinite. The problem counts
    as unbounded if the bound is more than a thousand times ||r|| / sqrt(d' diag(N) d), the size that the data
    suggest; a contact counts in ||r|| by its share in d, and in diag(N) by the mean of its block, as what no impulse
    moves along the normal may move along the tangents. Self-stress, G'd = 0 with r.d >= 0, does not count, however
    large. If all contacts yield no problem is unbounded. If d'Nd < 0 every problem is.

    A heavy body, too, has a small part in G'd: a press on a light grain. So where G is known, the impulses of d must
    cancel on every body in units of its own mass, see `_left_over`. What joints bear cancels too. And where d.N = 0 all
    velocities are at least -r.d away from the dual cones; so those of a solution, or nearly one, are no sign.
    """
    if problem.all_yield:
        return ""
    largest = problem.max(_largest(g))
    parts = _parts(
        g, problem.r, problem.cones.first_tangents, problem.compliance, problem.diagonal, max(largest, 1e-300)
    )
    along, closing, yielding, length, by_diagonal = problem.sum(np.array(parts)).tolist()
    size, speed = math.sqrt(length), math.sqrt(closing)
    bound = (along / (1e3 * size * speed)) ** 2 if along < 0 < size * speed else 0.0
    if not bound > max(yielding / by_diagonal if by_diagonal > 0 else 0.0, 1e-15):  # a part of d'Nd, and its rounding
        return ""
    y = problem.product(g) + problem.r if y is None else y
    if problem.norm(problem.cones.project(-y, np.empty_like(y))) < -0.5 * along / size:
        return ""
    energy = problem.dot(y - problem.r, g) if by_diagonal > 0 else 0.0
    if by_diagonal > 0 and not bound > energy / by_diagonal:
        return ""
    if problem.contact_map is not None and not bound > _left_over(problem, g / size):
        return ""
    if energy < -1e-12 * by_diagonal:
        return f"unbounded: N is indefinite, d'Nd = {energy / length:.1e} for a direction d of impulses"
    return f"unbounded: impulses grow without limit (norm {size:.1e} N s, {-along / size:.1e} J for each N s more)"


def why_indefinite(problem: ConeProblem) -> str:
    """The reason, in words, if N has a direction of negative curvature beyond rounded digits, so that what a method
    finds need be no minimum; else "". The first time it takes some products with N. Collective."""
    lowest = broadcast(problem.comm, problem.lowest_curvature)
    if lowest >= -ROUNDED:
        return ""
    return f"N is indefinite: d'Nd / d'd is {lowest:.1g} of the greatest for some impulses d"


def why_unanswered(problem: ConeProblem, coulomb: bool) -> str:
    """The reason, in words, if contacts that no impulse moves close, so that the problem is unbounded, or none obeys
    Coulomb's law; else "". For these contacts the test N d = 0, r.d < 0 with d in the cones is exact. Collective."""
    if not problem.unanswered or problem.cones.parts > 1:
        return ""
    slip = tangential(problem.r)
    falls = problem.r[:, 0] - (0.0 if coulomb else problem.mu * slip)
    rays = ~problem.diagonal.any(axis=1) & (falls < -1e-12 * (np.abs(problem.r[:, 0]) + problem.mu * slip))
    d = np.zeros_like(problem.r)
    d[rays, 0] = 1.0
    if not coulomb:
        d[rays, 1:] = -(problem.mu / np.maximum(slip, TINY))[rays, None] * problem.r[rays, 1:]
    count, close = problem.sum(int(rays.sum())), "close" if coulomb else "close or slide"
    if count and problem.norm(problem.product(d)) <= 1e-14 * problem.mean_diagonal * problem.norm(d):
        return f"unbounded: no impulse moves {count} contacts, which {close}"
    return ""


def _left_over(problem: ConeProblem, d: Array) -> float:
    """How much impulses d (nc, 3) leave on the bodies: the sum of |G_b' d|^2 / |G_b|^2 over the bodies b, with G_b the
    columns of a body, of which the mass drops out; between 0 and 2 for ||d|| = 1. Of a matrix a column is a body.
    Collective."""
    assert problem.contact_map is not None
    known = problem.contact_map
    G = known.body_rows
    halo, body = find_halo(problem.comm, G.columns, G.indices)
    each = sums_of(body, (G.blocks**2).sum(axis=1), halo.rows)
    halo.add(each)
    size, momentum = each[: G.columns], np.square(problem.momentum(d).reshape(-1, 6)[: G.columns])
    if not isinstance(known, ColumnMap):
        size, momentum = size.sum(axis=1), momentum.sum(axis=1)
    return float(problem.sum(np.divide(momentum, size, out=np.zeros(size.shape), where=size > 0).sum()))


@loop
def _largest(g):
    """The largest squared size of the rows."""
    largest = 0.0
    for c in range(len(g)):
        square = g[c, 0] * g[c, 0] + g[c, 1] * g[c, 1] + g[c, 2] * g[c, 2]
        largest = square if not square <= largest else largest
    return largest


@loop
def _parts(g, r, mu, compliance, diagonal, largest):
    """The sums of `why_unbounded` over the rows of this rank: r'g; ||r||^2 of what impulses answer, by the shares of
    the rows in g; g'Cg; g'g; and g'g by the means of the diagonal."""
    along, closing, yielding, length, by_diagonal = 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(len(g)):
        square = g[c, 0] * g[c, 0] + g[c, 1] * g[c, 1] + g[c, 2] * g[c, 2]
        tangential = r[c, 1] * g[c, 1] + r[c, 2] * g[c, 2], r[c, 1] * r[c, 1] + r[c, 2] * r[c, 2]
        share = max(np.sqrt(square / largest), 1e-6)
        along += r[c, 0] * g[c, 0] + (tangential[0] if mu[c] > 0 else 0.0)
        closing += share * (r[c, 0] * r[c, 0] + (tangential[1] if mu[c] > 0 else 0.0))
        length += square
        mean = 0.0
        for k in range(3):
            yielding += compliance[c, k] * g[c, k] * g[c, k]
            mean += diagonal[c, k] / 3.0
        by_diagonal += mean * square
    return along, closing, yielding, length, by_diagonal
