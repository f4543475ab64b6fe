"""The Newton matrix in the velocities of the bodies: its products (`operator`), its entries (`entries`), and the part
that is factorised (`stiff_part`)."""

from pctt.body_matrix.entries import BodyMatrix
from pctt.body_matrix.operator import BodyOperator, inverse_blocks

__all__ = ["BodyMatrix", "BodyOperator", "inverse_blocks"]
