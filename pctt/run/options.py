"""Options of ``python -m pctt.run``, read and checked before any work."""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Optional

from mpi4py import MPI
from petsc4py import PETSc

from dem.experiment import Experiment, SceneFileError, from_file
from dem.scenes import SCENES
from dem.together import together
from pctt import ccp
from pctt.ccp.newton import DEFAULTS
from pctt.ccp.newton.asked_for import LADDER
from pctt.contact_map import OPERATORS, is_free
from pctt.options import (
    AT_LEAST_ONE,
    COUNT,
    NOT_NEGATIVE,
    POSITIVE,
    OptionError,
    describe,
    nearest,
    option,
    read,
    refuse_unknown,
)
from pctt.pc import PRECONDITIONERS
from pctt.pc.ksp_options import entered, to_enter
from pctt.petsc import own_errors
from pctt.run.dump import dump_folder
from pctt.run.hdf5 import refuse_serial
from pctt.run.leftovers import OF_SOLVERS, refuse_misspelt
from pctt.run.place import held, is_checkpoint_of

#: Options of simulations, beside those of the scene.
OF_STEPS = {
    "scene", "steps", "dt", "delta", "recovery_speed", "restart", "restart_changed_file", "settle", "settle_delta",
    "settle_tol", "output_every", "checkpoint_every", "dump_problem", "dump_steps", "dump_hard", "monitor",
}  # fmt: skip

#: Options that settled states depend on, and -quiet.
OF_SETTLING = {"settle", "scene", "dt", "delta", "recovery_speed", "settle_delta", "settle_tol", "quiet"}

# what runs when no option is given
DEMO = {
    "scene": "mixer",
    "scene_n": "4",
    "restart": "settled",
    "steps": "5",
    "compare": "ilu,ilu-shifted,pbjacobi,none",
    "compare_every": "4",
    "output": "results/demo",
    "overwrite": "true",  # nothing but the demo writes to its folder
}


@dataclasses.dataclass(frozen=True)
class Run:
    """Options without a prefix."""

    scene: str = option("mixer", f"what to simulate: {', '.join(SCENES)}, or a file FILE.py with a scene of your own")
    steps: int = option(5, "time steps to make", check=COUNT)
    dt: Optional[float] = option(None, "time step; none: the scene's own", "s", check=POSITIVE)
    delta: Optional[float] = option(
        None, "gap below which a pair of bodies is a contact; none: the scene's own", "m", check=NOT_NEGATIVE
    )
    recovery_speed: float = option(
        1.0, "greatest speed at which bodies that overlap are pushed apart", "m/s", check=NOT_NEGATIVE
    )
    restart: str = option(
        "",
        "file to start from: checkpoint.h5 of a run; settled: the scene's settled state, made at first use",
    )
    restart_changed_file: bool = option(
        False, "let -restart go on from a state that another text of the scene file made; its options must be the same"
    )
    settle: bool = option(False, "make the scene's settled state with APGD, keep it in the cache, and stop")
    settle_delta: float = option(
        0.1,
        "-delta while settling: falling bodies come closer within a step than bodies at rest; the default of scenes "
        "with spheres of 0.1 m, others may have their own",
        "m",
        check=NOT_NEGATIVE,
    )
    settle_tol: float = option(1e-3, "natural residual of the steps of -settle", check=POSITIVE)
    output: str = option("results", "folder for state.h5, records.csv, steps.jsonl, summary.json, checkpoint.h5")
    overwrite: bool = option(
        False, "let the run replace another one in the folder of -output, once its first step is written"
    )
    output_every: int = option(1, "steps between two records in state.h5; 0: none", check=COUNT)
    checkpoint_every: int = option(1, "steps between two checkpoints", check=AT_LEAST_ONE)
    problem: str = option("", "FCLIB, PETSc binary or Siconos file with a cone problem to solve instead of a scene")
    problem_guess: bool = option(True, "start -problem from the guess in the file, if there is one")
    dump_problem: str = option(
        "",
        "folder for the steps' cone problems as FCLIB and PETSc binary files; or names of the FCLIB files, with {step} "
        "and perhaps {contacts} in them",
    )
    dump_steps: str = option("", "steps that -dump_problem writes, with commas between; none: every step")
    dump_hard: int = option(
        5, "how many cone problems that -ccp_type does not solve are written to the folder hard of -output", check=COUNT
    )
    ccp_type: str = option("pdip", "solver of the cone problems", choices=ccp.SOLVERS)
    ccp_newton: str = option(
        "auto", "unknowns of the Newton systems; auto: contact for pdip, body for conic", choices=("auto", *ccp.FORMS)
    )
    ccp_operator: str = option(
        "auto",
        "products with the contact map: free, by compiled loops without matrices, or assembled, by matrices of PETSc; "
        "auto: free where numba is installed",
        choices=OPERATORS,
    )
    ccp_compliance: Optional[float] = option(
        None,
        "compliance of the contacts, as a part of mean diag N; none: 0, rigid, or that of the file of -problem",
        check=NOT_NEGATIVE,
    )
    ccp_coulomb: Optional[bool] = option(
        None,
        "true: Coulomb's law; false: its relaxation by the cone problem, whose sliding contacts open; none: Coulomb's "
        "law where that costs about the same, in scenes with apgd or auto at -ccp_tol 1e-4 and above (docs/ccp.md)",
    )
    compare: str = option("", "preconditioners, with commas between, that each solve the same Newton systems")
    compare_every: int = option(1, "compare on every k-th Newton system", check=AT_LEAST_ONE)
    monitor: int = option(
        1,
        "what to print: 0 the tables at the end; 1 and a line per step; 2 and the accuracy of each step",
        check=("0, 1 or 2", lambda x: 0 <= x <= 2),
    )
    quiet: bool = option(False, "print nothing but errors")


