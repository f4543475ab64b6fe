"""The options database is the user's: what the project enters for its own KSPs goes again."""

from __future__ import annotations

import contextlib

import pytest

from pctt.ksp_options import entered, solver_options, taken_over, to_enter, unmarked, unused
from pctt.options import OptionError, describe


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
    options, sources = to_enter("a_", {"ksp_type": "cg", "pc_type": "sor"}, ranks=2)
    assert options == {
        "a_ksp_type": "cg", "a_pc_type": "bjacobi", "a_sub_pc_type": "ilu", "a_sub_pc_factor_levels": "2"
    }  # fmt: skip
    assert sources == {"a_sub_pc_factor_levels": "a_pc_factor_levels"}
    assert to_enter("a_", {"ksp_type": "cg", "pc_type": "sor"}, ranks=1) == ({"a_ksp_type": "cg"}, {})
    assert to_enter("b_", {"pc_type": "lu"}, ranks=1)[0]["b_pc_factor_mat_solver_type"] == "mumps"


def test_a_compared_ksp_has_the_options_of_the_projects_own_but_for_its_defaults(database):
    database["ccp_ksp_rtol"], database["ccp_ksp_type"] = "1e-9", "cg"
    database["ksp_max_it"] = "1"  # of the program that uses the library
    options, sources = to_enter("ccp_compare_x_", {"ksp_type": "gmres"}, ranks=1)
    assert options == {"ccp_compare_x_ksp_type": "gmres", "ccp_compare_x_ksp_rtol": "1e-9"}
    assert sources == {"ccp_compare_x_ksp_rtol": "ccp_ksp_rtol"}
    assert to_enter("ccp_", {}, ranks=1) == ({}, {})


def test_an_option_counts_as_used_when_what_was_made_of_it_is(database):
    database["mine"], database["idle"], database["hidden"] = "1", "2", "3"
    with entered({"ccp_mine": "1", "ccp_idle": "2"}, {"ccp_mine": "mine", "ccp_idle": "idle"}, hidden=["hidden"]):
        assert not database.hasName("hidden")
        assert database.getInt("ccp_mine") == 1
    assert unused(["mine", "idle", "hidden"]) == ["idle", "hidden"]
    with unmarked() as found:
        assert database.getInt("idle") == 2
        assert database.getInt("mine") == 1
    assert found == {"idle"}
    assert unused(database.getAll()) == ["hidden", "idle"]


def test_options_without_prefix_are_those_of_the_projects_solvers(database):
    database["pc_type"], database["compare_every"], database["ccp_ksp_rtol"] = "ilu", "2", "0.1"
    given = database.getAll()
    assert solver_options(given) == {"pc_type": "pc_type", "ksp_rtol": "ccp_ksp_rtol"}
    with taken_over(given):
        assert database.getAll() == {**given, "ccp_pc_type": "ilu"}
    assert database.getAll() == given
    words = "^-pc_tt_eps 3: no; did you mean -pc_tt_eps[?] -ccp_ksp_rtol 2, -ccp_tol 1$"
    with pytest.raises(OptionError, match=words), taken_over(given):
        raise OptionError("-ccp_pc_tt_eps 3: no; did you mean -ccp_pc_tt_eps? -ccp_ksp_rtol 2, -ccp_tol 1")


def test_both_spellings_of_an_option_with_different_values_are_refused():
    assert solver_options({"pc_type": "ilu", "ccp_pc_type": "ilu"}).keys() == {"pc_type"}
    with pytest.raises(OptionError, match="^-pc_type ilu and -ccp_pc_type lu: the same option; allowed is one value$"):
        solver_options({"ccp_pc_type": "lu", "pc_type": "ilu"})


def test_no_option_of_the_program_looks_like_one_of_a_solver():
    """Else `solver_options` would take it for one."""
    from pctt.run.options import option_groups
    from pctt.run.settings import find_scene

    known = [line.name for group, start in option_groups(find_scene("mixer")) for line in describe(group, start)]
    assert "ccp_tol" in known
    assert solver_options(dict.fromkeys(known)) == {}

PROGRAM = """
import time
from mpi4py import MPI
from petsc4py import PETSc
from pctt.ccp.newton import krylov

comm = MPI.COMM_WORLD
PETSc.Options()["ccp_pc_type"] = "ilu"
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


with krylov.OnAllRanks(comm) as block:
    fails_alone()
assert block.error == 76
print("agreed", flush=True)


with krylov.OnAllRanks(comm, patience=0.5): # where the others wait for it
    fails_alone()
    x.norm()
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
