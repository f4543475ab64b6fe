"""Fast transforms as preconditioners of matrices whose entries depend on differences.

A(x, y) = a(x - y) for the points of a grid (a Toeplitz matrix on each axis). Of all matrices that a cosine or a sine
transform Q diagonalises, the nearest one to A in Frobenius' norm has the eigenvalues diag(Q A Q'). They are Rayleigh
quotients of A, so this matrix is positive definite if A is. The quotients of all basis vectors of an axis are
transforms of the weighted differences: with v_k(i) v_k(j) = (cos t (i - j) +- cos t (i + j + 1)) / n, t = pi k / n, and
the sum of the second cosines over all pairs of difference s, which is -sin(t s) / sin(t),

    lambda_k = 1/n sum_s a(s) ((n - |s|) cos t s  -+  sin t |s| / sin t).

(For circulants: T. Chan, SIAM J. Sci. Stat. Comput. 9, 1988; for the cosine transform R. Chan, T. Chan & Wong, 1999.) A
cosine transform reflects at the boundary of the grid, where a circulant continues at the opposite side; a sine
transform reflects with the other sign. So errors at the boundary have opposite signs, and a mean of both inverses is
often nearer to that of A.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product as signs_of
from math import prod

import numpy as np
from scipy import fft

from pctt.tt.train import Array

KINDS = ("cosine", "sine")
SHARES = (1.0, 0.75, 0.5, 0.0)  # of the cosine transform, that are tried
FLOOR = 1e-13  # smaller eigenvalues, relative to the largest, count as rounding
TRIAL_ITS = 100  # most iterations of a trial by conjugate gradients


class FastTransform:
    """A mean of the inverses of the nearest matrices to A that a cosine and a sine transform diagonalise.

    differences : (n_1, ..., n_D) the means of a(s) over the signs of the coordinates of s
    share : of the cosine transform in the mean, the rest is that of the sine transform

    positive : whether all eigenvalues are positive; if not, neither is A

    >>> a = 0.3 ** np.arange(6.0)
    >>> A = a[abs(np.subtract.outer(range(6), range(6)))]
    >>> x = FastTransform(a).solve(A @ np.ones(6))
    >>> bool(abs(x - 1).max() < 0.25)
    True
    """

    def __init__(self, differences: Array, share: float = 1.0) -> None:
        self.share, self.shape = share, differences.shape
        self.positive = True
        self._inverses: list[tuple[str, Array]] = []
        for kind, part in zip(KINDS, (share, 1 - share)):
            if part == 0:
                continue
            values = eigenvalues(differences, kind)
            largest = float(values.max())
            self.positive &= bool(largest > 0 and values.min() > -FLOOR * largest)
            self._inverses.append((kind, part / np.maximum(values, FLOOR * abs(largest) or 1.0)))

    @property
    def name(self) -> str:
        return " and ".join(kind for kind, _ in self._inverses) + " transform"

    def solve(self, x: Array) -> Array:
        """The product of the mean of the inverses with x (n_1 ... n_D,)."""
        out = np.zeros(self.shape)
        for kind, inverse in self._inverses:
            forward, backward = (fft.dctn, fft.idctn) if kind == "cosine" else (fft.dstn, fft.idstn)
            spectrum = forward(x.reshape(self.shape))
            spectrum *= inverse
            out += backward(spectrum, overwrite_x=True)
        return out.ravel()


def eigenvalues(differences: Array, kind: str) -> Array:
    """diag(Q A Q'), of the shape of the differences."""
    values = differences
    for axis in range(differences.ndim):
        values = np.moveaxis(_along_last(np.moveaxis(values, axis, -1), kind), -1, axis)
    return values


def _along_last(a: Array, kind: str) -> Array:
    n = a.shape[-1]
    weighted = np.zeros((*a.shape[:-1], n + 1))
    weighted[..., :n] = a * ((n - np.arange(n)) / n)
    even = fft.dct(weighted, 1)  # sum over all s of the weighted a(s) cos(pi k s / n), k = 0, ..., n
    odd = np.zeros_like(even)
    if n > 1:  # sum of a(s) sin(pi k |s| / n)
        odd[..., 1:n] = fft.dst(a[..., 1:], 1) / (n * np.sin(np.pi * np.arange(1, n) / n))
    return (even - odd)[..., :n] if kind == "cosine" else (even + odd)[..., 1:]


def product(differences: Array) -> Callable[[Array], Array]:
    """The product with A by FFT, for differences that are even in each coordinate."""
    shape = differences.shape
    wide = [fft.next_fast_len(2 * n - 1, real=True) for n in shape]
    places = np.ix_(*[np.minimum(np.minimum(np.arange(m), m - np.arange(m)), n) for m, n in zip(wide, shape)])
    spectrum = fft.rfftn(np.pad(differences, [(0, 1)] * len(shape))[places]).real
    inside = tuple(slice(n) for n in shape)

    def times(x: Array) -> Array:
        return fft.irfftn(spectrum * fft.rfftn(x.reshape(shape), wide), wide)[inside].ravel()

    return times


def trial(differences: Array, transform: FastTransform, most: int = TRIAL_ITS) -> int:
    """Iterations of conjugate gradients to 1e-8 with this preconditioner and a random right side; `most` at most."""
    times = product(differences)
    r = np.random.default_rng(0).standard_normal(prod(differences.shape))
    enough = 1e-8 * float(np.linalg.norm(r))
    p, rz = np.zeros_like(r), np.inf
    for its in range(most):
        z = transform.solve(r)
        old, rz = rz, float(r @ z)
        p = z + rz / old * p
        q = times(p)
        curvature = float(p @ q)
        if not (rz > 0 and curvature > 0):
            return TRIAL_ITS  # not positive
        r = r - rz / curvature * q
        if float(np.linalg.norm(r)) <= enough:
            return its + 1
    return most


def best(differences: Array) -> tuple[float, int] | None:
    """The share of the cosine transform with which a solution costs least, and its iterations, on a part of the grid.

    The part has at most 4096 points, of the same spacing. None if this part of A is not positive.
    """
    side = max(1, int(4096 ** (1 / differences.ndim) + 1e-9))
    part = differences[tuple(slice(side) for _ in differences.shape)]
    transforms = {share: FastTransform(part, share) for share in SHARES}
    if not all(transform.positive for transform in transforms.values()):
        return None
    found, least = (SHARES[0], TRIAL_ITS), np.inf
    for share, transform in transforms.items():
        each = 1.25 if share in (0.0, 1.0) else 1.5  # the cost of an iteration in products by FFT
        its = trial(part, transform, int(min(TRIAL_ITS, least // each + 1)))
        if its * each < least:
            found, least = (share, its), its * each
    return found


def depend_on_differences(
    entries: Callable[[Array, Array], Array], shape: tuple[int, ...], order: Array | None, rng: np.random.Generator,
    pairs: int = 512,
) -> bool | None:  # fmt: skip
    """Whether entries at random pairs are those at pairs of the same difference elsewhere.

    None: they are not. True: they also keep their values if coordinates of the difference change their signs.
    The offsets of the pairs are of all sizes, so that steep kernels show.
    """
    places = []
    signs = rng.choice([-1, 1], (len(shape), pairs))
    joint = rng.random(pairs)
    for n, sign in zip(shape, signs):
        reach = np.minimum((n ** np.where(rng.random(pairs) < 0.5, joint, rng.random(pairs))).astype(int) - 1, n - 1)
        offset = rng.integers(0, reach + 1)
        here, there = rng.integers(0, n - offset, (2, pairs))
        places.append([here, here + offset, there, there + offset])
        places[-1] += [np.where(sign > 0, there, there + offset), np.where(sign > 0, there + offset, there)]
    points = [np.ravel_multi_index(axis, shape) for axis in zip(*places)]
    i, j, moved_i, moved_j, turned_i, turned_j = points if order is None else [order[p] for p in points]
    here, moved, turned = entries(i, j), entries(moved_i, moved_j), entries(turned_i, turned_j)
    if not _alike(here, moved):
        return None
    return _alike(here, turned)


def _alike(a: Array, b: Array) -> bool:
    """Whether a and b are equal up to 1e-6, and up to 1e-12 of the largest of all."""
    largest = np.maximum(np.abs(a), np.abs(b))
    return bool((np.abs(a - b) <= 1e-6 * largest + 1e-12 * largest.max(initial=0.0)).all())


def means_of_differences(
    entries: Callable[[Array, Array], Array], shape: tuple[int, ...], order: Array | None, even: bool
) -> Array:
    """The means (n_1, ..., n_D) of the entries over the signs of the coordinates of differences.

    even : all signs give the same entries
    """
    size, chunk = prod(shape), 1 << 20  # entries that are evaluated at a time
    out = np.zeros(size)
    turns = [(1,) * len(shape)] if even else [(1, *signs) for signs in signs_of((1, -1), repeat=len(shape) - 1)]
    for first in range(0, size, chunk):
        points = np.arange(first, min(first + chunk, size))
        distance = np.unravel_index(points, shape)
        for signs in turns:
            i = np.ravel_multi_index(tuple(x if s > 0 else 0 * x for x, s in zip(distance, signs)), shape)
            j = np.ravel_multi_index(tuple(x if s < 0 else 0 * x for x, s in zip(distance, signs)), shape)
            out[points] += entries(i, j) if order is None else entries(order[i], order[j])
    return out.reshape(shape) / len(turns)
