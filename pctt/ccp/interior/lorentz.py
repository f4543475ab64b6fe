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
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dem.compiled import loop
from pctt.ccp.cone import Array, FrictionCones

ROUND = 1e-14  # tangential part of a unit scaling point below which it has no direction


class LorentzCones:
    """Of k Lorentz cones for each of ``count`` contacts; arrays of them are (k count, 3), all first ones first.

    weight : (k, count) mu, rho, sigma; 1 where they are zero
    live : (k, count) 1; 0 where they are zero: the problem does not have these tangential numbers
    known : (rows, 3) the same of the numbers of impulses, of which a contact has 3 in each part of ``count`` rows
    """

    def __init__(self, cones: FrictionCones):
        self.cones, coefficient = cones, cones.coefficients
        self.number, self.count = coefficient.shape
        self.weight = np.where(coefficient > 0, coefficient, 1.0)
        self.live = (coefficient > 0).astype(float)
        self.width = 1 + sum(map(len, cones.tangents))
        self.rows = self.count * self.width // 3
        #: (k, 2) of the tangential numbers among those of a contact; -1: there is none
        self.place = np.array([[*where, -1][:2] for where in cones.tangents])
        self.known = self.back(np.ones((coefficient.size, 3)))
        self.known[: self.count, 0] = 1.0

    def of(self, g: Array) -> Array:
        """A g of impulses or other numbers of contacts (rows, 3)."""
        out = np.zeros((self.weight.size, 3))
        _of(g, self.weight, self.live, self.place, out)
        return out

    def back(self, z: Array) -> Array:
        """A'z (rows, 3)."""
        return _back(z, self.weight, self.live, self.place, np.zeros((self.rows, 3)), False)

    def impulses(self, s: Array) -> Array:
        """The g (rows, 3) with A g = s; where the normal numbers of a contact disagree, with the greatest."""
        return _back(s, self.weight, self.live, self.place, np.zeros((self.rows, 3)), True)

    def spread(self, y: Array) -> Array:
        """A z with A'z = y (rows, 3): all cones have the same part of the normal numbers."""
        z = self.of(y)
        z[:, 0] = (y[: self.count, 0] / self.weight / self.number).ravel()
        return z

    def arrows(self, root: Array, size: Array, u: Array, normal: Array, tangential: Array) -> Arrows:
        """Of scalings ``root``, ``size`` (`pctt.ccp.cone.scaling`) and directions of sliding ``u`` (k count, 3), zero
        without Coulomb's law, where C is ``normal`` (count,) and, in tangential numbers, ``tangential`` (k count,)."""
        shape = (self.count, self.width, self.width)
        given = self.weight.ravel(), self.live.ravel(), self.place, normal, tangential
        X = np.zeros(shape)
        return Arrows(self, tangential, X, *_arrows(root, size, u, *given, X))

    def barriers(self, root: Array, size: Array, u: Array, least: float, more: Array) -> Array:
        """B (count, width, width), with ``more`` (count, width) on its diagonal; what the problem does not have is held
        by at least 1e12 times ``least``."""
        B = np.zeros((self.count, self.width, self.width))
        _barriers(root, size, u, self.weight.ravel(), self.live.ravel(), self.place, least, more, B)
        return B


class Arrows(NamedTuple):
    """X (count, width, width) and its parts. Of each cone: ``right`` and ``left`` (k count, 2), D (k count, 3), the
    ``part`` (k count,) of sigma (count,); and ``rise`` (k count,) and ``turn`` (k count, 2), see `split`."""

    lorentz: LorentzCones
    tangential: Array
    X: Array
    right: Array
    left: Array
    D: Array
    part: Array
    sigma: Array
    rise: Array
    turn: Array

    def split(self, dy: Array, f: Array, ds: Array) -> Array:
        """T^-1 dz (k count, 3) of the step ds = f - W^2 dz with A'T^-1 dz = dy (rows, 3).

        The tangential numbers are those of dy. With them eliminated from W^-2, normal ones are a sum that does not
        cancel, where a product with W^-2 would end at 1e-6. What rounding leaves of dy_n the cones share."""
        cones = self.lorentz
        dz = cones.of(dy)
        dz[:, 0] = self.rise * (f[:, 0] - ds[:, 0]) - self.turn[:, 0] * dz[:, 1] - self.turn[:, 1] * dz[:, 2]
        part = cones.weight * self.part.reshape(cones.number, -1)
        lack = dy[: cones.count, 0] - (cones.weight * dz[:, 0].reshape(cones.number, -1)).sum(axis=0)
        dz[:, 0] += (part * (lack / (cones.weight * part).sum(axis=0))).ravel()
        return dz

    def alone(self, f: Array, r: Array) -> Array:
        """X (A' T^-1 W^-2 f - r) (rows, 3) of f (k count, 3) and r (rows, 3), without a product with W^-2, which would
        drown in rounding: late in an iteration it has eigenvalues that differ by 1e18."""
        lorentz, cones = self.lorentz, self.lorentz.cones
        out = np.zeros((lorentz.count, lorentz.width))
        parts = self.right, self.left, self.D, self.part, self.sigma
        _alone(f, cones.joined(r), lorentz.weight.ravel(), lorentz.place, self.tangential, *parts, out)
        return cones.rows(out)


@loop
def _of(g, weight, live, place, out):
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
def _back(z, weight, live, place, out, greatest):
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
def _alone(f, r, weight, place, tangential, right, left, D, part, sigma, out):
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
                B[c, m, m] = 1e12 * max(B[c, 0, 0], least)
        for m in range(B.shape[1]):
            B[c, m, m] += more[c, m]
