"""Cone problems in FCLIB files (HDF5), the library of friction contact problems of Acary et al. (2014).

A local problem holds W and q of u = W r + q; a global one M, H, f, w of M v = H r + f, u = H'v + w. Either
way the cone problem has N = W = H' M^-1 H and r = q = w + H' M^-1 f. Bilateral constraints (G, b of a global
problem, V, R, s of a local one) are not part of a cone problem and are refused.

FCLIB's own problem statement adds mu |u_t| to the normal velocity (Coulomb's law); the cone problem is the
convex one without that term. The data of the two are the same, the solutions are not where contacts slide.
"""

from pctt.ccp.fclib.reader import load, read
from pctt.ccp.fclib.stored import FileFormatError, Stored
from pctt.ccp.fclib.writer import Info, Solution, write_global, write_local

__all__ = ["FileFormatError", "Info", "Solution", "Stored", "load", "read", "write_global", "write_local"]
