"""The options database is the user's: what the project enters for its own KSPs goes again."""

from __future__ import annotations

import contextlib

import pytest

from pctt.ksp_options import entered, to_enter


def test_options_stand_within_the_block_only(database):
    database["mine"] = "1"
    database["flag"] = None
    before = database.getAll()
    with entered({"mine": "2", "other": "3", "flag": "4"}):
        assert database.getAll() == {"mine": "2", "other": "3", "flag": "4"}
    assert database.getAll() == before
    with contextlib.suppress(KeyError), entered({"mine": "2"}):
        raise KeyError
    assert database.getAll() == before


def test_ilu_on_several_ranks_is_block_jacobi_with_ilu(database):
    database["a_pc_type"] = "ilu"
    database["a_pc_factor_levels"] = "2"
    options = to_enter("a_", {"ksp_type": "cg", "pc_type": "sor"}, ranks=2)
    assert options == {
        "a_ksp_type": "cg", "a_pc_type": "bjacobi", "a_sub_pc_type": "ilu", "a_sub_pc_factor_levels": "2"
    }  # fmt: skip
    assert to_enter("a_", {"ksp_type": "cg", "pc_type": "sor"}, ranks=1) == {"a_ksp_type": "cg"}
    assert to_enter("b_", {"pc_type": "lu"}, ranks=1)["b_pc_factor_mat_solver_type"] == "mumps"


PROGRAM = """
import time
from mpi4py import MPI
from petsc4py import PETSc
from pctt.ccp.newton import krylov

comm = MPI.COMM_WORLD
PETSc.Options()["pc_type"] = "ilu"
before = PETSc.Options().getAll()
solver = krylov.Krylov(comm)
A = PETSc.Mat().createAIJ((40, 40), nnz=1, comm=comm)
for i in range(*A.getOwnershipRange()):
    A[i, i] = 2.0
A.assemble()
x, b = A.createVecs()
b.set(1.0)
assert solver.solve(A, b, x).converged
assert solver.ksp.pc.getType() == "bjacobi"
assert PETSc.Options().getAll() == before, PETSc.Options().getAll()
solver.destroy()


def fails_alone(): # where the others go on to the end, however long they take
    if comm.rank == 1:
        raise PETSc.Error(76)
    time.sleep(0.5)


assert krylov.on_all_ranks(comm, fails_alone) == 76
print("agreed", flush=True)


def fails_amidst(): # where the others wait for it
    fails_alone()
    x.norm()


krylov.on_all_ranks(comm, fails_amidst, patience=0.5)
print("not to be reached", flush=True)
"""


@pytest.mark.mpi
def test_the_users_options_and_an_error_on_one_rank(mpirun):
    with pytest.raises(AssertionError) as failure:
        mpirun(PROGRAM, 2)
    words = str(failure.value)
    assert words.count("agreed") == 2
    assert "rank 1 failed alone: error code 76" in words
    assert "not to be reached" not in words
