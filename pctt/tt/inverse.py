"""Approximate inverse of a symmetric positive definite matrix, as a train.

The solution X of S X = B minimises tr(X' S X) / 2 - tr(X' B), whose gradient is S X - B. Alternating over the
cores of X, the column index of the core at hand is a spectator: with orthonormal interfaces P of the other
cores the best core solves

    M y_j = f_j  for every column j of its mode,    M = P' S P  of order r m r',

with the same symmetric positive definite M for all columns: one Cholesky factorisation, or, where that costs
more, conjugate gradients that never form M. The condition of S is not squared, as it is where ||S X - B|| is
minimised. (Alternating energy minimisation: Oseledets & Dolgov, SIAM J. Sci. Comput. 34, 2012.)

The ranks grow on the way: every core gets, beside its own columns, those of the residual B - S X, seen through the
interfaces of a train Z near it that is renewed with every core (AMEn: Dolgov & Savostyanov, ibid. 36, 2014). Each pass
over the cores doubles the ranks, until the residual is small enough or the cap is reached.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from pctt.tt.train import Array, Train, full_ranks, identity, random

LARGEST = 12_000  # unknowns of a local system that is factorised: 1.2 GB
LOCAL_GAIN, LOCAL_ITS = 0.1, 60  # what conjugate gradients leave of the residual of a local system, and their most
LOCAL_EPS = 0.1  # of the residual that is asked for: all that a local system needs
EXPECTED_ITS = 10  # of them
LEAST_GROWTH, MOST_GROWTH = 4, 16  # of a rank in a pass
IDLE = 0.9  # a sweep at full rank that leaves more than this of the residual is the last
ENOUGH = 0.5  # part of eps at which the residual, estimated on the way, is worth measuring
SKETCH = 64  # rank of the random train with which a residual of high rank is estimated
HIGH = 300  # product of ranks of S and X from which that is done


@dataclass(frozen=True)
class Inverse:
    """A train X of the inverse of S, symmetric up to rounding.

    correction : Z = X - I where that is what was computed (`invert_near_identity`)
    residual : ||I - S X||_F / ||I||_F, with a correction ||I - S X||_F / ||S - I||_F; NaN where it was not asked for
    sweeps : there and back over the cores
    repaired : local systems that were not positive definite (S was not, or nearly) and had modes left out
    """

    train: Train
    correction: Train | None
    residual: float
    sweeps: int
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

    start : a train near the inverse, by default a multiple of the identity
    sweeps : there and back over the cores, at most; by default 1 from a start, else as many as the ranks need to reach
        the cap, and two more
    eps : the residual at which the ranks need not grow
    measure : compute the residual

    >>> from pctt.tt.train import decompose_matrix
    >>> A = 3 * np.eye(64) - np.diag(np.ones(63), 1) - np.diag(np.ones(63), -1)
    >>> X = invert(decompose_matrix(A, [4, 4, 4]), max_rank=8, eps=1e-6)
    >>> X.train.ranks, X.residual < 1e-6
    ((1, 5, 5, 1), True)
    """
    unit = identity(S.rows, S.dtype)
    X, left, count, repaired = _solve(S, unit, start, max_rank, sweeps, eps, measure, rng)
    return Inverse(X, None, left, count, repaired)


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
    if max_rank <= 1 or T.norm() == 0:
        return Inverse(unit, 0 * unit, float(max_rank <= 1) if T.norm() else 0.0, 0, 0)
    Z, left, count, repaired = _solve(unit + T, -T, start, max_rank - 1, sweeps, eps, measure, rng)
    return Inverse(unit + Z, Z, left, count, repaired)


def symmetrise(X: Train, max_rank: int | None = None, eps: float = 1e-12) -> Train:
    """(X + X') / 2, rounded."""
    return (0.5 * (X + X.T)).round(eps, max_rank)


def residual(S: Train, X: Train, B: Train | None = None) -> float:
    """||B - S X||_F / ||B||_F, B the identity by default, in train arithmetic: of the cost of a product of both ranks.
    Where that is high, an estimate from products with random trains, off by a third or so."""
    B = identity(S.rows, S.dtype) if B is None else B
    if max(S.ranks) * max(X.ranks) > HIGH:
        return _sketched(S, X, B) / B.norm()
    SX = S @ X
    scale = B.norm() ** 2
    square = 1 - 2 * SX.inner(B) / scale + SX.inner(SX) / scale
    if square > 1e4 * float(np.finfo(SX.dtype).eps):
        return float(square**0.5)
    return float((B - SX).norm() / scale**0.5)  # what rounding left of the difference of squares


