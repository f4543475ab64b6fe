"""The cones of contacts as Lorentz cones that share a normal number, and the blocks that they give a Newton step.

A friction cone is one Lorentz cone s = (mu n, t). Where a contact resists rolling and spinning, its cone is where three
are met: (mu n, t), (rho n, roll) and (sigma n, spin, 0). With A the map from impulses g to all s, the velocities of the
dual cone are y = A'z with z in the same Lorentz cones, which are their own duals: each resistance takes a part of y_n.

    s = A g,    N g + C g + r = A'z,    s and z in Lorentz cones, s'z = 0.

With the scalings W of the pairs a Newton step has the blocks

    B = A' T^-1 W^-2 A,    X = (B + C)^-1,

where T = 1 + e_n u' for Coulomb's law (`pctt.ccp.interior.conic`), else 1. The tangential numbers of a cone meet those
of the others in n alone, so X is a block diagonal D and a term of rank one, right left' / sigma. D and sigma are sums
of positive numbers, in which nothing cancels however near the boundary a pair is.

Source: Acary and Bourrier (2021) for the cone. The method of Siconos for friction and rolling, which also has a Lorentz
cone for each, keeps the parts of y_n as unknowns of its systems; here impulses are the only ones.

Each Lorentz cone x_0 >= |x_1:| is its own dual, with the Jordan product x o y = (x'y, x_0 y_1: + y_0 x_1:). Its unit is
e = (1, 0, 0), the spectral values of x are x_0 +- |x_1:|. Source: Domahidi, Chu and Boyd (2013).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dem.compiled import inlined, loop
from pctt.arrays import TINY, Array

HELD = 1e12  # stiffness of what is held, over that of normal impulses: the block keeps its digits
LEAST = 1e-17  # determinant of a unit point that rounding has put on or outside the boundary
ROUND = 1e-14  # tangential part of a unit scaling point below which it has no direction


class LorentzForm:
    """Of k Lorentz cones for each of ``count`` contacts; arrays of them are (k count, 3), all first ones first.

    weight : (k, count) mu, rho, sigma; 1 where they are zero
    live : (k, count) 1; 0 where they are zero: the problem does not have these tangential numbers
    known : (rows, 3) the same of the numbers of impulses, of which a contact has 3 in each part of ``count`` rows
    """

    def __init__(self, coefficient: Array, tangents: tuple[tuple[int, ...], ...]):
        """``coefficient`` (k, count); ``tangents``: of each cone, the numbers of a contact beside the first."""
        self.number, self.count = coefficient.shape
        self.weight = np.where(coefficient > 0, coefficient, 1.0)
        self.positive = (coefficient > 0).astype(float)
        self.width = 1 + sum(map(len, tangents))
        self.rows = self.count * self.width // 3
        #: (k, 2) of the tangential numbers among those of a contact; -1: there is none
        self.place = np.array([[*where, -1][:2] for where in tangents])
        self.mask = self.transpose(np.ones((coefficient.size, 3)))
        self.mask[: self.count, 0] = 1.0

    def apply(self, g: Array) -> Array:
        """A g of impulses or other numbers of contacts (rows, 3)."""
        out = np.zeros((self.weight.size, 3))
        _apply(g, self.weight, self.positive, self.place, out)
        return out

    def transpose(self, z: Array) -> Array:
        """A'z (rows, 3)."""
        return _transpose(z, self.weight, self.positive, self.place, np.zeros((self.rows, 3)), False)

    def impulses(self, s: Array) -> Array:
        """The g (rows, 3) with A g = s; where the normal numbers of a contact disagree, with the greatest."""
        return _transpose(s, self.weight, self.positive, self.place, np.zeros((self.rows, 3)), True)

    def right_inverse(self, y: Array) -> Array:
        """A z with A'z = y (rows, 3): all cones have the same part of the normal numbers."""
        z = self.apply(y)
        z[:, 0] = (y[: self.count, 0] / self.weight / self.number).ravel()
        return z

    def arrow(self, root: Array, size: Array, u: Array, normal: Array, tangential: Array) -> ArrowInverse:
        """Of scalings ``root``, ``size`` (`scaling`) and directions of sliding ``u`` (k count, 3), zero
        without Coulomb's law, where C is ``normal`` (count,) and, in tangential numbers, ``tangential`` (k count,)."""
        shape = (self.count, self.width, self.width)
        given = self.weight.ravel(), self.positive.ravel(), self.place, normal, tangential
        X = np.zeros(shape)
        return ArrowInverse(self, tangential, X, *_arrows(root, size, u, *given, X))

    def barriers(self, root: Array, size: Array, u: Array, least: float, more: Array) -> Array:
        """B (count, width, width), with ``more`` (count, width) on its diagonal; what the problem does not have is held
        by at least HELD times ``least``."""
        B = np.zeros((self.count, self.width, self.width))
        _barriers(root, size, u, self.weight.ravel(), self.positive.ravel(), self.place, least, more, B)
        return B


