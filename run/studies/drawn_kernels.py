"""Kernels that nobody chose: matrices drawn at random, and the products that CG takes for them to 1e-8 alone, with T.
Chan's circulant, and with `pctt.pc.TensorTrain` by its defaults, its trials included: run/study drawn_kernels [FIRST
[LAST]] [-name NAME] [-rank RANK] [-worst RATIO]. Kernel k is the same in every run.

Two thirds depend on differences of points of grids of one to three dimensions: covariances that are turned, moving,
seasonal, band-limited or of short range, spectra, sums and products of these, with a nugget, several unknowns a point.
Others are on grids with holes, graded or scattered points, with noise or weights that vary, of lengths that vary, of
low rank, or classical (Hilbert, Cauchy). A product counts 1, an application of a preconditioner as much as its
operations are of a product; columns of Nystrom's approximation are not counted. Ratios, of products and of iterations
alone, are what auto takes to what the better of CG alone and the circulant does. Writes results/drawn_kernels.json.
"""

from __future__ import annotations

from math import inf

import numpy as np
from scipy import special
from shared import Row, Table, parser, record, say_machine
from solutions import Array, System, ratio, solve, verdict, why_not

from pctt.tt.differences import Differences

GRIDS = {1: (300, 9000), 2: (18, 150), 3: (8, 28)}  # sides, from and to
DENSE = 1600  # points without a fast product

# -- functions of differences ---------------------------------------------------------------------------------


def distance(rng: np.random.Generator, s: Array) -> Array:
    """In lengths of one to thirty spacings, along turned axes or for a field that moves along the last one."""
    d, lengths = len(s), np.exp(rng.uniform(0, 3.4, len(s)))
    how = rng.choice(["axes", "turned", "moving", "round"])
    if how == "turned":
        s = np.tensordot(np.linalg.qr(rng.standard_normal((d, d)))[0], s, 1)
    elif how == "moving" and d > 1:
        s = np.array([*(s[:-1] - rng.uniform(-2, 2) * s[-1]), s[-1]])
    return np.sqrt(sum((x / (lengths[0] if how == "round" else a)) ** 2 for x, a in zip(s, lengths)))


def covariance(rng: np.random.Generator, s: Array) -> Array:
    r = distance(rng, s)
    a, b = 3**0.5 * r, 5**0.5 * r
    kinds = {
        "exponential": lambda: np.exp(-r),
        "matern3": lambda: (1 + a) * np.exp(-a),
        "matern5": lambda: (1 + b + b**2 / 3) * np.exp(-b),
        "gauss": lambda: np.exp(-(r**2) / 2),
        "rational": lambda: (1 + r**2) ** -rng.uniform(0.3, 2),
        "wendland": lambda: np.maximum(1 - r / 2, 0) ** 4 * (2 * r + 1),
        "stretched": lambda: np.exp(-(r ** rng.uniform(0.4, 1.9))),
    }
    return kinds[rng.choice(list(kinds))]()


def oscillating(rng: np.random.Generator, s: Array) -> Array:
    """A few waves, a season along an axis, or a band of wave numbers."""
    axis, r = s[rng.integers(len(s))], np.sqrt((s**2).sum(axis=0))
    wave, k = rng.uniform(-0.8, 0.8, (rng.integers(1, 4), len(s))), rng.uniform(0.1, 1.0)
    kinds = {
        "waves": lambda: sum(np.cos(np.tensordot(w, s, 1)) for w in wave),
        "season": lambda: np.exp(-2 * np.sin(np.pi * axis / rng.uniform(4, 60)) ** 2),
        "band": lambda: np.sinc(k * r / np.pi) if len(s) != 2 else special.j0(k * r),
        "box": lambda: np.prod([np.sinc(k * x / np.pi) for x in s], axis=0),
    }
    return kinds[rng.choice(list(kinds))]()


