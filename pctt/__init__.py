"""Many rigid bodies with hard contacts, cone complementarity problems with friction, tensor trains; on PETSc.

``pctt.Simulation`` makes the steps of a scene, `pctt.ccp` solves cone problems, `pctt.pc` has preconditioners.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pctt.simulation import Settings as Settings
    from pctt.simulation import Simulation as Simulation

__version__ = "0.3.0"
__all__ = ["Settings", "Simulation"]  # noqa: F822, made at first use


def __getattr__(name: str) -> Any:
    """`Simulation` and `Settings`, at first use: they start PETSc, and ``petsc4py.init`` may have to come before."""
    if name not in ("Simulation", "Settings"):
        raise AttributeError(f"module 'pctt' has no attribute {name!r}")
    from pctt import simulation

    return getattr(simulation, name)
