"""Cone problems without a solution: impulses that grow without limit while the objective falls.

They come from bodies that are pushed into each other and cannot escape: a grain squeezed by closing walls, or a wedge
held by friction between them. The natural residual does not show it: it falls like 1 / ||g||.
"""

from __future__ import annotations

import numpy as np

from dem.contact_map import find_halo
from dem.contact_map.cell import CellMap
from dem.contact_map.jointed import JointedMap
from pctt.ccp.cone import Array, dot
from pctt.ccp.problem import ConeProblem


def why_unbounded(problem: ConeProblem, g: Array) -> str:
    """The reason, in words, if the direction d = g / ||g|| of impulses g (nc, 3) in the cones shows that the problem is
    unbounded; else "". At most one product with N.

    A solution has velocities y = G v + r in the dual cones, so that d.y >= 0 and ||v|| >= -r.d / ||G'd||. In an
    unbounded problem impulses grow along a d with G'd = 0 and r.d < 0, and this bound is infinite. The problem counts
    as unbounded if the bound is more than a thousand times ||r|| / sqrt(d' diag(N) d), the size that the data
    suggest; a contact counts in ||r|| by its share in d, and in diag(N) by the mean of its block, as what no impulse
    moves along the normal may move along the tangents. Self-stress, G'd = 0 with r.d >= 0, does not count, however
    large. If all contacts yield no problem is unbounded.

    A heavy body, too, has a small part in G'd: a press on a light grain. So where G is known, the impulses of d must
    cancel on every body in units of its own mass, see `_left_over`. What joints bear cancels too.
    """
    if problem.all_yield:
        return ""
    r = problem.r.copy()
    r[problem.mu == 0, 1:] = 0.0  # sliding that no impulse answers
    sizes, speeds = np.sqrt(dot(g, g)), dot(r, r)
    share = np.maximum(sizes / max(problem.max(sizes.max(initial=0.0)), 1e-300), 1e-6)
    alone = problem.diagonal.sum(axis=1) @ dot(g, g) / 3.0
    parts = (np.vdot(r, g), share @ speeds, np.vdot(problem.compliance, g**2), sizes @ sizes, alone)
    along, closing, yielding, length, alone = problem.sum(np.array(parts))
    size, speed = np.sqrt(length), np.sqrt(closing)
    bound = (along / (1e3 * size * speed)) ** 2 if along < 0 < size * speed else 0.0
    if not bound > max(yielding / alone if alone > 0 else 0.0, 1e-15):  # a part of d'Nd, and its rounding
        return ""
    if alone > 0 and not bound > problem.dot(problem.product(g), g) / alone:
        return ""
    if problem.contact_map is not None and not bound > _left_over(problem, g / size):
        return ""
    return f"unbounded: impulses grow without limit (norm {size:.1e} N s, {-along / size:.1e} J for each N s more)"


def _left_over(problem: ConeProblem, d: Array) -> float:
    """How much impulses d (nc, 3) leave on the bodies: the sum of |G_b' d|^2 / |G_b|^2 over the bodies b, with G_b the
    columns of a body, of which the mass drops out; between 0 and 2 for ||d|| = 1. Collective."""
    assert problem.contact_map is not None
    known = problem.contact_map
    G = (known.free if isinstance(known, (CellMap, JointedMap)) else known).block_rows
    halo, body = find_halo(problem.comm, G.columns, G.indices)
    each = np.bincount(body, (G.blocks**2).sum(axis=(1, 2)), halo.rows)
    halo.add(each)
    size = each[: G.columns]
    momentum = np.square(problem.momentum(d).reshape(-1, 6)[: G.columns]).sum(axis=1)
    return float(problem.sum(np.divide(momentum, size, out=np.zeros(len(size)), where=size > 0).sum()))
