"""Dense matrices, 55 with exact products by FFT and 6 harder ones: conjugate gradients to 1e-8 alone, with
`pctt.pc.TensorTrain` by its defaults (auto) and as a train of rank 100 at most (train), and with its rivals: run/study
kernels [-only NAME...] [-ways WAY...] [-quick]. Writes results/kernels.json; all ways of the first 19, which are
the table there, write the section on kernels of docs/trains.md too.

The unit of length is the side of the domain, in one dimension the spacing. CPU
seconds of one thread. Rivals: the inverses of the diagonal blocks, where they differ, T. Chan's circulant, a block
Nystrom preconditioner (random-pivoted Cholesky of 200 columns, plus the nugget).
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from math import inf

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np
from scipy import fft, special
from shared import ROOT, Row, commit, markdown, parser, record, replace_section, say_machine
from solutions import COLUMNS, RTOL, WAYS, Array, System, solve, verdict, why_not

from pctt.tt.differences import Differences

Kernel = Callable[[Array, float], Array]  # takes distances, and the spacing of the grid
Systems = dict[str, Callable[[], System]]
TORUS = 4096  # points along a side of the torus on which a fractional Laplacian is computed
SQUARE_LOG = -1.0612  # mean of log r over a square of side 1 around 0
CUBE = 2.38  # mean of 1/r over a cube of side 1 around 0
MOST = 2000  # iterations
REPEAT, SHORT = 3, 0.05  # a solution of less than SHORT seconds is repeated, the fastest counts
QUICKLY = ("plain", "jacobi", "circulant", "auto")  # ways for the kernels that are not in the table
QUICK = ["exp02", "yukawa50", "laplace7", "imq1", "disc"]
TICK = 0.01  # seconds that are too few to compare
FAR = 2.0  # times the seconds of the fastest: a loser
PAGE, HEAD = ROOT / "docs/trains.md", "## Kernels\n"

# -- matrices -------------------------------------------------------------------------------------------------


def radial(shape: tuple[int, ...], kernel: Kernel, nugget: float = 0.0, h: float | None = None) -> System:
    """Of points on a grid with the spacing h; without h the first side of the grid is of length 1."""
    h = h or 1 / shape[0]
    squares = sum(np.meshgrid(*[(np.arange(n) * h) ** 2 for n in shape], indexing="ij", sparse=True))
    table = np.asarray(kernel(np.sqrt(squares), h), float)
    table.flat[0] += nugget
    return System.of(Differences.of_even(table), nugget)


def signed(shape: tuple[int, ...], kernel: Callable[..., Array], nugget: float) -> System:
    """Of a function of the differences of grid indices along each axis."""
    axes = [np.concatenate([np.arange(n), np.arange(1 - n, 0)]).astype(float) for n in shape]
    table = np.asarray(kernel(*np.meshgrid(*axes, indexing="ij")), float)
    table.flat[0] += nugget
    return System.of(Differences(shape, table[..., None, None]).compact(), nugget)


def log(factor: float) -> Kernel:
    """factor h^2 (-log(r / 2)): of a square with a diagonal shorter than 2, so it is positive definite."""
    own = SQUARE_LOG
    return lambda r, h: -factor * h**2 * np.where(r > 0, np.log(np.maximum(r, h) / 2), np.log(h / 2) + own)


def exponential(length: float) -> Kernel:
    return lambda r, h: np.exp(-r / length)


def matern(length: float) -> Kernel:
    """Matern's covariance of smoothness 3/2."""
    c = 3**0.5 / length
    return lambda r, h: (1 + c * r) * np.exp(-c * r)


def yukawa(k: float, factor: float) -> Kernel:
    own = factor / (4 * np.pi)
    return lambda r, h: own * h**3 * np.exp(-k * r) * np.where(r > 0, 1 / np.maximum(r, h), CUBE / h)