def joined(x: Array, parts: int) -> Array:
    """The numbers (count, 3 parts) of each contact, of rows (parts count, 3)."""
    return x if parts == 1 else np.concatenate(np.split(x, parts), axis=1)


def rows(x: Array, parts: int) -> Array:
    """The rows (parts count, 3) of the numbers (count, 3 parts) of each contact."""
    return x if parts == 1 else np.concatenate(np.split(x, parts, axis=1))


class ArrowInverse(NamedTuple):
    """X (count, width, width) and its parts. Of each cone: ``right`` and ``left`` (k count, 2), D (k count, 3), the
    ``part`` (k count,) of sigma (count,); and ``rise`` (k count,) and ``turn`` (k count, 2), see `dual_step`."""

    lorentz: LorentzForm
    tangential: Array
    X: Array
    right: Array
    left: Array
    D: Array
    part: Array
    sigma: Array
    rise: Array
    turn: Array

    def dual_step(self, dy: Array, f: Array, ds: Array) -> Array:
        """T^-1 dz (k count, 3) of the step ds = f - W^2 dz with A'T^-1 dz = dy (rows, 3).

        The tangential numbers are those of dy. With them eliminated from W^-2, normal ones are a sum that does not
        cancel, where a product with W^-2 would end at 1e-6. What rounding leaves of dy_n the cones share."""
        cones = self.lorentz
        dz = cones.apply(dy)
        _share_normals(dy, f, ds, cones.weight, (self.rise, self.turn, self.part), dz)
        return dz

    def uncoupled(self, f: Array, r: Array) -> Array:
        """X (A' T^-1 W^-2 f - r) (rows, 3) of f (k count, 3) and r (rows, 3), without a product with W^-2, which would
        drown in rounding: late in an iteration it has eigenvalues that differ by 1e18."""
        lorentz, parts_of = self.lorentz, self.lorentz.width // 3
        out = np.zeros((lorentz.count, lorentz.width))
        parts, weights = (self.right, self.left, self.D, self.part), (lorentz.weight.ravel(), self.sigma)
        _uncoupled(f, joined(r, parts_of), weights, lorentz.place, self.tangential, parts, out)
        return rows(out, parts_of)


