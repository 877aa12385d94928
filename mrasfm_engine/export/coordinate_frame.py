"""`frame.json`: the coordinate contract of a scene's files."""

from __future__ import annotations

from typing import Any

from pyproj import CRS

from mrasfm_engine.scene.scene import Scene

WORLD_CRS = "EPSG:4978"

AXES = {
    "rig": "x forward, y left, z up, on the vehicle; origin as in the drive's manifest",
    "camera": "x right, y down, z forward; origin at the centre of projection",
    "image": "x right, y down, pixels; the centre of the top left pixel is at (0.5, 0.5)",
}
CONVENTIONS = {
    "transforms": "a_from_b maps coordinates of frame b into frame a",
    "matrices": "4x4, row-major, float64, for column vectors",
    "quaternions": "x, y, z, w, unit",
    "lengths": "metres",
    "angles": "degrees",
    "times": "integer microseconds; in poses.tum seconds",
}
FILES = {
    "model": "local (COLMAP writes cam_from_world, quaternions w x y z; its world is local)",
    "points.ply": "local",
    "points.copc.laz": "its own coordinate reference system: UTM with ellipsoidal heights; without one: local",
    "poses.tum": "local_from_rig, quaternions x y z w",
    "poses.json": "world_from_rig and world_from_cam with world = local, and geodetic positions where georeferenced",
    "view.json": "as points.copc.laz, relative to its offset_m",
    "trajectory.gpkg": "longitude, latitude and ellipsoidal height where georeferenced, else local",
    "calibration.json": "rig_from_cam",
    "rig": "rig_from_cam, relative poses of cameras; pixels count from the centre of the top left one",
}
ONLY_GEOREFERENCED = {"autoware": "local, raised by the origin's ellipsoidal height"}


def frame_document(scene: Scene) -> dict[str, Any]:
    """Describe the frame of all files and, for a georeferenced scene, its place on the earth.

    Without georeference the geodetic fields are absent, not zero.
    """
    place = scene.georeference
    document: dict[str, Any] = {"version": 1, "georeferenced": place is not None}
    if place is not None:
        local = "x east, y north, z up, metres, at the origin"
        crs = CRS.from_user_input(WORLD_CRS)
        document |= {
            "world_crs": WORLD_CRS,
            "world_crs_wkt2": crs.to_wkt("WKT2_2019"),
            "height_datum": place.height_datum,
            "heights": "ellipsoidal in all files; height_datum is what the drive declared for its GNSS",
            "origin": {
                "latitude_deg": place.origin_latitude_deg,
                "longitude_deg": place.origin_longitude_deg,
                "ellipsoidal_height_m": place.origin_ellipsoidal_height_m,
            },
            "ecef_from_local": place.ecef_from_local.tolist(),
        }
    elif scene.rough_world_from_local is not None:
        local = "metres, axes of the rough trajectory's world (z up)"
    else:
        local = "metres, axes and origin of the drive's own choosing, not tied to the earth"
    if scene.rough_world_from_local is not None:
        document["rough_world_from_local"] = scene.rough_world_from_local.tolist()
    files = FILES if place is None else FILES | ONLY_GEOREFERENCED
    return document | {"axes": {"local": local, **AXES}, "conventions": CONVENTIONS, "files": files}
