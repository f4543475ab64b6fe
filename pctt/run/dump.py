"""Cone problems of steps, written to files: those of ``-dump_problem``, and, without being asked, those that the solver
failed on.

FCLIB files hold the global problem, M v = H r + f, u = H'v + w, because it says more than W does and takes
less room (W of a packing has four times the nonzeros of H), and W follows from it. Bodies of prescribed
motion have no rows: their velocity is part of w. With v_free the velocities without contacts,

    f = M v_free,    H = D,    w = r - H' v_free    (gap/dt, and what the prescribed bodies move).

A guided body has only the part of D along its guide. Nothing turns it, so its moments in M are arbitrary.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from dem.contact_map import ContactMap, root_blocks
from dem.contact_map.rows import packed
from dem.exchange import offsets
from dem.experiment import Experiment
from dem.model.world import World
from dem.parts.contact_law import ContactLaw
from dem.parts.ends import Constraint
from dem.scene import kinds_of
from dem.step.system import ContactSystem
from pctt import ccp
from pctt.arrays import Array
from pctt.ccp import fclib
from pctt.disk import FileError
from pctt.folder import HARD
from pctt.options import OptionError
from pctt.petsc import warn
from pctt.run.output import Place
from pctt.run.settings import Settings, scene_name


class Dump:
    """Writes the cone problems of a simulation's steps: the ``hard`` first that its solver does not solve, and to
    ``folder``, if there is one, all. The first rank gathers and writes them."""

    most = 500_000  #: contacts of a hard problem that is written unasked: 684 bytes each on the first rank

    def __init__(
        self, settings: Settings, experiment: Experiment, world: World, place: Place,
        hard: int, folder: str = "",
    ):  # fmt: skip
        self._settings, self._experiment, self._world, self._place = settings, experiment, world, place
        self._hard_left, self._folder = hard, folder
        self._none = unwritten(world.pairs, world.named, world.cell.deforms)
        if folder and self._none:
            raise OptionError(f"problems {folder}: {self._none}")

    def step(
        self, system: ContactSystem, problem: ccp.ConeProblem, guess: Array, result: ccp.Result, asked: ccp.Result
    ) -> dict[str, Any]:
        """Write the problem of the present step, before the bodies move, if the options say so; collective.

        ``asked`` is the result of the solver that the user chose, ``result`` the one that the step uses. Returns the
        entries for the step's figures. FileError if a file cannot be written.
        """
        files: dict[str, Any] = {"dumped": [], "hard_problem": ""}
        number, write = self._world.step + 1, partial(self._write, system, problem, guess, result, asked)
        if self._none:
            if self._hard_left and not asked.converged:
                self._hard_left = 0
                warn(self._world.comm, f"step {number} is not solved, and its problem is not written: {self._none}")
            return files
        if not problem.size:
            return files
        name = f"step{number:06d}_{problem.size}contacts"
        if self._folder:
            files["dumped"] = [str(write(Path(self._folder) / f"{name}.h5"))]
        if asked.converged or not self._hard_left:
            return files
        if problem.size > self.most:
            self._hard_left = 0
            words = f"step {number} is not solved, and its {problem.size} contacts are more than are written unasked"
            keep = "unless the run keeps all problems (-dump_problem FOLDER, in Python problems=FOLDER)"
            warn(self._world.comm, f"{words}; allowed are {self.most}, {keep}")
        else:
            self._hard_left -= 1
            self._place.make(HARD)
            path = write(self._place.now / HARD / f"{name}_{asked.iterations}its.h5")
            files["hard_problem"] = str(self._place.folder / HARD / path.name)
        return files

    def _write(
        self, system: ContactSystem, problem: ccp.ConeProblem, guess: Array, result: ccp.Result, asked: ccp.Result,
        path: Path,
    ) -> Path:  # fmt: skip
        """The global problem, the guess if there is one, and the solution if the step has one; the path."""
        dynamic, masses, D = masses_and_map(system)
        v_free = system.free_velocity[dynamic]
        f = np.einsum("bij,bj->bi", masses, v_free).ravel()
        rows, bodies = D.block_rows, offsets(D.comm, D.columns)
        own = bodies[D.comm.rank] + np.arange(D.columns)
        width = 6 * bodies[-1]
        M = sp.bsr_matrix((masses, own, np.arange(D.columns + 1)), shape=(6 * D.columns, width))
        Ht = sp.bsr_matrix((rows.blocks, rows.indices, rows.indptr), shape=(3 * D.rows, width))

        def state(g: Array) -> fclib.Solution:
            return fclib.Solution(g, problem.product(g) + problem.r, system.velocity(g)[dynamic].ravel())

        settings = self._settings
        stored = f"The solution has natural residual {result.residual:.3g}." if result.converged else ""
        info = fclib.Info(
            f"{scene_name(self._experiment)}, step {self._world.step + 1}",
            f"{problem.size} contacts of {self._experiment!r}, from time {self._world.time:g} s over "
            f"{settings.dt:g} s. {settings.solver} with tol {settings.tol:g}: {asked.reason}, "
            f"{asked.iterations} iterations, natural residual {asked.residual:.3g}. {stored}",
            "Solution and guess are those of Coulomb's law (mu |u_t| is added to the normal velocity)."
            if settings.law == ccp.COULOMB
            else "Solution and guess are those of the convex cone problem, min 1/2 r'Wr + q'r over the friction cones "
            "(no mu |u_t| in the normal velocity). W is positive semidefinite; r need not be unique, u is.",
        )
        try:
            fclib.write_global(
                path, D.comm, M, Ht, f, problem.r - D.velocities(v_free), problem.mu,
                info=info,
                solution=state(result.impulse) if result.converged else None,
                guess=state(guess) if problem.norm(guess) > 0 else None,
                point=system.point,
                compliance=problem.compliance[:, :2] if problem.yields else None,
            )  # fmt: skip
        except OSError as error:  # raised on all ranks alike
            raise FileError(str(error)) from None
        return path


def unwritten(pairs: ContactLaw, named: dict[str, dict[str, Any]], deforms: bool) -> str:
    """Why problems of a scene with these pairs and parts, or whose cell `deforms`, cannot be written, in words; "" if
    they can."""
    if pairs.resists:  # FCLIB's files have a format of their own for these
        return "files have no rolling and spinning; allowed are scenes without them"
    if deforms:
        return "files have no cells that deform; allowed are scenes without them"
    kinds = [kind for kind, *_ in kinds_of(Constraint, named)]
    return f"files have no {kinds[0]}s; allowed are scenes without them" if kinds else ""


def masses_and_map(system: ContactSystem) -> tuple[np.ndarray, Array, ContactMap]:
    """Mask of this rank's bodies that are dynamic, the mass matrices (n, 6, 6) of these, and the map of their
    velocities to those of the contacts: D', with the part along the guide or about the hinge of a body. Collective.

    M^-1/2 of the step says it all: a body does not move where that is zero. There its mass is arbitrary.
    """
    step = system.contact_map
    value, vector = np.linalg.eigh(root_blocks(step.source.root))
    largest = value.max(axis=-1, keepdims=True, initial=0.0)
    moves = value > 1e-9 * np.maximum(largest, np.finfo(float).tiny)
    turned = vector.swapaxes(-1, -2)
    free = packed((vector * moves[..., None, :]) @ turned)
    dynamic = moves.any(axis=(1, 2))
    inverse = np.where(moves, value, np.where(largest > 0, largest, 1.0))
    both = (vector / inverse[..., None, :] ** 2) @ turned
    masses = np.zeros((len(both), 6, 6))
    masses[:, :3, :3], masses[:, 3:, 3:] = both[:, 0], both[:, 1]
    count = int(dynamic.sum())
    number = np.full(step.halo.rows, -1)
    number[: len(dynamic)][dynamic] = offsets(step.comm, count)[step.comm.rank] + np.arange(count)
    step.halo.update(number)
    rows = replace(step.source, body=number[step.body], root=free[dynamic], columns=count)
    return dynamic, masses[dynamic], ContactMap(step.comm, rows)
