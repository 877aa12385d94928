"""Rotations and rigid transforms as arrays.

A transform `a_from_b` is a 4x4 float64 matrix (batches: (..., 4, 4)) that maps homogeneous coordinates of frame b into
frame a. Rotation vectors are radians; quaternions are unit and in the order x, y, z, w.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mrasfm_engine.types import Floats, Ints


def _rows_from_rotation() -> Floats:
    """Matrix (9, 16): four times the products (4, 4) of a quaternion's components, less the identity, of a rotation."""
    result = np.zeros((3, 3, 4, 4))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[i, i] = np.diag([*(2.0 * np.eye(3)[i] - 1.0), 1.0])
        result[[i, j], [j, i], i, j] = result[[i, j], [j, i], j, i] = 1.0
        result[k, j, i, 3] = result[k, j, 3, i] = 1.0
        result[j, k, i, 3] = result[j, k, 3, i] = -1.0
    return result.reshape(9, 16)


_ROWS_FROM_ROTATION, _ROWS_OF_NOTHING = _rows_from_rotation(), np.eye(4).ravel()


def skew(v: ArrayLike) -> Floats:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): `skew(v) @ x == cross(v, x)`."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def exp_so3(rotation_vector: ArrayLike) -> Floats:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians (Rodrigues' formula)."""
    w = np.asarray(rotation_vector, dtype=np.float64)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    k = skew(w)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle**2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    result: Floats = np.eye(3) + a * k + b * (k @ k)
    return result


def log_so3(rotation: ArrayLike) -> Floats:
    """Rotation vectors (..., 3) in radians, norm at most pi, of rotation matrices (..., 3, 3)."""
    q = quaternion_from_rotation(rotation)
    v, w = q[..., :3], q[..., 3]
    n = np.sqrt((v * v).sum(-1))
    small = n < 1e-9
    result: Floats = v * np.where(small, 2.0, 2.0 * np.arctan2(n, w) / np.where(small, 1.0, n))[..., None]
    return result


def quaternion_from_rotation(rotation: ArrayLike) -> Floats:
    """Unit quaternions (..., 4), x y z w, w >= 0, of rotation matrices (..., 3, 3)."""
    r = np.asarray(rotation, dtype=np.float64)
    # Shepperd's method: each row is the quaternion times four times one of its components, of which the largest serves.
    rows = (r.reshape(-1, 9) @ _ROWS_FROM_ROTATION + _ROWS_OF_NOTHING).reshape(-1, 4, 4)
    q = rows[np.arange(len(rows)), np.einsum("nii->ni", rows).argmax(1)]
    q *= (np.where(q[:, 3] < 0, -1.0, 1.0) / np.sqrt(np.einsum("ni,ni->n", q, q)))[:, None]
    result: Floats = q.reshape(*r.shape[:-2], 4)
    return result


def rotation_from_quaternion(quaternion_xyzw: ArrayLike) -> Floats:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), x y z w, which are normalised first."""
    q = np.asarray(quaternion_xyzw, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    k = skew(q[..., :3])
    result: Floats = np.eye(3) + 2 * q[..., 3, None, None] * k + 2 * (k @ k)
    return result


def transform(rotation: ArrayLike, translation: ArrayLike) -> Floats:
    """Transforms (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    r, t = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    out = np.zeros((*np.broadcast_shapes(r.shape[:-2], t.shape[:-1]), 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = r, t, 1.0
    return out


def inverse(a_from_b: ArrayLike) -> Floats:
    """`b_from_a` (..., 4, 4)."""
    m = np.asarray(a_from_b, dtype=np.float64)
    r = np.swapaxes(m[..., :3, :3], -1, -2)
    return transform(r, -(r @ m[..., :3, 3:])[..., 0])


def apply(a_from_b: ArrayLike, points_b: ArrayLike) -> Floats:
    """Points (..., n, 3) of frame b in frame a."""
    m, x = np.asarray(a_from_b, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    result: Floats = x @ np.swapaxes(m[..., :3, :3], -1, -2) + m[..., None, :3, 3]
    return result


def exp_se3(twist: ArrayLike) -> Floats:
    """Transforms (..., 4, 4) of twists (..., 6): rotation vector (rad), then velocity, both in the moving frame.

    A frame that turns and moves at a constant rate for unit time ends there. Source: Barfoot, "State Estimation for
    Robotics" (2017), section 7.1.
    """
    xi = np.asarray(twist, dtype=np.float64)
    w = xi[..., :3]
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    k = skew(w)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    b = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1.0 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    left_jacobian = np.eye(3) + b * k + c * (k @ k)
    return transform(exp_so3(w), (left_jacobian @ xi[..., 3:, None])[..., 0])


def inverse_left_jacobian(rotation_vector: ArrayLike) -> Floats:
    """Derivatives (..., 3, 3) of log(exp(omega) exp(v)) by omega at zero, for rotation vectors v (..., 3) below pi.

    Source: Barfoot, "State Estimation for Robotics" (2017), section 7.1.
    """
    v = np.asarray(rotation_vector, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    k = skew(v)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    c = np.where(small, 1.0 / 12, (1 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    result: Floats = np.eye(3) - 0.5 * k + c * (k @ k)
    return result


def rotation_angle_deg(rotation: ArrayLike) -> Floats:
    """Angles (...) in degrees, 0 to 180, of rotation matrices (..., 3, 3)."""
    result: Floats = np.degrees(np.linalg.norm(log_so3(rotation), axis=-1))
    return result


def mean_rotation(rotations: ArrayLike, weights: ArrayLike | None = None) -> Floats:
    """Chordal L2 mean (3, 3) of rotations (n, 3, 3) with optional weights (n,).

    Source: Hartley et al., "Rotation Averaging", IJCV 2013, section 5.2.
    """
    r = np.asarray(rotations, dtype=np.float64)
    w: Any = np.ones(len(r)) if weights is None else np.asarray(weights, dtype=np.float64)
    u, _, vt = np.linalg.svd(np.einsum("i,ijk->jk", w, r))
    result: Floats = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return result


def slerp(rotation_a: ArrayLike, rotation_b: ArrayLike, fraction: ArrayLike) -> Floats:
    """Rotation(s) at `fraction` (0..1) of the trajectory from a to b, along the shortest arc."""
    a, b = np.asarray(rotation_a, dtype=np.float64), np.asarray(rotation_b, dtype=np.float64)
    step = log_so3(np.swapaxes(a, -1, -2) @ b) * np.asarray(fraction, dtype=np.float64)[..., None]
    result: Floats = a @ exp_so3(step)
    return result


def interpolate(times: Ints, poses: Floats, at: Ints) -> Floats:
    """Poses (m, 4, 4) at times (m,) between the nearest of some poses; the first and the last hold beyond them.

    Parameters
    ----------
    times
        Rising times (n,) of the poses (n, 4, 4), n >= 1, in whole units.
    """
    after = np.clip(np.searchsorted(times, at), min(1, len(times) - 1), len(times) - 1)
    before = np.maximum(after - 1, 0)
    step = np.maximum(times[after] - times[before], 1)
    fraction = np.clip((at - times[before]) / step, 0.0, 1.0)
    a, b = poses[before], poses[after]
    rotation = slerp(a[:, :3, :3], b[:, :3, :3], fraction)
    return transform(rotation, a[:, :3, 3] + fraction[:, None] * (b[:, :3, 3] - a[:, :3, 3]))
