"""Cone complementarity problems with friction on PETSc: interior points, preconditioners, tensor trains."""

__version__ = "0.2.0"
