"""The settings of a simulation, and the options of ``python -m pctt.run`` as data; `pctt.run.options` reads them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Optional

from dem.experiment import SCENE_FILE, Experiment, Given, SceneFileError, from_file
from dem.scenes import SCENES
from pctt import ccp
from pctt.options import (
    AT_LEAST_ONE,
    COUNT,
    FRACTION,
    NOT_NEGATIVE,
    POSITIVE,
    OptionError,
    made,
    nearest,
    option,
    refuse_bad,
)

SETTLE_TOL = 1e-3  #: natural residual of the steps that settle a scene

# options of PETSc and of preconditioners in the demo
DEMO_SOLVERS = {
    "pc_type": "python",
    "pc_python_type": "pctt.pc.TensorTrain",
    "compare_ten_pc_tt_rank": "10",
}
# what runs when no option is given
DEMO = {
    "scene": "mixer",
    "scene_n": "4",
    "restart": "settled",
    "steps": "5",
    "compare": "auto:tt,ten:tt,pbjacobi,ilu,none",
    "compare_every": "6",
    "output": "results/demo",
    "overwrite": "true",  # nothing but the demo writes to its folder
    **DEMO_SOLVERS,
}


@dataclasses.dataclass(frozen=True)
class Run:
    """Options without a prefix."""

    scene: str = option("mixer", f"what to simulate: {', '.join(SCENES)}, or a file FILE.py with a scene of your own")
    steps: int = option(5, "time steps to make", check=COUNT)
    dt: Optional[float] = option(None, "time step; none: the scene's own", unit="s", check=POSITIVE)
    delta: Optional[float] = option(
        None, "gap below which a pair of bodies is a contact; none: the scene's own", unit="m", check=NOT_NEGATIVE
    )
    recovery_speed: float = option(
        1.0, "greatest speed at which bodies that overlap are pushed apart", unit="m/s", check=NOT_NEGATIVE
    )
    restart: str = option(
        "",
        "file to start from: checkpoint.h5 of a run; settled: the scene's settled state, made at first use",
    )
    restart_changed_file: bool = option(
        False,
        "let -restart go on from a state that another text of the scene file, or another surface of a tool, made; the "
        "options of the scene must be the same",
    )
    settle: bool = option(False, "make the scene's settled state with APGD, keep it in the cache, and stop")
    settle_delta: float = option(
        0.1,
        "-delta while settling: falling bodies come closer within a step than bodies at rest; the default of scenes "
        "with spheres of 0.1 m, others may have their own",
        unit="m",
        check=NOT_NEGATIVE,
    )
    settle_tol: float = option(SETTLE_TOL, "natural residual of the steps of -settle", check=FRACTION)
    output: str = option("results", "folder for state.h5, records.csv, steps.jsonl, summary.json, checkpoint.h5")
    overwrite: bool = option(
        False, "let the run replace another one in the folder of -output, once its first step is written"
    )
    output_every: int = option(1, "steps between two records in state.h5; 0: none", check=COUNT)
    checkpoint_every: int = option(1, "steps between two checkpoints", check=AT_LEAST_ONE)
    problem: str = option("", "FCLIB file with a cone problem to solve instead of a scene")
    problem_guess: bool = option(True, "start -problem from the guess in the file, if there is one")
    dump_problem: str = option("", "folder for the steps' cone problems as FCLIB files")
    dump_steps: str = option("", "steps that -dump_problem writes, with commas between; none: every step")
    dump_hard: int = option(
        5, "how many cone problems that -ccp_type does not solve are written to the folder hard of -output", check=COUNT
    )
    ccp_type: str = option("pdip", "solver of the cone problems", choices=ccp.SOLVERS)
    ccp_newton: str = option(
        "auto", "unknowns of the Newton systems; auto: contact for pdip, body for conic", choices=("auto", *ccp.FORMS)
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
    compare: str = option(
        "",
        "preconditioners TYPE or LABEL:TYPE, with commas between, that each solve the same Newton systems; options of "
        "one have the prefix compare_LABEL_",
    )
    compare_every: int = option(1, "compare on every k-th Newton system", check=AT_LEAST_ONE)
    monitor: int = option(
        1,
        "what to print: 0 the tables at the end; 1 and a line per step; 2 and the accuracy of each step",
        check=("0, 1 or 2", lambda x: 0 <= x <= 2),
    )
    quiet: bool = option(False, "print nothing but errors")

    def compared(self) -> list[str]:
        """The entries of ``compare``."""
        return [entry for entry in self.compare.split(",") if entry]


def _as(group: type, name: str, *default: Any) -> Any:
    """A field with the meaning, unit and check of an option, and another default if one is given."""
    (of,) = (field for field in dataclasses.fields(group) if field.name == name)
    return dataclasses.field(default=default[0] if default else of.default, metadata=of.metadata)


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a simulation makes its steps. The program's options of the same meaning are in parentheses."""

    dt: float = _as(Run, "dt")  #: time step; None: the scene's own [s] (``-dt``)
    delta: float = _as(Run, "delta")  #: gap below which a pair is a contact; None: the scene's own [m] (``-delta``)
    solver: str = _as(Run, "ccp_type", "auto")  #: method of ``pctt.ccp.SOLVERS`` (``-ccp_type``, with another default)
    tol: float = _as(ccp.Limits, "tol")  #: residual at which a step counts as solved (``-ccp_tol``)
    max_it: int = _as(ccp.Limits, "max_it")  #: iterations before the solver gives up; -1: its own (``-ccp_max_it``)
    closing_work: float = _as(ccp.Limits, "closing_work")  #: the same of the closing work (``-ccp_closing_work``)
    fallback: bool = _as(ccp.Limits, "fallback")  #: another solver goes on where it does not (``-ccp_fallback``)
    #: options of the solver, an instance of its class or a dict of its fields (``-ccp_apgd_...``); None: the defaults
    options: Any = None
    #: Coulomb's law or its relaxation, or a `pctt.ccp.Coulomb`; None: the law where it costs little (``-ccp_coulomb``)
    coulomb: Any = _as(Run, "ccp_coulomb")
    newton: str = _as(Run, "ccp_newton")  #: unknowns of the Newton systems (``-ccp_newton``)
    recovery_speed: float = _as(Run, "recovery_speed")  #: that pushes overlaps apart [m/s] (``-recovery_speed``)
    compliance: Optional[float] = _as(Run, "ccp_compliance")  #: of the contacts (``-ccp_compliance``)

    @property
    def limits(self) -> ccp.Limits:
        """When the solver stops."""
        return ccp.Limits(self.tol, self.max_it, self.closing_work, self.fallback)

    def of(self, scene: Experiment) -> Settings:
        """The same, with what a scene and a solver have of their own where nothing is given; then ``options`` is an
        instance, and ``coulomb`` one or False. OptionError for a bad value."""
        refuse_bad(self)
        kind, options, coulomb = ccp.SOLVERS[self.solver].options, self.options, self.coulomb
        if options is None or isinstance(options, Mapping):
            options = made(kind, options or {})
        if not isinstance(options, kind):
            raise OptionError(f"options {options!r}: allowed for {self.solver} is a dict or a {kind.__name__}")
        refuse_bad(options)
        if not isinstance(coulomb, (bool, ccp.Coulomb, type(None))):
            raise OptionError(f"coulomb {coulomb!r}: allowed is true, false or a Coulomb")
        if not isinstance(coulomb, ccp.Coulomb):
            coulomb = obeys_coulomb(coulomb, self.solver, self.tol) and ccp.Coulomb()
        refuse_bad(coulomb or ccp.Coulomb())
        dt, delta = (scene.dt if self.dt is None else self.dt, scene.delta if self.delta is None else self.delta)
        whole = dataclasses.replace(self, dt=dt, delta=delta, options=options, coulomb=coulomb)
        refuse_bad(whole)
        return whole


def obeys_coulomb(asked: bool | None, solver: str, tol: float) -> bool:
    """Whether steps obey Coulomb's law: as asked, or where that costs about the same."""
    return tol >= ccp.SOLVERS[solver].law_tol if asked is None else asked


@dataclasses.dataclass(frozen=True)
class Options:
    """Everything that a run of the program needs to know, with the scene's own values filled in; ``scene`` is an
    instance of a class of ``dem.scenes.SCENES`` or of the user's class."""

    run: Run
    scene: Any
    settings: Settings
    demo: bool



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


def scene_name(scene: Experiment) -> str:
    """How results name a scene: as the program does, a file of the user's without folder and suffix."""
    kind = type(scene)
    names = [name for name, known in SCENES.items() if known is kind]
    if isinstance(scene, Given):
        return "scene"
    return names[0] if names else kind.__module__.removeprefix(SCENE_FILE) if scene.digest else kind.__name__