@loop
def _apply(g, weight, live, place, out):
    cones, count = weight.shape
    for k in range(cones):
        for c in range(count):
            i = k * count + c
            out[i, 0] = weight[k, c] * g[c, 0]
            for a in range(2):
                m = place[k, a]
                if m >= 0:
                    out[i, 1 + a] = g[m // 3 * count + c, m % 3] * live[k, c]


@loop
def _transpose(z, weight, live, place, out, greatest):
    """The normal numbers are the sum of those in z times their weights, or the ``greatest`` by them."""
    cones, count = weight.shape
    for k in range(cones):
        for c in range(count):
            i = k * count + c
            if greatest:
                one = z[i, 0] / weight[k, c]
                out[c, 0] = one if k == 0 or not one <= out[c, 0] else out[c, 0]
            else:
                out[c, 0] += weight[k, c] * z[i, 0]
            for a in range(2):
                m = place[k, a]
                if m >= 0:
                    out[m // 3 * count + c, m % 3] = z[i, 1 + a] * live[k, c]
    return out


@loop
def _arrows(root, size, u, weight, live, place, normal, tangential, X):
    """Of each cone, W^-2 has the eigenvalue (1 + 2 h^2) / eta^2 along the tangential part h of the unit scaling point
    and 1 / eta^2 across it; a point on the boundary of its own has h of 1e9."""
    count, total = len(X), len(root)
    right, left, D = np.zeros((total, 2)), np.zeros((total, 2)), np.zeros((total, 3))
    part, sigma, rise, turn = np.zeros(total), np.zeros(count), np.zeros(total), np.zeros((total, 2))
    for c in range(count):
        sigma[c] = normal[c]
        for i in range(c, total, count):
            twice, squared = 2.0 * root[i, 0], size[i] * size[i]
            x, y = twice * root[i, 1], twice * root[i, 2]
            h = np.sqrt(x * x + y * y)
            x, y = (1.0, 0.0) if h <= ROUND else (x / h, y / h)
            along, across = (1.0 + 2.0 * h * h) / squared, 1.0 / squared
            of_along, of_across = live[i] / (along + tangential[i]), live[i] / (across + tangential[i])
            slope = 2.0 * np.sqrt(1.0 + h * h) * h / squared * of_along
            slides = x * u[i, 1] + y * u[i, 2]
            sideways = across * of_across
            right[i, 0], right[i, 1] = slope * x, slope * y
            turned = slope + (along * of_along - sideways) * slides
            left[i, 0], left[i, 1] = turned * x + sideways * u[i, 1], turned * y + sideways * u[i, 2]
            D[i, 0] = of_along * x * x + of_across * y * y
            D[i, 1] = (of_along - of_across) * x * y
            D[i, 2] = of_along * y * y + of_across * x * x
            part[i] = (across * across + along * tangential[i]) / (along + tangential[i])
            part[i] += tangential[i] * slope * slides
            sigma[c] += weight[i] * weight[i] * part[i]
            slope = 2.0 * np.sqrt(1.0 + h * h) * h / (1.0 + 2.0 * h * h)
            rise[i], turn[i, 0], turn[i, 1] = across / (1.0 + 2.0 * h * h), slope * x + u[i, 1], slope * y + u[i, 2]
        X[c, 0, 0] = 1.0 / sigma[c]
        for i in range(c, total, count):
            for a in range(2):
                m = place[i // count, a]
                if m < 0:
                    continue
                X[c, m, 0], X[c, 0, m] = weight[i] * right[i, a] / sigma[c], weight[i] * left[i, a] / sigma[c]
                for j in range(c, total, count):
                    for b in range(2):
                        n = place[j // count, b]
                        if n >= 0:
                            X[c, m, n] = weight[i] * right[i, a] * weight[j] * left[j, b] / sigma[c]
                            if i == j:
                                X[c, m, n] += D[i, a + b]
    return right, left, D, part, sigma, rise, turn


@loop
def _uncoupled(f, r, weights, place, tangential, parts, out):
    (right, left, D, part), (weight, sigma) = parts, weights
    count, total = len(out), len(f)
    for c in range(count):
        normal = -r[c, 0]
        for i in range(c, total, count):
            sums = part[i] * f[i, 0]
            for a in range(2):
                sums -= tangential[i] * left[i, a] * f[i, 1 + a]
                if place[i // count, a] >= 0:
                    sums -= left[i, a] * r[c, place[i // count, a]]
            normal += weight[i] * sums
        normal /= sigma[c]
        out[c, 0] = normal
        for i in range(c, total, count):
            m, n = place[i // count, 0], place[i // count, 1]
            x, y = tangential[i] * f[i, 1] + r[c, m], tangential[i] * f[i, 2] + (r[c, n] if n >= 0 else 0.0)
            more = weight[i] * normal - f[i, 0]
            out[c, m] = f[i, 1] - (D[i, 0] * x + D[i, 1] * y) + right[i, 0] * more
            if n >= 0:
                out[c, n] = f[i, 2] - (D[i, 1] * x + D[i, 2] * y) + right[i, 1] * more


@loop
def _share_normals(dy, f, ds, weight, parts, dz):
    """The normal numbers of dz in `ArrowInverse.dual_step`."""
    (rise, turn, part), (cones, count) = parts, weight.shape
    total = cones * count
    for c in range(count):
        lack, shared = dy[c, 0], 0.0
        for i in range(c, total, count):
            dz[i, 0] = rise[i] * (f[i, 0] - ds[i, 0]) - turn[i, 0] * dz[i, 1] - turn[i, 1] * dz[i, 2]
            lack -= weight[i // count, c] * dz[i, 0]
            shared += weight[i // count, c] ** 2 * part[i]
        for i in range(c, total, count):
            dz[i, 0] += weight[i // count, c] * part[i] * (lack / shared)


@loop
def _barriers(root, size, u, weight, live, place, least, more, B):
    count, total = len(B), len(root)
    for c in range(count):
        for i in range(c, total, count):
            twice, across = 2.0 * root[i, 0], 1.0 / (size[i] * size[i])
            h = twice * root[i, 1], twice * root[i, 2]
            square = h[0] * h[0] + h[1] * h[1]
            slope, slides = -2.0 * np.sqrt(1.0 + square) * across, h[0] * u[i, 1] + h[1] * u[i, 2]
            B[c, 0, 0] += weight[i] * weight[i] * ((1.0 + 2.0 * square) * across - slope * slides)
            for a in range(2):
                m = place[i // count, a]
                if m >= 0 and live[i] > 0:
                    B[c, m, 0] = weight[i] * slope * h[a]
                    B[c, 0, m] = weight[i] * (slope * h[a] - across * (u[i, 1 + a] + 2.0 * slides * h[a]))
                    B[c, m, m] = across
                    for b in range(2):
                        if place[i // count, b] >= 0:
                            B[c, m, place[i // count, b]] += 2.0 * across * h[a] * h[b]
        for m in range(1, B.shape[1]):
            if B[c, m, m] == 0.0:
                B[c, m, m] = HELD * max(B[c, 0, 0], least)
        for m in range(B.shape[1]):
            B[c, m, m] += more[c, m]


# -- algebra of one Lorentz cone ------------------------------------------------------------------------------


class NesterovTodd(NamedTuple):
    """The scaling W = eta (2 root root' - J), J = diag(1, -1, -1), of pairs: ``root`` (nc, 3), ``eta`` (nc,).

    Products by this form. Those by blocks lose a digit of the residual that the conic method reaches."""

    root: Array
    eta: Array


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
def right_hand_sides(root: Array, size: Array, z: Array, u: Array, w: Array) -> Array:
    """T^-1 (W^-1 w - z) (nc, 3); u (nc, 3) is the direction of sliding in T = 1 + e u'."""
    out = np.empty(z.shape)
    for c in range(len(z)):
        n, t_1, t_2 = _scaled(root, size, c, w, True)
        n, t_1, t_2 = n - z[c, 0], t_1 - z[c, 1], t_2 - z[c, 2]
        out[c, 0], out[c, 1], out[c, 2] = n - (u[c, 1] * t_1 + u[c, 2] * t_2), t_1, t_2
    return out


@loop
def uncoupled_changes(root: Array, size: Array, s: Array, w: Array) -> Array:
    """W w - s (nc, 3): ds of each cone without the others."""
    out = np.empty(s.shape)
    for c in range(len(s)):
        n, t_1, t_2 = _scaled(root, size, c, w, False)
        out[c, 0], out[c, 1], out[c, 2] = n - s[c, 0], t_1 - s[c, 1], t_2 - s[c, 2]
    return out


@loop
def subtract_inverse_squared(root: Array, size: Array, u: Array, x: Array, y: Array) -> Array:
    """x - T^-1 W^-2 y (nc, 3), with the T of `right_hand_sides`."""
    out = np.empty(x.shape)
    for c in range(len(x)):
        out[c, 0], out[c, 1], out[c, 2] = _scaled(root, size, c, y, True)
        n, t_1, t_2 = _scaled(root, size, c, out, True)
        out[c, 0] = x[c, 0] - (n - (u[c, 1] * t_1 + u[c, 2] * t_2))
        out[c, 1], out[c, 2] = x[c, 1] - t_1, x[c, 2] - t_2
    return out


@loop
def mehrotra_correction(root: Array, size: Array, z: Array, ds: Array, dz: Array, target: float) -> Array:
    """The w (nc, 3) with W z o w = target e - W^-1 ds o W dz."""
    out = np.empty(z.shape)
    for c in range(len(z)):
        p, q = _scaled(root, size, c, ds, True), _scaled(root, size, c, dz, False)
        n, t_1, t_2 = _jordan(p[0], p[1], p[2], q[0], q[1], q[2])
        x = _scaled(root, size, c, z, False)
        out[c, 0], out[c, 1], out[c, 2] = _jordan_divide(x[0], x[1], x[2], target - n, -t_1, -t_2)
    return out


@loop
def gondzio_correction(
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
def determinant(x: Array) -> Array:
    """x_0^2 - |x_1:|^2 (nc,) of points inside, kept positive in spite of rounding.

    Near the boundary rounding is at most 1.5 eps x_0^2: the first difference is exact, and neither the product nor the
    square is larger than x_0^2 / 2."""
    out = np.empty(len(x))
    for c in range(len(x)):
        out[c] = _determinant(x[c, 0], x[c, 1], x[c, 2])
    return out


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
