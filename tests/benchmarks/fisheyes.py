"""Line 32: four fisheyes of 190 deg beside four pinholes on the same vehicle, in the same street.

A fisheye's image is put together from five perspective ones that are rendered at its place.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_camera, project_points, unproject_pixels
from mrasfm_engine.synthetic.drive_writer import render_drives
from mrasfm_engine.synthetic.options import SynthOptions
from mrasfm_engine.synthetic.rigs import TrueCamera, true_cameras
from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.table import Figure, exactly

CAMERAS, UNITS = 4, 24
WIDTH, HEIGHT = 960, 600  # of the pinholes, 100 deg wide
# Of a fisheye's image, and what its circle shows: about as many pixels a degree as the pinholes have.
SIDE_PX, HALF_DEG = 1280, 95.0
FACE_PX, FACE_DEG = 840, 92.0
MODELS = {
    "OPENCV_FISHEYE": [1.0, 1.0, 0.0, 0.0, 0.01, -0.006, 0.001, 0.0],
    "MEI": [3.2, 3.2, 0.0, 0.0, 0.02, 0.4, 0.0, 0.0, 2.2],
}
# Axes of the faces in the fisheye: ahead, to both sides, up and down.
FACES = {
    "ahead": np.eye(3),
    "right": se3.exp_so3([0.0, np.pi / 2, 0.0]),
    "left": se3.exp_so3([0.0, -np.pi / 2, 0.0]),
    "up": se3.exp_so3([np.pi / 2, 0.0, 0.0]),
    "down": se3.exp_so3([-np.pi / 2, 0.0, 0.0]),
}
MAX_OF_PINHOLES = 1.5
LEAST_M = 0.002  # of an error that another is compared with: below it chance decides


def fisheyes(work: Path, seed: int) -> Iterator[Figure]:
    """Line 32."""
    # The calibration is known well, so that the scale, which a rig a metre wide tells worst, follows from the images.
    options = SynthOptions(
        cameras=CAMERAS, units=UNITS, seed=seed, width=WIDTH, height=HEIGHT, masks=False, tight=True, gnss=False
    )
    pinholes = work / "pinholes"
    render_drives(options, pinholes)
    rig = true_cameras(CAMERAS, width=WIDTH, height=HEIGHT, rng=np.random.default_rng([seed, 1]))
    faces = work / "faces"
    render_drives(options, faces, rig=[face for camera in rig for face in faces_of(camera)])
    error_m: dict[str, float] = {}
    for title, drive in (
        ("pinholes of 100 deg", pinholes),
        *((model, composed(faces, work / model, model)) for model in MODELS),
    ):
        scene = work / f"{title}, scene"
        mrasfm("reconstruct", drive, "--out", scene)
        found, what = evaluate(scene, drive), f"seed {seed}, {title}"
        error_m[title] = found["metric"]["rmse_m"]
        most = MAX_OF_PINHOLES * max(error_m["pinholes of 100 deg"], LEAST_M)
        yield exactly("32", f"{what}: images registered", found["registered_images"], CAMERAS * UNITS)
        yield Figure(line="32", what=f"{what}: position, metric RMSE", value=error_m[title], unit="m", most=most)
        rotation = found["metric"]["rotation_median_deg"]
        yield Figure(line="32", what=f"{what}: rotation, median", value=rotation, unit="deg", most=0.1)
        matches = read_report(scene)["by_stage"]["matches"]["verified_matches"]
        yield Figure(line="32", what=f"{what}: verified matches", value=matches)


def faces_of(camera: TrueCamera) -> list[TrueCamera]:
    """Perspective cameras at the place of a camera that together see all but what is behind it."""
    focal_px = 0.5 * FACE_PX / np.tan(np.radians(FACE_DEG) / 2)
    return [
        TrueCamera(
            name=f"{camera.name}_{name}",
            model="PINHOLE",
            width=FACE_PX,
            height=FACE_PX,
            params=(focal_px, focal_px, FACE_PX / 2, FACE_PX / 2),
            rig_from_cam=camera.rig_from_cam @ se3.transform(turn, np.zeros(3)),
        )
        for name, turn in FACES.items()
    ]


def _params(model: str) -> list[float]:
    """Parameters with which the image circle of `HALF_DEG` fills the image."""
    unit = pack_camera(model, MODELS[model])
    rim = np.array([[np.sin(np.radians(HALF_DEG)), 0.0, np.cos(np.radians(HALF_DEG))]])
    reach = project_points(*unit, rim)[0, 0]
    scale = 0.5 * SIDE_PX / reach
    return [MODELS[model][0] * scale, MODELS[model][1] * scale, SIDE_PX / 2, SIDE_PX / 2, *MODELS[model][4:]]


def composed(faces: Path, out: Path, model: str) -> Path:
    """The drive of the fisheyes that the faces are of."""
    document = json.loads((faces / "drive.json").read_text(encoding="utf-8"))
    params = _params(model)
    maps, inside = _maps(model, params)
    given = {camera["name"]: camera for camera in document["rig"]["cameras"]}
    names = [name.removesuffix("_ahead") for name in given if name.endswith("_ahead")]
    document["rig"]["cameras"] = [
        {**given[f"{name}_ahead"], "name": name, "model": model, "width": SIDE_PX, "height": SIDE_PX, "params": params}
        for name in names
    ]
    for frame in document["frames"]:
        images = {}
        for name in names:
            image = np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8)
            for face, (x, y, shown) in maps.items():
                source = cv2.imread(str(faces / frame["images"][f"{name}_{face}"]["file"]))
                seen = cv2.remap(source, x, y, cv2.INTER_LINEAR)
                image[shown] = seen[shown]
            image[~inside] = 0
            file = f"images/{name}/{frame['source_frame']:06d}.jpg"
            (out / file).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(out / file), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
            images[name] = {"file": file}
        frame["images"] = images
    (out / "drive.json").write_text(json.dumps(document), encoding="utf-8")
    shutil.copy(faces / "truth.tum", out / "truth.tum")
    return out


def _maps(model: str, params: list[float]) -> tuple[dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]], np.ndarray]:
    """Where each face has the fisheye's pixels, which of them it is taken for, and the image circle."""
    u, v = np.meshgrid(np.arange(SIDE_PX) + 0.5, np.arange(SIDE_PX) + 0.5)
    rays = unproject_pixels(*pack_camera(model, params), np.stack([u.ravel(), v.ravel()], 1))
    inside = (rays[:, 2] > np.cos(np.radians(HALF_DEG))).reshape(SIDE_PX, SIDE_PX)
    focal_px = 0.5 * FACE_PX / np.tan(np.radians(FACE_DEG) / 2)
    in_face = {name: rays @ turn for name, turn in FACES.items()}
    nearest = np.argmax([ray[:, 2] for ray in in_face.values()], axis=0)
    result = {}
    for k, (name, ray) in enumerate(in_face.items()):
        shown = nearest == k
        plane = ray[:, :2] / np.where(shown, ray[:, 2], 1.0)[:, None]
        x, y = (focal_px * plane + FACE_PX / 2 - 0.5).T.astype(np.float32).reshape(2, SIDE_PX, SIDE_PX)
        result[name] = (x, y, shown.reshape(SIDE_PX, SIDE_PX))
    return result, inside