@dataclasses.dataclass(frozen=True)
class Options:
    """Everything that a run needs to know, with the scene's own values filled in.

    ``scene`` is an instance of a class of ``dem.scenes.SCENES`` or of the user's; ``solver`` of the options class
    of ``ccp_type``; ``coulomb`` is there where Coulomb's law is to hold.
    """

    run: Run
    scene: Any
    dt: float
    delta: float
    limits: ccp.Limits
    solver: Any
    coulomb: ccp.Coulomb | None
    demo: bool

    @property
    def problem(self) -> str | None:
        return self.run.problem or None

    def compare_names(self) -> list[str]:
        return [name for name in self.run.compare.split(",") if name]


def read_options(database: Mapping[str, str], comm: MPI.Comm) -> Options:
    """The options of the database; raises OptionError, the same on every rank, before any work."""
    demo = not database
    database = DEMO if demo else database
    run = read(Run, database)
    solver = ccp.SOLVERS[run.ccp_type]
    prefix = f"ccp_{run.ccp_type}_"
    scene_class = together(comm, "scene file", lambda: find_scene(run.scene), own=(OptionError,))
    known = [d.name for group, start in _groups(scene_class) for d in describe(group, start)]
    refuse_unknown(database, known, prefixes=("compare_", "fallback_", "body_", "kkt_"))
    for name in known:
        PETSc.Options().hasName(name)  # PETSc warns of options that nobody asked for
    limits = read(ccp.Limits, database, "ccp_")
    obeys_coulomb = _obeys_coulomb(run, limits)
    _refuse_without_effect(database, run, obeys_coulomb)
    what = f"options of the scene {scene_class.__name__}"
    scene, dt, delta = together(comm, what, lambda: _read_scene(scene_class, database), own=(OptionError,))
    if "settle_delta" not in database:
        run = dataclasses.replace(run, settle_delta=scene.settle_delta)
    options = Options(
        run,
        scene,
        run.dt if run.dt is not None else dt,
        run.delta if run.delta is not None else delta,
        limits,
        read(solver.options, database, prefix),
        read(ccp.Coulomb, database, "ccp_coulomb_") if obeys_coulomb else None,
        demo,
    )
    compare = ccp.Comparison(comm, options.compare_names())  # refuses unknown names
    if solver.newton and not run.settle:
        form = ccp.newton_for(comm, run.ccp_type, run.ccp_newton, compare).form
        _refuse_for_petsc(database, form, comm)
    if run.ccp_operator == "free":
        try:
            is_free(run.ccp_operator)
        except ValueError as error:
            raise OptionError(str(error)) from None
    refuse_serial(comm)
    _refuse_missing("-restart", run.restart if run.restart != "settled" else "", comm)
    _refuse_missing("-problem", run.problem, comm)
    problems = dump_folder(run)
    if not run.settle:
        _refuse_unwritable("-output", Path(run.output), comm)
        if run.dump_problem:
            _refuse_unwritable("-dump_problem", problems, comm)
        _refuse_occupied(run, comm)
    return options


def _read_scene(scene_class: type[Experiment], database: Mapping[str, str]) -> tuple[Experiment, Any, Any]:
    """The scene with the options of the database, its time step and its contact distance; OptionError for an option
    that it refuses."""
    try:
        scene = read(scene_class, database, "scene_")
    except OptionError:
        raise
    except ValueError as error:
        if not str(error).startswith(tuple(field.name for field in dataclasses.fields(scene_class))):
            raise
        raise OptionError(f"-scene_{error}") from None
    # They may be properties too: what fails is to fail before any work.
    _ = scene.settling_time, scene.settle_delta, scene.domain
    return scene, scene.dt, scene.delta


