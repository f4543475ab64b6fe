"""Every bad input: status 2, one line that names it, and nothing changed that was there before."""

from __future__ import annotations

import re

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from program import DROP, SETTLED, SMALL, contents, database, one_line, steps_of
from sealed import edited

from pctt.options import OptionError
from pctt.run.options import read_options

# options, and what the line must name beside the first of them: value and what is allowed
BAD_OPTIONS = {
    "-stepss 3": ["did you mean -steps?"],
    "-scene_nn 3": ["did you mean -scene_n?"],
    "-ccp_typ apgd": ["did you mean -ccp_type?"],
    "-ccp_pdip_bounadry 1": ["did you mean -ccp_pdip_boundary?"],
    "-nonsense": ["no such option"],
    "-steps abc": ["abc", "whole number"],
    "-steps -1": ["-1", ">= 0"],
    "-steps": ["whole number"],
    "-dt nan": ["nan", "positive"],
    "-dt 1e300": ["1e300", "up to 1e+150"],
    "-scene_angular_velocity 1e300": ["1e300", "up to 1e+150"],
    "-recovery_speed nan": ["nan", ">= 0"],
    "-checkpoint_every 0": ["0", ">= 1"],
    "-settle maybe": ["maybe", "true or false"],
    "-overlap -1": ["-1", "a number >= 0, or relax"],
    "-scene nosuch": ["nosuch", "mixer"],
    "-scene_n 0": ["0", "at least 1"],
    "-scene_radius nan": ["nan", "finite number"],
    "-scene_seed -1": ["-1", "not be negative"],
    "-scene_perturbation 0.03": ["0.03", "0.025"],  # the spheres could overlap
    "-ccp_type pdpi": ["pdpi", "did you mean pdip?"],
    "-ccp_tol 1e4": ["1e4", "between 0 and 1"],  # a typing error for 1e-4: any impulses would be a solution
    "-ccp_pdip_centering 2 -ccp_type pdip": ["2", "between 0 and 1"],
    "-compare nosuch": ["nosuch", "ilu", "pbjacobi"],
    "-compare ten:tt,tent:tt,tt,x:ilu,x_pc:ilu": ["-compare_x_pc_... would be an option of x too"],
    "-compare_ten_pc_tt_rank 3 -compare auto:tt": ["not compared", "-compare lists auto:tt"],
    "-compare_ten_pc_tt_rank abc -compare ten:tt": ["-compare_ten_pc_tt_rank abc", "auto or a whole number"],
    "-pc_bic_tau 2 -ccp_type pdip": ["-pc_bic_tau 2", "below 1"],
    "-compare ilu -ccp_type apgd": ["apgd", "pdip"],
    "-ksp_type nosuch": ["nosuch"],
    "-pc_type nosuch": ["nosuch"],
    "-ksp_rtol abc": ["abc"],
    "-ksp_rtol 1e3": ["1e3", "below 1"],  # a typing error for 1e-3
    "-ksp_rtol -1": ["-1", ">= 0"],
    "-ksp_atol nan": ["-ksp_atol nan", ">= 0"],
    "-compare_x_pc_factor_levels one -compare x:ilu": ["-compare_x_pc_factor_levels one: PETSc refuses"],
    "-pc_python_type nosuch.Thing -pc_type python": ["nosuch.Thing"],
    "-restart missing.h5": ["missing.h5", "no such file"],
    "-restart .": ["no such file"],
    "-problem missing.hdf5": ["missing.hdf5", "no such file"],
    "-output": ["the name of a folder"],
    "-dump_problem results/notes.txt": ["results/notes.txt", "folder that can be written"],
    # options that mean nothing beside others
    "-scene blade -problem p.h5": ["blade", "-problem p.h5 makes no steps"],
    "-steps 3 -problem p.h5": ["-problem p.h5 makes no steps"],
    "-steps 3 -settle": ["-settle makes its state with APGD"],
    "-ccp_type pdip -settle": ["-settle makes its state with APGD"],
    "-compare_every 3": ["-compare_every 3: has no effect without -compare; allowed is both"],
    "-compare_ilu_pc_factor_levels 1": ["-compare lists none"],
    "-compare_icc_pc_factor_levels 1 -compare ilu,none": ["-compare lists ilu,none"],
    "-ccp_apgd_x 1": ["did you mean"],
    "-ccp_gauss_seidel_relaxation 1.2": ["another -ccp_type than auto"],
    "-ccp_newton body -ccp_type apgd": ["apgd solves no Newton systems", "pdip"],
    "-ccp_newton kkt": ["auto has no constraints with multipliers", "pdip"],
    "-ccp_newton kkt -ccp_type conic": ["conic has no constraints with multipliers", "contact and body"],
    "-ccp_newton contact": ["auto solves Coulomb's law in the form body alone; allowed are body, and the law relax"],
    "-ccp_newton contact -ccp_type conic -law coulomb": ["conic solves Coulomb's law in the form body alone"],
    "-ccp_pdip_form quadratic -ccp_type pdip": ["quadratic", "perspective, paper"],
    "-ksp_rtol 1e-3 -ccp_type apgd": ["apgd solves no Newton systems", "pdip"],
    "-law columb": ["columb", "did you mean coulomb?"],
    "-law coulomb -settle": ["-settle makes its state with APGD"],
    "-dt 0.01 -settle": ["-dt 0.01: -settle makes its state with APGD"],
    "-delta 0.01 -settle": ["-delta 0.01: -settle makes its state with APGD"],
    "-stiffness 1e5 -settle": ["-stiffness 1e5: -settle makes its state with APGD"],
    "-recovery_speed 2 -settle": ["-recovery_speed 2: -settle makes its state with APGD"],
    "-scene_torque 0": ["0", "must be positive"],
    "-scene_drawbar 3 -scene wheel": ["3 wheel weights has no effect on a carriage that is driven; allowed with the"],
    "-scene_slip 0.2 -scene wheel -scene_free": ["0.2 has no effect on a carriage that moves freely; allowed without"],
    "-scene_bars 3 -scene wheel -scene_file wheel.stl": ["3 has no effect on a wheel of a file"],
    "-scene_fraction 0.5 -scene plane_shear -scene_layer": ["0.5 has no effect on a layer"],
    # misspelt options of PETSc
    "-pc_typ ilu": ["did you mean -pc_type?"],
    "-ksp_tpye cg -ccp_type conic": ["did you mean -ksp_type?"],
}