def _sketched(S: Train, X: Train, B: Train) -> float:
    """Estimate of ||B - S X||_F: the root mean square of inner products with random trains that share all cores but
    the last (Feldman et al., "Tensor train sketching", have the variance)."""
    rng = np.random.default_rng(0)
    sketch = Projection(S, B, len(X))
    sketch.left[0] = np.ones((1, 1, 1))
    for k, x in enumerate(X.cores):
        width = len(sketch.left[k])
        y = rng.standard_normal((width, *x.shape[1:3], SKETCH)) / width**0.5
        sketch.step_right(k, y, x)
    d = len(X)
    products = sketch.left_B[d][:, 0] - sketch.left[d][:, 0, 0]
    return float(np.linalg.norm(products) / SKETCH**0.5)


def lowest(X: Train, rank: int = 4, sweeps: int = 4, rng: np.random.Generator | None = None) -> float:
    """An upper bound of the least eigenvalue of a symmetric X: the least v'Xv / v'v that an alternating search over
    trains v of the given rank finds. A negative value proves that X is not positive definite.

    >>> round(lowest(identity([4, 4, 4])), 12)
    1.0
    """
    rng = np.random.default_rng(0) if rng is None else rng
    v = list(random(X.rows, rank, [1] * len(X), rng, X.dtype).right_orthogonal().cores)
    galerkin = Projection.around(X, None, v, v)
    value = np.inf

    def lowest_core(k: int) -> None:
        nonlocal value
        w, y = linalg.eigh(galerkin.matrix(k), subset_by_index=[0, 0], check_finite=False)
        value = float(w[0])
        v[k] = y.reshape(v[k].shape)

    for _ in range(sweeps):
        before = value
        for k in range(len(v) - 1):
            lowest_core(k)
            _push_right(v, k)
            galerkin.step_right(k, v[k], v[k])
        for k in range(len(v) - 1, 0, -1):
            lowest_core(k)
            _push_left(v, k)
            galerkin.step_left(k, v[k], v[k])
        lowest_core(0)
        if value < 0 or abs(value - before) <= 1e-3 * abs(value):
            break
    return value


class Projection:
    """y' S x and y' B contracted over the cores before and after the one at hand, for trains y and x of matrices whose
    columns are spectators.

    left[k], right[k] : y' S x over the cores before and after k, (c, R, a) and (c', R', a')
    left_B[k], right_B[k] : the same of y' B, (c, R) and (c', R')
    """

    def __init__(self, S: Train, B: Train | None, length: int) -> None:
        self.S = S.cores
        self.B = None if B is None else B.cores
        one, one_B = np.ones((1, 1, 1), S.dtype), np.ones((1, 1), S.dtype)
        self.left, self.right = [one] * (length + 1), [one] * length
        self.left_B, self.right_B = [one_B] * (length + 1), [one_B] * length

    @classmethod
    def around(cls, S: Train, B: Train | None, y: list[Array], x: list[Array]) -> Projection:
        """With all that is right of the first core."""
        new = cls(S, B, len(x))
        for k in range(len(x) - 1, 0, -1):
            new.step_left(k, y[k], x[k])
        return new

    def step_right(self, k: int, y: Array, x: Array) -> None:
        T = np.tensordot(self.left[k], x, (2, 0))  # (c, R, i', j, b)
        T = np.tensordot(self.S[k], T, ((0, 2), (1, 2)))  # (i, R', c, j, b)
        self.left[k + 1] = np.tensordot(y, T, ((0, 1, 2), (2, 0, 3)))
        if self.B is not None:
            self.left_B[k + 1] = np.tensordot(y, np.tensordot(self.left_B[k], self.B[k], 1), ((0, 1, 2), (0, 1, 2)))

    def step_left(self, k: int, y: Array, x: Array) -> None:
        T = np.tensordot(x, self.right[k], (3, 2))  # (a, i', j, c, R)
        T = np.tensordot(self.S[k], T, ((2, 3), (1, 4)))  # (R, i, a, j, c)
        self.right[k - 1] = np.tensordot(y, T, ((1, 2, 3), (1, 3, 4)))
        if self.B is not None:
            T = np.tensordot(self.B[k], self.right_B[k], (3, 1))  # (R, i, j, c)
            self.right_B[k - 1] = np.tensordot(y, T, ((1, 2, 3), (1, 2, 3)))

    def matrix(self, k: int) -> Array:
        """M = P' S P (a m b, a m b), symmetric, for y = x, P the interfaces around core k."""
        S, left, right = self.S[k], self.left[k], self.right[k]
        T = np.tensordot(np.tensordot(left, S, (1, 0)), right, (4, 1))  # (a, a', i, i', b, b')
        n = left.shape[0] * S.shape[1] * right.shape[0]
        M = T.transpose(0, 2, 4, 1, 3, 5).reshape(n, n)
        return 0.5 * (M + M.T)

    def times(self, k: int, x: Array) -> Array:
        """M x for x (a, m, n, b), without M."""
        return _local_product(self.left[k], self.S[k], self.right[k], x)

    def diagonal(self, k: int) -> Array:
        """Diagonal of M, (a, m, 1, b)."""
        left = np.diagonal(self.left[k], axis1=0, axis2=2)  # (R, a)
        middle = np.diagonal(self.S[k], axis1=1, axis2=2)  # (R, R', m)
        right = np.diagonal(self.right[k], axis1=0, axis2=2)  # (R', b)
        T = np.tensordot(np.tensordot(left, middle, (0, 0)), right, (1, 0))  # (a, m, b)
        return T[:, :, None, :]

    def right_side(self, k: int) -> Array:
        """P' B (a, m, n, b)."""
        return self._of_B(k, self.left_B[k], self.right_B[k])

    def rest(self, k: int, x: Array) -> Array:
        """P' (B - S x) between my interfaces, for the core x."""
        return self.right_side(k) - self.times(k, x)

    def rest_left(self, other: Projection, k: int, x: Array) -> Array:
        """The same with my interfaces on the left, those of another test train on the right."""
        return self._of_B(k, self.left_B[k], other.right_B[k]) - _local_product(
            self.left[k], self.S[k], other.right[k], x
        )

    def rest_right(self, other: Projection, k: int, x: Array) -> Array:
        return other.rest_left(self, k, x)

    def _of_B(self, k: int, left: Array, right: Array) -> Array:
        assert self.B is not None
        return np.tensordot(np.tensordot(left, self.B[k], 1), right, (3, 1))


