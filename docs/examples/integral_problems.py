"""Integral equations on grids, I + s K s with a kernel K(x - y) and a weight s(x): entries, and products by FFT."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import fft

Array = np.ndarray


class Problem:
    """A(i, j) = nugget (i == j) + s_i K(|x_i - x_j|) s_j on a grid of n^d cells of the unit cube.

    kernel : takes distances, gives K h^d, with the value of a cell with itself where the distance is zero
    weight : s, takes coordinates (d, p) in [0, 1], gives (p,); None: 1
    """

    def __init__(
        self, name: str, n: int, dimensions: int, kernel: Callable[[Array], Array], nugget: float = 1.0,
        weight: Callable[[Array], Array] | None = None,
    ) -> None:  # fmt: skip
        self.name, self.n, self.grid = name, n, (n,) * dimensions
        self.kernel, self.nugget, self.weight = kernel, nugget, weight

    @property
    def size(self) -> int:
        return self.n ** len(self.grid)

    def points(self, i: Array) -> Array:
        return (np.array(np.unravel_index(i, self.grid)) + 0.5) / self.n

    def entries(self, i: Array, j: Array) -> Array:
        """The whole interface to a train: a function of row and column numbers."""
        x, y = self.points(i), self.points(j)
        values = self.kernel(np.sqrt(((x - y) ** 2).sum(axis=0)))
        if self.weight is not None:
            values = values * self.weight(x) * self.weight(y)
        return values + self.nugget * (i == j)

    def product(self) -> Callable[[Array], Array]:
        """A v by FFT: K is a convolution, a circulant on a grid twice as wide."""
        n, d = self.n, len(self.grid)
        offsets = np.minimum(np.arange(2 * n), 2 * n - np.arange(2 * n)) / n
        squares = sum(np.meshgrid(*[offsets**2] * d, indexing="ij", sparse=True))
        transformed = fft.rfftn(self.kernel(np.sqrt(squares)))
        s = 1.0 if self.weight is None else self.weight(self.points(np.arange(self.size))).reshape(self.grid)
        part = (slice(n),) * d

        def times(v: Array) -> Array:
            wide = fft.rfftn(s * v.reshape(self.grid), [2 * n] * d)
            return self.nugget * v + (s * fft.irfftn(transformed * wide, [2 * n] * d)[part]).ravel()

        return times

    def circulant(self) -> Callable[[Array], Array]:
        """C^-1 v by FFT, where C is the circulant nearest to A in the Frobenius norm (T. Chan 1988), axis by axis.
        ValueError where A is no convolution."""
        if self.weight is not None:
            raise ValueError("the weight varies: A is no convolution")
        n, d = self.n, len(self.grid)
        squares = sum(np.meshgrid(*[(np.arange(n + 1) / n) ** 2] * d, indexing="ij", sparse=True))
        means, near = self.kernel(np.sqrt(squares)), 1 - np.arange(n) / n
        for _ in range(d):  # each turn averages the first axis over its diagonals and makes it the last one
            axis = np.moveaxis(means, 0, -1)
            means = near * axis[..., :n] + (1 - near) * axis[..., n:0:-1]
        eigenvalues = self.nugget + fft.rfftn(means).real
        return lambda v: fft.irfftn(fft.rfftn(v.reshape(self.grid)) / eigenvalues, self.grid).ravel()


def fredholm(n: int) -> Problem:
    """u(x) + 100 int exp(-|x - y|^2 / 2 w^2) u(y) dy = f(x) on a square, w = 0.1: of the second kind."""
    return Problem(f"Fredholm {n}^2", n, 2, lambda r: 100 / n**2 * np.exp(-(r**2) / 0.02))


def potential(n: int) -> Problem:
    """u(x) + 40 int u(y) / (4 pi |x - y|) dy = f(x) in a cube; a cell with itself: 2.38 h^2 / (4 pi)."""

    def kernel(r: Array) -> Array:
        return 40 / (4 * np.pi) / n**3 * np.where(r > 0, 1 / np.maximum(r, 1 / n), 2.38 * n)

    return Problem(f"1/r {n}^3", n, 3, kernel)


def yukawa(n: int) -> Problem:
    """u(x) + 1000 int exp(-10 |x - y|) / (4 pi |x - y|) u(y) dy = f(x) in a cube, a screened potential."""

    def kernel(r: Array) -> Array:
        near = np.where(r > 0, 1 / np.maximum(r, 1 / n), 2.38 * n)
        return 1000 / (4 * np.pi) / n**3 * np.exp(-10 * r) * near

    return Problem(f"Yukawa {n}^3", n, 3, kernel)


def lippmann_schwinger(n: int, screening: float = 5.0) -> Problem:
    """Scattering of a screened potential, (-laplace + k^2 + q) u = f: u + G (q u) = G f with G = exp(-k r) / 4 pi r,
    made symmetric with s = sqrt(q); q = 10,000 at the heart of a smooth ball."""

    def kernel(r: Array) -> Array:
        return np.exp(-screening * r) / (4 * np.pi) / n**3 * np.where(r > 0, 1 / np.maximum(r, 1 / n), 2.38 * n)

    def weight(x: Array) -> Array:
        return 100.0 * np.exp(-((x - 0.5) ** 2).sum(axis=0) / (2 * 0.15**2) / 2)

    return Problem(f"Lippmann-Schwinger {n}^3", n, 3, kernel, weight=weight)


def gaussian_process(n: int, width: float = 0.02, nugget: float = 0.1) -> Problem:
    """Covariance exp(-|x - y|^2 / 2 width^2) + nugget of a field that is measured at all points of a grid."""
    name = f"Gaussian process {n}^2, width {width:g}, nugget {nugget:g}"
    return Problem(name, n, 2, lambda r: np.exp(-(r**2) / (2 * width**2)), nugget)
