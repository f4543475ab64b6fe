"""The contact map G = D' M^-1/2, between the velocities of bodies and those of contacts, and products with it.

Two storages: frames and arms (`CompactRows`), or 3 x 6 blocks (`BlockRows`). Two ways to multiply (``-ccp_operator``):
`FreeMap` by compiled loops over the contacts, `AssembledMap` by a matrix of PETSc.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Union

from mpi4py import MPI

from pctt.blocks import BlockRows
from pctt.compiled import available
from pctt.contact_map.assembled import AssembledMap
from pctt.contact_map.ghosts import Ghosts
from pctt.contact_map.rows import CompactRows, block_rows

if TYPE_CHECKING:
    from pctt.contact_map.free import FreeMap

__all__ = ["OPERATORS", "AssembledMap", "CompactRows", "ContactMap", "Ghosts", "block_rows", "contact_map", "is_free"]

ContactMap = Union["FreeMap", AssembledMap]
OPERATORS = ("auto", "free", "assembled")


def is_free(operator: str) -> bool:
    """Whether products are made by compiled loops.

    ValueError where the operator is not of OPERATORS, or asks for compiled loops and numba is missing."""
    if operator not in OPERATORS:
        raise ValueError(f"-ccp_operator {operator}: allowed are {', '.join(OPERATORS)}")
    if operator == "assembled":
        return False
    if operator == "free" and not available():
        raise ValueError("-ccp_operator free: numba is not installed (python3-numba in Debian); allowed is assembled")
    return available()


def contact_map(comm: MPI.Comm, rows: BlockRows | CompactRows, operator: str = "auto") -> ContactMap:
    """The map of these rows; ``operator`` is of OPERATORS; collective."""
    if is_free(operator):
        from pctt.contact_map.free import FreeMap  # its compiled loops take half a second to come

        return FreeMap(comm, rows)
    return AssembledMap(comm, rows)
