"""Options of ``python -m pctt.run``, read and checked before any work."""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.experiment import Experiment
from dem.together import together
from pctt import ccp
from pctt.ccp.newton import DEFAULTS
from pctt.ccp.newton.compare import labelled, prefix
from pctt.ksp_options import OF_SOLVERS, entered, refuse_misspelt, to_enter, unused
from pctt.options import NOT_NEGATIVE, POSITIVE, OptionError, describe, made, read, refuse_unknown
from pctt.petsc import own_errors
from pctt.run.dump import dump_steps
from pctt.run.hdf5 import refuse_serial
from pctt.run.place import refusal
from pctt.run.settings import DEMO, Options, Run, Settings, find_scene, obeys_coulomb

#: Options of simulations, beside those of the scene.
OF_STEPS = {
    "scene", "steps", "dt", "delta", "recovery_speed", "restart", "restart_changed_file", "settle", "settle_delta",
    "settle_tol", "output_every", "checkpoint_every", "dump_problem", "dump_steps", "dump_hard", "monitor",
}  # fmt: skip

#: What the numerical parameters of a scene may be.
NUMERICS = {"dt": POSITIVE, "delta": NOT_NEGATIVE, "settle_delta": NOT_NEGATIVE, "settling_time": NOT_NEGATIVE}

#: Options that settled states depend on, and -quiet.
OF_SETTLING = {"settle", "scene", "dt", "delta", "recovery_speed", "settle_delta", "settle_tol", "quiet"}


def read_options(database: Mapping[str, str], comm: MPI.Comm) -> Options:
    """The options of the database; raises OptionError, the same on every rank, before any work."""
    demo = not database
    database = DEMO if demo else database
    run = read(Run, database)
    solver = ccp.SOLVERS[run.ccp_type]
    scene_class = together(comm, "scene file", lambda: find_scene(run.scene), own=(OptionError,))
    known = [d.name for group, start in option_groups(scene_class) for d in describe(group, start)]
    refuse_unknown(unused(database), known, prefixes=OF_SOLVERS)  # PETSc has asked for its own when it started
    for name in known:
        PETSc.Options().hasName(name)  # PETSc warns of options that nobody asked for
    limits = read(ccp.Limits, database, "ccp_")
    # a file of -problem is solved as a plain cone problem by default
    coulomb = bool(run.ccp_coulomb) if run.problem else obeys_coulomb(run.ccp_coulomb, run.ccp_type, limits.tol)
    _refuse_without_effect(database, run, coulomb)
    what = f"options of the scene {scene_class.__name__}"
    scene = together(comm, what, lambda: _read_scene(run.scene, scene_class, database), own=(OptionError,))
    if "settle_delta" not in database:
        run = dataclasses.replace(run, settle_delta=scene.settle_delta)
    given = {
        **{name: getattr(run, name) for name in ("dt", "delta", "recovery_speed")},
        **{name: getattr(run, f"ccp_{name}") for name in ("newton", "compliance")},
        **vars(limits),
        "solver": run.ccp_type,
        "options": read(solver.options, database, solver.prefix),
        "coulomb": coulomb and read(ccp.Coulomb, database, "ccp_coulomb_"),
    }
    options = Options(run, scene, made(Settings, given).of(scene), demo)
    compare = ccp.Comparison(comm, run.compared())  # refuses unknown names
    _refuse_tolerances(database)  # newer releases of PETSc refuse them too, in other words
    if solver.newton and not run.settle:
        form = ccp.newton_for(comm, run.ccp_type, run.ccp_newton, compare).form
        _refuse_for_petsc(database, form, comm)
    dump_steps(run)  # refuses what is no list of steps
    _refuse_places(run, comm)
    return options


def _read_scene(name: str, scene_class: type[Experiment], database: Mapping[str, str]) -> Experiment:
    """The scene with the options of the database. OptionError if it refuses one, or has bad numbers of its own."""
    try:
        scene = read(scene_class, database, "scene_")
    except OptionError:
        raise
    except ValueError as error:
        if not str(error).startswith(tuple(field.name for field in dataclasses.fields(scene_class))):
            raise
        raise OptionError(f"-scene_{error}") from None
    _refuse_bad_numerics(name, scene)
    return scene


def _refuse_bad_numerics(name: str, scene: Experiment) -> None:
    """OptionError for an attribute of the scene that is no number, or a bad one, before any work. They may be
    properties and options too."""
    for attribute, (allowed, test) in NUMERICS.items():
        value = getattr(scene, attribute)
        if not (isinstance(value, (int, float, np.number)) and test(value)):
            raise OptionError(f"-scene {name}: its {attribute} is {value!r}; allowed is {allowed}")
    if scene.domain is not None:
        try:
            low, high = (np.broadcast_to(np.asarray(corner, dtype=float), 3) for corner in scene.domain)
            empty = not (low <= high).all()
        except (TypeError, ValueError):
            empty = True
        if empty:
            allowed = "a lower and an upper corner, each of three numbers, or None"
            raise OptionError(f"-scene {name}: its domain is {scene.domain!r}; allowed is {allowed}")