def banded(rng: np.random.Generator, s: Array) -> Array:
    """What a random stencil of a few points makes of white noise: the sum of its products with itself moved."""
    stencil = rng.standard_normal(rng.integers(2, 7, len(s)))
    if rng.random() < 0.5:
        stencil = np.abs(stencil)
    spectrum = np.abs(np.fft.fftn(stencil, [2 * n for n in stencil.shape])) ** 2
    found = np.fft.ifftn(spectrum).real
    inside = np.all([np.abs(x) < n for x, n in zip(s, stencil.shape)], axis=0)
    at = tuple(np.where(inside, x, 0).astype(int) for x in s)
    return np.where(inside, found[at], 0.0) / found.flat[0]


def spectral(rng: np.random.Generator, s: Array) -> Array:
    """Of a positive function of wave numbers t: a power of the Laplacian, rough bands, or one over a polynomial."""
    sides = [int(2 * np.abs(x).max() + 2) for x in s]
    t = np.meshgrid(*[2 * np.pi * np.fft.fftfreq(n) for n in sides], indexing="ij")
    laplacian = sum(rng.uniform(0.05, 1) * (2 - 2 * np.cos(x)) for x in t)
    kinds = {
        "power": lambda: laplacian ** rng.uniform(0.2, 1.5),
        "green": lambda: 1 / (10 ** rng.uniform(-4, 0) + laplacian) ** rng.uniform(0.5, 2),
        "bands": lambda: np.exp(rng.uniform(0.5, 3) * sum(np.cos(k * x) for x, k in zip(t, rng.integers(1, 9, 3)))),
        "gap": lambda: 0.01 + (np.sin(2 * laplacian) > rng.uniform(-0.5, 0.8)),
    }
    found = np.fft.ifftn(kinds[rng.choice(list(kinds))]()).real
    return found[tuple(x.astype(int) % n for x, n in zip(s, sides))] / found.flat[0]


def function(rng: np.random.Generator, s: Array) -> Array:
    """One of the above, or a product or a sum of two."""
    makers = (covariance, covariance, oscillating, banded, spectral)
    one, other = (makers[k](rng, s) for k in rng.integers(len(makers), size=2))
    return [one, one, one * other, rng.random() * one + other][rng.integers(4)]


# -- matrices -------------------------------------------------------------------------------------------------


def drawn(number: int) -> tuple[System, str]:
    """Kernel ``number``, and what it is in words."""
    rng = np.random.default_rng([2026, number])
    if number % 3 == 2:
        words, dense = without_differences(rng)
        dense[np.diag_indices_from(dense)] += nugget(rng) * np.diag(dense).mean()
        return System((len(dense),), lambda i, j: dense[i, j], lambda v: dense @ v), words
    d = int(rng.choice([1, 2, 2, 2, 3, 3]))
    least, most = GRIDS[d]
    grid = tuple(int(n) for n in np.exp(rng.uniform(np.log(least), np.log(most), d)))
    axes = [np.concatenate([np.arange(n), np.arange(1 - n, 0)]).astype(float) for n in grid]
    s = np.array(np.meshgrid(*axes, indexing="ij"))
    block = int(rng.choice([1, 1, 1, 1, 2, 3]))
    values = function(rng, s)[..., None, None]
    if block > 1:
        parts = rng.standard_normal((2, block, block))
        values = values * (parts[0] @ parts[0].T) + function(rng, s)[..., None, None] * (parts[1] @ parts[1].T)
    zero = (0,) * d
    values[zero] += nugget(rng) * np.trace(values[zero]) / block * np.eye(block)
    return System.of(Differences(grid, values).compact()), f"{' x '.join(map(str, grid))}, {block}"


def nugget(rng: np.random.Generator) -> float:
    """Relative to the diagonal: from hardly any to more than the matrix."""
    return float(10 ** rng.uniform(-4, 1))


