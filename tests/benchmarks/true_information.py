"""What a drive's images can tell of its cameras, from the exact scene and without the engine's adjustment.

The scene that was reconstructed says only which keypoint shows which point. Poses and calibration are the true ones,
the points are intersected anew from true rays, and derivatives are written down here from the projection of a pinhole.
The points and units are eliminated by sparse algebra; what is left is the information on the cameras' poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
import scipy.sparse as sp

from mrasfm_engine.geometry import se3

SIGMA_PX = 0.5
SIGMA_TURN_RAD = 0.1


@dataclass(frozen=True, kw_only=True)
class ExactScene:
    """True poses and calibration, and which image sees which point where."""

    world_from_rig: np.ndarray  # (u, 4, 4)
    rig_from_cam: np.ndarray  # (c, 4, 4)
    focal_px: np.ndarray  # (c, 2)
    centre_px: np.ndarray  # (c, 2)
    unit: np.ndarray  # (n,)
    camera: np.ndarray  # (n,)
    point: np.ndarray  # (n,)
    xy_px: np.ndarray  # (n, 2)

    @staticmethod
    def of(
        model: pycolmap.Reconstruction, cameras: list[str], world_from_rig: np.ndarray, rig_from_cam: np.ndarray
    ) -> ExactScene:
        """The tracks of a model (images are named .../CAMERA/UNIT.jpg) with true poses; its cameras are pinholes."""
        params = {}
        rows = []
        for k, point in enumerate(model.points3D.values()):
            for element in point.track.elements:
                image = model.images[element.image_id]
                folder, name = image.name.split("/")[-2:]
                camera = cameras.index(folder)
                params[camera] = model.cameras[image.camera_id].params
                rows.append((int(name.split(".")[0]), camera, k, *image.points2D[element.point2D_idx].xy))
        table = np.array(rows)
        pinhole = np.array([params[c] for c in range(len(cameras))])
        return ExactScene(
            world_from_rig=world_from_rig,
            rig_from_cam=rig_from_cam,
            focal_px=pinhole[:, :2],
            centre_px=pinhole[:, 2:4],
            unit=table[:, 0].astype(int),
            camera=table[:, 1].astype(int),
            point=table[:, 2].astype(int),
            xy_px=table[:, 3:],
        )


def camera_information(scene: ExactScene, antenna_m: np.ndarray, sigma_gnss_m: np.ndarray) -> np.ndarray:
    """Information (6 c, 6 c) on the cameras' rotations (rad) and positions (m), about and along the rig's axes.

    From all images and from independent positions (sigma of each axis) of the antenna at every unit.
    """
    units, cameras = len(scene.world_from_rig), len(scene.rig_from_cam)
    u, c = scene.unit, scene.camera
    turn = scene.world_from_rig[u, :3, :3]
    centre = turn @ scene.rig_from_cam[c, :3, 3, None]
    centre = centre[..., 0] + scene.world_from_rig[u, :3, 3]
    world_from_cam = turn @ scene.rig_from_cam[c, :3, :3]
    points = _intersect(scene, centre, world_from_cam)
    in_camera = np.einsum("nji,nj->ni", world_from_cam, points[scene.point] - centre)
    x, y, z = in_camera.T
    f, zero = scene.focal_px[c], np.zeros_like(x)
    projection = np.stack(
        [np.stack([f[:, 0] / z, zero, -f[:, 0] * x / z**2], 1), np.stack([zero, f[:, 1] / z, -f[:, 1] * y / z**2], 1)],
        axis=1,
    )  # (n, 2, 3)
    by_point = projection @ np.swapaxes(world_from_cam, 1, 2)
    arm = points[scene.point] - scene.world_from_rig[u, :3, 3]
    by_unit = np.concatenate([by_point @ se3.skew(arm), -by_point], axis=2)
    by_rig = by_point @ turn
    rig_arm = np.einsum("nji,nj->ni", turn, points[scene.point] - centre)
    by_camera = np.concatenate([by_rig @ se3.skew(rig_arm), -by_rig], axis=2)
    good = (z > 0.5) & np.isfinite(projection).all((1, 2))
    poses = _sparse(
        np.concatenate([by_unit, by_camera], 2)[good], [6 * u[good], 6 * units + 6 * c[good]], 6, 6 * (units + cameras)
    )
    depth = _sparse(by_point[good], [3 * scene.point[good]], 3, 3 * len(points))
    system = _without_points(poses, depth)
    for k in range(units):
        lever = scene.world_from_rig[k, :3, :3] @ antenna_m
        j = np.concatenate([-se3.skew(lever), np.eye(3)], 1) / sigma_gnss_m[:, None]
        system[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += j.T @ j
    split = 6 * units
    # Positions on a line leave the roll about it; how the whole scene is turned says nothing of the cameras.
    own = system[:split, :split] + np.diag(np.tile([1.0, 1.0, 1.0, 0.0, 0.0, 0.0], units)) / SIGMA_TURN_RAD**2
    across = system[split:, :split]
    result: np.ndarray = system[split:, split:] - across @ np.linalg.solve(own, across.T)
    return result


def _intersect(scene: ExactScene, centre: np.ndarray, world_from_cam: np.ndarray) -> np.ndarray:
    """Points (p, 3) nearest to the true rays of their keypoints."""
    rays = np.concatenate(
        [(scene.xy_px - scene.centre_px[scene.camera]) / scene.focal_px[scene.camera], np.ones((len(scene.unit), 1))], 1
    )
    rays = np.einsum("nij,nj->ni", world_from_cam, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    count = scene.point.max() + 1
    left, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(left, scene.point, across)
    np.add.at(right, scene.point, np.einsum("nij,nj->ni", across, centre))
    return np.linalg.solve(left + 1e-12 * np.eye(3), right[..., None])[..., 0]


def _sparse(blocks: np.ndarray, first: list[np.ndarray], width: int, columns: int) -> sp.csr_matrix:
    """Rows (2 n) with the blocks' columns at each of the given places."""
    n = len(blocks)
    column = np.concatenate([f[:, None] + np.arange(width) for f in first], 1)
    column = np.broadcast_to(column[:, None, :], blocks.shape)
    row = np.broadcast_to(np.arange(2 * n).reshape(n, 2, 1), blocks.shape)
    return sp.csr_matrix((blocks.ravel() / SIGMA_PX, (row.ravel(), column.ravel())), shape=(2 * n, columns))


