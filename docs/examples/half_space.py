"""Rough contact of two elastic balls with friction: a half-space of 128 x 128 points, products by FFT::

    python docs/examples/half_space.py 128 half_space.png

A ball is pressed on a plane of the same material and then shifted, once smooth, where Hertz, Cattaneo and Mindlin know
the answer, and once with a self-affine rough surface. (K. L. Johnson, Contact Mechanics, 1985, chapters 3, 4, 7.)
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from scipy import fft

from pctt import ccp

LENGTH, RADIUS, PRESSED = 1e-3, 5e-3, 16e-6  # side of the grid, radius of the ball, its approach [m]
G, NU, FRICTION = 0.4e9, 0.3, 0.3  # shear modulus [Pa], Poisson's ratio
STEPS = 8  # in which the ball is shifted, the last one makes all of it slide


def influence(n: int, a: float, coupled: bool = False) -> np.ndarray:
    """Displacements (3, 3, 2n, 2n) of a half-space by unit forces that are spread evenly on squares of side a: of a
    point from the square that lies i, j squares before it, negative ones wrapped. The axes are the normal and both
    tangents.

    Love 1929 has them for pressure (Boussinesq) as sums over the corners of a square, and so are those for shear
    (Cerruti; Johnson, sections 3.2, 3.6). Two
    bodies of one material have twice the diagonal blocks and no coupling of normal and tangents; ``coupled``: the other
    body is rigid.
    """
    corner = (np.arange(2 * n + 1) - n - 0.5) * a
    x, y = np.meshgrid(corner, corner, indexing="ij")
    along, across = x * np.arcsinh(y / abs(x)), y * np.arcsinh(x / abs(y))  # integrals of y^2 / r^3 and x^2 / r^3
    turn_x = 0.5 * y * np.log(x**2 + y**2) + x * np.arctan(y / x)  # of x / r^2
    turn_y = 0.5 * x * np.log(x**2 + y**2) + y * np.arctan(x / y)
    pair, half = -NU * np.hypot(x, y), (0.5 - NU)  # of x y / r^3
    F = np.array([
        [(1 - NU) * (along + across), half * turn_x, half * turn_y],
        [-half * turn_x, along * (1 - NU) + across, pair],
        [-half * turn_y, pair, along + across * (1 - NU)],
    ]) / (2 * np.pi * G * a**2)  # fmt: skip
    if not coupled:
        F[0, 1:] = F[1:, 0] = 0.0
        F *= 2
    return np.roll(np.diff(np.diff(F, axis=2), axis=3), (-n, -n), (2, 3))


def operator(n: int, K: np.ndarray) -> ccp.Operator:
    """N of n x n points: a convolution with K, which is a product on a grid twice as wide, and its diagonal blocks."""
    transformed, wide = fft.rfft2(K), (2 * n, 2 * n)

    def mult(g: np.ndarray) -> np.ndarray:
        force = fft.rfft2(g.T.reshape(3, n, n), wide)
        return fft.irfft2((transformed * force).sum(axis=1), wide)[:, :n, :n].reshape(3, -1).T

    return ccp.Operator(mult, np.tile(K[:, :, 0, 0], (n * n, 1, 1)))


def points(n: int) -> np.ndarray:
    """Of the grid (n, n, 2), from its middle [m]."""
    x = ((np.arange(n) + 0.5) / n - 0.5) * LENGTH
    return np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1)


def roughness(n: int, rms: float = 1.2e-6, hurst: float = 0.8, longest: float = LENGTH / 6) -> np.ndarray:
    """Heights (n, n) of a self-affine surface [m]: wavelengths from the longest one to six points, the spectrum
    q^-2(1 + H), random phases."""
    q = np.hypot(*np.meshgrid(fft.fftfreq(n, LENGTH / n), fft.fftfreq(n, LENGTH / n), indexing="ij"))
    kept = (q >= 1 / longest) & (q <= n / (6 * LENGTH))
    if not kept.any():
        raise ValueError(f"{n} points along a side: allowed are at least 36, which have waves of a sixth of it")
    size = np.where(kept, np.where(q > 0, q, 1.0) ** -(1 + hurst), 0.0)
    z = fft.ifft2(size * fft.fft2(np.random.default_rng(1).standard_normal((n, n)))).real
    return rms / z.std() * z


class State(NamedTuple):
    """After a step.

    shift : of the ball [m]
    force : (n, n, 3) on the plane [N]
    slip : (n, n, 2) of the plane against the ball, since it was pressed [m]
    zones : (n, n) 0 open, 1 slides, 2 sticks
    iterations : of the solver
    """

    shift: float
    force: np.ndarray
    slip: np.ndarray
    zones: np.ndarray
    iterations: int

    @property
    def totals(self) -> np.ndarray:
        """The forces of all points together, of the normal and both tangents [N]."""
        return self.force.sum(axis=(0, 1))


def press_and_shift(heights: np.ndarray, shifts: np.ndarray, coupled: bool = False, tol: float = 1e-6) -> list[State]:
    """The states of a ball with rough ``heights`` (n, n) that is pressed by PRESSED and then shifted along x, by
    Coulomb's law for the increments of slip."""
    n = len(heights)
    N, mu = operator(n, influence(n, LENGTH / n, coupled)), np.full(n * n, FRICTION)
    gap = (points(n) ** 2).sum(axis=2).ravel() / (2 * RADIUS) - heights.ravel() - PRESSED
    states, slip, guess = [], np.zeros((n * n, 2)), None
    problem = ccp.ConeProblem(MPI.COMM_SELF, np.zeros((n * n, 3)), mu, N=N)
    for shift in shifts:
        problem = problem.with_velocities(np.column_stack([gap, -slip - [shift, 0.0]]))
        result = ccp.solve(problem, guess, limits=ccp.Limits(tol))
        if not result.converged:
            raise RuntimeError(f"shift {shift:g} m: {result.reason}")
        guess, slip = result.impulse, slip + result.velocity[:, 1:]
        found = (each.reshape(n, n, -1).squeeze() for each in (guess, slip, result.states))
        states.append(State(shift, *found, result.iterations))
    return states


