"""Names of the array types of this package."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Union

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

#: Anything that a user may pass where numbers are expected.
ArrayLike = Union[float, Sequence[float], Sequence[Sequence[float]], Floats]

#: The lower and the upper corner of a box [m].
Corners = tuple[tuple[float, float, float], tuple[float, float, float]]
