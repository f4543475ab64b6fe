"""Cone problems without a solution: impulses that grow without limit while the objective falls.

They come from bodies that are pushed into each other and cannot escape: a grain squeezed by closing walls, or a wedge
held by friction between them. The natural residual does not show it: it falls like 1 / ||g||.
"""

from __future__ import annotations

import numpy as np

from pctt.ccp.cone import Array, dot
from pctt.ccp.problem import ConeProblem

AMPLIFICATION = 1e3  # change of velocity per speed of the contacts that no step is believed to need
ELSEWHERE = 1e-3  # how much speeds of contacts count that have no part in it
ROUNDING = 1e-15  # of d'Nd, in units of mean diag N


def why_unbounded(problem: ConeProblem, g: Array) -> str:
    """The reason, in words, if the direction d = g / ||g|| of impulses g (nc, 3) in the cones shows that the problem is
    unbounded; else "". One product with N.

    A solution has velocities y = G v + r in the dual cones, so that d.y >= 0 and ||v|| >= -r.d / ||G'd||. In an
    unbounded problem impulses grow along a d with G'd = 0 and r.d < 0, and this bound is infinite. The problem counts
    as unbounded if the bound is more than AMPLIFICATION times ||r|| / sqrt(mean diag N), the size that the data
    suggest; a contact counts in ||r|| by its share in d. Self-stress, G'd = 0 with r.d >= 0, does not count, however
    large. With compliance no problem is unbounded, as d'Nd includes it.
    """
    r = problem.r.copy()
    r[problem.mu == 0, 1:] = 0.0  # sliding that no impulse answers
    sizes, speeds = np.sqrt(dot(g, g)), dot(r, r)
    weight = np.maximum(sizes / max(problem.max(sizes.max(initial=0.0)), 1e-300), ELSEWHERE**2)
    parts = (np.vdot(r, g), weight @ speeds, np.vdot(problem.product(g), g), sizes @ sizes)
    along, closing, bent, length = problem.sum(np.array(parts))
    bent = max(bent / problem.mean_diagonal, ROUNDING * length)
    if not -along > AMPLIFICATION * np.sqrt(closing * bent):
        return ""
    size = np.sqrt(length)
    return f"unbounded: impulses grow without limit (norm {size:.1e} N s, {-along / size:.1e} J for each N s more)"
