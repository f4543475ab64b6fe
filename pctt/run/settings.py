"""The settings of a simulation, and the options of ``python -m pctt.run`` as data; `pctt.run.options` reads them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from numbers import Real
from operator import attrgetter
from pathlib import Path
from typing import Any, Optional

import numpy as np
from mpi4py import MPI

from dem.experiment import SCENE_FILE, Experiment, SceneExperiment, SceneFileError, from_file
from dem.scene import Scene
from dem.start import time_step
from dem.together import first_differing_rank
from pctt import ccp
from pctt.ccp.registry import why_idle, why_refused
from pctt.options import (
    AT_LEAST_ONE,
    COUNT,
    FRACTION,
    NOT_NEGATIVE,
    POSITIVE,
    OptionError,
    instance,
    nearest,
    number,
    option,
    refuse_bad,
    word_or_number,
)
from pctt.scenes import SCENES

#: By how much a contact may close in a step beyond what its spring gives, as a part of the contact distance.
CLOSING = 0.15
RELAX = "relax"  #: a value of the option -overlap


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
    "scene_torque": "60000",  # N m, half more than the mean: a stronger drive jams between rigid grains and a wall
    "ccp_type": "pdip",
    "restart": "settled",
    "steps": "5",
    "dt": "0.025",
    "ccp_tol": "1e-4",
    "compare": "bic,pbjacobi,auto:tt,ten:tt,ilu,none",
    "compare_every": "6",
    "output": "results/demo",
    "overwrite": "true",  # nothing but the demo writes to its folder
    **DEMO_SOLVERS,
}


_LIMITS = attrgetter(*(field.name for field in dataclasses.fields(ccp.Limits)))


@dataclasses.dataclass(frozen=True)
class Settings(ccp.Limits):
    """How a simulation makes its steps; options of the program, but for ``options`` and ``settle_tol``. The limits of
    the solver, ``tol``, ``max_it`` and ``closing_work``, are those of `pctt.ccp.Limits`."""

    solver: str = option(
        "auto", "solver of the cone problems; -compare or options of linear solvers alone take pdip",
        choices=ccp.SOLVERS, name="ccp_type",
    )  # fmt: skip
    newton: str = option(
        "auto", "unknowns of the Newton systems, kkt for pdip alone; auto: contact for pdip, body for conic",
        choices=("auto", *ccp.FORMS),
    )
    law: str = option(
        "",
        "Coulomb's law, or its relaxation by the cone problem, where what slides opens (docs/ccp.md); none: coulomb, "
        "but relaxation with pdip, -compare and -problem",
        choices=ccp.LAWS, name="law",
    )  # fmt: skip
    tol: float = option(5e-4, "natural residual at which a cone problem counts as solved", check=FRACTION)
    closing_work: float = option(
        0.5, "closing and opening work at which a cone problem counts as solved; inf: any",
        check=("a positive number, or inf", lambda x: x > 0),
    )  # fmt: skip
    closing_speed: float = option(
        None,
        "speed at which a contact may still close where a cone problem counts as solved; inf: any; none: 0.15 "
        "-delta in a step, and inf where -ccp_closing_work is inf, with pdip, in comparisons and in -problem",
        unit="m/s", check=("a positive number, or inf", lambda x: x > 0),
    )  # fmt: skip
    dt: float = option(
        None, "time step; none: the scene's own, or what its sizes and speeds need", unit="s", check=POSITIVE, name="dt"
    )
    delta: float = option(
        None, "gap below which a pair of bodies is a contact; none: the scene's own, or 0.05 of the smallest radius",
        unit="m", check=NOT_NEGATIVE, name="delta",
    )  # fmt: skip
    stiffness: Optional[float] = option(
        None,
        "stiffness of all contacts; inf: rigid; none: what the scene states, else rigid with pdip and in comparisons, "
        "and with other solvers what overlaps of 0.3 % of a radius need",
        unit="N/m", check=("a positive number, or inf", lambda x: x > 0), name="stiffness",
    )  # fmt: skip
    recovery_speed: float = option(
        1.0, "greatest speed at which rigid bodies that overlap are pushed apart", unit="m/s", check=NOT_NEGATIVE,
        name="recovery_speed",
    )  # fmt: skip
    overlap: str = option(
        "0.01",
        "greatest overlap of bodies at the start, over half the thickness of the thinner one; relax: any, and they are "
        "pushed apart before the first step, without a speed",
        check=("a number >= 0, or relax", word_or_number(RELAX, NOT_NEGATIVE[1])),
        name="overlap",
    )
    options: Any = number(None, "options of the solver, an instance of its class or a dict of its fields")
    settle_tol: float = number(1e-3, "tol of settling; its last tenth has a tenth of it and mends the overlaps")

    def __post_init__(self) -> None:
        object.__setattr__(self, "overlap", str(self.overlap))  # a number is one, too

    @property
    def limits(self) -> ccp.Limits:
        """When the solver stops."""
        limits = ccp.Limits(*_LIMITS(self))
        return limits if limits.closing_speed is not None else dataclasses.replace(limits, closing_speed=math.inf)

    @property
    def words(self) -> str:
        """How steps are solved: the method, its tolerance and the law of contact."""
        law = "Coulomb's law" if self.law == ccp.COULOMB else "relaxation of Coulomb's law"
        return f"{self.solver} to {self.tol:g}, {law}"

    def law_for(self, relaxed: bool = False) -> str:
        """The law that is asked for; else the relaxation with `pdip`, and where the run is ``relaxed`` by its kind, as
        comparisons are."""
        return self.law or (ccp.RELAXATION if relaxed or self.solver == "pdip" else ccp.COULOMB)

    @property
    def facts(self) -> tuple[dict[str, str], dict[str, float]]:
        """What has to be alike on all ranks: words, or what else has no rounding, and numbers, by name."""
        given = {name: value for name, value in vars(self).items() if not callable(value)}
        numbers = {name: float(value) for name, value in given.items() if isinstance(value, Real)}
        return {name: repr(value) for name, value in given.items() if name not in numbers}, numbers

    def completed_for(self, scene: Experiment, relaxed: bool = False) -> Settings:
        """The same, with what a scene and a solver have of their own where nothing is given; then ``options`` is an
        instance. The law is that of `law_for`. OptionError for a bad value."""
        refuse_bad(self)
        law = self.law_for(relaxed)
        if why := why_idle(self.solver, self.newton, law):
            raise OptionError(f"newton {self.newton}: {why}")
        options: Any = instance(ccp.SOLVERS[self.solver].options, "options", self.options, f" for {self.solver}")
        dt, delta = (scene.dt if self.dt is None else self.dt, scene.delta if self.delta is None else self.delta)
        whole = dataclasses.replace(self, dt=dt, delta=delta, options=options, law=law)
        refuse_bad(whole)
        return whole

    def fitted(self, scene: Scene, relaxed: bool = False) -> Settings:
        """The same, with the time step and the contact distance that a built scene needs where none is given, and with
        rigid contacts in the paper's model, unless a stiffness is stated."""
        paper = (relaxed or self.solver == "pdip") and self.stiffness is None and not scene.states_stiffness
        stiffness = math.inf if paper else self.stiffness
        dt = time_step.recommended(scene) if self.dt is None else self.dt
        delta = time_step.contact_distance(scene) if self.delta is None else self.delta
        pairs = scene.pairs(np.inf)
        resists, friction = pairs.resists, float(np.maximum(pairs.friction, pairs.static_friction).max())
        if self.law == ccp.COULOMB and (steep := ccp.why_steep(friction, self.tol)):
            raise OptionError(f"friction {steep}")
        if why := why_refused(self.solver, ccp.RollingCones if resists else ccp.FrictionCones):
            raise OptionError(f"solver {self.solver}: the scene has {why}")
        if resists and self.newton == "contact":
            raise OptionError("newton contact: the scene has rolling or spinning resistance; allowed is body")
        if delta < scene.reach:
            allowed = f"bodies attract each other up to {scene.reach:g} m; allowed is at least that"
            raise OptionError(f"delta {delta:g} m: {allowed}")
        speed = self.closing_speed
        if speed is None:
            speed = math.inf if paper or delta == 0.0 or math.isinf(self.closing_work) else CLOSING * delta / dt
        return dataclasses.replace(self, dt=dt, delta=delta, stiffness=stiffness, closing_speed=speed)


