"""`poses.json` and `poses.tum`: where the vehicle and its cameras were."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mrasfm_engine.geometry import geodesy
from mrasfm_engine.io.trajectory_file import format_tum
from mrasfm_engine.scene.drive import pose_documents
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Bools, Floats

POSE_TIME = {
    False: "an image's pose is at its unit's timestamp_us",
    True: "a unit's pose is at its timestamp_us, an image's at its own: with a rolling shutter, of its middle row",
}
LISTS = ("units", "images")  # of `poses_document`, as long as the drive


def poses_text(scene: Scene) -> str:
    """`poses.tum`: `world_from_rig` of the registered units."""
    kept = scene.unit_registered
    return format_tum(scene.drive.timestamps_us[kept].tolist(), scene.world_from_rig[kept])


def poses_document(scene: Scene, components: Sequence[Bools] = ()) -> dict[str, Any]:
    """`poses.json`: every unit and every image of the drive, with a pose where it is registered.

    Units of `components`, masks (units,) of the first and so on, have their pose in that component's own `poses.json`.
    A registered unit with a `component` belongs to the scene's component of that number.

    A value that does not exist (the pose of what is not registered, the geodetic position of a scene that is not
    georeferenced, an unknown sigma) is absent, never zero or null.
    """
    cameras = scene.world_from_cam
    unit_places = geodetic_positions(scene, scene.world_from_rig)
    camera_places = geodetic_positions(scene, cameras)
    rig_poses = pose_documents(scene.world_from_rig)  # NaN of what is not registered, which is not written
    camera_poses = pose_documents(cameras)
    units = []
    for u, frame in enumerate(scene.drive.manifest.frames):
        registered = bool(scene.unit_registered[u])
        unit: dict[str, Any] = {
            "timestamp_us": frame.timestamp_us,
            "source_frame": frame.source_frame,
            "registered": registered,
        }
        if registered:
            unit["world_from_rig"] = rig_poses[u]
            if np.isfinite(scene.sigma_position_m[u]).all():
                unit["sigma_position_m"] = scene.sigma_position_m[u].tolist()
            unit |= _place(unit_places, u)
            if scene.unit_component[u]:
                unit["component"] = int(scene.unit_component[u])
        for number, own in enumerate(components, start=1):
            if own[u]:
                unit["component"] = number
        units.append(unit)
    images = []
    for i, source in enumerate(scene.drive.images):
        image: dict[str, Any] = {
            "file": source.file,
            "camera": scene.drive.cameras[source.camera].name,
            "unit": source.unit,
            "timestamp_us": source.timestamp_us,
            "registered": bool(scene.image_registered[i]),
        }
        if image["registered"]:
            image["world_from_cam"] = camera_poses[i]
            image |= _place(camera_places, i)
        images.append(image)
    return {
        "version": 1,
        "world": "the local frame of frame.json",
        "pose_time": POSE_TIME[scene.unit_from_image is not None],
        "units": units,
        "images": images,
    }


def geodetic_positions(scene: Scene, world_from_any: Floats) -> Floats | None:
    """Geodetic coordinates (n, 3) of the poses' origins; NaN where a pose is."""
    if scene.georeference is None:
        return None
    positions = world_from_any[:, :3, 3]
    known = np.isfinite(positions).all(axis=1)
    places = np.full(positions.shape, np.nan)
    places[known] = geodesy.geodetic_from_local(positions[known], scene.georeference.ecef_from_local)
    return places


def _place(places: Floats | None, index: int) -> dict[str, Any]:
    if places is None:
        return {}
    latitude, longitude, height = places[index].tolist()
    return {"geodetic": {"latitude_deg": latitude, "longitude_deg": longitude, "ellipsoidal_height_m": height}}
