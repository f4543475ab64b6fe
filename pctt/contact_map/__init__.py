"""The contact map G = D' M^-1/2, from the velocities of bodies to the velocities of contacts, and products with it.

There are two storage formats: frames and arms (`CompactRows`), and 3 x 6 blocks (`BlockRows`). There are two ways to
multiply (``-ccp_operator``): `FreeMap` uses compiled loops over the contacts, `AssembledMap` uses a PETSc matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Union

from mpi4py import MPI

from pctt.blocks import BlockRows
from pctt.compiled import available
from pctt.contact_map.assembled import AssembledMap
from pctt.contact_map.ghosts import Ghosts
from pctt.contact_map.rows import CompactRows, block_rows, checked

if TYPE_CHECKING:
    from pctt.contact_map.free import FreeMap

__all__ = ["OPERATORS", "AssembledMap", "CompactRows", "ContactMap", "Ghosts", "block_rows", "contact_map", "is_free"]

ContactMap = Union["FreeMap", AssembledMap]
OPERATORS = ("auto", "free", "assembled")


def is_free(operator: str) -> bool:
    """Whether compiled loops compute the products.

    ValueError if the operator is not in OPERATORS, or if it needs compiled loops and numba is missing.
    """
    if operator not in OPERATORS:
        raise ValueError(f"-ccp_operator {operator}: allowed are {', '.join(OPERATORS)}")
    if operator == "assembled":
        return False
    if operator == "free" and not available():
        raise ValueError("-ccp_operator free: numba is not installed (python3-numba in Debian); allowed is assembled")
    return available()


def contact_map(comm: MPI.Comm, rows: BlockRows | CompactRows, operator: str = "auto") -> ContactMap:
    """The map with these rows; ``operator`` is one of OPERATORS. Collective; ValueError on all ranks for wrong rows."""
    rows = checked(comm, rows)
    if is_free(operator):
        from pctt.contact_map.free import FreeMap  # the import of its compiled loops takes half a second

        return FreeMap(comm, rows)
    return AssembledMap(comm, rows)