def refuse_unlike(settings: Settings, comm: MPI.Comm) -> None:
    """OptionError on all ranks if one has other settings than the first; collective."""
    words, numbers = settings.facts
    if other := first_differing_rank(comm, repr(words) + repr(list(numbers)), [np.array(x) for x in numbers.values()]):
        first, its = (comm.bcast({**words, **numbers}, rank) for rank in (0, other))
        name = next(name for name in vars(settings) if first.get(name) != its.get(name))
        given = f"{name} {its[name]} on rank {other}, and {first[name]} on rank 0"
        raise OptionError(f"{given}; allowed are the same settings on all ranks")


@dataclasses.dataclass(frozen=True)
class Run:
    """What the program simulates or solves, and what it writes."""

    scene: str = option("mixer", f"what to simulate: {', '.join(SCENES)}, or a file FILE.py with a scene of your own")
    steps: int = option(5, "time steps to make", check=COUNT)
    seconds: Optional[float] = option(None, "time to simulate, in place of -steps", unit="s", check=POSITIVE)
    restart: str = option(
        "",
        "file to start from: checkpoint.h5 of a run; settled: the scene's settled state, made at first use",
        check=("the name of a file, or settled", bool),
    )
    settle: bool = option(False, "make the scene's settled state with APGD, keep it in the cache, and stop")
    output: str = option(
        "results", "folder for state.h5, records.csv, steps.jsonl, summary.json, checkpoint.h5",
        check=("the name of a folder", bool),
    )  # fmt: skip
    overwrite: bool = option(
        False, "let the run replace another one in the folder of -output, once its first step is written"
    )
    output_every: int = option(10, "steps between two records in state.h5, and the last one; 0: none", check=COUNT)
    checkpoint_every: int = option(10, "steps between two checkpoints, and one at the end", check=AT_LEAST_ONE)
    checkpoint_minutes: Optional[float] = option(
        None, "time between two checkpoints by the clock, in place of -checkpoint_every", unit="min", check=NOT_NEGATIVE
    )
    problem: str = option(
        "", "FCLIB file with a cone problem to solve instead of a scene", check=("the name of a file", bool)
    )
    dump_problem: str = option(
        "", "folder for the steps' cone problems as FCLIB files", check=("the name of a folder", bool)
    )
    compare: str = option(
        "",
        "preconditioners TYPE or LABEL:TYPE, with commas between, that each solve the same Newton systems; options of "
        "one have the prefix compare_LABEL_",
        check=("one or more of them", lambda text: bool(text.strip(","))),
    )
    compare_every: int = option(1, "compare on every k-th Newton system", check=AT_LEAST_ONE)
    threads: int = option(1, "threads of each rank for the loops of the solver, where ranks have several cores",
                          check=AT_LEAST_ONE)  # fmt: skip
    quiet: bool = option(False, "print nothing but errors")

    def steps_of(self, dt: float) -> int:
        """How many time steps of dt [s] to make."""
        return self.steps if self.seconds is None else math.ceil(self.seconds / dt * (1 - 1e-12))

    def compared(self) -> list[str]:
        """The entries of ``compare``."""
        return [entry for entry in self.compare.split(",") if entry]


@dataclasses.dataclass(frozen=True)
class Options:
    """Everything that a run of the program needs to know, with the scene's own values filled in; ``scene`` is an
    instance of a class of ``pctt.scenes.SCENES`` or of the user's class, ``given`` are the options as typed."""

    run: Run
    scene: Any
    settings: Settings
    demo: bool
    given: Mapping[str, Optional[str]]


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
    if isinstance(scene, SceneExperiment):
        return "scene"
    return names[0] if names else kind.__module__.removeprefix(SCENE_FILE) if scene.digest else kind.__name__