def option_groups(scene: type[Experiment]) -> list[tuple[type, str]]:
    """The classes whose fields are options, with their prefixes."""
    solvers = [(solver.options, solver.prefix) for solver in ccp.SOLVERS.values()]
    laws: list[tuple[type, str]] = [(ccp.Limits, "ccp_"), (ccp.Coulomb, "ccp_coulomb_")]
    return [(Run, ""), (scene, "scene_"), *laws, *solvers]


def _refuse_without_effect(database: Mapping[str, str], run: Run, coulomb: bool) -> None:
    """OptionError for the first option that means nothing beside the others."""
    solver = ccp.SOLVERS[run.ccp_type]
    newton = ", ".join(name for name, solver in ccp.SOLVERS.items() if solver.newton)
    of_others = tuple(other.prefix for other in ccp.SOLVERS.values() if other is not solver)
    compared = tuple(map(prefix, labelled(run.compared())))
    own = {field.name for field in dataclasses.fields(Run)}

    def strangers(start: str, known: tuple[str, ...]) -> set[str]:
        return {name for name in database if name.startswith(start) and not name.startswith(known)}

    settles = "-settle makes its state with APGD, where this option has no effect; allowed is one of the two"
    no_newton = f"-ccp_type {run.ccp_type} solves no Newton systems; allowed is {newton}"
    not_compared = f"its preconditioner is not compared; -compare lists {run.compare or 'none'}"
    unsettled = not run.settle and run.restart != "settled"
    rules: list[tuple[Any, set[str], tuple[str, ...], str]] = [  # if, which options by name or by beginning, why not
        (run.problem, OF_STEPS, ("scene_",), f"-problem {run.problem} makes no steps; allowed is one of the two"),
        (run.settle, own - OF_SETTLING, ("ccp_", *OF_SOLVERS), settles),
        (not run.dump_problem, {"dump_steps"}, (), "it needs -dump_problem FOLDER"),
        (not run.problem, {"problem_guess"}, (), "allowed with -problem only"),
        (unsettled, {"settle_delta", "settle_tol"}, (), "allowed with -settle or -restart settled only"),
        (run.restart in ("", "settled"), {"restart_changed_file"}, (), "allowed with -restart FILE only"),
        (run.quiet and run.monitor > 0, {"monitor"}, (), "-quiet prints nothing; allowed is one of the two"),
        (not solver.newton, {"compare", "ccp_newton"}, OF_SOLVERS, no_newton),
        (not run.compare, {"compare_every"}, (), "allowed with -compare only"),
        (True, strangers("compare_", compared) - {"compare_every"}, (), not_compared),
        (True, set(), of_others, f"belongs to another -ccp_type than {run.ccp_type}"),
        (not coulomb, set(), ("ccp_coulomb_",), "allowed with -ccp_coulomb only"),
    ]
    for applies, names, starts, reason in rules:
        for name, value in database.items():
            if applies and (name in names or name.startswith(starts)):
                raise OptionError(f"{f'-{name} {value or str()}'.rstrip()}: {reason}")


def _refuse_tolerances(database: Mapping[str, str]) -> None:
    """OptionError for a relative tolerance of a KSP that PETSc would refuse at the first Newton system, or worse,
    take."""
    for name, text in database.items():
        if name.endswith("ksp_rtol"):
            try:
                wrong = not 0.0 <= float(text or "nan") < 1.0
            except ValueError:  # PETSc knows other words, and refuses the rest
                continue
            if wrong:
                raise OptionError(f"{f'-{name} {text or str()}'.rstrip()}: allowed is a number >= 0 and below 1")


def _refuse_for_petsc(database: Mapping[str, str], form: str, comm: MPI.Comm) -> None:
    """OptionError for options of the KSP that PETSc refuses or does not know. PETSc itself would complain only at the
    first Newton system, or never."""
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


def _refuse_places(run: Run, comm: MPI.Comm) -> None:
    """OptionError for files that are not there, and for folders in which the run cannot write or must not."""
    refuse_serial(comm)
    _refuse_missing("-restart", run.restart if run.restart != "settled" else "", comm)
    _refuse_missing("-problem", run.problem, comm)
    if not run.settle:
        refuse_unwritable("-output", Path(run.output), comm)
        if run.dump_problem:
            refuse_unwritable("-dump_problem", Path(run.dump_problem), comm)
        _refuse_occupied(run, comm)


def _refuse_missing(name: str, path: str, comm: MPI.Comm) -> None:
    readable = comm.bcast(not path or os.access(path, os.R_OK) and os.path.isfile(path))
    if not readable:
        raise OptionError(f"{name} {path}: no such file, or not readable")


def refuse_unwritable(name: str, folder: Path, comm: MPI.Comm) -> None:
    """Make a folder; OptionError for the option ``name`` if files cannot be written there; collective."""
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
    """OptionError if the output folder holds a run, unless this run continues it or has ``-overwrite``."""
    restart = run.restart if not run.problem else ""
    refused = comm.bcast(refusal(Path(run.output), restart, run.overwrite) if comm.rank == 0 else "")
    if refused:
        raise OptionError(refused)
