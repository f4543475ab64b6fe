"""The options of ``python -m pctt.run`` as data; `pctt.run.options` reads and checks them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Optional

from dem.experiment import Experiment, SceneFileError, from_file
from dem.scenes import SCENES
from pctt import ccp
from pctt.options import AT_LEAST_ONE, COUNT, FRACTION, NOT_NEGATIVE, POSITIVE, OptionError, nearest, option

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
    settle_tol: float = option(1e-3, "natural residual of the steps of -settle", check=FRACTION)
    output: str = option("results", "folder for state.h5, records.csv, steps.jsonl, summary.json, checkpoint.h5")
    overwrite: bool = option(
        False, "let the run replace another one in the folder of -output, once its first step is written"
    )
    output_every: int = option(1, "steps between two records in state.h5; 0: none", check=COUNT)
    checkpoint_every: int = option(1, "steps between two checkpoints", check=AT_LEAST_ONE)
    problem: str = option("", "FCLIB, PETSc binary or Siconos file with a cone problem to solve instead of a scene")
    problem_guess: bool = option(True, "start -problem from the guess in the file, if there is one")
    dump_problem: str = option("", "folder for the steps' cone problems as FCLIB and PETSc binary files")
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

    ``scene`` is an instance of a class of ``dem.scenes.SCENES`` or of the user's class, ``solver`` one of the options
    class of ``ccp_type``. ``coulomb`` is None if the steps obey the relaxation.
    """

    run: Run
    scene: Any
    dt: float
    delta: float
    limits: ccp.Limits
    solver: Any
    coulomb: ccp.Coulomb | None
    demo: bool

    def compare_names(self) -> list[str]:
        return [name for name in self.run.compare.split(",") if name]


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
