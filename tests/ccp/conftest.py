"""Every test starts from an empty PETSc options database: solvers enter their defaults there."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from petsc4py import PETSc


@pytest.fixture(autouse=True)
def database() -> Iterator[PETSc.Options]:
    """The options database, empty."""
    options = PETSc.Options()
    before = options.getAll()
    for name in before:
        options.delValue(name)
    yield options
    for name in options.getAll():
        options.delValue(name)
    for name, value in before.items():
        options[name] = value
