"""Dense matrices on grids for `kernels.py`: 19 whose entries depend on differences, so that products by FFT are exact,
and harder ones. The unit of length is the side of the domain, in one dimension the spacing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import prod

import numpy as np
from scipy import fft

Array = np.ndarray
Product = Callable[[Array], Array]
TORUS = 4096  # points along a side of the torus on which a fractional Laplacian is computed
SQUARE_LOG = -1.0612  # mean of log r over a square of side 1 around 0
CUBE = 2.38  # mean of 1/r over a cube of side 1 around 0


class Differences:
    """A(i, j) = table[|x_i - x_j|] for the points x of a grid; the nugget is in table[0]."""

    def __init__(self, name: str, table: Array, nugget: float) -> None:
        self.name, self.table, self.nugget = name, table, nugget
        self.grid, self.size = table.shape, table.size
        self.fast = True

    def entries(self, i: Array, j: Array) -> Array:
        x, y = np.unravel_index(i, self.grid), np.unravel_index(j, self.grid)
        return self.table[tuple(np.abs(a - b) for a, b in zip(x, y))]

    def product(self) -> Product:
        """By FFT of the least good sizes, real to complex."""
        wide = [fft.next_fast_len(2 * n - 1, real=True) for n in self.grid]
        around = [np.minimum(np.arange(m), m - np.arange(m)) for m in wide]
        values = np.pad(self.table, [(0, 1)] * len(self.grid))  # zero beyond the differences of the grid
        values = values[np.ix_(*[np.minimum(a, n) for a, n in zip(around, self.grid)])]
        transformed = fft.rfftn(values).real.copy()
        part = tuple(slice(n) for n in self.grid)

        def times(v: Array) -> Array:
            spectrum = fft.rfftn(v.reshape(self.grid), wide)
            spectrum *= transformed
            return fft.irfftn(spectrum, wide, overwrite_x=True)[part].ravel()

        return times


@dataclass
class General:
    """A matrix whose entries do not depend on differences. ``times``: its product, None if there is no fast one."""

    name: str
    grid: tuple[int, ...]
    entries: Callable[[Array, Array], Array]
    times: Product | None = None
    nugget: float = 0.0

    @property
    def size(self) -> int:
        return prod(self.grid)

    @property
    def fast(self) -> bool:
        return self.times is not None

    def product(self) -> Product:
        """Without a fast one: with the dense matrix."""
        if self.times is not None:
            return self.times
        j = np.arange(self.size)
        dense = np.stack([self.entries(np.full(self.size, i), j) for i in j])
        return lambda v: dense @ v


def radial(name: str, shape: tuple[int, ...], h: float, kernel: Callable[[Array], Array], nugget: float) -> Differences:
    """kernel : takes distances"""
    squares = sum(np.meshgrid(*[(np.arange(n) * h) ** 2 for n in shape], indexing="ij", sparse=True))
    table = np.asarray(kernel(np.sqrt(squares)), float)
    table.flat[0] += nugget
    return Differences(name, table, nugget)


def log(n: int, factor: float, nugget: float) -> Differences:
    """factor h^2 (-log(r / 2)): of a square with a diagonal shorter than 2, so it is positive definite."""
    h = 1 / n

    def kernel(r: Array) -> Array:
        return -factor * h**2 * np.where(r > 0, np.log(np.maximum(r, h) / 2), np.log(h / 2) + SQUARE_LOG)

    name = f"I + {factor:g} log r" if nugget == 1 else f"log r + {nugget:g}"
    return radial(f"{name}, {n}^2", (n, n), h, kernel, nugget)


def exponential(shape: tuple[int, int], length: float, nugget: float, h: float) -> Differences:
    name = f"exp l={length:g}, nugget {nugget:g}, {shape[0]} x {shape[1]}"
    return radial(name, shape, h, lambda r: np.exp(-r / length), nugget)


def matern(n: int, length: float, nugget: float) -> Differences:
    """Matern's covariance of smoothness 3/2."""

    def kernel(r: Array) -> Array:
        return (1 + 3**0.5 * r / length) * np.exp(-(3**0.5) * r / length)

    return radial(f"Matern 3/2 l={length:g}, nugget {nugget:g}, {n}^2", (n, n), 1 / n, kernel, nugget)


def yukawa(n: int, k: float, factor: float, nugget: float) -> Differences:
    h = 1 / n

    def kernel(r: Array) -> Array:
        return factor * h**3 / (4 * np.pi) * np.exp(-k * r) * np.where(r > 0, 1 / np.maximum(r, h), CUBE / h)

    name = f"I + {factor:g} Yukawa k={k:g}" if nugget == 1 else f"Yukawa k={k:g}, nugget {nugget:g}"
    return radial(f"{name}, {n}^3", (n,) * 3, h, kernel, nugget)