class Theory:
    """Two smooth balls of one material: Hertz 1882 for pressing, Cattaneo 1938 and Mindlin 1949 for the shift (Johnson,
    sections 4.2 and 7.2)."""

    radius = np.sqrt(RADIUS * PRESSED)  # of the contact [m]
    normal = 4 / 3 * G / (1 - NU) * np.sqrt(RADIUS) * PRESSED**1.5  # force [N]
    pressure = 1.5 * normal / (np.pi * radius**2)  # in the middle [Pa]
    shift = 3 * FRICTION * normal * (2 - NU) / (8 * G * radius)  # at which all slides [m]

    @classmethod
    def tangential(cls, shift: float) -> float:
        """The tangential force over its limit, friction times normal force."""
        return 1 - max(1 - shift / cls.shift, 0.0) ** 1.5

    @classmethod
    def stick(cls, shift: float) -> float:
        """Radius of the part that sticks over that of the contact."""
        return max(1 - shift / cls.shift, 0.0) ** 0.5

    @classmethod
    def tractions(cls, x: np.ndarray, shift: float) -> tuple[np.ndarray, np.ndarray]:
        """Normal and tangential [Pa] at distances x (p,) from the middle [m]."""

        def ellipse(radius: float) -> np.ndarray:
            return cls.pressure / cls.radius * np.sqrt(np.maximum(radius**2 - x**2, 0.0))

        whole = ellipse(cls.radius)
        return whole, FRICTION * (whole - ellipse(cls.stick(shift) * cls.radius))


