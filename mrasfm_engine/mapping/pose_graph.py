"""Spreading the error of a closed loop over the units between: a pose graph over rigid units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Bools, Floats, Ints


@dataclass(frozen=True, kw_only=True)
class Edges:
    """Measured relative poses a_from_b (n, 4, 4) of units (n, 2), with sigmas of every axis."""

    units: Ints
    a_from_b: Floats
    sigma_rotation_rad: Floats  # (n,)
    sigma_translation_m: Floats  # (n,)
    robust: Bools  # (n,) with a Cauchy loss: the measurement may be wrong


def optimise_pose_graph(
    world_from_rig: Floats, edges: Edges, *, iterations: int = 30, loss_scale: float = 3.0
) -> Floats:
    """Poses (n, 4, 4) that agree best with the edges; the first unit of the first edge stays where it is.

    Gauss-Newton with a sparse direct factorisation. With steps omega, tau in world axes as in `adjustment.problem`, the
    residuals of an edge and their derivatives are

        r_t = R_a' (p_b - p_a) - t_ab       d/dtau_b = R_a',  d/dtau_a = -R_a',  d/domega_a = R_a' [p_b - p_a]x
        r_w = log(R_ab' R_a' R_b)           d/domega_b = R_b',  d/domega_a = -R_b'   (for small r_w)
    """
    rotation, position = world_from_rig[:, :3, :3].copy(), world_from_rig[:, :3, 3].copy()
    a, b = edges.units[:, 0], edges.units[:, 1]
    used = np.unique(edges.units)
    column = np.full(len(rotation), -1, dtype=np.int64)
    moving = used[used != edges.units[0, 0]]
    column[moving] = np.arange(len(moving))
    sigma = np.concatenate(
        [np.repeat(edges.sigma_rotation_rad[:, None], 3, 1), np.repeat(edges.sigma_translation_m[:, None], 3, 1)],
        axis=1,
    )
    for _ in range(iterations):
        residual, jacobian_a, jacobian_b = _linearise(rotation, position, edges)
        r = residual / sigma
        weight = np.where(edges.robust, 1.0 / (1.0 + (r**2).sum(1) / loss_scale**2), 1.0)
        scale = np.sqrt(weight)[:, None] / sigma
        step = _solve(
            residual * scale, jacobian_a * scale[..., None], jacobian_b * scale[..., None], column[a], column[b]
        )
        step = step.reshape(-1, 6)
        rotation[moving] = se3.exp_so3(step[:, :3]) @ rotation[moving]
        position[moving] += step[:, 3:]
        if np.abs(step).max(initial=0.0) < 1e-8:
            break
    return se3.transform(rotation, position)


def _linearise(rotation: Floats, position: Floats, edges: Edges) -> tuple[Floats, Floats, Floats]:
    """Residuals (n, 6), rotation first, and their Jacobians (n, 6, 6) in the steps of both units."""
    a, b = edges.units[:, 0], edges.units[:, 1]
    ra_t, rb_t = np.swapaxes(rotation[a], 1, 2), np.swapaxes(rotation[b], 1, 2)
    between = position[b] - position[a]
    residual = np.concatenate(
        [
            se3.log_so3(np.swapaxes(edges.a_from_b[:, :3, :3], 1, 2) @ ra_t @ rotation[b]),
            np.einsum("nij,nj->ni", ra_t, between) - edges.a_from_b[:, :3, 3],
        ],
        axis=1,
    )
    jacobian_a, jacobian_b = np.zeros((len(a), 6, 6)), np.zeros((len(a), 6, 6))
    jacobian_a[:, :3, :3], jacobian_b[:, :3, :3] = -rb_t, rb_t
    jacobian_a[:, 3:, :3] = ra_t @ se3.skew(between)
    jacobian_a[:, 3:, 3:], jacobian_b[:, 3:, 3:] = -ra_t, ra_t
    return residual, jacobian_a, jacobian_b


def _solve(residual: Floats, jacobian_a: Floats, jacobian_b: Floats, column_a: Ints, column_b: Ints) -> Floats:
    """The least squares step of all moving units; columns of -1 are fixed."""
    rows = np.arange(residual.size).reshape(residual.shape)
    data, row, col = [], [], []
    for jacobian, column in ((jacobian_a, column_a), (jacobian_b, column_b)):
        free = column >= 0
        data.append(jacobian[free].ravel())
        row.append(np.repeat(rows[free].ravel(), 6))
        col.append((6 * column[free][:, None, None] + np.arange(6)).repeat(6, axis=1).ravel())
    size = 6 * (int(max(column_a.max(), column_b.max())) + 1)
    j = coo_matrix(
        (np.concatenate(data), (np.concatenate(row), np.concatenate(col))), shape=(residual.size, size)
    ).tocsc()
    h = (j.T @ j).tocsc()
    step: Floats = -splu(h).solve(np.asarray(j.T @ residual.ravel()))
    return step
