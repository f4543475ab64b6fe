"""The friction cone |(g_1, g_2)| <= mu g_n and the arithmetic that the solvers need on it.

Impulses are arrays (nc, 3), one row per contact in the order (normal, tangent 1, tangent 2); ``mu`` is (nc,).

`FrictionCones` is what solvers ask of the cones of a problem; `pctt.ccp.rolling` has others with the same members.

The cone of friction 1 is its own dual, with the Jordan product x o y = (x'y, x_0 y_1: + y_0 x_1:). Its unit is
e = (1, 0, 0), the spectral values of x are x_0 +- |x_1:|. Source: Domahidi, Chu and Boyd (2013).

Compiled loops take arrays of rows flat: so the compiler knows the distance from one contact to the next, and works on
several at once. Comparisons are written so that a NaN stays a NaN. Constants have single precision, so that loops on
arrays of single precision stay in it. They are exact in double precision too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dem.compiled import PART, inlined, loop, prange

Array = NDArray[np.float64]
TINY = float(np.finfo(float).tiny)
ZERO, ONE = np.float32(0.0), np.float32(1.0)
STRIP = 256  # contacts whose numbers stay in the nearest cache from one loop to the next
LEAST = 1e-17  # determinant of a unit point that rounding has put on or outside the boundary
NO_MOVE = 64.0 * float(np.finfo(float).eps) ** 2  # (8 eps)^2: |move|^2 / |step y|^2 that rounding makes


@inlined
def _nearest(n, t_1, t_2, mu):
    """The nearest point of a cone, by selections: a processor could not predict branches."""
    length = np.sqrt(t_1 * t_1 + t_2 * t_2)
    height = (mu * length + n) * (ONE / (ONE + mu * mu))
    height = n if height < n else height
    height = ZERO if height < ZERO else height
    radius = mu * height
    reach = radius if length < radius else length
    shrink = radius / (ONE if reach == ZERO else reach)
    return height, t_1 * shrink, t_2 * shrink


@loop
def project_to(x: Array, mu: Array, out: Array) -> Array:
    """`project` into ``out``, which is C-contiguous."""
    flat, to = x.ravel(), out.reshape(out.size)
    for c in range(len(mu)):
        i = 3 * c
        to[i], to[i + 1], to[i + 2] = _nearest(flat[i], flat[i + 1], flat[i + 2], mu[c])
    return out


@loop
def not_idle(x: Array, last_x: Array, y: Array, mu: Array, least: float) -> NDArray[np.bool_]:
    """The loop of `FrictionCones.not_idle`."""
    out, enough = np.empty(len(mu), np.bool_), x.dtype.type(least)
    x, last_x, y = x.ravel(), last_x.ravel(), y.ravel()
    for c in range(len(mu)):
        i = 3 * c
        opening = y[i] - mu[c] * np.sqrt(y[i + 1] * y[i + 1] + y[i + 2] * y[i + 2])
        out[c] = (x[i] > 0) | (last_x[i] > 0) | (not opening > enough)
    return out


@loop
def errors(x: Array, y: Array, r: Array, step: float, mu: Array, de_saxce: float, units: Array) -> tuple[Array, float]:
    """Sums (5,) over the contacts, and the greatest -y_n, or 0. The sums are of |P(x - step y) - x|^2, where y gets the
    term (mu |y_t|, 0, 0) of De Saxce if ``de_saxce`` is 1, and below the rounding of step y it is zero: a contact that
    slides has 0 = P(-step y) only up to that; of |x|^2; and closing work, opening work and 1/2 x.(y - r).

    ``units`` (2, nc, 3) multiply x and y, if there are any: (0, nc, 3) is none."""
    sums, most = np.zeros((5, STRIP)), np.zeros(STRIP)
    g, v, scaled = np.empty(3 * STRIP), np.empty(3 * STRIP), len(units) > 0
    x, y, r = x.ravel(), y.ravel(), r.ravel()
    for first in range(0, len(mu), STRIP):
        friction = mu[first : first + STRIP]
        a, b = 3 * first, 3 * (first + len(friction))
        if scaled:
            _multiply(x[a:b], units[0].ravel()[a:b], g)
            _multiply(y[a:b], units[1].ravel()[a:b], v)
        else:
            g[: b - a], v[: b - a] = x[a:b], y[a:b]
        _add_moves(g, v, step, friction, de_saxce, sums[0])
        _add_works(g, v, r[a:b], len(friction), sums[1], sums[2], sums[3], sums[4], most)
    return sums.sum(axis=1), most.max()


@loop
def _multiply(x, y, out):
    for k in range(len(x)):
        out[k] = x[k] * y[k]


@loop
def _add_moves(x, y, step, mu, de_saxce, squares):
    """Comparisons, here and below, let a NaN through."""
    for c in range(len(mu)):
        i, m = 3 * c, mu[c]
        n, u, v, y_n, y_u, y_v = x[i], x[i + 1], x[i + 2], y[i], y[i + 1], y[i + 2]
        w = y_n + de_saxce * m * np.sqrt(y_u * y_u + y_v * y_v)
        to_n, to_u, to_v = _nearest(n - step * w, u - step * y_u, v - step * y_v, m)
        square = (to_n - n) ** 2 + (to_u - u) ** 2 + (to_v - v) ** 2
        squares[c] += 0.0 if square <= NO_MOVE * (step * step) * (y_n * y_n + y_u * y_u + y_v * y_v) else square


@loop
def _add_works(x, y, r, count, squares, closings, openings, energies, most):
    """In a loop of its own: a compiler makes vectors of two short loops, and not of a long one."""
    for c in range(count):
        i = 3 * c
        n, u, v, y_n, y_u, y_v = x[i], x[i + 1], x[i + 2], y[i], y[i + 1], y[i + 2]
        along = n * y_n + u * y_u + v * y_v
        closing = 0.0 if y_n > 0.0 else -y_n
        squares[c] += n * n + u * u + v * v
        closings[c] += n * closing
        openings[c] += 0.0 if along < 0.0 else along
        energies[c] += 0.5 * (along - (n * r[i] + u * r[i + 1] + v * r[i + 2]))
        most[c] = closing if closing > most[c] or closing != closing else most[c]


@loop
def accelerated_step(
    x: Array, last_x: Array, y: Array, compliance: Array, beta: float, step: float, mu: Array, de_saxce: float,
    out: Array,
) -> tuple[float, float, float]:  # fmt: skip
    """P(z - step y_z) for z = x + beta (x - last_x) and its gradient y_z = y + C z, to which the term (mu |y_t|, 0, 0)
    of De Saxce is added once (``de_saxce`` 1: Coulomb's law) or not (0). ``compliance`` has the diagonal of C (nc, 3),
    or no row for C = 0.

    Returned are, for this rank, d'Cd and |d|^2 of d = out - z, and y_z'(out - x); z and y_z are nowhere stored. A
    contact moves 64 bytes in single precision, 52 without compliance."""
    part, way, soft = x.dtype.type(beta), x.dtype.type(step), len(compliance) > 0
    sums = np.zeros(((len(mu) + PART - 1) // PART, 3))
    for k in prange(len(sums)):
        a, b = k * PART, min(k * PART + PART, len(mu))
        stiff = compliance[a:b] if soft else compliance
        sums[k] = _step_of_part(x[a:b], last_x[a:b], y[a:b], stiff, part, way, mu[a:b], de_saxce, out[a:b])
    return sums[:, 0].sum(), sums[:, 1].sum(), sums[:, 2].sum()


@loop
def _step_of_part(x, last_x, y, compliance, part, way, mu, de_saxce, out):
    soft = len(compliance) > 0
    x, last_x, y, compliance, to = x.ravel(), last_x.ravel(), y.ravel(), compliance.ravel(), out.reshape(out.size)
    z, y_z = np.empty(3 * STRIP, x.dtype), np.empty(3 * STRIP, x.dtype)
    squares, products = np.zeros(3 * STRIP, x.dtype), np.zeros(3 * STRIP, x.dtype)
    work = np.zeros(3 * STRIP, x.dtype)
    for first in range(0, len(mu), STRIP):
        friction = mu[first : first + STRIP]
        a, b = 3 * first, 3 * (first + len(friction))
        extrapolate(x[a:b], last_x[a:b], part, z)
        if soft:
            add_compliance(y[a:b], compliance[a:b], z, y_z)
        else:
            y_z[: b - a] = y[a:b]
        if de_saxce:
            _add_de_saxce(y_z, friction)
        _step(z, y_z, way, friction, to[a:b])
        add_squares(to[a:b], z, squares)
        add_products(to[a:b], x[a:b], y_z, products)
        if soft:
            add_work(to[a:b], z, compliance[a:b], work)
    return work.sum(), squares.sum(), products.sum()


@loop
def extrapolate(x, last_x, beta, out):
    for k in range(len(x)):
        out[k] = x[k] + beta * (x[k] - last_x[k])


@loop
def add_compliance(y, compliance, z, out):
    for k in range(len(y)):
        out[k] = y[k] + compliance[k] * z[k]


@loop
def add_work(x, y, compliance, sums):
    for k in range(len(x)):
        sums[k] += compliance[k] * (x[k] - y[k]) ** 2


@loop
def _add_de_saxce(y, mu):
    for c in range(len(mu)):
        i = 3 * c
        y[i] += mu[c] * np.sqrt(y[i + 1] * y[i + 1] + y[i + 2] * y[i + 2])


@loop
def _step(x, y, step, mu, out):
    for c in range(len(mu)):
        i = 3 * c
        n, t_1, t_2 = x[i] - step * y[i], x[i + 1] - step * y[i + 1], x[i + 2] - step * y[i + 2]
        out[i], out[i + 1], out[i + 2] = _nearest(n, t_1, t_2, mu[c])


@loop
def add_squares(x, y, sums):
    for k in range(len(x)):
        sums[k] += (x[k] - y[k]) ** 2


@loop
def add_products(x, y, z, sums):
    for k in range(len(x)):
        sums[k] += (x[k] - y[k]) * z[k]


@loop
def times(blocks: Array, x: Array) -> Array:
    """Products of blocks (nc, 3, 3) with rows. (Twice as fast as a batched matrix product.)"""
    out = np.empty_like(x)
    for c in range(len(x)):
        n, t_1, t_2 = x[c, 0], x[c, 1], x[c, 2]
        for i in range(3):
            out[c, i] = blocks[c, i, 0] * n + blocks[c, i, 1] * t_1 + blocks[c, i, 2] * t_2
    return out


@loop
def step_to_boundary(x: Array, dx: Array, mu: Array) -> float:
    """Largest a such that x + a dx is in the cones of this rank (inf where nothing limits it); x is inside.

    The smaller positive root of |x_t + a dx_t|^2 = mu^2 (x_n + a dx_n)^2, in the form that does not cancel,
    and the apex x_n + a dx_n = 0 (which alone limits a contact without friction).
    """
    x, dx = x.ravel(), dx.ravel()
    least = np.inf
    for c in range(len(mu)):
        i, m = 3 * c, mu[c]
        n, t_1, t_2 = x[i], x[i + 1], x[i + 2]
        dn, dt_1, dt_2 = dx[i], dx[i + 1], dx[i + 2]
        size = np.sqrt(t_1 * t_1 + t_2 * t_2)
        quadratic = dt_1 * dt_1 + dt_2 * dt_2 - (m * dn) ** 2
        linear = t_1 * dt_1 + t_2 * dt_2 - m * m * n * dn
        inside = (m * n - size) * (m * n + size)
        discriminant = linear * linear + quadratic * inside
        step = np.inf
        if linear > 0 and discriminant >= 0:
            step = inside / (linear + np.sqrt(discriminant))
        elif linear <= 0 and quadratic > 0 and m > 0:
            step = (np.sqrt(max(discriminant, 0.0)) - linear) / quadratic
        if dn < 0 and not -n / dn >= step:
            step = -n / dn
        if not step >= least:
            least = step
            if step != step:  # no other is smaller
                break
    return least


@loop
def step_inside(x: Array, dx: Array) -> float:
    """`step_to_boundary` in the cones of friction 1, for an x that rounding may have put on the boundary: there it is
    not zero. It is zero where dx is no number.

    By the smallest spectral value of dx seen from x (Vandenberghe, "The CVXOPT linear and quadratic cone program
    solvers", 2010)."""
    fastest = 0.0
    for c in range(len(x)):
        x_0, x_1, x_2 = x[c, 0], x[c, 1], x[c, 2]
        dx_0, dx_1, dx_2 = dx[c, 0], dx[c, 1], dx[c, 2]
        size = np.sqrt(_determinant(x_0, x_1, x_2))
        inner = (x_0 * dx_0 - x_1 * dx_1 - x_2 * dx_2) / size
        along = (inner + dx_0) / (x_0 + size)
        turned_1, turned_2 = dx_1 - along * x_1, dx_2 - along * x_2
        speed = (np.sqrt(turned_1 * turned_1 + turned_2 * turned_2) - inner) / size
        if not speed <= fastest:
            fastest = speed
            if speed != speed:
                return 0.0
    return 1.0 / fastest if fastest > 0 else np.inf


@loop
def step_to_zero(x: Array, dx: Array) -> float:
    """Largest a such that x + a dx >= 0 on this rank, x > 0."""
    least = np.inf
    for c in range(len(x)):
        if dx[c] < 0 and not -x[c] / dx[c] >= least:
            least = -x[c] / dx[c]
            if least != least:
                break
    return least


@loop
def determinant(x: Array) -> Array:
    """x_0^2 - |x_1:|^2 (nc,) of points inside, kept positive in spite of rounding.

    Near the boundary rounding is at most 1.5 eps x_0^2: the first difference is exact, and neither the product nor the
    square is larger than x_0^2 / 2."""
    out = np.empty(len(x))
    for c in range(len(x)):
        out[c] = _determinant(x[c, 0], x[c, 1], x[c, 2])
    return out


@loop
def scaling(s: Array, z: Array) -> tuple[Array, Array]:
    """The Nesterov-Todd scaling W of pairs (s, z) inside the cones x_0 >= |x_1:|, the symmetric W with W z = W^-1 s:
    its unit hyperbolic vector (nc, 3) and size eta (nc,), see `NesterovTodd`.

    W has the eigenvalues eta (w_0 + |w_1:|), eta / (w_0 + |w_1:|) and eta for (1, u), (1, -u) and (0, u'), where u is
    the direction of the unit scaling point w. Source: Nesterov and Todd (1997); Andersen, Roos and Terlaky (2003)."""
    root, size = np.empty((len(s), 3)), np.empty(len(s))
    for c in range(len(s)):
        size_s = np.sqrt(_determinant(s[c, 0], s[c, 1], s[c, 2]))
        size_z = np.sqrt(_determinant(z[c, 0], z[c, 1], z[c, 2]))
        cosine = (s[c, 0] * z[c, 0] + s[c, 1] * z[c, 1] + s[c, 2] * z[c, 2]) / (size_s * size_z)
        angle = 0.5 * (1.0 + cosine)
        angle = np.sqrt(0.5 if angle < 0.5 else angle)
        of_s, of_z = 0.5 / (angle * size_s), 0.5 / (angle * size_z)
        first, size[c] = of_s * s[c, 0] + of_z * z[c, 0], np.sqrt(size_s / size_z)
        length = np.sqrt(2.0 * (1.0 + first))
        root[c, 0] = (1.0 + first) / length
        root[c, 1] = (of_s * s[c, 1] - of_z * z[c, 1]) / length
        root[c, 2] = (of_s * s[c, 2] - of_z * z[c, 2]) / length
    return root, size


@loop
def nesterov_todd(root: Array, size: Array, x: Array, inverse: bool) -> Array:
    """W x (nc, 3) for the W of `scaling`, or W^-1 x."""
    out = np.empty(x.shape)
    for c in range(len(x)):
        out[c, 0], out[c, 1], out[c, 2] = _scaled(root, size, c, x, inverse)
    return out


@loop
def pulls(root: Array, size: Array, s: Array, z: Array, u: Array, w: Array) -> tuple[Array, Array]:
    """T^-1 (W^-1 w - z) and W w - s (nc, 3); u (nc, 3) is the direction of sliding in T = 1 + e u'."""
    out, other = np.empty(s.shape), np.empty(s.shape)
    for c in range(len(s)):
        n, t_1, t_2 = _scaled(root, size, c, w, True)
        n, t_1, t_2 = n - z[c, 0], t_1 - z[c, 1], t_2 - z[c, 2]
        out[c, 0], out[c, 1], out[c, 2] = n - (u[c, 1] * t_1 + u[c, 2] * t_2), t_1, t_2
        n, t_1, t_2 = _scaled(root, size, c, w, False)
        other[c, 0], other[c, 1], other[c, 2] = n - s[c, 0], t_1 - s[c, 1], t_2 - s[c, 2]
    return out, other


@loop
def less_inverse_squares(root: Array, size: Array, u: Array, x: Array, y: Array) -> Array:
    """x - T^-1 W^-2 y (nc, 3), with the T of `pulls`."""
    out = np.empty(x.shape)
    for c in range(len(x)):
        out[c, 0], out[c, 1], out[c, 2] = _scaled(root, size, c, y, True)
        n, t_1, t_2 = _scaled(root, size, c, out, True)
        out[c, 0] = x[c, 0] - (n - (u[c, 1] * t_1 + u[c, 2] * t_2))
        out[c, 1], out[c, 2] = x[c, 1] - t_1, x[c, 2] - t_2
    return out


@loop
def centring(root: Array, size: Array, z: Array, ds: Array, dz: Array, target: float) -> Array:
    """The w (nc, 3) with W z o w = target e - W^-1 ds o W dz."""
    out = np.empty(z.shape)
    for c in range(len(z)):
        p, q = _scaled(root, size, c, ds, True), _scaled(root, size, c, dz, False)
        n, t_1, t_2 = _jordan(p[0], p[1], p[2], q[0], q[1], q[2])
        x = _scaled(root, size, c, z, False)
        out[c, 0], out[c, 1], out[c, 2] = _jordan_divide(x[0], x[1], x[2], target - n, -t_1, -t_2)
    return out


@loop
def towards_path(
    root: Array, size: Array, z: Array, ds: Array, dz: Array, reach: float, low: float, high: float
) -> Array:
    """The w (nc, 3) with W z o w = d: the d that moves the spectral values of (W z + reach W^-1 ds) o (W z + reach W
    dz) into [low, high], but none by more than ``high`` downwards."""
    out = np.empty(z.shape)
    for c in range(len(z)):
        x, p, q = _scaled(root, size, c, z, False), _scaled(root, size, c, ds, True), _scaled(root, size, c, dz, False)
        n, t_1, t_2 = _jordan(
            x[0] + reach * p[0], x[1] + reach * p[1], x[2] + reach * p[2],
            x[0] + reach * q[0], x[1] + reach * q[1], x[2] + reach * q[2],
        )  # fmt: skip
        length = np.sqrt(t_1 * t_1 + t_2 * t_2)
        more, less = _into(n + length, low, high), _into(n - length, low, high)
        turn = 0.5 * (more - less) / max(length, TINY)
        n, t_1, t_2 = 0.5 * (more + less), turn * t_1, turn * t_2
        out[c, 0], out[c, 1], out[c, 2] = _jordan_divide(x[0], x[1], x[2], n, t_1, t_2)
    return out


@inlined
def _into(value, low, high):
    move = min(max(value, low), high) - value
    return -high if move < -high else move


@inlined
def _scaled(root, size, c, x, inverse):
    """W x of a contact, or W^-1 x."""
    first, u, v, eta = root[c, 0], root[c, 1], root[c, 2], size[c]
    if inverse:
        u, v, eta = -u, -v, 1.0 / eta
    along = 2.0 * (first * x[c, 0] + u * x[c, 1] + v * x[c, 2])
    return (along * first - x[c, 0]) * eta, (along * u + x[c, 1]) * eta, (along * v + x[c, 2]) * eta


@inlined
def _jordan(x_0, x_1, x_2, y_0, y_1, y_2):
    """x o y."""
    return x_0 * y_0 + x_1 * y_1 + x_2 * y_2, x_0 * y_1 + y_0 * x_1, x_0 * y_2 + y_0 * x_2


@inlined
def _jordan_divide(x_0, x_1, x_2, y_0, y_1, y_2):
    """The w with x o w = y; x inside the cone."""
    first = (x_0 * y_0 - x_1 * y_1 - x_2 * y_2) / _determinant(x_0, x_1, x_2)
    return first, (y_1 - first * x_1) / x_0, (y_2 - first * x_2) / x_0


@inlined
def _determinant(x_0, x_1, x_2):
    small, large = abs(x_1), abs(x_2)
    if small > large:
        small, large = large, small
    found = (x_0 - large) * (x_0 + large) - small * small
    least = max(LEAST * x_0 * x_0, TINY)
    return least if found < least else found


# -- what solvers ask of cones ----------------------------------------------------------------------------------


def project(x: Array, mu: Array, out: Array | None = None) -> Array:
    """Euclidean projection of each row on its friction cone; ``out`` may be x itself.

    >>> project(np.array([[1.0, 0.0, 1.0], [-1.0, 0.0, 0.1]]), np.array([1.0, 1.0]))
    array([[1., 0., 1.],
           [0., 0., 0.]])
    """
    return project_to(x, mu, np.empty(x.shape, x.dtype) if out is None else out)


def margin(x: Array, mu: Array) -> Array:
    """mu g_n - |(g_1, g_2)|, positive inside the cone (nc,)."""
    return mu * x[:, 0] - tangential(x)


def tangential(x: Array) -> Array:
    """|(g_1, g_2)| (nc,). (Five times as fast as np.hypot; no impulse is near the ends of the range of numbers.)"""
    t = x[:, 1] * x[:, 1]
    t += x[:, 2] * x[:, 2]
    return np.sqrt(t, out=t)


def dot(x: Array, y: Array) -> Array:
    """Inner products of rows (nc,). (Six times as fast as a sum along rows of three.)"""
    out: Array = x[:, 0] * y[:, 0]
    out += x[:, 1] * y[:, 1]
    out += x[:, 2] * y[:, 2]
    return out


class FrictionCones:
    """The cones of all contacts of this rank. Arrays of unknowns are (rows, 3), the first rows with the normals."""

    #: of each Lorentz cone of a contact, which numbers of the contact it has beside the first (`interior.lorentz`)
    tangents: tuple[tuple[int, ...], ...] = ((1, 2),)

    def __init__(self, mu: Array):
        self.mu, self.count = mu, len(mu)

    @property
    def coefficients(self) -> Array:
        """(k, count) of the k Lorentz cones."""
        return self.mu[None]

    def joined(self, x: Array) -> Array:
        """The numbers (count, width) of each contact, of rows (rows, 3)."""
        return x

    def rows(self, x: Array) -> Array:
        """The rows (rows, 3) of the numbers (count, width) of each contact."""
        return x

    def times(self, blocks: Array, x: Array) -> Array:
        """Products of blocks (count, width, width) with the numbers of contacts, in rows (rows, 3)."""
        return times(blocks, x)

    def scaled(self, size: Array, precision: type[np.floating]) -> FrictionCones:
        """The cones of unknowns multiplied by ``size`` (rows, 3), whose tangential numbers are equal."""
        return FrictionCones((self.mu * size[:, 1] / size[:, 0]).astype(precision, copy=False))

    def rows_of(self, contacts: NDArray[np.intp]) -> NDArray[np.intp]:
        """The rows of these contacts (n,), ascending."""
        return contacts

    def only(self, contacts: NDArray[np.intp]) -> FrictionCones:
        """Those of these contacts (n,)."""
        return FrictionCones(self.mu[contacts])

    def project(self, x: Array, out: Array) -> Array:
        """The nearest points (rows, 3), into ``out``, which may be x."""
        return project_to(x, self.mu, out)

    def resisted(self, y: Array) -> Array:
        """De Saxce's term mu |y_t| (count,): the power that velocities y lose for a unit of normal impulse."""
        return self.mu * tangential(y)

    def accelerated_step(
        self, x: Array, last_x: Array, y: Array, compliance: Array, beta: float, step: float, coulomb: bool, out: Array
    ) -> tuple[float, float, float]:
        """The loop `accelerated_step` for these cones."""
        return accelerated_step(x, last_x, y, compliance, beta, step, self.mu, float(coulomb), out)

    def move(self, x: Array, y: Array, step: Array | float, coulomb: bool = False) -> Array:
        """P(x - step y) - x (rows, 3) for one length or many; for Coulomb's law y_n gets De Saxce's term."""
        out = y.copy()
        if coulomb:
            out[: self.count, 0] += self.resisted(y)
        out *= -step
        out += x
        self.project(out, out)
        out -= x
        return out

    def errors(
        self, g: Array, y: Array, r: Array, step: float, coulomb: bool, units: Array | None = None
    ) -> tuple[Array, float]:
        """||`move`||^2, |g|^2, closing work, opening work and 1/2 g.(y - r) of this rank's contacts (5,), and the
        greatest speed at which one closes. ``units`` (2, rows, 3) multiply g and y."""
        return errors(g, y, r, step, self.mu, float(coulomb), np.empty((0, *r.shape)) if units is None else units)

    def not_idle(self, x: Array, last_x: Array, y: Array, least: float) -> NDArray[np.bool_]:
        """Mask (count,) of the contacts but those without an impulse at x and last_x whose distance inside the dual
        cone, y_n less `resisted`, exceeds the ``least``."""
        return not_idle(x, last_x, y, self.mu, least)


# -- the cone of friction 1 -----------------------------------------------------------------------------------


class NesterovTodd(NamedTuple):
    """The scaling W = eta (2 root root' - J), J = diag(1, -1, -1), of pairs: ``root`` (nc, 3), ``eta`` (nc,), as
    `scaling` has them.

    Products by this form. Those by blocks lose a digit of the residual that the conic method reaches."""

    root: Array
    eta: Array

    def times(self, x: Array) -> Array:
        """W x (nc, 3)."""
        return nesterov_todd(self.root, self.eta, x, False)

    def divide(self, x: Array) -> Array:
        """W^-1 x (nc, 3)."""
        return nesterov_todd(self.root, self.eta, x, True)


@loop
def central_pair(x: Array, tau: Array, complementarity: float) -> tuple[Array, Array]:
    """The pair (s, z) inside the cones with s - tau z = x and s o z = complementarity e; tau (nc,).

    In the spectral values l of x: s = (l + root(l^2 + 4 complementarity tau)) / 2, and z likewise of -l."""
    s, z = np.empty(x.shape), np.empty(x.shape)
    for c in range(len(x)):
        size = np.sqrt(x[c, 1] * x[c, 1] + x[c, 2] * x[c, 2])
        high, of_high = _central(x[c, 0] + size, 4.0 * complementarity * tau[c])
        low, of_low = _central(x[c, 0] - size, 4.0 * complementarity * tau[c])
        turn, back = 0.5 * (high - low) / max(size, TINY), 0.5 * (of_high - of_low) / max(size, TINY) / tau[c]
        s[c, 0], s[c, 1], s[c, 2] = 0.5 * (high + low), turn * x[c, 1], turn * x[c, 2]
        z[c, 0], z[c, 1], z[c, 2] = 0.5 * (of_high + of_low) / tau[c], back * x[c, 1], back * x[c, 2]
    return s, z


@inlined
def _central(value, room):
    """Two positive numbers whose difference is the value and whose product is room / 4."""
    larger = 0.5 * (abs(value) + np.sqrt(value * value + room))
    smaller = 0.25 * room / larger  # their difference would cancel
    return (larger, smaller) if value > 0 else (smaller, larger)
