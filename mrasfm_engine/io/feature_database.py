"""`features.db`: keypoints, descriptors and matches as a COLMAP database, enough to aggregate later without the images.

Ids are those of the model (`export_colmap`), for all images of the drive, registered or not.
"""

from __future__ import annotations

import errno
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap

from mrasfm_engine.geometry import se3
from mrasfm_engine.io.export_colmap import REFERENCE_SENSOR_ID, RIG_ID, frame_of_image
from mrasfm_engine.scene.scene import ImageFeatures, Scene


def write_features(scene: Scene, path: Path) -> None:
    """Write the database in one transaction.

    Raises
    ------
    OSError
        Where the database cannot be written.
    """
    try:
        database = pycolmap.Database.open(str(path))
        try:
            transaction = pycolmap.DatabaseTransaction(database)
            _write_cameras(scene, database)
            _write_images(scene, database)
            _write_pairs(scene, database)
            del transaction  # commits
        finally:
            database.close()
        # COLMAP leaves the database in write-ahead mode, in which it cannot be read from a read-only folder.
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("PRAGMA journal_mode = DELETE")
    except (RuntimeError, sqlite3.Error) as error:
        raise OSError(errno.EIO, f"{path.name}: {error}") from error


def _write_cameras(scene: Scene, database: pycolmap.Database) -> None:
    rig = pycolmap.Rig()
    rig.rig_id = RIG_ID
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.IMU, REFERENCE_SENSOR_ID))
    for k, (camera, refined) in enumerate(zip(scene.drive.cameras, scene.calibration, strict=True)):
        written = pycolmap.Camera(
            model=camera.model, width=camera.width, height=camera.height, params=refined.params, camera_id=k + 1
        )
        written.has_prior_focal_length = True
        database.write_camera(written, use_camera_id=True)
        cam_from_rig = pycolmap.Rigid3d(se3.inverse(refined.rig_from_cam)[:3])
        rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, k + 1), cam_from_rig)
    database.write_rig(rig, use_rig_id=True)


def _write_images(scene: Scene, database: pycolmap.Database) -> None:
    frames: dict[int, pycolmap.Frame] = {}
    for i, (image, features) in enumerate(zip(scene.drive.images, scene.features, strict=True)):
        written = pycolmap.Image(name=image.file, camera_id=image.camera + 1, image_id=i + 1)
        database.write_image(written, use_image_id=True)
        database.write_keypoints(i + 1, np.ascontiguousarray(features.xy_px, dtype=np.float32))
        database.write_descriptors(i + 1, _descriptors(features))
        frame_id = frame_of_image(scene, i)
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


def _write_pairs(scene: Scene, database: pycolmap.Database) -> None:
    for pair in scene.pairs:
        a, b = pair.image_a + 1, pair.image_b + 1
        matches = pair.matches.astype(np.uint32)
        database.write_matches(a, b, matches)
        if pair.inliers.any():
            geometry = pycolmap.TwoViewGeometry(
                config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED, inlier_matches=matches[pair.inliers]
            )
            database.write_two_view_geometry(a, b, geometry)