class Growing:
    """The train x of the inverse while its cores are solved for one by one, and a train z near its residual.

    estimate : of ||B - S x||, what z has seen of it in the last pass
    """

    def __init__(self, S: Train, B: Train, x: Train, most: list[int], eps: float, rng: np.random.Generator) -> None:
        self.x = list(x.right_orthogonal().cores)
        self.most, self.goal = most, LOCAL_EPS * eps
        width = min(MOST_GROWTH, max(most, default=1))
        self.z = list(random(S.rows, width, S.columns, rng, S.dtype).right_orthogonal().cores)
        self.galerkin = Projection.around(S, B, self.x, self.x)
        self.residual = Projection.around(S, B, self.z, self.x)
        self.repaired = 0
        self.estimate = 0.0

    def forward(self) -> None:
        x, z = self.x, self.z
        for k in range(len(x) - 1):
            self._solve(k)
            new = self.galerkin.rest_left(self.residual, k, x[k])  # (a, m, n, z)
            z[k] = self.residual.rest(k, x[k])
            _truncate_right(x, k, self.most[k])
            _push_right(x, k, new[..., : self._room(k, x[k].shape[3])])
            _push_right(z, k)
            self.galerkin.step_right(k, x[k], x[k])
            self.residual.step_right(k, z[k], x[k])

    def backward(self) -> None:
        x, z = self.x, self.z
        for k in range(len(x) - 1, 0, -1):
            self._solve(k)
            new = self.galerkin.rest_right(self.residual, k, x[k])  # (z, m, n, b)
            z[k] = self.residual.rest(k, x[k])
            _truncate_left(x, k, self.most[k - 1])
            _push_left(x, k, new[: self._room(k - 1, x[k].shape[0])])
            _push_left(z, k)
            self.galerkin.step_left(k, x[k], x[k])
            self.residual.step_left(k, z[k], x[k])
        self._solve(0)
        z[0] = self.residual.rest(0, x[0])
        self.estimate = float(np.linalg.norm(z[0]))

    def _room(self, bond: int, rank: int) -> int:
        return max(0, min(max(LEAST_GROWTH, rank), self.most[bond] - rank))

    def _solve(self, k: int) -> None:
        a, m, n, b = self.x[k].shape
        f = self.galerkin.right_side(k)
        if _large(a, m, n, b, *self.galerkin.S[k].shape[::3]):
            self.x[k], whole = _conjugate_gradients(self.galerkin, k, self.x[k], f, self.goal)
        else:
            y, whole = _solve_positive(self.galerkin.matrix(k), f.transpose(0, 1, 3, 2).reshape(-1, n))
            self.x[k] = y.reshape(a, m, b, n).transpose(0, 1, 3, 2)
        self.repaired += not whole