def fractional(n: int, power: float) -> Differences:
    """(-Laplace)^power by the symbol (4 - 2 cos - 2 cos)^power, restricted to a square: zero outside."""
    t = 2 - 2 * np.cos(2 * np.pi * np.arange(TORUS) / TORUS)
    table = fft.irfft2((t[:, None] + t[: TORUS // 2 + 1]) ** power)[:n, :n]
    return Differences(f"(-Laplace)^{power:g}, {n}^2", np.ascontiguousarray(table), 0.0)


def multiquadric(n: int, width: float) -> Differences:
    return radial(f"inverse multiquadric {width:g}h, {n}", (n,), 1.0, lambda r: 1 / np.sqrt(1 + (r / width) ** 2), 0.0)


def wendland(n: int, radius: float) -> Differences:
    def kernel(r: Array) -> Array:
        return np.maximum(1 - r / radius, 0) ** 4 * (4 * r / radius + 1)

    return radial(f"Wendland C2 {radius:g}h, {n}", (n,), 1.0, kernel, 0.0)


def gauss(shape: tuple[int, int], h: float) -> Differences:
    name = f"I + 100 Gauss w=.1, {shape[0]} x {shape[1]}"
    return radial(name, shape, h, lambda r: 100 * h**2 * np.exp(-(r**2) / 0.02), 1.0)


def nineteen() -> dict[str, Callable[[], Differences]]:
    """The kernels with a product by FFT, by short names. Nuggets of the covariances are .01 if nothing else is said."""
    odd = (509, 521)
    return {
        "log1": lambda: log(512, 100, 1.0),
        "log3": lambda: log(512, 1, 1e-3),
        "log5": lambda: log(512, 1, 1e-5),
        "exp02": lambda: exponential((256, 256), 0.02, 0.01, 1 / 256),
        "exp05": lambda: exponential((512, 512), 0.05, 0.01, 1 / 512),
        "exp1": lambda: exponential((256, 256), 0.1, 0.01, 1 / 256),
        "matern256": lambda: matern(256, 0.02, 0.01),
        "matern512": lambda: matern(512, 0.02, 0.01),
        "yukawa1000": lambda: yukawa(64, 10, 1000, 1.0),
        "yukawa1": lambda: yukawa(64, 1, 1, 1e-3),
        "yukawa10": lambda: yukawa(64, 10, 1, 1e-5),
        "yukawa50": lambda: yukawa(64, 50, 1, 1e-6),
        "laplace3": lambda: fractional(256, 0.3),
        "laplace7": lambda: fractional(256, 0.7),
        "imq1": lambda: multiquadric(2**16, 1),
        "imq3": lambda: multiquadric(2**16, 3),
        "wendland": lambda: wendland(2**16, 30),
        "gauss_odd": lambda: gauss(odd, 1 / 512),
        "exp_odd": lambda: exponential(odd, 0.02, 0.1, 1 / 512),
    }


def weighted(n: int, name: str, weight: Callable[[Array, Array], Array]) -> General:
    """I + a K a with K = 100 h^2 exp(-10 r) and a weight a(x, y) of the points of the square."""
    kernel = radial("", (n, n), 1 / n, lambda r: 100 / n**2 * np.exp(-10 * r), 0.0)
    axis = (np.arange(n) + 0.5) / n
    a = np.broadcast_to(weight(axis[:, None], axis), (n, n)).ravel()
    fast = kernel.product()
    return General(
        f"I + a K a, a = {name}, {n}^2", (n, n), lambda i, j: (i == j) + a[i] * kernel.entries(i, j) * a[j],
        lambda v: v + a * fast(a * v), 1.0,
    )  # fmt: skip


def scattered(n: int, name: str, points: Array) -> General:
    """The inverse multiquadric of width 1 between points on a line, plus .01 I."""
    return General(
        f"inverse multiquadric, {name}, {n}", (n,),
        lambda i, j: 0.01 * (i == j) + 1 / np.hypot(1, points[i] - points[j]),
    )  # fmt: skip


def hard() -> dict[str, Callable[[], General]]:
    """Matrices whose entries do not depend on differences."""
    n = 256
    rng = np.random.default_rng(5)

    def disc(x: Array, y: Array) -> Array:
        return 20.0 * (np.hypot(x - 0.5, y - 0.5) < 0.3)

    def checker(x: Array, y: Array) -> Array:
        return 1 + 29.0 * ((np.floor(8 * x) + np.floor(8 * y)) % 2)

    def blocks(x: Array, y: Array) -> Array:
        return rng.uniform(0, 3, (16, 16))[np.ix_((16 * x[:, 0]).astype(int), (16 * y).astype(int))]

    few = 2**12
    return {
        "smooth": lambda: weighted(n, "smooth", lambda x, y: 1 + np.sin(3 * x) * np.cos(2 * y)),
        "disc": lambda: weighted(n, "a disc of 20", disc),
        "checker": lambda: weighted(n, "a checkerboard of 1 and 30", checker),
        "blocks": lambda: weighted(n, "16 x 16 random blocks", blocks),
        "jittered": lambda: scattered(few, "jittered points", np.arange(few) + rng.uniform(-0.3, 0.3, few)),
        "chebyshev": lambda: scattered(few, "Chebyshev points", 0.5 * few * (1 - np.cos(np.pi * np.arange(few) / few))),
    }
