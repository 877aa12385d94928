"""A map as a scene: one drive made of all drives, with a rig for each, so that scenes' writers serve for maps.

Cameras and files are called SCENE/NAME; units and images are numbered through, scene by scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.map_adjustment import MapModel
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.geometry import geodesy
from mrasfm_engine.geometry.camera_model import pack_camera, unpack_camera
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import CameraCalibration, Georeference, ImageFeatures, Scene
from mrasfm_engine.scene.semantics import majority_class
from mrasfm_engine.types import Floats
from schemas import Camera, DriveManifest, Frame, FrameImage, Rig


def map_scene(assembly: Assembly, model: MapModel, reference: SourceScene, component_of_scene: Sequence[int]) -> Scene:
    """The map's poses, points and observations as a scene, in the frame of the reference."""
    rows, point, count = model.rows, model.point, len(model.state.points_m)
    image = assembly.keypoint_image[rows]
    counts = np.bincount(point, minlength=count).clip(1)
    source = assembly.keypoint_point[rows]
    colors = np.concatenate([s.point_colors for s in assembly.scenes]).astype(np.float64)[source]
    mean_color = np.stack([np.bincount(point, colors[:, k], minlength=count) for k in range(3)], 1)
    classes = np.concatenate([s.point_classes for s in assembly.scenes])[source]
    poses = model.state.world_from_rig.copy()
    poses[~assembly.registered] = np.nan
    first = np.concatenate(
        [s.keypoint_first[:-1] + f for s, f in zip(assembly.scenes, assembly.first_keypoint, strict=False)]
    )
    return Scene(
        drive=_joined_drive(assembly),
        unit_registered=assembly.registered,
        image_registered=np.concatenate([s.image_registered for s in assembly.scenes]),
        world_from_rig=poses,
        sigma_position_m=np.concatenate([s.sigma_position_m for s in assembly.scenes]),
        calibration=calibrations(assembly, model),
        points_m=model.state.points_m,
        point_colors=np.round(mean_color / counts[:, None]).astype(np.uint8),
        point_error_px=np.bincount(point, model.errors_px, minlength=count) / counts,
        point_classes=majority_class(classes, point, count),
        observation_point=point,
        observation_image=image,
        observation_keypoint=rows - first[image],
        features=_features(assembly),
        pairs=[],
        georeference=_georeference(assembly, reference) if reference.common_world is None else None,
        rough_world_from_local=reference.ecef_from_local if reference.common_world is not None else None,
        unit_from_image=None if assembly.simultaneous else model.state.unit_from_band,
        rig_of_camera=np.repeat(np.arange(len(assembly.scenes)), np.diff(assembly.first_camera)),
        unit_component=np.array(component_of_scene, dtype=np.int64)[assembly.scene_of_unit],
    )


def _joined_drive(assembly: Assembly) -> Drive:
    """The drive of several, not validated: frames of different drives need not be in order of time."""
    cameras: list[Camera] = []
    frames: list[Frame] = []
    for scene in assembly.scenes:
        cameras += [c.model_copy(update={"name": f"{scene.name}/{c.name}"}) for c in scene.drive.cameras]
        for frame in scene.manifest.frames:
            images = {
                f"{scene.name}/{name}": FrameImage.model_construct(
                    file=f"{scene.name}/{image.file}", timestamp_us=image.timestamp_us, mask=None
                )
                for name, image in frame.images.items()
            }
            frames.append(frame.model_copy(update={"images": images}))
    manifest = DriveManifest.model_construct(
        name="map", rig=Rig.model_construct(cameras=cameras), frames=frames, notes=[]
    )
    return Drive(assembly.scenes[0].drive.root, manifest)


def calibrations(assembly: Assembly, model: MapModel) -> list[CameraCalibration]:
    """Calibrations of all cameras of all drives in the map; their scenes state how certain they are."""
    cameras = [camera for scene in assembly.scenes for camera in scene.drive.cameras]
    unknown = np.full(3, np.nan)
    return [
        CameraCalibration(
            rig_from_cam=rig_from_cam,
            params=params_of(camera, params),
            sigma_rotation_deg=unknown,
            sigma_translation_m=unknown,
            repeatability_rotation_deg=unknown,
            repeatability_translation_m=unknown,
            sigma_focal_px=float("nan"),
            observed=np.zeros(6, dtype=np.bool_),
        )
        for camera, rig_from_cam, params in zip(
            cameras, model.state.rig_from_cam, model.state.camera_params, strict=True
        )
    ]


def params_of(camera: Camera, packed: Floats) -> Floats:
    """A camera's parameters in a state, exactly the camera's own where they have not changed."""
    if np.array_equal(packed, pack_camera(camera.model, camera.params)[1]):
        return np.array(camera.params)
    return unpack_camera(camera.model, packed)


def _features(assembly: Assembly) -> list[ImageFeatures]:
    result = []
    for scene in assembly.scenes:
        for xy in np.split(scene.keypoint_xy_px, scene.keypoint_first[1:-1]):
            result.append(
                ImageFeatures(xy_px=xy, descriptors=np.zeros((0, 128), np.uint8), colors=np.zeros((0, 3), np.uint8))
            )
    return result


def _georeference(assembly: Assembly, reference: SourceScene) -> Georeference:
    latitude, longitude, height = geodesy.geodetic_from_ecef(reference.ecef_from_local[:3, 3]).tolist()
    datums = sorted({scene.height_datum for scene in assembly.scenes if scene.is_placed})
    return Georeference(
        origin_latitude_deg=latitude,
        origin_longitude_deg=longitude,
        origin_ellipsoidal_height_m=height,
        height_datum=", ".join(datums),
        ecef_from_local=reference.ecef_from_local,
    )