def find_scene(name: str) -> type[Experiment]:
    """The scene of that name, or the one that the file of that name defines; OptionError if there is none."""
    if name.endswith(".py"):
        try:
            return from_file(Path(name))
        except SceneFileError as error:
            raise OptionError(f"-scene {name}: {error}") from None
    if name not in SCENES:
        allowed = f"one of {', '.join(SCENES)}, or a file FILE.py"
        raise OptionError(f"-scene {name}: allowed is {allowed}{nearest(name, SCENES)}")
    return SCENES[name]


def scene_name(name: str) -> str:
    """How results name a scene: a file of the user's without folder and suffix."""
    return Path(name).stem


def _groups(scene: type[Experiment]) -> list[tuple[type, str]]:
    solvers = [(solver.options, f"ccp_{name}_") for name, solver in ccp.SOLVERS.items()]
    laws: list[tuple[type, str]] = [(ccp.Limits, "ccp_"), (ccp.Coulomb, "ccp_coulomb_")]
    return [(Run, ""), (scene, "scene_"), *laws, *solvers]


NEWTON_HELP = """\
  The KSP without prefix, e.g. -ksp_type bcgs -ksp_rtol 1e-3 -ksp_max_it 1000 -ksp_pc_side right -pc_type pbjacobi
  (the defaults; rtol is 10 ccp_tol where that is smaller), -ksp_monitor, -ksp_view, -log_view. A compared
  preconditioner NAME has the prefix -compare_NAME_, e.g. -compare_ilu_pc_factor_levels 1. On several ranks ilu and
  icc work within each rank."""
TOPICS = {"run": "the run itself", "scene": "the scene of -scene", "ccp": "cone problems and their solvers",
          "pc": "preconditioners of this package", "ksp": "Newton systems"}  # fmt: skip


def help_text(database: Mapping[str, str], topic: str = "") -> str:
    """Options with default, unit and meaning, of one of TOPICS or of all; OptionError for another topic."""
    if topic and topic not in TOPICS:
        raise OptionError(f"-help {topic}: there is no such topic; allowed are {', '.join(TOPICS)}, or none for all")
    lines = ["Options of pctt.run (names <default unit>: meaning); without any, it runs the demo:"]
    lines += ["  " + " ".join(f"-{name} {value}" for name, value in DEMO.items())]
    lines += ["Of one topic: " + ", ".join(f"-help {name} ({text})" for name, text in TOPICS.items()), ""]
    for part, title, text in _help_sections(database):
        if topic in ("", part):
            lines += [title, text, ""]
    return "\n".join(lines[:-1] if not topic else lines[4:-1])


def _help_sections(database: Mapping[str, str]) -> Iterator[tuple[str, str, str]]:
    """Topic, title and text of each section of the help."""
    scene = database.get("scene", "mixer")
    parts = ["run", "scene", "ccp", "ccp", *("ccp" for _ in ccp.SOLVERS)]
    titles = ["Run", f"Scene {scene}", "Cone problem", "Coulomb's law by cone problems, with -ccp_coulomb"]
    titles += [f"-ccp_type {name}: {solver.help}" for name, solver in ccp.SOLVERS.items()]
    for part, title, (group, prefix) in zip(parts, titles, _groups(find_scene(scene))):
        yield part, title, "\n".join(map(str, describe(group, prefix)))
    for pc in PRECONDITIONERS:
        title = f"-pc_type python -pc_python_type pctt.pc.{pc.__name__}"
        yield "pc", title, "\n".join(map(str, describe(pc.options_class, pc.options_prefix)))
    yield "ksp", "Newton systems", NEWTON_HELP


def _obeys_coulomb(run: Run, limits: ccp.Limits) -> bool:
    """Whether Coulomb's law is to hold; a file of ``-problem`` is solved as the cone problem that it is."""
    if run.ccp_coulomb is not None:
        return run.ccp_coulomb
    return not run.problem and limits.tol >= ccp.SOLVERS[run.ccp_type].law_tol


