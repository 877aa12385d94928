"""`features.db`: keypoints, descriptors and matches as a COLMAP database, enough to aggregate later without the images.

Ids are those of the model (`export.colmap`), for all images of the drive, registered or not.
"""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from mrasfm_engine.export.colmap import REFERENCE_SENSOR_ID, RIG_ID, colmap_models, frame_of_image
from mrasfm_engine.export.file_contents import sha256
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.colmap_cameras import NearestModel, nearest_model
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches, Scene
from mrasfm_engine.types import Floats


def write_features(scene: Scene, path: Path) -> str:
    """Write a scene's database, with the calibration as refined, in one transaction; the SHA-256 of its content.

    Raises
    ------
    OSError
        Where the database cannot be written.
    """
    _write(
        _Content(
            drive=scene.drive,
            features=scene.features,
            pairs=scene.pairs,
            rig_from_cam=[refined.rig_from_cam for refined in scene.calibration],
            models=colmap_models(scene),
            frames=[frame_of_image(scene, i) for i in range(len(scene.drive.images))],
        ),
        path,
    )
    return sha256(path)


def write_matches(drive: Drive, features: Sequence[ImageFeatures], pairs: Sequence[PairMatches], path: Path) -> None:
    """Write what mapping begins with, for other mappers: a frame for every unit, the calibration as given, no
    descriptors.

    Raises
    ------
    OSError
        Where the database cannot be written.
    """
    _write(
        _Content(
            drive=drive,
            features=features,
            pairs=pairs,
            rig_from_cam=list(drive.rig_from_cam),
            models=[nearest_model(camera, np.array(camera.params)) for camera in drive.cameras],
            frames=[image.unit + 1 for image in drive.images],
            descriptors=False,
        ),
        path,
    )


@dataclass(frozen=True, kw_only=True)
class _Content:
    drive: Drive
    features: Sequence[ImageFeatures]
    pairs: Sequence[PairMatches]
    rig_from_cam: Sequence[Floats]  # by camera (4, 4)
    models: Sequence[NearestModel]  # by camera
    frames: Sequence[int]  # by image, the id of its frame
    descriptors: bool = True


def _write(content: _Content, path: Path) -> None:
    try:
        database = pycolmap.Database.open(str(path))
        try:
            transaction = pycolmap.DatabaseTransaction(database)
            _write_cameras(content, database)
            _write_images(content, database)
            _write_pairs(content.pairs, database)
            del transaction  # commits
        finally:
            database.close()
        # COLMAP leaves the database in write-ahead mode, in which it cannot be read from a read-only folder.
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("PRAGMA journal_mode = DELETE")
    except (RuntimeError, sqlite3.Error) as error:
        raise OSError(errno.EIO, f"{path.name}: {error}") from error


def _write_cameras(content: _Content, database: pycolmap.Database) -> None:
    rig = pycolmap.Rig()
    rig.rig_id = RIG_ID
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.IMU, REFERENCE_SENSOR_ID))
    for k, (camera, nearest) in enumerate(zip(content.drive.cameras, content.models, strict=True)):
        written = pycolmap.Camera(
            model=nearest.model, width=camera.width, height=camera.height, params=nearest.params, camera_id=k + 1
        )
        written.has_prior_focal_length = True
        database.write_camera(written, use_camera_id=True)
        cam_from_rig = pycolmap.Rigid3d(se3.inverse(content.rig_from_cam[k])[:3])
        rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, k + 1), cam_from_rig)
    database.write_rig(rig, use_rig_id=True)


def _write_images(content: _Content, database: pycolmap.Database) -> None:
    frames: dict[int, pycolmap.Frame] = {}
    for i, (image, features) in enumerate(zip(content.drive.images, content.features, strict=True)):
        written = pycolmap.Image(name=image.file, camera_id=image.camera + 1, image_id=i + 1)
        database.write_image(written, use_image_id=True)
        if len(features.xy_px):  # of an image without a row COLMAP knows no keypoints: those of a stop are many
            database.write_keypoints(i + 1, np.ascontiguousarray(features.xy_px, dtype=np.float32))
            if content.descriptors:
                database.write_descriptors(i + 1, _descriptors(features))
        frame_id = content.frames[i]
        frame = frames.setdefault(frame_id, pycolmap.Frame(frame_id=frame_id, rig_id=RIG_ID))
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, image.camera + 1)
        frame.add_data_id(pycolmap.data_t(sensor, i + 1))
    for _, frame in sorted(frames.items()):
        database.write_frame(frame, use_frame_id=True)


def _descriptors(features: ImageFeatures) -> pycolmap.FeatureDescriptors:
    """COLMAP keeps bytes and what they are: of float descriptors it takes four bytes a number."""
    data = np.ascontiguousarray(features.descriptors)
    if data.dtype == np.uint8:
        return pycolmap.FeatureDescriptors(type=pycolmap.FeatureExtractorType.SIFT, data=data)
    # COLMAP has no name for most networks; its matchers refuse descriptors of another kind than their own.
    return pycolmap.FeatureDescriptors(type=pycolmap.FeatureExtractorType.UNDEFINED, data=data.view(np.uint8))


def _write_pairs(pairs: Sequence[PairMatches], database: pycolmap.Database) -> None:
    for pair in pairs:
        a, b = pair.image_a + 1, pair.image_b + 1
        matches = pair.matches.astype(np.uint32)
        database.write_matches(a, b, matches)
        if pair.inliers.any():
            geometry = pycolmap.TwoViewGeometry(
                config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED, inlier_matches=matches[pair.inliers]
            )
            database.write_two_view_geometry(a, b, geometry)
