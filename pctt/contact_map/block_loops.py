"""Compiled loops over contacts that are stored as rows of 3 x 6 blocks (`BlockRows`).

The functions are those of `compact_loops`, for mass-scaled velocities. Row c has the blocks ``start[c]`` to
``start[c + 1] - 1``; their columns are in ``body`` (nb,).
"""

from __future__ import annotations

from pctt.compiled import inlined, loop


@inlined
def velocity_at(c, blocks, start, body, w):
    """G w at the contact c."""
    y0 = y1 = y2 = 0.0
    for k in range(start[c], start[c + 1]):
        i = body[k]
        for n in range(6):
            y0 += blocks[k, 0, n] * w[i, n]
            y1 += blocks[k, 1, n] * w[i, n]
            y2 += blocks[k, 2, n] * w[i, n]
    return y0, y1, y2


@inlined
def push(c, blocks, start, body, g0, g1, g2, m):
    """Add the momenta G' g of an impulse g at the contact c to m."""
    for k in range(start[c], start[c + 1]):
        i = body[k]
        for n in range(6):
            m[i, n] += blocks[k, 0, n] * g0 + blocks[k, 1, n] * g1 + blocks[k, 2, n] * g2


@loop
def add_velocities(blocks, start, body, w, y):
    """y += G w (nc, 3)."""
    for c in range(len(start) - 1):
        y0, y1, y2 = velocity_at(c, blocks, start, body, w)
        y[c, 0] += y0
        y[c, 1] += y1
        y[c, 2] += y2


@loop
def add_momenta(blocks, start, body, g, m):
    """m += G' g for impulses g (nc, 3)."""
    for c in range(len(start) - 1):
        push(c, blocks, start, body, g[c, 0], g[c, 1], g[c, 2], m)


@inlined
def weighted(weight, c, y0, y1, y2):
    """H y at the contact c. ``weight`` has the upper triangles of symmetric blocks H, (nc, 6), or all of H, (nc, 9)."""
    if weight.shape[1] == 6:
        return (
            weight[c, 0] * y0 + weight[c, 1] * y1 + weight[c, 2] * y2,
            weight[c, 1] * y0 + weight[c, 3] * y1 + weight[c, 4] * y2,
            weight[c, 2] * y0 + weight[c, 4] * y1 + weight[c, 5] * y2,
        )
    return (
        weight[c, 0] * y0 + weight[c, 1] * y1 + weight[c, 2] * y2,
        weight[c, 3] * y0 + weight[c, 4] * y1 + weight[c, 5] * y2,
        weight[c, 6] * y0 + weight[c, 7] * y1 + weight[c, 8] * y2,
    )


@loop
def add_through(blocks, start, body, weight, w, m):
    """m += G' H G w for the ``weight`` of `weighted`."""
    for c in range(len(start) - 1):
        y0, y1, y2 = velocity_at(c, blocks, start, body, w)
        f0, f1, f2 = weighted(weight, c, y0, y1, y2)
        push(c, blocks, start, body, f0, f1, f2, m)


@inlined
def pack(H, weight):
    """Blocks H (nc, 3, 3) as the ``weight`` of `weighted`."""
    whole = weight.shape[1] == 9
    for c in range(len(H)):
        for i in range(3):
            for j in range(0 if whole else i, 3):
                weight[c, 3 * i + j if whole else j if i == 0 else i + j + 1] = H[c, i, j]


@loop
def weights(blocks, start, body, H, weight):
    """The ``weight`` of `add_through` for H (nc, 3, 3)."""
    pack(H, weight)


@loop
def add_body_blocks(blocks, start, body, weight, out):
    """out (bodies, 6, 6) += the diagonal blocks of G' H G."""
    for c in range(len(start) - 1):
        for k in range(start[c], start[c + 1]):
            i = body[k]
            for n in range(6):
                b0, b1, b2 = blocks[k, 0, n], blocks[k, 1, n], blocks[k, 2, n]
                h0, h1, h2 = weighted(weight, c, b0, b1, b2)
                for p in range(6):
                    out[i, p, n] += blocks[k, 0, p] * h0 + blocks[k, 1, p] * h1 + blocks[k, 2, p] * h2


@loop
def local_product(weight, g, y):
    """y = H g (nc, 3) for the ``weight`` of `weighted`."""
    for c in range(len(weight)):
        y[c, 0], y[c, 1], y[c, 2] = weighted(weight, c, g[c, 0], g[c, 1], g[c, 2])