def main(n: int, picture: str = "") -> dict[str, list[State]]:
    """Press and shift a smooth and a rough ball, print both beside theory, and draw them."""
    shifts = Theory.shift * np.linspace(0.0, 1.0, STEPS + 1)
    surfaces = {"smooth": np.zeros((n, n)), "rough": roughness(n)}
    runs = {name: press_and_shift(heights, shifts) for name, heights in surfaces.items()}
    print(f"Hertz: force {Theory.normal:.4f} N, contact {np.pi * Theory.radius**2 * 1e6:.4f} mm^2")
    area = (LENGTH / n) ** 2 * 1e6
    for name, states in runs.items():
        first = states[0]
        print(f"{name}: force {first.totals[0]:.4f} N, contact {(first.zones > 0).sum() * area:.4f} mm^2")
        print("shift um  iterations  Q / mu P  (smooth)  radius of stick / contact (smooth)")
        for shift, state in zip(shifts, states):
            share = state.totals[1] / (FRICTION * state.totals[0])
            stick = np.sqrt((state.zones == 2).sum() / (state.zones > 0).sum())
            print(f"{1e6 * shift:8.2f}  {state.iterations:10}  {share:8.4f}  ({Theory.tangential(shift):.4f})"
                  f"  {stick:25.3f}   ({Theory.stick(shift):.3f})")  # fmt: skip
    if picture:
        draw(n, runs, picture)
    return runs


def draw(n: int, runs: dict[str, list[State]], picture: str) -> None:
    """Pressures and zones at half the shift, tractions beside theory, and force over shift."""
    import matplotlib.pyplot as plt
    from matplotlib.colors import ListedColormap

    figure, axes = plt.subplots(2, 3, figsize=(11.5, 6.6))
    side, area, middle = 0.5e3 * LENGTH, (LENGTH / n) ** 2, STEPS // 2
    box = {"extent": (-side, side, -side, side), "origin": "lower"}
    colours = ListedColormap(["white", "sandybrown", "steelblue"])
    for (above, below), (name, states) in zip(axes.T, runs.items()):
        state = states[middle]
        pressure = np.where(state.zones > 0, state.force[..., 0] / area / 1e6, np.nan)
        shown = above.imshow(pressure.T, vmin=0, **box)
        figure.colorbar(shown, ax=above, label="pressure [MPa]")
        above.set_title(f"{name} ball, pressed")
        zones = below.imshow(state.zones.T, cmap=colours, vmin=-0.5, vmax=2.5, **box)
        figure.colorbar(zones, ax=below, ticks=[0, 1, 2]).ax.set_yticklabels(["open", "slides", "sticks"])
        below.set_title(f"{name} ball, half the shift")
    for axis in axes[:, :2].flat:
        axis.set(xlim=(-0.36, 0.36), ylim=(-0.36, 0.36), xlabel="x [mm]", ylabel="y [mm]")
    x, state = points(n)[:, 0, 0], runs["smooth"][middle]
    fine = np.linspace(x[0], x[-1], 1000)
    for k, (name, theory) in enumerate(zip(("pressure", "friction"), Theory.tractions(fine, state.shift))):
        found = state.force[:, n // 2 - 1 : n // 2 + 1, k].mean(axis=1) / area
        axes[0, 2].plot(1e3 * fine, theory / 1e6, color=f"C{k}", label="by theory")
        axes[0, 2].plot(1e3 * x, found / 1e6, ".", color=f"C{k}", label=name)
    axes[0, 2].set(xlabel="x [mm]", ylabel="traction [MPa]", xlim=(-0.36, 0.36), title="smooth, half the shift, y = 0")
    axes[0, 2].legend(fontsize=9, loc="center")
    shifts = np.linspace(0, Theory.shift, 200)
    axes[1, 2].plot(1e6 * shifts, [Theory.tangential(shift) for shift in shifts], label="Cattaneo, Mindlin")
    for (name, states), mark in zip(runs.items(), "os"):
        shares = [state.totals[1] / (FRICTION * state.totals[0]) for state in states]
        axes[1, 2].plot([1e6 * state.shift for state in states], shares, mark, label=name)
    axes[1, 2].set(xlabel=r"shift [$\mu$m]", ylabel="tangential force, of its limit", title="force of the shift")
    axes[1, 2].legend(fontsize=9)
    figure.tight_layout()
    figure.savefig(picture, dpi=90)


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
