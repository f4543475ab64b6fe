"""Options of PETSc through the program: what they print, what they select, and which of them had no effect."""

from __future__ import annotations

import re

import pytest
from program import SETTLED, summary_of
from test_pages import stored_problem

TRAIN = ("-pc_type", "python", "-pc_python_type", "pctt.pc.TensorTrain")
NONE = "no Newton system was solved by a KSP"
NO_EFFECT = re.compile(r"^options without effect in this run(?:, as (.*))?: (.*)$", re.MULTILINE)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("ranks", "pc", "viewed"),
    [(1, ("-pc_type", "ilu"), "type: ilu"), (2, TRAIN, "tensor train: ")],
)
def test_petsc_shows_every_solve(ranks, pc, viewed, program, settled, tmp_path):
    """Of two steps, between which contacts come and go; in a process of its own, as PETSc says some at its end."""
    shown = ("-ksp_view", "ascii:view.txt", "-ksp_view_pre", "-ksp_monitor", "-ksp_converged_reason", "-log_view")
    done = program(*SETTLED, "-steps", 2, *pc, *shown, "-options_left", "-sub_mat_idle", 3, ranks=ranks, own=True)
    solves = re.findall(r"^ *Linear ccp_ solve (?:converged|did not).* iterations (\d+)", done.stdout, re.MULTILINE)
    assert sum(map(int, solves)) >= summary_of(tmp_path / "results")["ksp_its"] > len(solves) > 10
    assert len(re.findall(r"KSP Residual norm", done.stdout)) == sum(map(int, solves)) + len(solves)
    for text in (done.stdout, (tmp_path / "view.txt").read_text()):
        assert text.count("KSP Object: (ccp_) ") == len(solves)
        assert text.count(viewed) >= len(solves)
    assert re.search(r"^KSPSolve +\d+", done.stdout, re.MULTILINE)
    assert NO_EFFECT.findall(done.stdout) == [("", "-sub_mat_idle 3")]
    assert "There is one unused database option" in done.stdout
    assert "Option left: name:-sub_mat_idle value: 3" in done.stdout


def test_the_view_is_on_the_terminal_without_a_file(program, settled):
    done = program(*SETTLED, "-steps", 1, "-ksp_type", "cg", "-ccp_ksp_view")
    assert done.stdout.count("KSP Object: (ccp_) ") == done.stdout.count("type: cg") > 5


@pytest.mark.parametrize(
    "options",
    [("-ksp_type", "gmres"), ("-ccp_pc_type", "jacobi"), ("-sub_pc_type", "icc"), ("-mat_mumps_icntl_14", 30)],
)
def test_options_of_linear_solvers_alone_take_pdip(options, program, settled, tmp_path):
    done = program(*SETTLED, "-steps", 1, *options)
    assert "pdip to 0.0005, relaxation of Coulomb's law" in done.stdout
    assert summary_of(tmp_path / "results")["newton_its"] > 0
    idle = options if "sub" in options[0] or "mat" in options[0] else ()
    assert NO_EFFECT.findall(done.stdout) == [("", " ".join(map(str, idle)))] * bool(idle)


def test_options_that_are_not_of_newton_systems_leave_the_solver(program, settled):
    """As in a ~/.petscrc; `auto` solves these steps by apgd."""
    done = program(*SETTLED, "-steps", 1, "-vec_idle", 3, "-log_view_memory")
    assert "auto to 0.0005, Coulomb's law" in done.stdout
    assert NO_EFFECT.findall(done.stdout) == [(NONE, "-vec_idle 3")]


def test_a_stored_problem_is_solved_by_pdip_too(program, tmp_path):
    stored_problem(tmp_path / "problem.hdf5")
    words = ("-problem", "problem.hdf5", "-overwrite", "-pc_type", "jacobi", "-ksp_max_it", 50)
    assert not NO_EFFECT.search(program(*words).stdout)
    figures = summary_of(tmp_path / "results")
    assert (figures["solver"], figures["newton_systems"]) == ("pdip", "BiCGStab (right), jacobi")
    assert NO_EFFECT.findall(program(*words, "-ccp_type", "auto").stdout) == [(NONE, "-ksp_max_it 50, -pc_type jacobi")]


