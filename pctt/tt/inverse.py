"""Approximate inverse of a symmetric positive definite matrix, as a train.

The solution X of S X = B minimises tr(X' S X) / 2 - tr(X' B), whose gradient is S X - B. Alternating over the
cores of X, the column index of the core at hand is a spectator: with orthonormal interfaces P of the other
cores the best core solves

    M y_j = f_j  for every column j of its mode,    M = P' S P  of order r m r',

with the same symmetric positive definite M for all columns: one Cholesky factorisation, or, where that costs
more, conjugate gradients that never form M. The condition of S is not squared, as it is where ||S X - B|| is
minimised. (Alternating energy minimisation: Oseledets & Dolgov,
SIAM J. Sci. Comput. 34, 2012; Dolgov & Savostyanov, ibid. 36, 2014.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from pctt.tt.apply import Apply
from pctt.tt.train import Array, Train, identity, random

SMALL = 1e-3  # of the norm of a start: the random directions that fill up its ranks
LARGEST = 12_000  # unknowns of a local system that is factorised: 1.2 GB
LOCAL_TOL, LOCAL_ITS = 1e-2, 30  # of conjugate gradients on a local system
EXPECTED_ITS = 10  # of them
HIGH = 1000  # product of ranks of S and X from which a residual is estimated
PROBES = 16  # random vectors for that


@dataclass(frozen=True)
class Inverse:
    """A train X of the inverse of S, symmetric up to rounding.

    correction : Z = X - I where that is what was computed (`invert_near_identity`)
    residual : ||I - S X||_F / ||I||_F, or NaN where it was not asked for
    energy : (tr(X' S X) / 2 - tr(X' B)) / n after every sweep
    repaired : local systems that were not positive definite (S was not, or nearly) and had modes left out
    """

    train: Train
    correction: Train | None
    residual: float
    energy: tuple[float, ...]
    repaired: int


def invert(
    S: Train,
    max_rank: int = 10,
    start: Train | None = None,
    sweeps: int | None = None,
    eps: float = 0.0,
    measure: bool = True,
    rng: np.random.Generator | None = None,
) -> Inverse:
    """Inverse of a symmetric positive definite S with ranks at most `max_rank`.

    start : a train near the inverse, by default the identity; its ranks are filled up with small random
        directions
    sweeps : there and back over the cores, at most; by default 2 from scratch, 1 from a start
    eps : a sweep that lowers the energy by less than eps times its value is the last
    measure : compute the residual

    >>> from pctt.tt.train import decompose_matrix
    >>> A = 3 * np.eye(64) - np.diag(np.ones(63), 1) - np.diag(np.ones(63), -1)
    >>> X = invert(decompose_matrix(A, [4, 4, 4]), max_rank=8, sweeps=4)
    >>> X.train.ranks, X.residual < 1e-5
    ((1, 5, 5, 1), True)
    """
    unit = identity(S.rows, S.dtype)
    X, energy, repaired = _solve(S, unit, unit if start is None else start, max_rank, start is None, sweeps, eps, rng)
    return Inverse(X, None, residual(S, X) if measure else np.nan, energy, repaired)


def invert_near_identity(
    T: Train,
    max_rank: int = 10,
    start: Train | None = None,
    sweeps: int | None = None,
    eps: float = 0.0,
    measure: bool = True,
    rng: np.random.Generator | None = None,
) -> Inverse:
    """Inverse of S = I + T as X = I + Z: the identity is exact, the ranks of X are at most `max_rank`, those of Z one
    less. With rank 1, Z = 0. The start is an earlier Z (`correction`); the rest is as in `invert`.

    Z is cheaper to apply than X: `Apply(Z)` and one addition.
    """
    unit = identity(T.rows, T.dtype)
    if max_rank <= 1:
        return Inverse(unit, 0 * unit, residual(unit + T, unit) if measure else np.nan, (), 0)
    guess = -T if start is None else start
    Z, energy, repaired = _solve(unit + T, -T, guess, max_rank - 1, start is None, sweeps, eps, rng)
    X = unit + Z
    return Inverse(X, Z, residual(unit + T, X) if measure else np.nan, energy, repaired)


def symmetrise(X: Train, max_rank: int | None = None, eps: float = 1e-12) -> Train:
    """(X + X') / 2, rounded."""
    return (0.5 * (X + X.T)).round(eps, max_rank)


def residual(S: Train, X: Train) -> float:
    """||I - S X||_F / ||I||_F, in train arithmetic: of the cost of a product of both ranks. Where that is high, the
    root mean square of ||v - S X v|| / ||v|| over random signs v."""
    size = S.shape[0]
    if max(S.ranks) * max(X.ranks) > HIGH:
        V = np.random.default_rng(0).choice([-1.0, 1.0], (PROBES, size))
        apply_S, apply_X = Apply(S), Apply(X)
        rest = [v - apply_S(apply_X(v)) for v in V]
        return float(np.linalg.norm(rest) / (PROBES * size) ** 0.5)
    SX = S @ X
    square = 1 - 2 * SX.trace() / size + SX.inner(SX) / size
    if square > 1e4 * float(np.finfo(SX.dtype).eps):
        return float(square**0.5)
    return (identity(S.rows, S.dtype) - SX).norm() / size**0.5  # what rounding left of the difference of squares


def lowest(X: Train, rank: int = 2, sweeps: int = 2, rng: np.random.Generator | None = None) -> float:
    """An upper bound of the least eigenvalue of a symmetric X: the least v'Xv / v'v that an alternating search over
    trains v of the given rank finds. A negative value proves that X is not positive definite.

    >>> round(lowest(identity([4, 4, 4])), 12)
    1.0
    """
    rng = np.random.default_rng(0) if rng is None else rng
    environment = Environment(X, random(X.rows, rank, [1] * len(X), rng, X.dtype))
    value = np.inf

    def solve(k: int) -> Array:
        nonlocal value
        w, v = linalg.eigh(environment.projected(k), subset_by_index=[0, 0], check_finite=False)
        value = float(w[0])
        return v.reshape(environment.x[k].shape)

    for _ in range(sweeps):
        environment.sweep(solve)
    return value


class Environment:
    """A train x of orthonormal interfaces around the core at hand, with S and B projected on them from both sides.

    S : matrix train, cores (R, m, m, R')
    x : matrix train whose column modes are spectators, cores (a, m, n, b)
    B : matrix train like x, or None
    left[k], right[k] : x' S x contracted over the cores before and after k, (a, R, a) and (b, R', b)
    left_B[k], right_B[k] : the same of x' B, (a, R) and (b, R')
    """

    def __init__(self, S: Train, x: Train, B: Train | None = None) -> None:
        self.S = S.cores
        self.B = None if B is None else B.cores
        self.x = list(x.right_orthogonal().cores)
        d = len(self.x)
        self.left = [np.ones((1, 1, 1), S.dtype)] * d
        self.right = list(self.left)
        self.left_B = [np.ones((1, 1), S.dtype)] * d
        self.right_B = list(self.left_B)
        for k in range(d - 1, 0, -1):
            self._pass_left(k)

    def projected(self, k: int) -> Array:
        """M = P' S P (a m b, a m b), symmetric, with P the interfaces around core k."""
        S, left, right = self.S[k], self.left[k], self.right[k]
        T = np.tensordot(np.tensordot(left, S, (1, 0)), right, (4, 1))  # (a, a', i, i', b, b')
        n = left.shape[0] * S.shape[1] * right.shape[0]
        M = T.transpose(0, 2, 4, 1, 3, 5).reshape(n, n)
        return 0.5 * (M + M.T)

    def times(self, k: int, x: Array) -> Array:
        """(M + M') x / 2 for x (a, m, n, b), M = P' S P, without M."""
        S, left, right = self.S[k], self.left[k], self.right[k]
        one = _local_product(left, S, right, x)
        other = _local_product(left.transpose(2, 1, 0), S.transpose(0, 2, 1, 3), right.transpose(2, 1, 0), x)
        return 0.5 * (one + other)

    def diagonal(self, k: int) -> Array:
        """Diagonal of M, (a, m, 1, b)."""
        left = np.diagonal(self.left[k], axis1=0, axis2=2)  # (R, a)
        middle = np.diagonal(self.S[k], axis1=1, axis2=2)  # (R, R', m)
        right = np.diagonal(self.right[k], axis1=0, axis2=2)  # (R', b)
        T = np.tensordot(np.tensordot(left, middle, (0, 0)), right, (1, 0))  # (a, m, b)
        return T[:, :, None, :]

    def right_side(self, k: int) -> Array:
        """P' B (a m b, n): a column for every index of the spectator."""
        assert self.B is not None
        T = np.tensordot(np.tensordot(self.left_B[k], self.B[k], 1), self.right_B[k], (3, 1))  # (a, i, j, b)
        return T.transpose(0, 1, 3, 2).reshape(-1, T.shape[2])

    def sweep(self, solve: Callable[[int], Array]) -> None:
        """Replaces core after core by `solve(k)`, from the first to the last and back; the last only once."""
        d = len(self.x)
        for k in range(d - 1):
            self.x[k] = solve(k)
            a, m, n, b = self.x[k].shape
            Q, R = np.linalg.qr(self.x[k].reshape(-1, b))
            self.x[k] = Q.reshape(a, m, n, -1)
            self.x[k + 1] = np.tensordot(R, self.x[k + 1], 1)
            self._pass_right(k)
        for k in range(d - 1, 0, -1):
            self.x[k] = solve(k)
            a, m, n, b = self.x[k].shape
            Q, R = np.linalg.qr(self.x[k].reshape(a, -1).T)
            self.x[k] = Q.T.reshape(-1, m, n, b)
            self.x[k - 1] = np.tensordot(self.x[k - 1], R.T, 1)
            self._pass_left(k)
        self.x[0] = solve(0)

    def _pass_right(self, k: int) -> None:
        x = self.x[k]
        T = np.tensordot(self.left[k], x, (2, 0))  # (a, R, i', j, b')
        T = np.tensordot(self.S[k], T, ((0, 2), (1, 2)))  # (i, R', a, j, b')
        self.left[k + 1] = np.tensordot(x, T, ((0, 1, 2), (2, 0, 3)))  # (b, R', b')
        if self.B is not None:
            self.left_B[k + 1] = np.tensordot(x, np.tensordot(self.left_B[k], self.B[k], 1), ((0, 1, 2), (0, 1, 2)))

    def _pass_left(self, k: int) -> None:
        x = self.x[k]
        T = np.tensordot(x, self.right[k], (3, 2))  # (a', i', j, b, R')
        T = np.tensordot(self.S[k], T, ((2, 3), (1, 4)))  # (R, i, a', j, b)
        self.right[k - 1] = np.tensordot(x, T, ((1, 2, 3), (1, 3, 4)))  # (a, R, a')
        if self.B is not None:
            T = np.tensordot(self.B[k], self.right_B[k], (3, 1))  # (R, i, j, b)
            self.right_B[k - 1] = np.tensordot(x, T, ((1, 2, 3), (1, 2, 3)))


def _solve(
    S: Train,
    B: Train,
    start: Train,
    max_rank: int,
    cold: bool,
    sweeps: int | None,
    eps: float,
    rng: np.random.Generator | None,
) -> tuple[Train, tuple[float, ...], int]:
    """The symmetric solution of S X = B, the energy per unknown after every sweep, the local systems repaired."""
    if S.rows != S.columns:
        raise ValueError("only a square matrix has an inverse")
    rng = np.random.default_rng(0) if rng is None else rng
    environment = Environment(S, _fill(start.astype(S.dtype), max_rank, rng), B)
    energy: list[float] = []
    local, repaired = 0.0, 0

    def solve(k: int) -> Array:
        nonlocal local, repaired
        a, m, n, b = environment.x[k].shape
        f = environment.right_side(k)
        if _large(a, m, n, b, *S.cores[k].shape[::3]):
            f = f.reshape(a, m, b, n).transpose(0, 1, 3, 2)
            y, whole = _conjugate_gradients(environment, k, f)
        else:
            y, whole = _solve_positive(environment.projected(k), f)
        repaired += not whole
        local = -0.5 * float(np.vdot(f, y)) / S.shape[0]
        return y if y.ndim == 4 else y.reshape(a, m, b, n).transpose(0, 1, 3, 2)

    for _ in range((2 if cold else 1) if sweeps is None else sweeps):
        environment.sweep(solve)
        energy.append(local)
        if len(energy) > 1 and abs(energy[-1] - energy[-2]) <= eps * abs(energy[-1]):
            break
    return symmetrise(Train(environment.x), max_rank), tuple(energy), repaired


def _solve_positive(M: Array, f: Array) -> tuple[Array, bool]:
    """Solution of M y = f for a symmetric M; where M is not positive definite, in its clearly positive modes."""
    try:
        factor = linalg.cho_factor(M, lower=True, check_finite=False)
        return linalg.cho_solve(factor, f, check_finite=False), True
    except linalg.LinAlgError:
        w, V = linalg.eigh(M, check_finite=False)
        w = np.where(w > 1e-3 * w[-1], w, np.inf)
        return V @ ((V.T @ f) / w[:, None]), False


def _large(a: int, m: int, n: int, b: int, R: int, R_next: int) -> bool:
    """Whether a local system costs more operations to form, factorise and solve than to iterate on."""
    size = a * m * b
    forming = 2 * a * a * m * m * R_next * (R + b * b)
    iteration = 4 * n * (a * m * b * (a * R + b * R_next) + a * b * m * m * R * R_next)
    return size > LARGEST or EXPECTED_ITS * iteration < forming + size**3 / 3 + 2 * size * size * n


def _conjugate_gradients(environment: Environment, k: int, f: Array) -> tuple[Array, bool]:
    """Solution of M y = f (a, m, n, b) to LOCAL_TOL, all columns as one system, from the core that is there, scaled by
    the diagonal; False, and y as far as it got, where M is not positive definite."""
    weight = environment.diagonal(k)
    if weight.min() <= 0:
        weight = np.ones_like(weight)
    y = environment.x[k].copy()
    r = f - environment.times(k, y)
    z = r / weight
    p, rz = z, float(np.vdot(r, z))
    goal = LOCAL_TOL * float(np.linalg.norm(f))
    for _ in range(LOCAL_ITS):
        if np.linalg.norm(r) <= goal:
            break
        q = environment.times(k, p)
        curvature = float(np.vdot(p, q))
        if curvature <= 0:
            return y, False
        y += rz / curvature * p
        r -= rz / curvature * q
        z = r / weight
        rz, last = float(np.vdot(r, z)), rz
        p = z + rz / last * p
    return y, True


def _local_product(left: Array, S: Array, right: Array, x: Array) -> Array:
    """left (a, R, a'), S (R, i, j, R'), right (b, R', b') on x (a', j, n, b')."""
    T = np.tensordot(left, x, 1)  # (a, R, j, n, b')
    T = np.tensordot(T, S, ((1, 2), (0, 2)))  # (a, n, b', i, R')
    return np.tensordot(T, right, ((2, 4), (2, 1))).transpose(0, 2, 1, 3)  # (a, i, n, b)


def _fill(X: Train, max_rank: int, rng: np.random.Generator) -> Train:
    """X rounded to `max_rank`, lower ranks filled up by small random directions."""
    X = X.round(0.0, max_rank) if max(X.ranks) > max_rank else X
    missing = [max_rank - r for r in X.ranks[1:-1]]
    if not any(missing):
        return X
    small = random(X.rows, [max(1, r) for r in missing], X.columns, rng, X.dtype)
    scale = SMALL * (X.norm() or 1.0) / max(small.norm(), float(np.finfo(X.dtype).tiny))
    return X + small * scale
