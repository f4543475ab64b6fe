"""Builds of PETSc that will not do are named at once; errors of contexts keep their words, ends of programs end."""

from __future__ import annotations

import numpy as np
import pytest
from petsc4py import PETSc

from pctt.memory import limits
from pctt.petsc import is_used, options_database, own_errors, remember, require_real_double


@pytest.fixture
def database():
    """PETSc's database with options whose values have blanks, some of them asked for."""
    given = {"my_path": "two  words -my_flag", "my_text": "-3 x\t-my_other", "my_long": 3000 * "x" + " y"}
    given |= {"my_number": "-0.5", "my_empty": "", "my_last": "z -my_number 4"}
    options = PETSc.Options()
    for name, value in given.items():
        options.setValue(name, value)
    for name in ("my_text", "my_number", "my_long"):
        options.hasName(name)
    yield given
    for name in given:
        options.delValue(name)


def test_values_of_options_with_blanks_are_whole(database):
    found = options_database()
    assert {name: value for name, value in found.items() if name.startswith("my_")} == database
    assert options_database("my_") == {name[3:]: value for name, value in database.items()}
    assert {name for name in database if is_used(name)} == {"my_text", "my_number", "my_long"}


@pytest.mark.parametrize("scalar", [np.complex128, np.float32])
def test_other_scalars_are_named(scalar):
    with pytest.raises(ImportError, match=f"are {np.dtype(scalar).name}; allowed is a build with real scalars"):
        require_real_double(scalar)


def test_an_error_that_petsc_forgets_is_remembered():
    def forgets() -> None:
        remember(KeyError("the user's own"))
        raise PETSc.Error(101)

    with pytest.raises(KeyError, match="the user's own"), own_errors():
        forgets()


def test_an_error_of_petsc_itself_stays():
    remember(KeyError("of another time"))
    with pytest.raises(PETSc.Error), own_errors():
        raise PETSc.Error(77)


def test_the_limits_of_nested_control_groups_hold(tmp_path):
    for folder, most, used in (("", "max", "7"), ("slurm", "1000", "100"), ("slurm/job", "max", "50")):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "memory.max").write_text(most + "\n")
        (tmp_path / folder / "memory.current").write_text(used + "\n")
    assert limits(tmp_path, "slurm/job") == [900.0]
    assert limits(tmp_path, "") == []


PROGRAM = """
from petsc4py import PETSc
mat = PETSc.Mat().createAIJ(((2, None), (2, None)), nnz=1)
for row in range(*mat.getOwnershipRange()):
    mat[row, row] = 2.0
mat.assemble()
ksp = PETSc.KSP().create()
ksp.setOperators(mat)
ksp.pc.setType("python")
ksp.pc.setPythonType("pctt.pc.TensorTrain")
ksp.setUp()
if ksp.comm.rank == 1:
    ksp.destroy()
    mat.destroy()
print("the end")
"""


@pytest.mark.mpi
def test_a_program_ends_where_one_rank_has_no_object_left(mpirun):
    assert mpirun(PROGRAM, 2, seconds=30).count("the end") == 2