def fractional(n: int, power: float) -> System:
    """(-Laplace)^power by the symbol (4 - 2 cos - 2 cos)^power, restricted to a square: zero outside."""
    t = 2 - 2 * np.cos(2 * np.pi * np.arange(TORUS) / TORUS)
    table = fft.irfft2((t[:, None] + t[: TORUS // 2 + 1]) ** power)[:n, :n]
    return System.of(Differences.of_even(np.ascontiguousarray(table)))


def multiquadric(width: float) -> Kernel:
    """The inverse one."""
    return lambda r, h: 1 / np.sqrt(1 + (r / width) ** 2)


def wendland(radius: float) -> Kernel:
    """C2"""
    return lambda r, h: np.maximum(1 - r / radius, 0) ** 4 * (4 * r / radius + 1)


def gauss(factor: float, width: float) -> Kernel:
    return lambda r, h: factor * h**2 * np.exp(-((r / width) ** 2) / 2)


def nineteen() -> Systems:
    """The kernels with a product by FFT. A nugget of 1 makes an integral equation of the second kind."""
    small, large, cube, row, odd = (128, 128), (256, 256), (32, 32, 32), (2**14,), (193, 207)
    return {
        "log1": lambda: radial(large, log(100), 1.0),
        "log3": lambda: radial(large, log(1), 1e-3),
        "log5": lambda: radial(large, log(1), 1e-5),
        "exp02": lambda: radial(small, exponential(0.02), 0.01),
        "exp05": lambda: radial(large, exponential(0.05), 0.01),
        "exp1": lambda: radial(small, exponential(0.1), 0.01),
        "matern_small": lambda: radial(small, matern(0.02), 0.01),
        "matern_large": lambda: radial(large, matern(0.02), 0.01),
        "yukawa1000": lambda: radial(cube, yukawa(10, 1000), 1.0),
        "yukawa1": lambda: radial(cube, yukawa(1, 1), 1e-3),
        "yukawa10": lambda: radial(cube, yukawa(10, 1), 1e-5),
        "yukawa50": lambda: radial(cube, yukawa(50, 1), 1e-6),
        "laplace3": lambda: fractional(128, 0.3),
        "laplace7": lambda: fractional(128, 0.7),
        "imq1": lambda: radial(row, multiquadric(1), h=1.0),
        "imq3": lambda: radial(row, multiquadric(3), h=1.0),
        "wendland": lambda: radial(row, wendland(30), h=1.0),
        "gauss_odd": lambda: radial(odd, gauss(100, 0.1), 1.0, 1 / 200),
        "exp_odd": lambda: radial(odd, exponential(0.02), 0.1, 1 / 200),
    }


def matern5(d: Array) -> Array:
    """Matern's covariance of smoothness 5/2."""
    return (1 + 5**0.5 * d + 5 / 3 * d**2) * np.exp(-(5**0.5) * d)


def turned(x: Array, y: Array, angle: float, long: float, short: float) -> Array:
    """Distances in lengths along and across a direction."""
    c, s = np.cos(angle), np.sin(angle)
    return np.hypot((c * x + s * y) / long, (c * y - s * x) / short)


def around(x: Array, n: int) -> Array:
    """Distances on a circle."""
    return np.minimum(np.abs(x), n - np.abs(x))


def others() -> Systems:
    """Kernels by differences that others have tried or that the choice was not made with: rotated, moving, periodic,
    oscillating, separable, of a few waves, of long correlations. Lengths in spacings."""
    season = lambda t, period: np.exp(-2 * np.sin(np.pi * t / period) ** 2)  # noqa: E731
    wave = lambda x, y, a, b: np.cos(a * x + b * y)  # noqa: E731
    return {
        "matern_axes": lambda: signed((200, 200), lambda x, y: matern5(turned(x, y, 0, 20, 4)), 0.01),
        "matern_30": lambda: signed((200, 200), lambda x, y: matern5(turned(x, y, 0.52, 20, 4)), 0.01),
        "exp_60": lambda: signed((160, 120), lambda x, y: np.exp(-turned(x, y, 1.05, 30, 2)), 0.001),
        "gauss_23": lambda: signed((128, 128), lambda x, y: np.exp(-turned(x, y, 0.4, 15, 3) ** 2 / 2), 0.01),
        "matern_box": lambda: signed((24,) * 3, lambda x, y, z: matern5(np.hypot(turned(x, y, 0, 8, 4), z / 2)), 0.01),
        "gp_64": lambda: signed((64, 64, 64), lambda x, y, z: matern5(np.hypot(np.hypot(x, y), z) / 6), 0.1),
        "sinc": lambda: signed((24,) * 3, lambda x, y, z: np.sinc(0.3 / np.pi * np.hypot(np.hypot(x, y), z)), 0.1),
        "bessel": lambda: signed((128, 128), lambda x, y: special.j0(0.3 * np.hypot(x, y)), 0.1),
        "separable": lambda: signed((24, 24, 20), lambda x, y, t: np.exp(-np.hypot(x, y) / 6 - np.abs(t) / 8), 0.01),
        "gneiting": lambda: signed(
            (24, 24, 20),
            lambda x, y, t: np.exp(-np.hypot(x, y) / (36 + 7.2 * np.abs(t)) ** 0.5) / (1 + np.abs(t) / 5), 0.01),
        "moving": lambda: signed((96, 96), lambda x, t: np.exp(-np.hypot((x - 0.8 * t) / 6, t / 12)), 0.01),
        "moving3": lambda: signed(
            (24, 24, 20), lambda x, y, t: np.exp(-np.hypot(np.hypot(x - 0.5 * t, y) / 6, t / 9)), 0.01),
        "season": lambda: signed((96, 96), lambda x, t: matern5(np.abs(x) / 8) * season(t, 12), 0.01),
        "season_100": lambda: signed((100, 100), lambda x, t: matern5(np.abs(x) / 8) * season(t, 12), 0.01),
        "season_365": lambda: signed((64, 365), lambda x, t: np.exp(-np.abs(x) / 8) * season(t, 30.4), 0.05),
        "quasi": lambda: signed((8192,), lambda t: np.exp(-np.abs(t) / 500) * season(t, 37), 0.01),
        "torus": lambda: signed((64, 64), lambda x, y: np.exp(-(around(x, 64) + around(y, 64)) / 5), 0.01),
        "torus_129": lambda: signed((129, 129), lambda x, y: np.exp(-(around(x, 129) + around(y, 129)) / 7), 0.01),
        "cylinder": lambda: signed((163, 178), lambda x, y: np.exp(-around(x, 163) / 5 - np.abs(y) / 2), 0.003),
        "product": lambda: signed((128, 128), lambda x, y: np.cos(0.5 * x) * np.cos(0.5 * y), 0.1),
        "waves": lambda: signed((150, 150), lambda x, y: wave(x, y, 0.3, 0.1) + wave(x, y, 0.2, -0.4), 0.5),
        "power": lambda: signed((30000,), lambda x: (1 + np.abs(x)) ** -0.5, 0.0),
        "gauss_60": lambda: signed((256, 256), lambda x, y: np.exp(-(np.hypot(x, y) / 60) ** 2 / 2), 0.01),
        "gauss_100": lambda: signed((256, 128), lambda x, y: np.exp(-turned(x, y, 0, 100, 15) ** 2 / 2), 0.1),
        "rational": lambda: signed((300, 200), lambda x, y: 1 / (1 + turned(x, y, 0, 30, 10) ** 2), 0.001),
        "tent": lambda: signed((146, 144), lambda x, y: np.maximum(1 - turned(x, y, 0.8, 70, 100), 0) ** 2, 0.01),
    }  # fmt: skip


def more() -> Systems:
    """Ten that are turned, moving, periodic with noise, on lines, in a box; and of sizes that are no powers of two."""
    season = lambda t, period: np.exp(-2 * np.sin(np.pi * t / period) ** 2)  # noqa: E731
    matern3 = lambda d: (1 + 3**0.5 * d) * np.exp(-(3**0.5) * d)  # noqa: E731
    return {
        "exp_15": lambda: signed((120, 90), lambda x, y: np.exp(-turned(x, y, 0.26, 25, 5)), 0.01),
        "matern3_45": lambda: signed((100, 100), lambda x, y: matern3(turned(x, y, 0.785, 15, 3)), 0.05),
        "matern5_75": lambda: signed((144, 96), lambda x, y: matern5(turned(x, y, 1.31, 10, 2)), 0.001),
        "moving_fast": lambda: signed((80, 125), lambda x, t: np.exp(-np.hypot((x - 1.7 * t) / 8, t / 10)), 0.02),
        "moving_gauss": lambda: signed((90, 84), lambda x, t: np.exp(-(((x + 0.4 * t) / 5) ** 2) - (t / 9) ** 2), 0.05),
        "line_matern3": lambda: signed((5000,), lambda x: matern3(np.abs(x) / 40), 0.01),
        "line_season": lambda: signed((3600,), lambda x: np.exp(-np.abs(x) / 300) * season(x, 24), 0.1),
        "periodic": lambda: signed((120, 135), lambda x, y: np.exp(-((around(x, 120) / 9) ** 2) - np.abs(y) / 6), 0.05),
        "matern5_noisy": lambda: signed((100, 81), lambda x, y: matern5(np.hypot(x, y) / 3), 1.0),
        "exp_box": lambda: signed((30, 25, 20), lambda x, y, z: np.exp(-np.hypot(turned(x, y, 0, 12, 4), z / 2)), 0.02),
    }  # fmt: skip


def weighted(n: int, weight: Callable[[Array, Array], Array]) -> System:
    """I + a K a with K = 100 h^2 exp(-10 r) and a weight a(x, y) of the points of the square."""
    kernel = radial((n, n), lambda r, h: 100 * h**2 * np.exp(-10 * r))
    axis = (np.arange(n) + 0.5) / n
    a = np.broadcast_to(weight(axis[:, None], axis), (n, n)).ravel()
    fast = kernel.product()
    return System(
        (n, n), lambda i, j: (i == j) + a[i] * kernel.entries(i, j) * a[j], lambda v: v + a * fast(a * v), nugget=1.0
    )  # fmt: skip


def scattered(points: Array) -> System:
    """The inverse multiquadric of width 1 between points on a line, plus 0.01 I."""
    kernel = multiquadric(1)
    return System((len(points),), lambda i, j: 0.01 * (i == j) + kernel(points[i] - points[j], 1.0), None)


def hard() -> Systems:
    """Matrices whose entries do not depend on differences: weights that are smooth, 20 in a disc, 1 and 30 on a
    checkerboard, random in 16 x 16 blocks; points that are jittered, or Chebyshev's."""
    n, rng = 128, np.random.default_rng(5)

    def blocks(x: Array, y: Array) -> Array:
        return rng.uniform(0, 3, (16, 16))[np.ix_((16 * x[:, 0]).astype(int), (16 * y).astype(int))]

    few = np.arange(2**11)
    return {
        "smooth": lambda: weighted(n, lambda x, y: 1 + np.sin(3 * x) * np.cos(2 * y)),
        "disc": lambda: weighted(n, lambda x, y: 20.0 * (np.hypot(x - 0.5, y - 0.5) < 0.3)),
        "checker": lambda: weighted(n, lambda x, y: 1 + 29.0 * ((np.floor(8 * x) + np.floor(8 * y)) % 2)),
        "blocks": lambda: weighted(n, blocks),
        "jittered": lambda: scattered(few + rng.uniform(-0.3, 0.3, len(few))),
        "chebyshev": lambda: scattered(0.5 * len(few) * (1 - np.cos(np.pi * few / len(few)))),
    }


# -- solutions ------------------------------------------------------------------------------------------------


def solution(given: System, way: str) -> Row:
    """Of the fastest of REPEAT, if it takes less than SHORT seconds; or why there is none."""
    if why := why_not(way, given):
        return {"note": "-", "why": why}
    row = solve(given, way, most=MOST)
    for _ in range(REPEAT - 1 if seconds(row) < SHORT else 0):
        row = min(row, solve(given, way, most=MOST), key=seconds)
    return row


def seconds(row: Row) -> float:
    """Of set-up and solution; infinite for a failure."""
    return row["setup_s"] + row["solve_s"] if row.get("iterations", inf) < inf else inf


def text(row: Row) -> str:
    if "note" in row:
        return row["note"]
    if seconds(row) == inf:
        return f"{row['residual']:.0e} left"
    refused = ", no train" * ("no train" in row["what"] and bool(row["warned"]))
    return f"{seconds(row):.2f} ({row['iterations']}){refused}"


def losers(found: dict[str, dict[str, Row]], figure: Callable[[Row], float], least: float) -> dict[str, float]:
    """Systems by their names where auto takes more than FAR times what the best of all ways does, and how much."""
    ratios = {}
    for name, rows in found.items():
        best = max(min(figure(row) for row in rows.values()), least)
        if "auto" in rows and best < inf:
            ratios[name] = figure(rows["auto"]) / best
    return {name: value for name, value in ratios.items() if value > FAR}


def said_of(found: dict[str, dict[str, Row]]) -> list[str]:
    """Lines on some systems: how auto compares."""
    fastest = sum(seconds(rows["auto"]) <= max(TICK, min(map(seconds, rows.values()))) for rows in found.values())
    late = ", ".join(f"{name} ({value:.1f})" for name, value in losers(found, seconds, TICK).items())
    line = f"auto is the fastest in {fastest} of {len(found)}; more than {FAR:g} times the fastest: {late or 'none'}"
    return [*verdict(found), line]


def main(given: argparse.Namespace) -> None:
    about = say_machine()
    sets = {"of the table": nineteen(), "others by differences": {**others(), **more()}, "not by differences": hard()}
    names = {name: make for group in sets.values() for name, make in group.items()}
    found: dict[str, dict[str, Row]] = {}
    for name in given.only or (QUICK if given.quick else names):
        system, found[name] = names[name](), {}
        for way in given.ways if name in sets["of the table"] or given.only else QUICKLY:
            found[name][way] = solution(system, way)
        shape = " x ".join(map(str, system.grid))
        print(f"{name}, {shape}: {' | '.join(f'{way} {text(row)}' for way, row in found[name].items())}", flush=True)
        for row in (found[name][way] for way in ("auto", "train") if way in found[name]):
            print("    " + "; WARNED: ".join(filter(None, (row["what"], row["warned"]))), flush=True)
    groups = {words: {name: found[name] for name in group if name in found} for words, group in sets.items()}
    said = {words: said_of(rows) for words, rows in groups.items() if rows and "auto" in given.ways}
    print("\n".join(f"{words}: {line}" for words, lines in said.items() for line in lines))
    rows = [{"name": name, "ways": ways} for name, ways in found.items()]
    record("kernels", about, [{"said": said}, *rows])
    if set(found) >= set(nineteen()) and set(given.ways) == set(WAYS):
        write_page(groups["of the table"], said, about)


# -- the page -------------------------------------------------------------------------------------------------


def write_page(found: dict[str, dict[str, Row]], said: dict[str, list[str]], about: Row) -> None:
    """The section of docs/trains.md."""
    lines = []
    for name, rows in found.items():
        best = min(map(seconds, rows.values()))
        cells = [f"**{text(row)}**" if seconds(row) == best else text(row) for row in rows.values()]
        took = rows["auto"]["what"].partition(" of a grid")[0].removesuffix(" transform")
        lines.append([WORDS[name], *cells[:1], *cells[2:], took])  # without Jacobi, which is the same as none
    heads = ["kernel", *(head for way, head in WAYS.items() if way != "jacobi"), "auto took"]
    points = [f"- {words}: {line}" for words, part in said.items() for line in part]
    section = TEXT.format(
        table=markdown(heads, lines), said="\n".join(points), columns=COLUMNS, rtol=RTOL, most=MOST, cpu=about["cpu"],
        commit=commit(),
    )  # fmt: skip
    replace_section(PAGE, HEAD, section)


TEXT = """`run/study kernels` writes this section: CG to a true residual of {rtol:g}, the same matrices and right
sides in every column. Cells have CPU seconds of set-up and solution (iterations), or what {most} iterations left; one
thread of an {cpu}, commit {commit}. The fastest is bold. "auto" is `TensorTrain` by its defaults, block
Nystrom has {columns} columns. Jacobi is as CG alone: diagonals are constant. Trials and set-up of "auto"
pay where CG takes longer than these.

{table}

Products are those with the matrix, trials included; preconditioners count by their operations.
Iterations are the KSP's own.

{said}

`run/study drawn_kernels 1100 1160` draws others at random, with which nothing was tuned.

"""
WORDS = {
    "log1": "I + 100 log r, 256^2", "log3": "log r + 1e-3, 256^2", "log5": "log r + 1e-5, 256^2",
    "exp02": "exp l=0.02, nugget 0.01, 128^2", "exp05": "exp l=0.05, nugget 0.01, 256^2",
    "exp1": "exp l=0.1, nugget 0.01, 128^2", "matern_small": "Matern 3/2 l=0.02, nugget 0.01, 128^2",
    "matern_large": "Matern 3/2 l=0.02, nugget 0.01, 256^2", "yukawa1000": "I + 1000 Yukawa k=10, 32^3",
    "yukawa1": "Yukawa k=1, nugget 1e-3, 32^3", "yukawa10": "Yukawa k=10, nugget 1e-5, 32^3",
    "yukawa50": "Yukawa k=50, nugget 1e-6, 32^3", "laplace3": "(-Laplace)^0.3, 128^2",
    "laplace7": "(-Laplace)^0.7, 128^2", "imq1": "inverse multiquadric 1h, 16384",
    "imq3": "inverse multiquadric 3h, 16384", "wendland": "Wendland C2 30h, 16384",
    "gauss_odd": "I + 100 Gauss w=0.1, 193 x 207", "exp_odd": "exp l=0.02, nugget 0.1, 193 x 207",
}  # fmt: skip


if __name__ == "__main__":
    words = parser("kernels", __doc__)
    words.add_argument("-only", nargs="+", choices=[*nineteen(), *others(), *more(), *hard()], help="systems")
    words.add_argument("-ways", nargs="+", choices=WAYS, default=[*WAYS], help="ways to solve them")
    words.add_argument("-quick", action="store_true", help="five systems")
    main(words.parse_args())
