"""Approximate inverse of a symmetric positive definite matrix, as a train.

The solution X of S X = B minimises tr(X' S X) / 2 - tr(X' B). The method alternates over the cores of X (Oseledets &
Dolgov, SIAM J. Sci. Comput. 34, 2012). With orthonormal interfaces P of the other cores the best core solves

    M y_j = f_j  for every column j of its mode,    M = P' S P  of order r m r'.

Conjugate gradients solve these systems and never form M. Every core gets, beside its own columns, columns of the
residual B - S X, as seen through the interfaces of a train Z near the residual (AMEn: Dolgov & Savostyanov, ibid. 36,
2014). So each pass doubles the ranks until the residual is small enough or the cap is reached.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pctt.tt.projection import Projection, columns, lowest, rows
from pctt.tt.train import Array, Train, full_ranks, identity, random
from pctt.tt.work import TooMuchWorkError, Work, inner_operations, local_operations, svd_operations

IDLE = 0.8  # a sweep that leaves more than this part of the residual is the last, or, if ranks can grow, drops too much
NOISE = 1e-7  # a smaller part of the residual counts as rounding
PASSES = 8  # over the cores that must be left within the limit of operations, after ranks have grown
CERTAIN = 0.7  # bound of ||I - S X||_F; below 1, because the estimate is sometimes wrong by a third
INVERSION = "the inversion"  # the phase for `Work`
EPSILON = float(np.finfo(float).eps)
HIGH = 300  # with a larger product of the ranks of S and X, the residual is estimated


@dataclass(frozen=True)
class Inverse:
    """A train of the inverse of S, symmetric up to rounding.

    Attributes
    ----------
    applied : X, or Z with X = I + Z if ``identity``
    residual : ||I - S X||_F / ||I||_F, with ``identity`` ||I - S X||_F / ||S - I||_F
    sweeps : number of sweeps there and back over the cores
    repaired : number of local systems that were not positive definite, because S was not, or nearly not
    certain : whether ||I - S X||_F is safely below 1. Then X has as many negative eigenvalues as S: on the line from
        S^-1 to X the matrix S^-1 - t (S^-1 - X) = S^-1 (I - t (I - S X)) is never singular
    stopped : where the limit of the operations ended the growth of the ranks; empty if it did not
    """

    applied: Train
    identity: bool
    residual: float
    sweeps: int
    repaired: int
    certain: bool = False
    stopped: str = ""

    @property
    def train(self) -> Train:
        """X."""
        if not self.identity:
            return self.applied
        unit = identity(self.applied.rows)
        return unit + self.applied if self.applied.norm() > 0 else unit


def invert(
    S: Train, max_rank: int = 10, start: Train | None = None, sweeps: int | None = None, eps: float = 0.0,
    rng: np.random.Generator | None = None,
) -> Inverse:  # fmt: skip
    """Return the inverse of a symmetric positive definite S with ranks at most `max_rank`.

    Parameters
    ----------
    start : a train near the inverse, by default the identity
    sweeps : largest number of sweeps there and back over the cores. The default is 1 with a start; otherwise it is the
        number that the ranks need to reach the cap, and two more.
    eps : with a residual below this the ranks need not grow

    >>> from pctt.tt.train import decompose_matrix
    >>> A = 3 * np.eye(64) - np.diag(np.ones(63), 1) - np.diag(np.ones(63), -1)
    >>> X = invert(decompose_matrix(A, [4, 4, 4]), max_rank=8, eps=1e-6)
    >>> X.train.ranks, X.residual < 1e-6
    ((1, 5, 5, 1), True)
    """
    return _solve(S, identity(S.rows), start, max_rank, sweeps, eps, rng, Work())


def invert_near_identity(
    T: Train, max_rank: int = 10, start: Train | None = None, sweeps: int | None = None, eps: float = 0.0,
    rng: np.random.Generator | None = None, work: Work | None = None,
) -> Inverse:  # fmt: skip
    """Return the inverse of S = I + T as X = I + Z, with an exact identity; arguments as in `invert`.

    The ranks of X are at most `max_rank`, those of Z one less. With rank 1, Z = 0. The start is an earlier Z. `work`
    counts operations. Near its limit the ranks do not grow any more, and at the limit the result of the last whole
    sweep is taken; TooMuchWorkError if there is none. Z is cheaper to apply than X: it takes `Apply(Z)` and one
    addition.
    """
    unit, norm = identity(T.rows), T.norm()
    if max_rank <= 1 or norm == 0:
        return Inverse(0 * unit, True, float(norm > 0), 0, 0, norm < CERTAIN)
    found = _solve(unit + T, -T, start, max_rank - 1, sweeps, eps, rng, work or Work())
    return replace(found, identity=True, certain=found.repaired == 0 and found.residual * norm < CERTAIN)


def invert_positive(
    T: Train, max_rank: int, eps: float, worth: float = 0.25, sweeps: int | None = None, work: Work | None = None
) -> Inverse | None:
    """`invert_near_identity`, but None if a search among trains finds that I + T is not positive definite.

    If an accuracy of `worth` times eps or more is enough to make the inverse `certain`, it is computed to this
    accuracy: that is cheaper than a test with full vectors.
    """
    if lowest(identity(T.rows) + T) <= 0:
        return None
    certain = CERTAIN / (T.norm() or 1.0)
    goal = min(eps, certain) if worth * eps <= certain else eps
    return invert_near_identity(T, max_rank, sweeps=sweeps, eps=goal, work=work)


def residual(S: Train, X: Train, B: Train | None = None) -> float:
    """Return ||B - S X||_F / ||B||_F in train arithmetic; by default B is the identity.

    The cost grows with the product of the ranks of S and X. If this product is high, the result is an estimate from
    products with random trains, with an error of about a third.
    """
    B = identity(S.rows) if B is None else B
    if max(S.ranks) * max(X.ranks) > HIGH:
        return _sketched(S, X, B) / B.norm()
    SX = S @ X
    scale = B.norm() ** 2
    square = 1 - 2 * SX.inner(B) / scale + SX.inner(SX) / scale
    if square > 1e4 * EPSILON:
        return float(square**0.5)
    return float((B - SX).norm() / scale**0.5)  # rounding spoils the difference of squares


def _sketched(S: Train, X: Train, B: Train) -> float:
    """An estimate of ||B - S X||_F: the root mean square of inner products with random trains. These share all cores
    except the last (Feldman et al., "Tensor train sketching", give the variance)."""
    rng, samples = np.random.default_rng(0), 64  # of which the error of the estimate is a third
    sketch = Projection(S, B, len(X))
    sketch.left[0] = np.ones((1, 1, 1))
    for k, x in enumerate(X.cores):
        width = len(sketch.left[k])
        y = rng.standard_normal((width, *x.shape[1:3], samples)) / width**0.5
        sketch.step(k, 1, y, x)
    d = len(X)
    products = sketch.left_B[d][:, 0] - sketch.left[d][:, 0, 0]
    return float(np.linalg.norm(products) / samples**0.5)


class Growing:
    """The symmetric train x of the inverse, whose cores are computed one by one, and a train z near its residual.

    x is symmetric by structure. A basis vector of a bond is a matrix that equals its own transpose or minus its
    transpose; the signs of the bond tell which. So a core (a, i, j, b) equals its transpose in i and j times the signs
    of a and b.

    estimate : the part of ||B - S x|| that z has seen in the last pass
    """

    def __init__(
        self, S: Train, B: Train, x: Train, most: list[int], eps: float, rng: np.random.Generator, work: Work,
    ) -> None:  # fmt: skip
        self.most, self.work = most, work
        self.goal = 0.1 * eps  # a local system needs no smaller residual
        width = min(16, max(most, default=1))  # the largest growth of a rank in a pass
        self.x, self.signs = _with_signs(x, most)
        self.z = list(random(S.rows, width, S.columns, rng).right_orthogonal().cores)
        self.galerkin = Projection.around(S, B, self.x, self.x)
        self.residual = Projection.around(S, B, self.z, self.x)
        self.drop = 0.1 * eps / len(x) ** 0.5  # what a core may leave out
        self.repaired = 0
        self.estimate = 0.0

    def sweep(self) -> None:
        """A pass over the cores there and back."""
        last = len(self.x) - 1
        for k in range(last):
            self._step(k, 1)
        for k in range(last, 0, -1):
            self._step(k, -1)
        self._solve(0)
        self.z[0] = self.residual.rest(0, self.x[0])
        self.estimate = float(np.linalg.norm(self.z[0]))

    def _step(self, k: int, direction: int) -> None:
        """Compute core k, and go to the next one (``direction`` 1) or to the one before (-1)."""
        x, z = self.x, self.z
        self._solve(k)
        left, right = (self.galerkin, self.residual)[::direction]
        new = left.rest_left(right, k, x[k])  # (a, m, n, z) or (z, m, n, b)
        z[k] = self.residual.rest(k, x[k])
        _push(x, self.signs, k, direction, self.most[min(k, k + direction)], self.drop, new)
        z[k] = columns(z[k]) if direction > 0 else rows(z[k])
        self.galerkin.step(k, direction, x[k], x[k])
        self.residual.step(k, direction, z[k], x[k])

    def words(self, norm: float) -> str:
        """How far it is, for a message. norm : ||B||"""
        left = f", leaves about {self.estimate / norm:.1e} of the residual" if self.estimate else ""
        return f"{INVERSION}, at rank {max(x.shape[3] for x in self.x)}{left}"

    def _solve(self, k: int) -> None:
        """Compute nearly the symmetric core of least energy by conjugate gradients, from the present core.

        They are scaled by the diagonal. They stop at a tenth of the first residual, at `goal` times the right side, or
        after 20 iterations.
        """
        signs = self.signs[k : k + 2]

        def symmetric(y: Array) -> Array:
            return 0.5 * (y + _transpose(y, *signs))

        galerkin, y = self.galerkin, self.x[k]
        weight = galerkin.diagonal(k)
        weight = weight + weight.transpose(0, 2, 1, 3)
        if weight.min() <= 0:
            weight = np.ones_like(weight)
        f = symmetric(galerkin.right_side(k))
        r = f - symmetric(galerkin.times(k, y))
        z = r / weight
        p, rz = z, float(np.vdot(r, z))
        enough = max(0.1 * float(np.linalg.norm(r)), self.goal * float(np.linalg.norm(f)))
        one = local_operations(galerkin.left[k], galerkin.S[k], galerkin.right[k], y)
        bases = svd_operations(len(y) * y.shape[1] * y.shape[2], 2 * y.shape[3])
        self.work.spend(6 * one + 2 * bases, INVERSION)  # all but the products of the iterations
        for _ in range(20):
            if np.linalg.norm(r) <= enough:
                break
            self.work.spend(one, INVERSION)
            q = symmetric(galerkin.times(k, p))
            curvature = float(np.vdot(p, q))
            if curvature <= 0:
                self.repaired += 1
                break
            y = y + rz / curvature * p
            r -= rz / curvature * q
            z = r / weight
            rz, last = float(np.vdot(r, z)), rz
            p = z + rz / last * p
        self.x[k] = y


def _solve(
    S: Train, B: Train, start: Train | None, max_rank: int, sweeps: int | None, eps: float,
    rng: np.random.Generator | None, work: Work,
) -> Inverse:  # fmt: skip
    """The symmetric solution of S X = B with its relative residual."""
    if S.rows != S.columns:
        raise ValueError("only a square matrix has an inverse")
    rng = np.random.default_rng(0) if rng is None else rng
    most = [min(max_rank, r) for r in full_ranks([m * m for m in S.rows])]
    if sweeps is None:
        sweeps = 1 if start is not None else 2 + int(np.ceil(0.5 * np.log2(max(1.0, max(most, default=1)))))
    first = B if start is None else start
    growing = Growing(S, B, first.round(0.0, max_rank), most, eps, rng, work)
    norm, before, enough = B.norm(), np.inf, 0.5 * eps

    def measured(X: Train) -> float:
        work.spend(inner_operations(S, X, HIGH), INVERSION)
        return residual(S, X, B)

    whole: tuple[Train, int] | None = None  # the result of the last sweep that was not stopped, and the number repaired
    stopped = ""
    for count in range(1, sweeps + 1):
        begun = work.spent
        try:
            growing.sweep()
            whole = Train(list(growing.x)), growing.repaired
            if growing.estimate <= enough * norm:
                X = whole[0]
                left = measured(X)
                if left <= eps:
                    X, left = _rounded(X, left, eps, measured)
                    return Inverse(X, False, left, count, growing.repaired)
                enough *= 0.5 * eps / left  # the estimate sees only a part of the residual
            # more passes have to make use of the ranks of the next one, with whose cubes the operations grow
            room = (work.limit - work.spent) / (PASSES * max(work.spent - begun, 1.0))
            ranks = [x.shape[3] for x in growing.x[:-1]]
            growing.most = [int(max(r, min(r * max(room, 0.0) ** (1 / 3), cap))) for r, cap in zip(ranks, most)]
            if growing.estimate > IDLE * before:
                if ranks == growing.most:
                    break
                growing.drop *= 0.3
            before = growing.estimate
            if growing.most != most:
                stopped = growing.words(norm)
        except TooMuchWorkError:
            stopped = stopped or growing.words(norm)
            if whole is None:
                raise TooMuchWorkError(stopped) from None
            break
    assert whole is not None, "there is at least one sweep"
    X, repaired = whole
    left = residual(S, X, B)
    return Inverse(X, False, left, count, repaired, stopped=stopped if left > eps else "")


def _rounded(X: Train, left: float, eps: float, measured: Callable[[Train], float]) -> tuple[Train, float]:
    """X rounded so that its residual stays below eps, and this residual. The first tolerance that does it is taken."""
    tolerance = 4.0 * eps
    while tolerance > 0.02 * eps:
        smaller = X.round(tolerance)
        found = measured(smaller)
        if found <= eps:
            return smaller, found
        tolerance *= max(0.25, min(0.84, 0.97 * eps / found))  # the residual is about proportional to it
    return X, left


def _transpose(x: Array, left: Array, right: Array) -> Array:
    """The core of the transposed train, for interfaces with these signs."""
    return x.transpose(0, 2, 1, 3) * np.multiply.outer(left, right)[:, None, None, :]


def _with_signs(X: Train, most: list[int]) -> tuple[list[Array], list[Array]]:
    """(X + X') / 2 with orthonormal right interfaces and ranks at most `most`, and the signs of all bonds."""
    x = list(X.left_orthogonal().cores)
    signs = [np.ones(1)] * (len(x) + 1)
    for k in range(len(x) - 1, 0, -1):
        signs[k] = np.zeros(len(x[k]))  # no symmetry yet
        _push(x, signs, k, -1, most[k - 1], 0.0)
    x[0] = 0.5 * (x[0] + _transpose(x[0], signs[0], signs[1]))
    return x, signs


def _push(
    x: list[Array], signs: list[Array], k: int, direction: int, most: int, drop: float, more: Array | None = None
) -> None:
    """Give core k, as a matrix (a m n, b), at most ``most`` orthonormal columns, some of them from ``more``.

    The next core takes the other factor. With ``direction`` -1 the same for the rows (a, m n b), and the core before.
    """
    turn = (0, 1, 2, 3) if direction > 0 else (3, 1, 2, 0)
    here, there = (k, k + 1)[::direction]
    core, more = x[k].transpose(turn), None if more is None else more.transpose(turn)
    Q, R, signs[there] = _basis(core, signs[here], signs[there], most, drop, more)
    x[k] = np.ascontiguousarray(Q.reshape(*core.shape[:3], -1).transpose(turn))
    x[k + direction] = np.tensordot(R, x[k + 1], 1) if direction > 0 else np.tensordot(x[k - 1], R, (3, 1))


def _basis(
    x: Array, left: Array, right: Array, most: int, drop: float, more: Array | None
) -> tuple[Array, Array, Array]:
    """Q and R of a core x (a, m, n, b) = Q R, and the signs of the columns of Q.

    ``left`` and ``right`` are the signs of the bonds of x. Q has at most `most` orthonormal columns; some of them are
    for the residual `more` (a, m, n, c).
    """
    size = len(x) * x.shape[1] * x.shape[2]
    parts = []
    for sign in (1.0, -1.0):
        half = x if right.any() else _half(x, sign, left)
        mine = np.flatnonzero(right != -sign)
        U, s, V = np.linalg.svd(half[..., mine].reshape(size, -1), full_matrices=False)
        R = np.zeros((len(s), len(right)))
        R[:, mine] = s[:, None] * V
        parts.append((U, s, R))
    keep = _largest([s for _, s, _ in parts], most, drop)
    Q = [_own_transposes(U[:, :r], sign, left, x.shape) for sign, (U, _, _), r in zip((1.0, -1.0), parts, keep)]
    coefficients = [R[:r] for (_, _, R), r in zip(parts, keep)]
    room = min(most - sum(keep), max(4, sum(keep)))
    if more is not None and room > 0:
        extra = []
        for sign, known in zip((1.0, -1.0), Q):
            half = _half(more, sign, left).reshape(size, -1)
            half = half - known @ (known.T @ half)
            extra.append(np.linalg.svd(half, full_matrices=False)[:2])
        floor = NOISE * float(np.linalg.norm(more))  # smaller remains of known directions have no sign
        new = _largest([s for _, s in extra], room, 0.1)
        new = [min(n, int(np.count_nonzero(s > floor))) for n, (_, s) in zip(new, extra)]
        for part, (U, _) in enumerate(extra):
            U = U[:, : new[part]]
            Q[part] = np.hstack((Q[part], np.linalg.qr(U - Q[part] @ (Q[part].T @ U))[0]))
            coefficients[part] = np.vstack((coefficients[part], np.zeros((new[part], len(right)))))
    signs = np.repeat(np.array([1.0, -1.0]), [len(R) for R in coefficients])
    return np.hstack(Q), np.vstack(coefficients), signs


def _own_transposes(U: Array, sign: float, left: Array, shape: tuple[int, ...]) -> Array:
    """Orthonormal columns U, corrected so that each equals its transpose times ``sign``.

    With singular values near zero, rounding spoils this property.
    """
    half = _half(U.reshape(*shape[:3], -1), sign, left).reshape(U.shape)
    if np.linalg.norm(half - U) <= NOISE * U.shape[1] ** 0.5:
        return U
    Q, R = np.linalg.qr(half)
    return Q * np.where(np.diagonal(R) < 0, -1.0, 1.0)


def _half(x: Array, sign: float, left: Array) -> Array:
    """The part of a core that equals its own transpose times ``sign``, for a left bond with these signs."""
    return 0.5 * (x + sign * _transpose(x, left, np.ones(x.shape[3])))


def _largest(values: list[Array], most: int, drop: float) -> list[int]:
    """The numbers of values to keep from each of two descending lists: together at least one and at most `most`.

    They are as small as possible if the norm of the other values must not exceed `drop` times the norm of all values.
    """
    both = np.sort(np.concatenate(values))[::-1]
    tail = np.sqrt(np.cumsum(both[::-1] ** 2))[::-1]
    floor = max(drop, EPSILON) * tail[0]
    rank = max(1, min(most, int(np.count_nonzero(tail > floor))))
    first = int(np.count_nonzero(values[0] > both[rank])) if len(both) > rank else len(values[0])
    return [first, min(rank - first, len(values[1]))]