#: These go through the program, the others through its function that reads the options.
FROM_OUTSIDE = (
    "-stepss 3",
    "-steps -1",
    "-steps",
    "-scene_n 0",
    "-scene_radius nan",
    "-compare nosuch",
    "-ksp_type nosuch",
    "-pc_type nosuch",
    "-pc_python_type nosuch.Thing -pc_type python",
)


@pytest.fixture
def results(tmp_path):
    """A folder with files of an earlier run, which must stay as they are."""
    folder = tmp_path / "results"
    if MPI.COMM_WORLD.rank == 0:
        (folder / "frames").mkdir(parents=True)
        for name in ("summary.json", "state.h5", "checkpoint.h5", "frames/000001.h5", "notes.txt"):
            (folder / name).write_text(f"what was in {name}")
    MPI.COMM_WORLD.Barrier()
    return folder


def refused(program, folder, *options, **how):
    """Run with bad options; the one line that it said."""
    before = contents(folder)
    done = program(*options, **how, status=None)
    assert contents(folder) == before
    assert done.stderr.count("\n") == 1, done.stderr
    assert "results" not in done.stdout
    return one_line(done, 2)


def check_words(said, options):
    name = options.split()[0]
    assert re.match(rf"{name}(?!\w)", said), said
    for word in BAD_OPTIONS[options]:
        assert word in said
    assert "\n" not in said


@pytest.mark.parametrize("options", [options for options in BAD_OPTIONS if options not in FROM_OUTSIDE])
def test_a_bad_option_is_refused_before_any_work(options, results, monkeypatch):
    monkeypatch.chdir(results.parent)
    before = contents(results)
    with pytest.raises(OptionError) as refusal:
        read_options(database(options.split()), MPI.COMM_SELF)
    check_words(str(refusal.value), options)
    assert contents(results) == before


