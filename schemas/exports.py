"""Formats of exports, by the names that commands and the HTTP API give them.

A new one is its line here and its writer in `mrasfm_engine.export.formats`; commands, the API, the client and the
documentation follow from the two.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from schemas.artifacts import MAP_FILE, OWN_CAR_FOLDER, REPORT_FILE, ROAD_TIFF_FILE, SCENES_FOLDER

MIN_IMAGE_SIZE_PX, MAX_IMAGE_SIZE_PX = 64, 20_000
MAX_FORMATS = 32  # of one export
MAX_COMPONENT = 100_000  # a drive has no more frames


@dataclass(frozen=True, kw_only=True)
class ExportFormat:
    """A format as users choose it.

    Attributes
    ----------
    needs_images
        Its writer reads the images of the drives.
    needs_picture
        Its writer reads the picture of the road, which may be large.
    needs_place
        Only a georeferenced scene or map has it.
    takes_crs
        Its coordinates can be in a coordinate reference system of the user's choice.
    without_crs
        Why they cannot, for a user who asks for one for several formats.
    """

    name: str
    description: str
    needs_images: bool = False
    needs_picture: bool = False
    needs_place: bool = False
    takes_crs: bool = False
    without_crs: str = "its coordinates are those of the local frame"


EXPORT_FORMATS = {
    known.name: known
    for known in (
        ExportFormat(
            name="colmap",
            description="COLMAP workspace with undistorted pinhole images and masks, for 3DGS, nerfstudio and MVS",
            needs_images=True,
        ),
        ExportFormat(
            name="nerfstudio",
            description="transforms.json with undistorted pinhole images, masks and points, for nerfstudio",
            needs_images=True,
        ),
        ExportFormat(
            name="nuscenes",
            description="tables of nuScenes with pinhole images as keyframes, for its development kit and converters",
            needs_images=True,
        ),
        ExportFormat(
            name="mcap",
            description="one MCAP file with Foxglove's schemas, for Foxglove, Lichtblick and rerun",
            needs_images=True,
        ),
        ExportFormat(
            name="copc",
            description="points as a cloud-optimised point cloud in a coordinate reference system of your choice",
            needs_place=True,
            takes_crs=True,
        ),
        ExportFormat(
            name="geopackage",
            description="path and positions of units and cameras in a coordinate reference system of your choice",
            needs_place=True,
            takes_crs=True,
        ),
        ExportFormat(
            name="geotiff",
            description="picture of the road from above as GeoTIFF in a coordinate reference system of your choice",
            needs_picture=True,
            needs_place=True,
            takes_crs=True,
        ),
        ExportFormat(name="kitti", description="poses, times and calibration as KITTI odometry has them"),
        ExportFormat(
            name="geojson",
            description="path and positions of units and cameras as GeoJSON",
            needs_place=True,
            without_crs="GeoJSON (RFC 7946) has WGS84 alone",
        ),
    )
}


def unknown_formats(names: Iterable[str]) -> list[str]:
    """Names that are of no format, each once."""
    return sorted(set(names) - EXPORT_FORMATS.keys())


# What every export reads; of a map besides calibration/NAME.json and SCENES_FOLDER/NAME.npz of each scene.
_EXPORTED = (REPORT_FILE, "poses.json", "frame.json", "points.ply", "model/images.bin", "model/points3D.bin")
EXPORTED_OF_SCENE = frozenset({*_EXPORTED, "manifest.json", "calibration.json"})
EXPORTED_OF_MAP = frozenset({*_EXPORTED, MAP_FILE})


def is_read_by_export(path: str, formats: Collection[str]) -> bool:
    """Return whether an export in these formats reads this file of a scene or map, by its path in the folder that is
    exported.
    """
    if path == ROAD_TIFF_FILE:
        return any(EXPORT_FORMATS[name].needs_picture for name in formats)
    folders = (f"{OWN_CAR_FOLDER}/", f"{SCENES_FOLDER}/", "calibration/")
    return path in EXPORTED_OF_SCENE | EXPORTED_OF_MAP or path.startswith(folders)
