"""Conversion of a manifest's body axes to the engine's: x forward, y left, z up."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.scene.drive import matrix_from_pose, pose_from_matrix
from mrasfm_engine.types import Floats
from schemas import BodyAxes, DriveManifest, Pose

_FLU_FROM_BODY = {
    BodyAxes.FLU: ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    BodyAxes.RDF: ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
    BodyAxes.FRD: ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}


def flu_from_body(axes: BodyAxes) -> Floats:
    """The pure rotation (4, 4) that maps coordinates in the given body axes to forward, left, up."""
    matrix = np.eye(4)
    matrix[:3, :3] = _FLU_FROM_BODY[axes]
    return matrix


def manifest_in_flu(manifest: DriveManifest) -> DriveManifest:
    """The same drive with `body_axes` flu.

    Converts what is expressed in the rig frame: cameras' `rig_from_cam`, the antenna, and the rig end of the rough
    poses. The world of the rough poses has its z axis up whatever the body axes are, and stays.
    """
    axes = manifest.rig.body_axes
    if axes is BodyAxes.FLU:
        return manifest
    flu_body = flu_from_body(axes)

    def rotated(pose: Pose) -> Pose:
        return pose_from_matrix(flu_body @ matrix_from_pose(pose))

    cameras = [c.model_copy(update={"rig_from_cam": rotated(c.rig_from_cam)}) for c in manifest.rig.cameras]
    update: dict[str, object] = {"rig": manifest.rig.model_copy(update={"body_axes": BodyAxes.FLU, "cameras": cameras})}
    if manifest.gnss is not None:
        antenna = [float(v) for v in flu_body[:3, :3] @ manifest.gnss.antenna_in_rig_m]
        update["gnss"] = manifest.gnss.model_copy(update={"antenna_in_rig_m": antenna})
    if manifest.rough_poses is not None:
        poses = [
            p.model_copy(update={"world_from_rig": pose_from_matrix(matrix_from_pose(p.world_from_rig) @ flu_body.T)})
            for p in manifest.rough_poses.poses
        ]
        update["rough_poses"] = manifest.rough_poses.model_copy(update={"poses": poses})
    return manifest.model_copy(update=update)