def test_a_file_of_options_that_petsc_refuses_is_named(program, results, tmp_path):
    (tmp_path / "options").write_text("-steps 1 -dt 0.01\n")
    before = contents(results)
    done = program("-options_file", "options", own=True, status=2)  # PETSc says more before
    assert done.stderr.splitlines()[-1].startswith("pctt.run: PETSc refuses -options_file")
    assert "Traceback" not in done.stderr
    assert contents(results) == before


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("dt = -0.01", ["its dt is -0.01", "positive"]),
        ("dt = float('nan')", ["its dt is nan", "positive"]),
        ("dt = '0.01'", ["its dt is '0.01'", "positive"]),
        ("dt: float = 0.0", ["its dt is 0.0", "positive"]),
        ("delta = 'wide'", ["its delta is 'wide'", ">= 0"]),
        ("settling_time = None", ["its settling_time is None", ">= 0"]),
        ("settle_delta = -1", ["its settle_delta is -1", ">= 0"]),
        ("settling_time = -1.0", ["its settling_time is -1.0", ">= 0"]),
        ("domain = (0, 1, 2)", ["its domain is (0, 1, 2)", "upper corner"]),
        ("domain = ((0, 0, 2), (1, 1, 1))", ["its domain is", "upper corner"]),
    ],
)
def test_a_bad_numerical_parameter_of_a_scene_file_is_refused_before_any_work(line, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    head = "from dataclasses import dataclass\nfrom dem.experiment import Experiment\n@dataclass(frozen=True)\n"
    body = f"class Own(Experiment):\n    {line}\n    def build(self):\n        return 1\n"
    (tmp_path / "own.py").write_text(head + body)
    with pytest.raises(OptionError) as refusal:
        read_options({"scene": "own.py"}, MPI.COMM_SELF)
    for word in ["-scene own.py", *words]:
        assert word in str(refusal.value)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("options", FROM_OUTSIDE)
def test_a_bad_option_ends_the_program_with_one_line(options, program, results):
    check_words(refused(program, results, *options.split()).partition(": ")[2], options)


@pytest.mark.parametrize("words", ["results", "-steps 3 results", "-quiet -steps 3 4", "- -steps 3"])
def test_a_stray_word_is_refused(words, program, results):
    said = refused(program, results, *words.split())
    stray = words.split()[0] if words.startswith("- ") else words.split()[-1]
    assert said == f"pctt.run: {stray}: belongs to no option; a value follows its option, as in -output {stray}"


@pytest.mark.mpi
def test_values_with_blanks_are_taken_whole(program, tmp_path):
    """What stands behind a blank of a value is no option."""
    out = "my runs -overwrite -scene_n 0"
    options = ("-scene", "my -quiet scene.py", "-steps", 1, "-quiet", "-scene_height", 0.1)
    (tmp_path / options[1]).write_text(DROP)
    program(*options, "-output", out, "-dump_problem", "two  words", ranks=2, own=True)
    assert {path.name for path in tmp_path.iterdir()} - {"__pycache__"} == {out, "two  words", options[1]}
    assert len(list((tmp_path / "two  words").iterdir())) == 1
    program(*options, "-output", out, "-restart", f"{out}/checkpoint.h5", own=True)
    assert len(steps_of(tmp_path / out)) == 2


def test_what_petsc_cannot_hold_is_refused(program, results, monkeypatch):
    assert refused(program, results, "-output", "") == "pctt.run: -output: allowed is the name of a folder"
    assert "r?sultats: has bytes that are no text" in refused(program, results, "-output", "r\udce9sultats", own=True)
    monkeypatch.setenv("PETSC_OPTIONS", "-output 'my runs'")
    assert "PETSC_OPTIONS -output 'my runs': has a single quote" in refused(program, results, "-steps", "1")


@pytest.mark.parallel(1, 2)
def test_options_that_had_no_effect_are_named_at_the_end(program, settled):
    used = ("-pc_type", "ilu", "-pc_factor_levels", 1, "-ksp_rtol", 1e-2)
    used += ("-ksp_type", "gmres", "-ksp_gmres_restart", 20)
    idle = ("-ksp_richardson_scale", 0.5, "-pc_sor_its", 2, "-sub_pc_sor_omega", 1.5, "-mat_mumps_icntl_14", 30)
    own = ("-options_left", "no", "-malloc_debug", "0")
    done = program(*SETTLED, "-steps", 1, *used, *idle, *own)
    said = [line for line in done.stdout.splitlines() if line.startswith("options without effect")]
    assert len(said) == 1, done.stdout
    named = said[0].partition(": ")[2].split(", ")
    assert sorted(named) == sorted(f"{name} {value}" for name, value in zip(idle[::2], idle[1::2]))


def test_a_run_that_goes_on_says_that_it_has_no_start(program, settled):
    """It is not refused: the command of the run before goes on."""
    words = (*SMALL, "-steps", 0, "-overlap", "relax", "-overwrite", "-restart")
    said = program(*words, settled).stdout
    assert "options without effect in this run, as it goes on from a checkpoint: -overlap relax\n" in said


@pytest.mark.parametrize("solver", ["pdip", "conic"])
def test_options_of_newton_systems_that_have_an_effect_are_not_named(solver, program, settled):
    options = ("-ksp_rtol", 1e-2, "-ksp_max_it", 300, "-ksp_norm_type", "unpreconditioned")
    if solver == "pdip":
        options += ("-compare", "ilu,tt", "-compare_every", 2)
        options += ("-compare_ilu_pc_factor_levels", 1, "-compare_tt_pc_tt_rank", 2)
    else:
        options += ("-ksp_type", "cg", "-law", "relaxation")  # else the few contacts have factors without a KSP
    done = program(*SETTLED, "-steps", 2, "-ccp_type", solver, *options)
    assert "without effect" not in done.stdout


# -- files ------------------------------------------------------------------------------------------------


def damaged(path, how, checkpoint):
    """Write a file that is no checkpoint, or one that lacks a group, a data set or an attribute."""
    whole = checkpoint.read_bytes()
    path.write_bytes({"no HDF5": b"these are no data\n" * 100, "truncated": whole[: len(whole) // 2]}.get(how, whole))
    if how == "FCLIB":
        with h5py.File(path, "w") as file:
            file["fclib_local/vectors/mu"] = np.ones(1)
            file["fclib_local/spacedim"] = 3
    elif how in ("grains", "grains/velocity", "scene"):
        with edited(path) as file:
            del (file.attrs if how in file.attrs else file)[how]


PROBLEM = ("-problem", "bad.h5")
RESTART = (*SMALL, "-restart", "bad.h5", "-steps", 1)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize(
    ("how", "options"),
    [(how, PROBLEM) for how in ("no HDF5", "truncated", "FCLIB")]
    + [(how, RESTART) for how in ("no HDF5", "truncated", "FCLIB", "grains", "grains/velocity", "scene")],
)
def test_a_file_of_another_kind_or_a_damaged_one_is_refused(how, options, program, results, settled, tmp_path):
    if MPI.COMM_WORLD.rank == 0:
        damaged(tmp_path / "bad.h5", how, settled)
    MPI.COMM_WORLD.Barrier()
    assert "bad.h5" in refused(program, results, *options, "-overwrite")


@pytest.mark.parametrize(
    ("option", "value", "stored"),
    [
        ("-scene_friction", "0.5", "0.25"),
        ("-scene_seed", "7", "1"),
        ("-scene", "shear", "mixer"),
    ],
)
def test_a_checkpoint_of_another_scene_is_refused(option, value, stored, program, results, settled):
    own = () if option == "-scene" else SMALL
    said = refused(program, results, *own, option, value, "-restart", settled, "-overwrite")
    assert said == f"pctt.run: {option} {value}: {settled} was made with {option} {stored}; allowed is the same"


def test_an_output_folder_under_a_regular_file_is_refused(program, results, tmp_path):
    (tmp_path / "file").write_text("in the way")
    said = refused(program, results, *SMALL, "-steps", 1, "-output", "file/results")
    assert "-output file/results" in said
    assert (tmp_path / "file").read_text() == "in the way"


@pytest.mark.parallel(1, 2)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_scene_that_flies_apart_ends_with_one_line(program):
    done = program(*SMALL, "-scene_gravity", 1e150, "-dt", 1e3, "-steps", 3, status=1)
    assert "step" in one_line(done, 1)


def test_a_run_without_rigid_contacts_says_that_nothing_pushes_them_apart(program, settled):
    words = (*SMALL, "-steps", 0, "-recovery_speed", 0.5, "-overwrite", "-restart", settled)
    idle = "options without effect in this run, as no contact is rigid: -recovery_speed 0.5\n"
    assert idle in program(*words).stdout
    assert "without effect" not in program(*words, "-stiffness", "inf").stdout
