"""Unit quaternions (w, x, y, z) as rotations from the body frame to the world frame.

Every public function but `integrate` works on stacks: quaternions have shape (..., 4), vectors (..., 3).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from dem.compiled import loop

if TYPE_CHECKING:
    from dem.arrays import Floats

#: scipy takes and gives (x, y, z, w); its `scalar_first` came with 1.14.
_TO_SCIPY, _FROM_SCIPY = [1, 2, 3, 0], [3, 0, 1, 2]


def cross(a: Floats, b: Floats) -> Floats:
    """Cross product of vectors (..., 3); several times faster than `numpy.cross` on long arrays."""
    out = np.empty(np.broadcast(a, b).shape)
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def across(axis: Floats) -> Floats:
    """Unit vectors (m, 3) normal to the given ones (m, 3)."""
    other = np.zeros_like(axis)
    other[np.arange(len(axis)), np.abs(axis).argmin(axis=1)] = 1.0
    normal = cross(axis, other)
    return normal / length(normal)[:, None]


def length(v: Floats) -> Floats:
    """Lengths (...,) of vectors (..., n); several times faster than `numpy.linalg.norm` on long arrays."""
    return np.sqrt(np.einsum("...i,...i->...", v, v))


def multiply(p: Floats, q: Floats) -> Floats:
    """Hamilton product (..., 4): the rotation `q` followed by the rotation `p`."""
    pw, pv = p[..., :1], p[..., 1:]
    qw, qv = q[..., :1], q[..., 1:]
    w = pw * qw - (pv * qv).sum(axis=-1, keepdims=True)
    return np.concatenate([w, pw * qv + qw * pv + cross(pv, qv)], axis=-1)


def conjugate(q: Floats) -> Floats:
    """Inverse rotation (..., 4) of unit quaternions."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def normalized(q: Floats) -> Floats:
    """Quaternions (..., 4) scaled to unit norm."""
    return q / length(q)[..., None]


def rotate(q: Floats, v: Floats) -> Floats:
    """Vectors (..., 3) turned from the body frame to the world frame."""
    w, u = q[..., :1], q[..., 1:]
    uv = cross(u, v)
    return v + 2.0 * (w * uv + cross(u, uv))


def matrix(q: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) from the body frame to the world frame."""
    return _matrices(np.ascontiguousarray(q, dtype=float).reshape(-1, 4)).reshape(q.shape[:-1] + (3, 3))


@loop
def _matrices(q: Floats) -> Floats:
    out = np.empty((len(q), 3, 3))
    for n in range(len(q)):
        w, x, y, z = q[n, 0], q[n, 1], q[n, 2], q[n, 3]
        out[n, 0, 0], out[n, 1, 1] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z)
        out[n, 2, 2] = 1 - 2 * (x * x + y * y)
        out[n, 0, 1], out[n, 1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
        out[n, 0, 2], out[n, 2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
        out[n, 1, 2], out[n, 2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    return out


def from_matrix(r: Floats) -> Floats:
    """Unit quaternion (4,) of one rotation matrix (3, 3)."""
    return Rotation.from_matrix(r).as_quat()[_FROM_SCIPY]


def exponential(rotation: Floats) -> Floats:
    """Quaternions (..., 4) of rotation vectors (..., 3): angle in radians times unit axis."""
    return Rotation.from_rotvec(rotation).as_quat()[..., _FROM_SCIPY]


def rotation_vector(before: Floats, after: Floats) -> Floats:
    """Rotation vectors (..., 3), angle [rad] times unit axis in the world frame, of the shortest turns from one
    orientation (..., 4) to another; exact also for tiny angles."""
    return Rotation.from_quat(multiply(after, conjugate(before))[..., _TO_SCIPY]).as_rotvec()


@loop
def integrate(q: Floats, velocity: Floats, dt: float) -> Floats:
    """Orientations (n, 4) after the time `dt` [s] at constant world-frame angular velocities [rad/s]: the last three
    columns of `velocity` (n, 3 or more).

    q <- exp(dt w) q, renormalised so that the rounding of many steps does not add up.
    """
    out = np.empty((len(q), 4))
    for n in range(len(q)):
        x, y, z = dt * velocity[n, -3], dt * velocity[n, -2], dt * velocity[n, -1]
        angle = np.sqrt(x * x + y * y + z * z)
        w = np.cos(0.5 * angle)
        share = np.sin(0.5 * angle) / angle if angle > 0.0 else 0.5
        x, y, z = share * x, share * y, share * z
        a, b, c, d = q[n, 0], q[n, 1], q[n, 2], q[n, 3]
        e, f = w * a - x * b - y * c - z * d, w * b + a * x + y * d - z * c
        g, h = w * c + a * y + z * b - x * d, w * d + a * z + x * c - y * b
        size = 1.0 / np.sqrt(e * e + f * f + g * g + h * h)
        out[n, 0], out[n, 1], out[n, 2], out[n, 3] = size * e, size * f, size * g, size * h
    return out


def principal(tensor: Floats) -> tuple[Floats, Floats]:
    """Principal moments (3,) and axes, as a quaternion (4,), of an inertia tensor (3, 3); where it is diagonal the axes
    stay."""
    moments, axes = np.diag(tensor).copy(), np.eye(3)
    if np.abs(tensor - np.diag(moments)).max() > 1e-12 * moments.max():
        moments, axes = np.linalg.eigh(tensor)
        axes[:, 2] *= np.linalg.det(axes)  # right-handed
    return moments, from_matrix(axes)
