"""Prints what the development kits of data sets say, as JSON: `read_datasets.py nuscenes ROOT SCENE`, `... av2 LOG`.

It runs in an environment of its own (`datasets.lock`), and knows of this project what its documentation says.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

HALF_PX = 0.5


def observations(scene: Path) -> dict[str, list[tuple[float, float, list[float]]]]:
    """Keypoints of images with their points, of the model as COLMAP's text files have it."""
    rows = [line for line in (scene / "model/text/points3D.txt").read_text().splitlines() if line[0] != "#"]
    points = {int(row.split()[0]): [float(v) for v in row.split()[1:4]] for row in rows}
    lines = [row for row in (scene / "model/text/images.txt").read_text().split("\n") if not row.startswith("#")]
    found = {}
    for image, keypoints in zip(lines[::2], lines[1::2], strict=False):
        triples = np.array(keypoints.split(), dtype=float).reshape(-1, 3)
        found[image.split()[9]] = [(x, y, points[int(p)]) for x, y, p in triples if p >= 0]
    return found


def read_nuscenes(root: Path, scene: Path) -> dict[str, Any]:
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.geometry_utils import transform_matrix, view_points
    from pyquaternion import Quaternion

    kit = NuScenes(version="v1.0-mrasfm", dataroot=str(root), verbose=False)
    images = json.loads((scene / "poses.json").read_text())["images"]
    files = {(f"CAM_{image['camera'].upper()}", image["unit"]): image["file"] for image in images}
    seen, errors = observations(scene), {HALF_PX: [], 0.0: []}
    for data in kit.sample_data:
        calibrated = kit.get("calibrated_sensor", data["calibrated_sensor_token"])
        ego = kit.get("ego_pose", data["ego_pose_token"])
        rows = seen[files[data["channel"], int(Path(data["filename"]).stem)]]
        poses = [transform_matrix(p["translation"], Quaternion(p["rotation"])) for p in (ego, calibrated)]
        cam_from_world = np.linalg.inv(poses[0] @ poses[1])
        points = cam_from_world[:3, :3] @ np.array([row[2] for row in rows]).T + cam_from_world[:3, 3:]
        pixels = view_points(points, np.array(calibrated["camera_intrinsic"]), normalize=True)[:2].T
        for half, found in errors.items():
            found.append(np.linalg.norm(pixels + half - np.array([row[:2] for row in rows]), axis=1))
    medians = {half: float(np.median(np.concatenate(found))) for half, found in errors.items()}
    return {"samples": len(kit.sample), "median_px": medians[HALF_PX], "without_half_px": medians[0.0]}


def read_av2(log: Path) -> dict[str, Any]:
    """Pixels of fixed points in each camera, and the vehicle's positions by microseconds."""
    from av2.geometry.camera.pinhole_camera import PinholeCamera
    from av2.utils.io import read_city_SE3_ego

    points = np.array([[20.0, 3.0, 1.0], [-15.0, 4.0, 2.0], [12.0, -9.0, 0.5], [8.0, 15.0, 3.0]])
    cameras = sorted(path.name for path in (log / "sensors" / "cameras").iterdir())
    pixels = {name: PinholeCamera.from_feather(log, name).project_ego_to_img(points)[0].tolist() for name in cameras}
    places = {int(ns) // 1000: pose.translation.tolist() for ns, pose in read_city_SE3_ego(log).items()}
    return {"points": points.tolist(), "pixels": pixels, "places": places}


if __name__ == "__main__":
    reader = {"nuscenes": read_nuscenes, "av2": read_av2}[sys.argv[1]]
    print(json.dumps(reader(*map(Path, sys.argv[2:]))))
