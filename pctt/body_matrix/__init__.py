"""The Newton matrix in the bodies' velocities, as products (`operator`), as entries, and what of it is factorised."""

from pctt.body_matrix.entries import BodyMatrix
from pctt.body_matrix.operator import BodyOperator

__all__ = ["BodyMatrix", "BodyOperator"]
