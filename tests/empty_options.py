"""A PETSc options database that is empty for every test of the folders whose conftest imports it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from petsc4py import PETSc


@pytest.fixture(autouse=True)
def database() -> Iterator[PETSc.Options]:
    """The options database, emptied before and after."""
    options = PETSc.Options()
    for name in options.getAll():
        options.delValue(name)
    yield options
    for name in options.getAll():
        options.delValue(name)
