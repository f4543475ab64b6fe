"""The functions of ``barrier`` as loops over the contacts."""

from __future__ import annotations

import numpy as np

from pctt.compiled import loop


@loop
def perspective_value(g, mu):
    out = np.empty(len(mu))
    for c in range(len(mu)):
        n = g[c, 0]
        f = 0.5 * ((g[c, 1] * g[c, 1] + g[c, 2] * g[c, 2]) / n - mu[c] * mu[c] * n)
        out[c] = f if mu[c] > 0 else -n
    return out


@loop
def perspective_gradient(g, mu):
    out = np.empty_like(g)
    for c in range(len(mu)):
        u, v = g[c, 1] / g[c, 0], g[c, 2] / g[c, 0]
        if mu[c] == 0:
            out[c, 0], out[c, 1], out[c, 2] = -1.0, 0.0, 0.0
        else:
            out[c, 0], out[c, 1], out[c, 2] = -0.5 * (u * u + v * v + mu[c] * mu[c]), u, v
    return out


@loop
def perspective_hessian(g, mu):
    out = np.zeros((len(mu), 3, 3))
    for c in range(len(mu)):
        if mu[c] != 0:
            bend = 1.0 / g[c, 0]
            u, v = g[c, 1] * bend, g[c, 2] * bend
            out[c, 0, 0] = (u * u + v * v) * bend
            out[c, 0, 1] = out[c, 1, 0] = -u * bend
            out[c, 0, 2] = out[c, 2, 0] = -v * bend
            out[c, 1, 1] = out[c, 2, 2] = bend
            out[c, 1, 2] = out[c, 2, 1] = 0.0 * bend  # none where that is no number
    return out


@loop
def blocks(lam, f, df, hessian):
    out = np.empty_like(hessian)
    for c in range(len(lam)):
        size, stiff = lam[c], lam[c] / -f[c]
        for i in range(3):
            for j in range(3):
                out[c, i, j] = size * hessian[c, i, j] + stiff * df[c, i] * df[c, j]
    return out
