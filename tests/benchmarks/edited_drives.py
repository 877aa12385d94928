"""Drives under other manifests, whose images stay where they are."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.drive import matrix_from_pose, pose_from_matrix
from schemas import Pose

Edit = Callable[[dict[str, Any]], None]


def edited_drive(drive: Path, copy: Path, *edits: Edit) -> Path:
    """A copy of the drive whose manifest is edited. Its other files are links: nobody may write into them."""
    shutil.copytree(drive, copy, copy_function=os.link)
    manifest = json.loads((drive / "drive.json").read_text(encoding="utf-8"))
    for edit in edits:
        edit(manifest)
    (copy / "drive.json").unlink()  # a link to the other drive's
    (copy / "drive.json").write_text(json.dumps(manifest), encoding="utf-8")
    return copy


def turned(number: int, by_deg: tuple[float, float, float]) -> Edit:
    """A camera is given turned by a rotation vector in its own axes: pitch, yaw, roll."""

    def edit(manifest: dict[str, Any]) -> None:
        camera = manifest["rig"]["cameras"][number]
        pose = matrix_from_pose(Pose(**camera["rig_from_cam"]))
        pose[:3, :3] = pose[:3, :3] @ se3.exp_so3(np.radians(by_deg))
        camera["rig_from_cam"] = pose_from_matrix(pose).model_dump()

    return edit