def without_differences(rng: np.random.Generator) -> tuple[str, Array]:
    """A matrix that depends on places, and what it is."""
    n = int(rng.integers(500, DENSE))
    side = int(n**0.5)
    points = np.stack(np.unravel_index(np.arange(side**2), (side, side)), axis=1).astype(float)
    kinds = ["holes", "noise", "weights", "graded", "scattered", "lengths", "low rank", "Cauchy", "diffusion", "sphere"]
    kind = str(rng.choice(kinds))
    if kind == "holes":
        points = points[rng.random(len(points)) < rng.uniform(0.4, 0.95)]
    elif kind == "graded":
        points = side * (points / side) ** rng.uniform(1.3, 3)
    elif kind == "scattered":
        points = rng.uniform(0, side, (len(points), rng.integers(1, 4)))
    elif kind == "sphere":
        points = rng.standard_normal((n, 3))
        points *= side / 4 / np.linalg.norm(points, axis=1)[:, None]
    elif kind == "low rank":
        F = rng.standard_normal((n, int(rng.integers(5, 150)))) * 10 ** rng.uniform(-1, 1)
        return kind, F @ F.T + np.diag(10 ** rng.uniform(-1, 1, n))
    elif kind == "Cauchy":
        x = np.sort(rng.uniform(0, 1, n)) + 10 ** rng.uniform(-4, 0)
        return kind, 1 / np.add.outer(x, x)
    elif kind == "diffusion":
        c = np.exp(rng.uniform(0, 6) * rng.random(n + 1))
        L = np.diag(c[1:] + c[:-1]) - np.diag(c[1:-1], 1) - np.diag(c[1:-1], -1)
        values, vectors = np.linalg.eigh(L)
        return kind, (vectors * np.maximum(values, 0) ** rng.uniform(-0.6, 0.8)) @ vectors.T
    s = np.moveaxis(points[:, None] - points, -1, 0)
    if kind == "lengths":
        length = 1 + side * rng.uniform(0.02, 0.3) * points[:, 0] / side
        both = np.add.outer(length**2, length**2)
        return kind, 2 * np.outer(length, length) / both * np.exp(-(s**2).sum(axis=0) / both)
    A = covariance(rng, s)
    if kind == "noise":
        A[np.diag_indices_from(A)] += 10 ** rng.uniform(-3, 1, len(A))
    elif kind == "weights":
        weight = np.exp(rng.uniform(0, 2) * np.sin(points[:, 0] / rng.uniform(1, side)))
        A = weight[:, None] * A * weight
    return kind, A


def main() -> None:
    words = parser("drawn_kernels", __doc__)
    words.add_argument("first", nargs="?", type=int, default=0)
    words.add_argument("last", nargs="?", type=int, default=120)
    words.add_argument("-name", default="", help="only kernels whose words have this in them")
    words.add_argument("-rank", default="auto", help="-pc_tt_rank")
    words.add_argument("-worst", type=float, default=0.0, help="only rows with a larger ratio")
    asked = words.parse_args()
    about = say_machine()
    table = Table(
        kernel=("number", "6d"), alone=("alone", "7.0f"), circulant=("circulant", "9.1f"), trials=("trials", "6.1f"),
        auto=("auto", "7.1f"), products=("products", "8.2f"), iterations=("iterations", "10.2f"), what=("what", "<"),
    )  # fmt: skip
    found: dict[str, dict[str, Row]] = {}
    for number in range(asked.first, asked.last):
        given, name = drawn(number)
        if asked.name not in name:
            continue
        ways = [way for way in ("plain", "circulant", "auto") if not why_not(way, given)]
        rows = found[str(number)] = {way: solve(given, way, asked.rank) for way in ways}
        ratios = {figure: ratio(rows, figure) for figure in ("iterations", "products")}
        if max(ratios.values()) >= asked.worst:
            row = {"number": number, "alone": rows["plain"]["products"], "auto": rows["auto"]["products"], "what": ""}
            row |= {"circulant": rows["circulant"]["products"] if given.a else inf, "trials": rows["auto"]["trials"]}
            table.add(row | ratios, f"{name}: {rows['auto']['what'][:60]}")
    said = verdict(found)
    print("\n".join(said))
    rows = [{"number": name, "ways": ways} for name, ways in found.items()]
    record("drawn_kernels", about, [{"verdict": said}, *rows])


if __name__ == "__main__":
    main()