def _refuse_without_effect(database: Mapping[str, str], run: Run, obeys_coulomb: bool) -> None:
    """OptionError for the first option that means nothing beside the others."""
    solver = ccp.SOLVERS[run.ccp_type]
    newton = ", ".join(name for name, solver in ccp.SOLVERS.items() if solver.newton)
    others = tuple(other.prefix for other in ccp.SOLVERS.values() if other is not solver)
    compared = tuple(f"compare_{name}_" for name in run.compare.split(",") if name)
    ladder = tuple(f"fallback_{name}_" for name in LADDER)
    own = {field.name for field in dataclasses.fields(Run)}
    rules: list[tuple[Any, Callable[[str], bool], str]] = [  # if, which options, why not
        (
            run.problem,
            lambda name: name in OF_STEPS or name.startswith("scene_"),
            f"-problem {run.problem} makes no steps; allowed is one of the two",
        ),
        (
            run.settle,
            lambda name: (name in own or name.startswith(("ccp_", *OF_SOLVERS))) and name not in OF_SETTLING,
            "-settle makes its state with APGD and takes no notice of it; allowed is one of the two",
        ),
        (not run.problem, lambda name: name == "problem_guess", "allowed with -problem only"),
        (
            not run.settle and run.restart != "settled",
            lambda name: name in ("settle_delta", "settle_tol"),
            "allowed with -settle or -restart settled only",
        ),
        (
            run.restart in ("", "settled"),
            lambda name: name == "restart_changed_file",
            "allowed with -restart FILE only",
        ),
        (run.quiet, lambda name: name == "monitor", "-quiet prints nothing; allowed is one of the two"),
        (
            not solver.newton,
            lambda name: name in ("compare", "ccp_newton") or name.startswith(OF_SOLVERS),
            f"-ccp_type {run.ccp_type} solves no Newton systems; allowed is {newton}",
        ),
        (not run.compare, lambda name: name == "compare_every", "allowed with -compare only"),
        (
            True,
            lambda name: name.startswith("compare_") and name != "compare_every" and not name.startswith(compared),
            f"its preconditioner is not compared; -compare lists {run.compare or 'none'}",
        ),
        (
            True,
            lambda name: name.startswith("fallback_") and not name.startswith(ladder),
            f"no such fallback; there are {', '.join(LADDER)}",
        ),
        (True, lambda name: name.startswith(others), f"belongs to another -ccp_type than {run.ccp_type}"),
        (not obeys_coulomb, lambda name: name.startswith("ccp_coulomb_"), "allowed with -ccp_coulomb only"),
    ]
    for applies, concerned, reason in rules:
        for name, value in database.items():
            if applies and concerned(name):
                raise OptionError(f"{f'-{name} {value or str()}'.rstrip()}: {reason}")


def _refuse_for_petsc(database: Mapping[str, str], form: str, comm: MPI.Comm) -> None:
    """OptionError for options of the KSP that PETSc refuses or does not know; it would do so at the first Newton
    system, or never."""
    given = {name: value for name, value in database.items() if name.startswith(("ksp_", "pc_"))}
    known = PETSc.Options().getAll()
    absent = {name: value for name, value in given.items() if name not in known}
    ksp = PETSc.KSP().create(comm)
    try:
        with entered({**to_enter("", DEFAULTS[form], comm.size), **absent}), own_errors():
            ksp.setFromOptions()
            refuse_misspelt(given)
    except OptionError:  # from a preconditioner of ours
        raise
    except Exception as error:  # PETSc's own, and whatever importing a -pc_python_type raises
        reason = str(error).splitlines()[-1]
        reason = reason.partition("] ")[2] or reason
        listed = ", ".join(f"-{name} {value or ''}".strip() for name, value in given.items())
        raise OptionError(f"{listed}: PETSc refuses: {reason}") from None
    finally:
        ksp.destroy()


def _refuse_missing(name: str, path: str, comm: MPI.Comm) -> None:
    readable = comm.bcast(not path or os.access(path, os.R_OK) and os.path.isfile(path))
    if not readable:
        raise OptionError(f"{name} {path}: no such file, or not readable")


def _refuse_unwritable(name: str, folder: Path, comm: MPI.Comm) -> None:
    error = None
    if comm.rank == 0:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as problem:
            error = problem.strerror
    error = comm.bcast(error)
    if error:
        raise OptionError(
            f"{name} {folder}: cannot write there ({error}); allowed is a folder that can be written"
        )


def _refuse_occupied(run: Run, comm: MPI.Comm) -> None:
    """OptionError if the output folder holds a run that this one neither goes on with nor may replace."""
    folder = Path(run.output)
    there: list[str] = []
    if comm.rank == 0 and not run.overwrite and not (is_checkpoint_of(folder, run.restart) and not run.problem):
        there = held(folder)
    there = comm.bcast(there)
    if there:
        goes_on = f", or -restart {folder / 'checkpoint.h5'} to go on with it" * ("checkpoint.h5" in there)
        raise OptionError(
            f"-output {folder}: holds a run ({', '.join(there)}); allowed is another folder, -overwrite to replace "
            f"that run{goes_on}"
        )