def _solve(
    S: Train,
    B: Train,
    start: Train | None,
    max_rank: int,
    sweeps: int | None,
    eps: float,
    measure: bool,
    rng: np.random.Generator | None,
) -> tuple[Train, float, int, int]:
    """The symmetric solution of S X = B, its relative residual, the sweeps made, the local systems repaired."""
    if S.rows != S.columns:
        raise ValueError("only a square matrix has an inverse")
    rng = np.random.default_rng(0) if rng is None else rng
    most = [min(max_rank, r) for r in full_ranks([m * m for m in S.rows])]
    if sweeps is None:
        sweeps = 1 if start is not None else 2 + int(np.ceil(0.5 * np.log2(max(1.0, max(most, default=1)))))
    first = B if start is None else start.astype(S.dtype)
    growing = Growing(S, B, first.round(0.0, max_rank), most, eps, rng)
    norm, count, before, enough = B.norm(), 0, np.inf, ENOUGH * eps
    while count < sweeps:
        growing.forward()
        growing.backward()
        count += 1
        if growing.estimate <= enough * norm:
            X = symmetrise(Train(growing.x), max_rank)
            left = residual(S, X, B) if measure else eps
            if left <= eps:
                return *(_rounded(S, B, X, left, eps) if measure else (X, np.nan)), count, growing.repaired
            enough *= 0.5 * eps / left  # it sees a part of the residual
        full = all(x.shape[3] >= r for x, r in zip(growing.x, most))
        if full and growing.estimate > IDLE * before:
            break
        before = growing.estimate if full else np.inf
    X = symmetrise(Train(growing.x), max_rank)
    return X, residual(S, X, B) if measure else np.nan, count, growing.repaired


def _rounded(S: Train, B: Train, X: Train, left: float, eps: float) -> tuple[Train, float]:
    """X of the least ranks that a few trials find to leave the residual below eps, and the residual."""
    for part in (1.0, 0.3, 0.1, 0.03):
        smaller = X.round(part * eps)
        if smaller.ranks == X.ranks:
            break
        found = residual(S, smaller, B)
        if found <= eps:
            return smaller, found
    return X, left


def _push_right(x: list[Array], k: int, more: Array | None = None) -> None:
    """Core k with orthonormal columns, seen as (a m n, b), and room for more of them; the rest goes to core k + 1."""
    a, m, n, b = x[k].shape
    columns = x[k].reshape(-1, b)
    if more is not None and more.shape[3]:
        columns = np.hstack((columns, _scaled(more.reshape(len(columns), -1))))
    Q, R = np.linalg.qr(columns)
    x[k] = Q.reshape(a, m, n, -1)
    x[k + 1] = np.tensordot(R[:, :b], x[k + 1], 1)


def _push_left(x: list[Array], k: int, more: Array | None = None) -> None:
    """Core k with orthonormal rows, seen as (a, m n b), and room for more of them; the rest goes to core k - 1."""
    a, m, n, b = x[k].shape
    rows = x[k].reshape(a, -1)
    if more is not None and len(more):
        rows = np.vstack((rows, _scaled(more.reshape(-1, rows.shape[1]))))
    Q, R = np.linalg.qr(rows.T)
    x[k] = np.ascontiguousarray(Q.T).reshape(-1, m, n, b)
    x[k - 1] = np.tensordot(x[k - 1], R[:, :a].T, 1)


def _scaled(x: Array) -> Array:
    return x / (np.linalg.norm(x) or 1.0)


def _truncate_right(x: list[Array], k: int, most: int) -> None:
    if x[k].shape[3] > most:
        a, m, n, b = x[k].shape
        U, s, V = np.linalg.svd(x[k].reshape(-1, b), full_matrices=False)
        x[k] = U[:, :most].reshape(a, m, n, -1)
        x[k + 1] = np.tensordot(s[:most, None] * V[:most], x[k + 1], 1)


def _truncate_left(x: list[Array], k: int, most: int) -> None:
    if x[k].shape[0] > most:
        a, m, n, b = x[k].shape
        U, s, V = np.linalg.svd(x[k].reshape(a, -1), full_matrices=False)
        x[k] = V[:most].reshape(-1, m, n, b)
        x[k - 1] = np.tensordot(x[k - 1], U[:, :most] * s[:most], 1)


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


def _conjugate_gradients(galerkin: Projection, k: int, x: Array, f: Array, goal: float) -> tuple[Array, bool]:
    """Solution of M y = f (a, m, n, b), all columns as one system, from x, scaled by the diagonal, until LOCAL_GAIN of
    the first residual or `goal` times f is left; False, and y as far as it got, where M is not positive definite."""
    weight = galerkin.diagonal(k)
    if weight.min() <= 0:
        weight = np.ones_like(weight)
    y = x.copy()
    r = f - galerkin.times(k, y)
    z = r / weight
    p, rz = z, float(np.vdot(r, z))
    enough = max(LOCAL_GAIN * float(np.linalg.norm(r)), goal * float(np.linalg.norm(f)))
    for _ in range(LOCAL_ITS):
        if np.linalg.norm(r) <= enough:
            break
        q = galerkin.times(k, p)
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
