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
from pathlib import Path
from typing import Any

import numpy as np
from petsc4py import PETSc

from dem import bodies, quaternion
from dem.experiment import Experiment
from dem.free_motion import free_directions
from dem.system import ContactSystem
from dem.world import World
from pctt import ccp
from pctt.blocks import BlockRows, block_csr_matrix, block_matrix
from pctt.ccp import fclib
from pctt.ccp.cone import Array
from pctt.disk import FileError
from pctt.exchange import offsets
from pctt.folder import HARD, Place
from pctt.run.settings import Settings, scene_name


class Dump:
    """Writes the cone problems of a simulation's steps: the ``hard`` first that its solver does not solve, and to
    ``folder``, if there is one, all."""

    def __init__(
        self, settings: Settings, experiment: Experiment, world: World, place: Place,
        hard: int, folder: str = "",
    ):  # fmt: skip
        self._settings, self._experiment, self._world, self._place = settings, experiment, world, place
        self._hard_left, self._folder = hard, folder

    def step(
        self, system: ContactSystem, problem: ccp.ConeProblem, guess: Array, result: ccp.Result, asked: ccp.Result
    ) -> dict[str, Any]:
        """Write the problem of the present step, before the bodies move, if the options say so; collective.

        ``asked`` is the result of the solver that the user chose, ``result`` the one that the step uses. Returns the
        entries for the step's figures. FileError if a file cannot be written.
        """
        number = self._world.step + 1
        hard = not asked.converged and self._hard_left > 0
        files: dict[str, Any] = {"dumped": [], "hard_problem": ""}

        def write(path: Path) -> None:
            try:
                self._write(path, system, problem, guess, result, asked)
            except OSError as error:  # raised on all ranks alike
                raise FileError(str(error)) from None

        if problem.size and self._folder:
            path = Path(self._folder) / f"step{number:06d}_{problem.size}contacts.h5"
            write(path)
            files["dumped"] = [str(path)]
        if problem.size and hard:
            self._hard_left -= 1
            name = f"step{number:06d}_{problem.size}contacts_{asked.iterations}its.h5"
            self._place.make(HARD)
            write(self._place.now / HARD / name)
            files["hard_problem"] = str(self._place.folder / HARD / name)
        return files

    def _write(
        self,
        path: Path,
        system: ContactSystem,
        problem: ccp.ConeProblem,
        guess: Array,
        result: ccp.Result,
        asked: ccp.Result,
    ) -> None:
        """The global problem, the guess if there is one, and the solution if the step has one."""
        dynamic, M = _mass(self._world)
        H = _map(system, self._world, dynamic)
        v_free = M.createVecLeft()
        v_free.array = system.free_velocity[dynamic].ravel()
        f, moved = M.createVecLeft(), H.createVecRight()
        M.mult(v_free, f)
        H.multTranspose(v_free, moved)
        w = problem.r - moved.array.reshape(-1, 3)

        def state(g: Array) -> fclib.Solution:
            return fclib.Solution(g, problem.product(g) + problem.r, system.velocity(g)[dynamic].ravel())

        fclib.write_global(
            path, M, H, f.array, w, problem.mu,
            info=self._info(problem, result, asked),
            solution=state(result.impulse) if result.converged else None,
            guess=state(guess) if problem.norm(guess) > 0 else None,
            point=system.point,
            compliance=problem.softness,
        )  # fmt: skip
        for petsc_object in (M, H, v_free, f, moved):
            petsc_object.destroy()

    def _info(self, problem: ccp.ConeProblem, result: ccp.Result, asked: ccp.Result) -> fclib.Info:
        settings, world, scene = self._settings, self._world, self._experiment
        stored = f"The solution has natural residual {result.residual:.3g}." if result.converged else ""
        return fclib.Info(
            f"{scene_name(scene)}, step {world.step + 1}",
            f"{problem.size} contacts of {scene!r}, from time {world.time:g} s over {settings.dt:g} s. "
            f"{settings.solver} with -ccp_tol {settings.tol:g}: {asked.reason}, {asked.iterations} iterations, "
            f"natural residual {asked.residual:.3g}. {stored}",
            "Solution and guess are those of Coulomb's law (mu |u_t| is added to the normal velocity)."
            if settings.coulomb
            else "Solution and guess are those of the convex cone problem, min 1/2 r'Wr + q'r over the friction cones "
            "(no mu |u_t| in the normal velocity). W is positive semidefinite; r need not be unique, u is.",
        )


def _mass(world: World) -> tuple[np.ndarray, PETSc.Mat]:
    """Mask of the bodies of this rank's rows that are dynamic, and the mass matrix (6 n x 6 n) of those."""
    last = world.comm.rank == world.comm.size - 1
    parts = [world.grains, world.large] if last else [world.grains]
    owned = bodies.concatenate(parts)
    dynamic = bodies.is_dynamic(owned)
    owned = owned.take(dynamic)
    owned = replace(owned, inertia=np.where(np.isfinite(owned.inertia), owned.inertia, 1.0))
    blocks = np.zeros((len(owned), 6, 6))
    blocks[:, range(3), range(3)] = owned.mass[:, None]
    blocks[:, 3:, 3:] = np.linalg.inv(bodies.inverse_inertia(owned))
    alike = np.ptp(owned.inertia, axis=1) == 0  # exactly diagonal, as for spheres
    blocks[alike, 3:, 3:] = owned.inertia[alike, :, None] * np.eye(3)
    count, first = len(owned), offsets(world.comm, len(owned))[world.comm.rank]
    bodies_here = first + np.arange(count)
    return dynamic, block_csr_matrix(world.comm, 6 * count, 6 * count, np.arange(count + 1), bodies_here, blocks)


def _map(system: ContactSystem, world: World, dynamic: np.ndarray) -> PETSc.Mat:
    """D (6 n x 3 nc) of the dynamic bodies alone; guided bodies have only the part along their guides. Collective."""
    body, blocks = system.blocks()
    grains = world.slabs[-1]
    large = body >= grains
    row = body[large] - grains
    blocks[large, :, :3] = blocks[large, :, :3] @ free_directions(world.large_bodies)[row]
    axes = quaternion.matrix(world.large.quaternion)
    turns = np.isfinite(world.large.inertia)  # about which of its axes a body does
    blocks[large, :, 3:] = blocks[large, :, 3:] @ ((axes * turns[:, None, :]) @ axes.transpose(0, 2, 1))[row]
    moves = np.concatenate([np.ones(grains, dtype=bool), bodies.is_dynamic(world.large)])
    kept = moves[body]
    indptr = np.concatenate([[0], np.cumsum(kept.sum(axis=1))])
    rows = BlockRows(indptr, (np.cumsum(moves) - 1)[body][kept], blocks[kept], int(dynamic.sum()))
    transposed = block_matrix(world.comm, rows)  # a row of D' has all its entries here
    H = transposed.transpose(PETSc.Mat())
    transposed.destroy()
    return H
