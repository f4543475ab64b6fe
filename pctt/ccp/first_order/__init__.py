"""First-order methods for the cone problem: nothing but products with N (or its rows) and projections.

One method per file, those for comparison alone in ``compared``; ``scaled.py`` is the problem that they work on,
``progress.py`` how they end. All stop on the natural residual, start from a guess, and take the same path on any number
of ranks but for rounding. None of
PETSc's TAO solvers applies: its methods for bounds (TAOBNCG, TAOBQPIP, TAOBLMVM, TAOGPCG, TAOTRON) project on
boxes, and its methods for general constraints (TAOALMM, TAOPDIPM) take smooth functions, whose gradient a cone's
constraint does not have at the apex, where a large part of the contacts ends.
"""
