"""First-order methods for the cone problem: nothing but products with N (or its rows) and projections.

There is one method per file; methods for comparison alone are in ``compared``. ``scaled.py`` is the problem that all
work on, ``progress.py`` ends them. All start from a guess, stop on the natural residual, and take the same path on any
number of ranks, but for rounding. None of PETSc's TAO solvers applies: its methods for bounds (TAOBNCG, TAOBQPIP,
TAOBLMVM, TAOGPCG, TAOTRON) project on boxes, and its methods for general constraints (TAOALMM, TAOPDIPM) take smooth
functions, whose gradient a cone's constraint does not have at the apex, where a large part of the contacts ends.
"""