def test_both_spellings_are_one_option(program, settled, tmp_path):
    counts = []
    for prefix in ("-", "-ccp_"):
        done = program(*SETTLED, "-steps", 1, f"{prefix}ksp_type", "gmres", f"{prefix}pc_type", "jacobi", "-overwrite")
        assert "Newton systems: GMRES (right), jacobi\n" in done.stdout
        assert not NO_EFFECT.search(done.stdout)
        counts.append(summary_of(tmp_path / "results")["ksp_its"])
    assert counts[0] == counts[1] > 0


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("steps", [0, 1])
def test_where_no_newton_system_was_solved_all_their_options_are_named(steps, program, settled):
    """`auto` leaves these steps to apgd; without steps there is nothing to solve."""
    options = ("-pc_type", "ilu", "-ksp_monitor", "-compare_ilu_ksp_max_it", 3, "-compare", "ilu")
    done = program(*SETTLED, "-steps", steps, "-ccp_type", "auto", *options)
    assert "Newton systems of conic, for steps that apgd leaves to it: " in done.stdout
    (why, named), = NO_EFFECT.findall(done.stdout)
    assert why == NONE
    assert set(named.split(", ")) == {"-pc_type ilu", "-ksp_monitor", "-compare_ilu_ksp_max_it 3", "-compare ilu"}


@pytest.mark.parametrize("solver", ["conic", "auto"])
def test_a_run_says_where_the_law_leaves_a_ksp_nothing_to_do(solver, program, settled):
    words = (*SETTLED, "-steps", 1, "-ccp_type", solver, "-pc_type", "jacobi", "-overwrite")
    said = program(*words).stdout
    assert "WARNING: no Newton systems: for Coulomb's law conic has a linear solver of its own" in said
    assert NO_EFFECT.findall(said) == [(NONE, "-pc_type jacobi")]
    said = program(*words, "-law", "relaxation").stdout
    assert "WARNING: no Newton" not in said
    assert NO_EFFECT.findall(said) == [(NONE, "-pc_type jacobi")] * (solver == "auto")


def test_a_preconditioner_beside_compared_ones_has_no_effect(program, settled):
    """Unless it is one of them; the options of the Krylov method are those of all."""
    words = ("-steps", 1, "-compare", "jacobi", "-ksp_max_it", 200)
    done = program(*SETTLED, *words, "-pc_type", "sor", "-pc_sor_omega", 1.2)
    assert NO_EFFECT.findall(done.stdout) == [("", "-pc_sor_omega 1.2, -pc_type sor")]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("-pc_type ilu -ccp_pc_type lu", "-pc_type ilu and -ccp_pc_type lu: the same option; allowed is one value"),
        ("-ccp_pc_typ ilu", "-ccp_pc_typ: PETSc has no such option for these systems; did you mean -pc_type?"),
        ("-ccp_ksp_rtol 2", "-ccp_ksp_rtol 2: allowed is a number >= 0 and below 1"),
        ("-ccp_type apgd -ccp_pc_type ilu", "-ccp_pc_type ilu: -ccp_type apgd solves no Newton systems"),
        ("-ccp_compare_ilu_pc_factor_levels 1", "-ccp_compare_ilu_pc_factor_levels 1: its preconditioner is not compa"),
        ("-pc_type python -pc_python_type pctt.pc.TensorTrain -pc_tt_eps x", "-pc_tt_eps x: allowed is a"),
        ("-pc_type python -pc_python_type pctt.pc.TensorTrain -pc_tt_esp 1", "-pc_tt_esp: no such option; did you "),
        ("-ccp_pc_type python -ccp_pc_python_type pctt.pc.TensorTrain -ccp_pc_tt_eps x", "-ccp_pc_tt_eps x: allowed"),
        ("-ccp_unknown 3", "-ccp_unknown: no such option"),
    ],
)
def test_errors_name_an_option_as_it_is_spelt(options, words, program):
    assert f"pctt.run: {words}" in program(*options.split(), status=2).stderr
