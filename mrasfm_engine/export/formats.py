"""Export formats: one table of their writers.

A format is its line in `schemas.exports.EXPORT_FORMATS` (name, description, needs), a module with its writer
(`export.contract.Writer`), and its line here. `export.run_export` does the rest: it reads the scene or map, calls the
writers, reads all files back by the checks that they return, withholds what fails and puts the others in place.
"""

from __future__ import annotations

from collections.abc import Callable

from mrasfm_engine.export.colmap_workspace import write_colmap
from mrasfm_engine.export.contract import ExportOptions, ExportSource, Writer
from mrasfm_engine.export.copc_in_crs import system_of_points, write_copc_in_crs
from mrasfm_engine.export.geojson import write_geojson
from mrasfm_engine.export.geopackage_in_crs import write_geopackage_in_crs
from mrasfm_engine.export.geotiff_in_crs import placed_picture, write_geotiff_in_crs
from mrasfm_engine.export.kitti_odometry import write_kitti
from mrasfm_engine.export.mcap import write_mcap
from mrasfm_engine.export.nerfstudio import write_nerfstudio
from mrasfm_engine.export.nuscenes import write_nuscenes

# Raise the InputError with which the format's writer would refuse a georeferenced scene, before anything is written.
CHECKS: dict[str, Callable[[ExportSource, ExportOptions], object]] = {
    "copc": system_of_points,
    "geotiff": placed_picture,
}

WRITERS: dict[str, Writer] = {
    "colmap": write_colmap,
    "nerfstudio": write_nerfstudio,
    "nuscenes": write_nuscenes,
    "mcap": write_mcap,
    "copc": write_copc_in_crs,
    "geopackage": write_geopackage_in_crs,
    "geotiff": write_geotiff_in_crs,
    "kitti": write_kitti,
    "geojson": write_geojson,
}
