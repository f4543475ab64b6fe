"""First-order methods for the cone problem: nothing but products with N (or its rows) and projections.

All start from a guess, stop on the natural residual, and take the same path on any number of ranks, but for rounding.
`apgd` is the one to take; at a tolerance of 1e-4 the Barzilai-Borwein steps of `projected_steps` are as fast. The
others are methods of the literature, kept for comparison: none of them was the fastest on any measured problem
(docs/problems.md). None of PETSc's TAO solvers applies: its methods for bounds project on boxes, and its methods for
general constraints (TAOALMM, TAOPDIPM) take smooth functions, whose gradient a cone's constraint does not have at the
apex, where a large part of the contacts ends.
"""
