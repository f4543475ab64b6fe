"""Compiles the loops of common scenes for this processor, ahead of their first step: ``python -m pctt.compile``.

Scenes make a few steps, and their machine code stays on disk, where `dem.machine_code` finds it; what is there already
is not compiled again. What other scenes need is compiled at their first step.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from pctt import (
    Block,
    Box,
    Clump,
    Dynamic,
    Experiment,
    Hinged,
    Mesh,
    Plane,
    Rotation,
    Scene,
    Simulation,
    Superellipsoid,
)
from pctt.scenes import Mixer, PlaneShear

CORNERS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])  # of a tetrahedron
FACES = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
DENSITY = 2500.0  # [kg/m^3]


def places(*heights: float) -> np.ndarray:
    """Four places at each of these heights (n, 3) [m]."""
    return np.array([[x, y, z] for z in heights for x in (-0.125, 0.125) for y in (-0.103, 0.103)])


def scene_with(**law: Any) -> Scene:
    """A floor, a wall, a paddle that turns, a door on its hinge, and a lid that falls on what is added."""
    scene = Scene(friction=0.5, **law)
    scene.add_body("walls", [Plane((0, 0, 1)), Plane((1, 0, 0), center=(-0.23, 0, 0))])
    scene.add_body("paddle", [Box((0.02, 0.2, 0.05))], Rotation((0, 0, 1.0)), position=(0, 0, 0.06))
    scene.add_body("door", [Box((0.02, 0.2, 0.2))], Hinged((0, 0, 1)), position=(0.25, 0, 0.3), density=500.0)
    scene.add_body("lid", [Box((0.2, 0.2, 0.02))], Dynamic(), position=(0, 0, 0.941), density=500.0)
    return scene


def run(scene: Scene | Experiment, **settings: Any) -> None:
    """Make steps of a scene; its files are thrown away."""
    with tempfile.TemporaryDirectory() as folder:
        sim = Simulation(scene, **settings)
        sim.write(Path(folder) / "run")
        sim.run(steps=3)


def cube(count: int) -> Scene:
    """Spheres that touch, so many along each side."""
    scene = Scene(friction=0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres(0.1 + 0.2 * np.indices((count,) * 3).reshape(3, -1).T, 0.1, DENSITY)
    return scene


def spheres() -> None:
    run(Mixer(n=2))
    run(cube(6))  # contacts enough for single precision
    for law in {}, {"restitution": 0.5, "rolling": 0.01}, {"spinning": 0.01}, {"cohesion": 9.0, "cohesion_range": 1e-3}:
        scene = scene_with(**law)
        scene.add_spheres(places(0.103, 0.306), 0.1, DENSITY)
        run(scene)


def interior_points() -> None:
    for count in 2, 6:  # few contacts have solvers of their own
        for settings in {"solver": "conic"}, {"solver": "conic", "law": "relaxation"}, {"solver": "pdip"}:
            run(cube(count), **settings)


def parts() -> None:
    scene = scene_with()
    scene.add_body("rock", [Mesh(0.1 * CORNERS, FACES)], position=(0.6, 0, 0.05))
    scene.add_spheres([[0, 0, 0.3], [0.6, 0, 0.25]], 0.1, DENSITY)
    scene.add_source("rain", Block((-0.2, -0.2, 1.2), (0.2, 0.2, 1.6)), number_rate=100.0, radius=0.05, density=DENSITY)
    scene.add_joint("arm", "lid", anchor=(0, 0, 0.941))
    scene.add_spring("spring", 0, stiffness=100.0)
    run(scene)
    run(PlaneShear(n=6))


def shapes() -> None:
    scene = scene_with()
    scene.add_boxes(places(0.103, 0.306), (0.1, 0.1, 0.1), DENSITY)
    scene.add_capsules(places(0.489), 0.05, 0.03, DENSITY)
    scene.add_polyhedra(places(0.642), 0.07 * CORNERS, DENSITY)
    scene.add_grains(places(0.765), Superellipsoid((0.1, 0.1, 0.05)), DENSITY)
    scene.add_clumps(places(0.868), Clump([[-0.05, 0, 0], [0.05, 0, 0]], [0.05, 0.05]), DENSITY)
    run(scene)


KINDS: dict[str, Callable[[], None]] = {
    "boxes, capsules, polyhedra, superellipsoids and clumps": shapes,
    "spheres and the laws of contact": spheres,
    "interior points": interior_points,
    "sources, joints, springs, meshes and cells": parts,
}


def main() -> None:
    argparse.ArgumentParser(prog="python -m pctt.compile", description=__doc__.partition("\n")[0]).parse_args()
    began = time.perf_counter()
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:  # each process has an MPI of its own
        running = {pool.submit(kind): name for name, kind in KINDS.items()}
        for done in as_completed(running):
            done.result()
            print(f"{time.perf_counter() - began:5.1f} s: {running[done]}", flush=True)


if __name__ == "__main__":
    main()
