"""Options of ``python -m pctt.run``, read and checked before any work."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.compiled import set_threads
from dem.experiment import Experiment
from dem.together import together
from pctt import ccp
from pctt.ccp.newton.compare import labelled, prefix
from pctt.ccp.newton.defaults import DEFAULTS, INCOMPLETE
from pctt.ccp.registry import why_idle
from pctt.ksp_options import (
    OWN,
    entered,
    mark_used,
    refuse_misspelt,
    refuse_unknown,
    solver_options,
    taken_over,
    to_enter,
    unmarked,
)
from pctt.options import NOT_NEGATIVE, POSITIVE, OptionError, describe, read
from pctt.petsc import own_errors
from pctt.run.output import refusal, refuse_unwritable
from pctt.run.settings import DEMO, Options, Run, Settings, find_scene

#: Options of steps, of which a settled state has its own; options of simulations, beside those of the scene; those that
#: settled states depend on, and -quiet.
OF_MODEL = {"dt", "delta", "stiffness", "recovery_speed"}
OF_STEPS = OF_MODEL | {
    "scene", "steps", "restart", "settle", "output_every", "checkpoint_every", "checkpoint_minutes", "dump_problem",
    "overlap",
}  # fmt: skip
OF_SETTLING = {"settle", "scene", "quiet"}


def read_options(database: Mapping[str, str], comm: MPI.Comm) -> Options:
    """The options of the database; raises OptionError, the same on every rank, before any work."""
    demo = not database
    database = DEMO if demo else database
    run, asked = read(Run, database), read(Settings, database, "ccp_")
    of_systems = [name for name in solver_options(database) if not name.startswith("vec_")]
    if (run.compare or of_systems) and "ccp_type" not in database:
        asked = dataclasses.replace(asked, solver="pdip")  # the paper's
    solver = ccp.SOLVERS[asked.solver]
    scene_class = together(comm, "scene file", lambda: find_scene(run.scene), own=(OptionError,))
    known = [d.name for group, start in option_groups(scene_class) for d in describe(group, start)]
    refuse_unknown(database, known)  # PETSc has asked for its own when it started
    mark_used(known)
    _refuse_without_effect(database, run, asked)
    what = f"options of the scene {scene_class.__name__}"
    scene = together(comm, what, lambda: _read_scene(run.scene, scene_class, database), own=(OptionError,))
    asked = dataclasses.replace(asked, options=read(solver.options, database, solver.prefix))
    compare = ccp.Comparison(comm, run.compared())  # refuses unknown names
    if solver.newton and not run.settle:
        form = ccp.newton_for(comm, asked.solver, asked.newton, compare).form
        _refuse_for_petsc(database, form, compare)
    _refuse_places(run, comm)
    together(comm, "option -threads", lambda: _start_threads(run.threads), own=(OptionError,))
    return Options(run, scene, asked.completed_for(scene, relaxed=bool(run.problem or run.compare)), demo, database)


def _start_threads(count: int) -> None:
    try:
        set_threads(count)
    except ValueError as error:
        raise OptionError(f"-{error}") from None


def _read_scene(name: str, scene_class: type[Experiment], database: Mapping[str, str]) -> Experiment:
    """The scene with the options of the database. OptionError if it refuses one, or has bad numbers of its own."""
    try:
        scene = read(scene_class, database, "scene_")
        _refuse_bad_numerics(name, scene)
    except OptionError:
        raise
    except ValueError as error:
        if not str(error).startswith(tuple(field.name for field in dataclasses.fields(scene_class))):
            raise
        raise OptionError(f"-scene_{error}") from None
    return scene


def _refuse_bad_numerics(name: str, scene: Experiment) -> None:
    """OptionError for an attribute of the scene that is no number, or a bad one, before any work. They may be
    properties and options too."""
    for attribute in ("dt", "delta", "settle_delta", "settling_time"):
        value, (allowed, test) = getattr(scene, attribute), POSITIVE if attribute == "dt" else NOT_NEGATIVE
        if value is None and attribute != "settling_time":
            continue  # from the scene's sizes and speeds
        if not (isinstance(value, (int, float, np.number)) and test(value)):
            raise OptionError(f"-scene {name}: its {attribute} is {value!r}; allowed is {allowed}")
    try:
        low, high = scene.domain or (0, 0)
        good = bool(np.all(np.broadcast_to(low, 3) <= np.broadcast_to(high, 3)))
    except (TypeError, ValueError):
        good = False
    if not good:
        allowed = "a lower and an upper corner, each of three numbers, or None"
        raise OptionError(f"-scene {name}: its domain is {scene.domain!r}; allowed is {allowed}")


def option_groups(scene: type[Experiment]) -> list[tuple[type, str]]:
    """The classes whose fields are options, with their prefixes."""
    solvers = [(solver.options, solver.prefix) for solver in ccp.SOLVERS.values()]
    return [(Run, ""), (scene, "scene_"), (Settings, "ccp_"), *solvers]


def _refuse_without_effect(database: Mapping[str, str], run: Run, asked: Settings) -> None:
    """OptionError for the first option that means nothing beside the others."""
    solver = ccp.SOLVERS[asked.solver]
    newton = ", ".join(name for name, solver in ccp.SOLVERS.items() if solver.newton)
    of_others = tuple(other.prefix for other in ccp.SOLVERS.values() if other is not solver)
    compared = tuple(map(prefix, labelled(run.compared())))
    solvers = solver_options(database)
    strangers = {
        name for short, name in solvers.items() if short.startswith("compare_") and not short.startswith(compared)
    }
    own = {field.name for field in dataclasses.fields(Run)}

    settles = "-settle makes its state with APGD, where this option has no effect; allowed is one of the two"
    no_newton = f"-ccp_type {asked.solver} solves no Newton systems; allowed is {newton}"
    idle = why_idle(asked.solver, asked.newton, asked.law_for(bool(run.problem or run.compare)))
    rules: list[tuple[Any, set[str], tuple[str, ...], str]] = [  # if, which options by name or by beginning, why not
        (run.problem, OF_STEPS, ("scene_",), f"-problem {run.problem} makes no steps; allowed is one of the two"),
        (run.settle, own - OF_SETTLING | OF_MODEL | {"law", *solvers.values()}, ("ccp_",), settles),
        (not solver.newton, {"compare", "compare_every", "ccp_newton", *solvers.values()}, (), no_newton),
        (idle, {"ccp_newton"}, (), idle),
        (not run.compare, {"compare_every"}, (), "has no effect without -compare; allowed is both"),
        (True, strangers, (), f"its preconditioner is not compared; -compare lists {run.compare or 'none'}"),
        (True, set(), of_others, f"belongs to another -ccp_type than {asked.solver}"),
    ]
    for applies, names, starts, reason in rules:
        for name, value in database.items():
            if applies and (name in names or name.startswith(starts)):
                raise OptionError(f"{f'-{name} {value or str()}'.rstrip()}: {reason}")


#: Releases of PETSc differ in what numbers they refuse.
TOLERANCES: dict[str, tuple[str, Callable[[float], bool]]] = {
    "ksp_rtol": ("a number >= 0 and below 1", lambda x: 0.0 <= x < 1.0),
    "ksp_atol": ("a finite number >= 0", lambda x: 0.0 <= x < math.inf),
}


def _refuse_for_petsc(database: Mapping[str, str], form: str, compare: ccp.Comparison) -> None:
    """OptionError for options of the KSPs that PETSc refuses or does not know. PETSc itself would complain only at the
    first Newton system, or never."""
    comm = compare.comm
    given = {n: spelt for n, spelt in solver_options(database).items() if n.startswith(("ksp_", "pc_"))}
    for name, (allowed, holds) in TOLERANCES.items():
        if name not in given:
            continue
        spelt = given[name]
        try:
            value = float(database[spelt] or "nan")
        except ValueError:
            continue  # PETSc says what is no number
        if not holds(value):
            raise OptionError(f"{f'-{spelt} {database[spelt] or str()}'.rstrip()}: allowed is {allowed}")
    ksps = []
    later = INCOMPLETE if form == "contact" and "pc_type" not in given else {}
    try:
        with unmarked(), taken_over(database):
            for defaults in (DEFAULTS[form], DEFAULTS[form] | later):
                ksps.append(PETSc.KSP().create(comm))
                ksps[-1].setOptionsPrefix(OWN)
                options, origins = to_enter(OWN, defaults, comm.size)
                with entered(options), own_errors():
                    ksps[-1].setFromOptions()
            moved = set(origins.values())
            refuse_misspelt({n: spelt for n, spelt in given.items() if OWN + n not in moved})
            given = {n: spelt for n, spelt in solver_options(database).items() if n.startswith("compare_")}
            compare.make_all()
    except OptionError:  # also from a preconditioner of ours
        raise
    except Exception as error:  # PETSc's own, and whatever importing a -pc_python_type raises
        reason = str(error).splitlines()[-1]
        reason = reason.partition("] ")[2] or reason
        listed = ", ".join(f"-{spelt} {database[spelt] or ''}".strip() for spelt in given.values())
        raise OptionError(f"{listed}: PETSc refuses: {reason}") from None
    finally:
        compare.destroy()
        for ksp in ksps:
            ksp.destroy()


def _refuse_places(run: Run, comm: MPI.Comm) -> None:
    """OptionError for files that are not there, and for folders in which the run cannot write, or which hold another
    run that it neither continues nor has ``-overwrite`` for."""
    for name, path in {"-restart": run.restart if run.restart != "settled" else "", "-problem": run.problem}.items():
        if not comm.bcast(not path or os.access(path, os.R_OK) and os.path.isfile(path)):
            raise OptionError(f"{name} {path}: no such file, or not readable")
    if run.settle:
        return
    refuse_unwritable("-output", Path(run.output), comm)
    if run.dump_problem:
        refuse_unwritable("-dump_problem", Path(run.dump_problem), comm)
    restart = run.restart if not run.problem else ""
    if refused := comm.bcast(refusal(Path(run.output), restart, run.overwrite, True)):
        raise OptionError(refused)
