"""The program ``python -m pctt.run``: options -> scene -> stepper -> results.

The only place that sees both the mechanics (``dem``) and the solvers (``pctt``).
"""