def _without_points(poses: sp.csr_matrix, depth: sp.csr_matrix) -> np.ndarray:
    """J'J of the poses with the points eliminated."""
    v = (depth.T @ depth).tocsr()
    count = v.shape[0] // 3
    blocks = np.stack([v.diagonal(k) if k == 0 else np.append(v.diagonal(k), np.zeros(k)) for k in range(3)])
    blocks = blocks.reshape(3, count, 3)
    dense = np.zeros((count, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            dense[:, i, j] = dense[:, j, i] = blocks[j - i, :, i]
    known = np.linalg.eigvalsh(dense)[:, 0] > 1e-9 * np.trace(dense, axis1=1, axis2=2)
    inverse = np.zeros_like(dense)
    inverse[known] = np.linalg.inv(dense[known])
    eliminated = sp.bsr_matrix((inverse, np.arange(count), np.arange(count + 1)))
    w = (poses.T @ depth).tocsr()
    return np.asarray((poses.T @ poses - w @ eliminated @ w.T).todense())


@dataclass(frozen=True, kw_only=True)
class Expected:
    """What the geometry lets a drive observe."""

    hidden: np.ndarray  # (6 c,) sorted: share of the prior's sigma that images leave in the least observed motions
    observed: np.ndarray  # (c, 6)
    ratio: np.ndarray  # (c, 6)
    scale_ratio: float  # posterior over prior sigma of the rig's size, with the positions


def expected_directions(information: np.ndarray, position_m: np.ndarray, sigma: np.ndarray) -> Expected:
    """Which directions the information (6 c, 6 c) observes against a prior of sigma (6,) for every camera.

    With the mean rotation, the mean position and the size of the rig held, as they are common to all cameras.
    """
    cameras = len(position_m)
    every = np.tile(sigma, cameras)
    whitened = information * np.outer(every, every)
    size = np.zeros((cameras, 6))
    size[:, 3:] = (position_m - position_m.mean(0)) / sigma[3:]
    mean = np.kron(np.ones((1, cameras)), np.eye(6))
    held = np.concatenate([mean, size.reshape(1, -1)])
    ratio = _ratio(whitened, held).reshape(cameras, 6)
    free = _complement(mean)
    growth = free.T @ size.ravel()
    growth /= np.linalg.norm(growth)
    posterior = np.linalg.inv(free.T @ whitened @ free + np.eye(free.shape[1]))
    return Expected(
        hidden=1 / np.sqrt(1 + np.maximum(np.linalg.eigvalsh(whitened), 0)),
        observed=ratio < 0.5,
        ratio=ratio,
        scale_ratio=float(np.sqrt(growth @ posterior @ growth)),
    )


def _complement(rows: np.ndarray) -> np.ndarray:
    """An orthonormal basis (n, k) of what the rows (m, n) do not span."""
    _, _, vt = np.linalg.svd(rows)
    return vt[np.linalg.matrix_rank(rows) :].T


def _ratio(whitened: np.ndarray, held: np.ndarray) -> np.ndarray:
    basis = _complement(held)
    posterior = basis @ np.linalg.inv(basis.T @ whitened @ basis + np.eye(basis.shape[1])) @ basis.T
    return np.sqrt(np.diagonal(posterior) / np.diagonal(basis @ basis.T))
