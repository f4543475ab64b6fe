"""Builds of PETSc that will not do are named at once."""

from __future__ import annotations

import numpy as np
import pytest

from pctt.petsc import require_real_double


def test_real_double_precision_will_do():
    assert require_real_double() is None


@pytest.mark.parametrize("scalar", [np.complex128, np.float32])
def test_other_scalars_are_named(scalar):
    with pytest.raises(ImportError, match=f"are {np.dtype(scalar).name}; allowed is a build with real scalars"):
        require_real_double(scalar)
