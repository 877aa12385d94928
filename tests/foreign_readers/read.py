"""Prints what readers of others say of a georeferenced scene with a picture of its road, as JSON: `read.py SCENE`.

It runs in an environment of its own (`requirements.lock`), and knows nothing of this project but what `docs/outputs.md`
says. A reader that is not installed is named. Warnings are errors.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Found = dict[str, Any]
SHIFTS_M = {"in place": 0.0, "0.25 m": 0.25}
# Half of a usual lane. Real roads are dark beside light grass, metres wide, which a shift of 0.25 m leaves as it is: of
# what differs within this distance it leaves little.
CONTRAST_M = 2.0


def ply_rows(path: Path) -> np.ndarray:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}
    properties = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    return np.frombuffer(body, dtype=[(name, kinds[kind]) for kind, name in properties])


def read_laspy(scene: Path) -> Found:
    """Points against those of the PLY, through the file's coordinate reference system."""
    import laspy
    from pyproj import Transformer

    las, rows = laspy.read(scene / "points.copc.laz"), ply_rows(scene / "points.ply")
    frame = json.loads((scene / "frame.json").read_text())
    matrix = np.array(frame["ecef_from_local"])
    to_ecef = Transformer.from_crs(las.header.parse_crs(), "EPSG:4978", always_xy=True)
    local_m = (np.stack(to_ecef.transform(las.x, las.y, las.z), -1) - matrix[:3, 3]) @ matrix[:3, :3]
    own = rows[las["point_id"] - 1]
    same = [np.array_equal(las[name], own[name]) for name in ("track_length", "error_px", "road_patch", "component")]
    same += [np.array_equal(las[name] // 257, own[name]) for name in ("red", "green", "blue")]
    return {
        "points": len(las.x),
        "ply_points": len(rows),
        "farthest_m": float(np.linalg.norm(local_m - np.stack([own[axis] for axis in "xyz"], -1), axis=1).max()),
        "attributes_agree": all(same),
    }


def read_copclib(scene: Path) -> Found:
    import copclib

    reader = copclib.FileReader(str(scene / "points.copc.laz"))
    nodes = reader.GetAllNodes()
    return {
        "valid": reader.ValidateSpatialBounds(),
        "points": sum(node.point_count for node in nodes),
        "nodes": len(nodes),
    }


def read_pyogrio(scene: Path) -> Found:
    """Layers, and positions of images against `poses.json`."""
    import pyogrio

    path = scene / "trajectory.gpkg"
    _, _, geometries, fields = pyogrio.raw.read(path, layer="camera_positions")
    names = pyogrio.read_info(path, layer="camera_positions")["fields"].tolist()
    images = json.loads((scene / "poses.json").read_text())["images"]
    known = [image["geodetic"] for image in images if image["registered"]]
    keys = ("longitude_deg", "latitude_deg", "ellipsoidal_height_m")
    expected = np.array([[place[key] for key in keys] for place in known])
    found = np.array([np.frombuffer(geometry[5:], "<f8") for geometry in geometries if geometry is not None])
    return {
        "layers": sorted(pyogrio.list_layers(path)[:, 0].tolist()),
        "system": pyogrio.read_info(path, layer="trajectory")["crs"],
        "images": len(fields[names.index("image")]),
        "expected_images": len(images),
        "degrees_off": float(np.abs(found - expected)[:, :2].max()),
        "metres_off": float(np.abs(found - expected)[:, 2].max()),
        "time": str(fields[names.index("time")].dtype),
    }


def read_rasterio(scene: Path) -> Found:
    """The road's picture; correlation of its colours with those of the points of the road, in place and shifted.

    `correlations` are of the colours, `contrasts` of their differences from the mean of the points around them.
    """
    import laspy
    import rasterio
    from rasterio.warp import transform

    las = laspy.read(scene / "points.copc.laz")
    road = las["road_patch"] >= 0
    own = np.stack([las.red, las.green, las.blue], -1)[road].mean(axis=1)
    easting, northing = np.array(las.x)[road], np.array(las.y)[road]
    system = las.header.parse_crs().to_wkt()
    correlations: dict[str, list[float]] = {}
    contrasts: dict[str, list[float]] = {}
    with rasterio.open(scene / "pictures" / "road.tif") as picture:
        pixels = picture.read()
        for name, shift_m in SHIFTS_M.items():
            for east, north in ((1, 0), (-1, 0), (0, 1), (0, -1)) if shift_m else ((0, 0),):
                x, y = transform(system, picture.crs, easting + east * shift_m, northing + north * shift_m)
                row, column = (
                    np.floor(v).astype(int) for v in rasterio.transform.rowcol(picture.transform, x, y, op=float)
                )
                shown = (row >= 0) & (row < picture.height) & (column >= 0) & (column < picture.width)
                shown[shown] = pixels[3, row[shown], column[shown]] > 127
                colors = pixels[:3, row[shown], column[shown]].mean(axis=0)
                places = np.stack([easting, northing], -1)[shown]
                both = np.stack([colors, own[shown]])
                correlations.setdefault(name, []).append(float(np.corrcoef(both)[0, 1]))
                contrasts.setdefault(name, []).append(float(np.corrcoef(both - means_around(places, both))[0, 1]))
        return {
            "correlations": correlations,
            "contrasts": contrasts,
            "road_points": int(road.sum()),
            "overviews": [picture.overviews(band) for band in picture.indexes],
            "is_tiled": bool(picture.profile["tiled"]),
            "projection": picture.crs.to_dict().get("proj", ""),
        }


def read_yaml(scene: Path) -> Found:
    """Every number is a number, and Kalibr's chain composes to `calibration.json`."""
    import yaml

    paths = [*scene.glob("rig/**/*.yaml"), *scene.glob("autoware/*.yaml")]
    documents = {path.name: yaml.safe_load(path.read_text()) for path in paths}
    cameras = json.loads((scene / "calibration.json").read_text())["cameras"]
    cam_from_first, off = np.eye(4), 0.0
    first = None
    for camera, refined in zip(documents["camchain.yaml"].values(), cameras.values(), strict=True):
        pose = refined["refined"]["rig_from_cam"]
        rig_from_cam = np.eye(4)
        rig_from_cam[:3, :3], rig_from_cam[:3, 3] = rotation_of(pose["rotation_xyzw"]), pose["translation_m"]
        first = rig_from_cam if first is None else first
        cam_from_first = np.array(camera.get("T_cn_cnm1", np.eye(4))) @ cam_from_first
        off = max(off, float(np.abs(first @ np.linalg.inv(cam_from_first) - rig_from_cam).max()))
    return {
        "files": len(documents),
        "texts_for_numbers": [value for value in leaves(documents) if isinstance(value, str) and is_number(value)],
        "chain_off": off,
        "origin": documents["map_projector_info.yaml"]["map_origin"],
        "cameras": len(cameras),
    }


def read_pypcd4(scene: Path) -> Found:
    """The PCD against the PLY, which is lower by the height of the origin."""
    import pypcd4

    cloud = pypcd4.PointCloud.from_path(str(scene / "autoware" / "pointcloud_map.pcd"))
    rows, frame = ply_rows(scene / "points.ply"), json.loads((scene / "frame.json").read_text())
    expected = np.stack([rows[axis] for axis in "xyz"], -1).astype(np.float64)
    expected[:, 2] += frame["origin"]["ellipsoidal_height_m"]
    return {"points": cloud.points, "farthest_m": float(np.abs(cloud.numpy(("x", "y", "z")) - expected).max())}


def means_around(places: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Means of values (k, n) over the places (n, 2) within `CONTRAST_M` of each place."""
    means = []
    for part in np.array_split(places, max(1, len(places) // 500)):
        near = np.linalg.norm(part[:, None] - places[None], axis=2) < CONTRAST_M
        means.append(values @ near.T / near.sum(axis=1))
    return np.concatenate(means, axis=1)


def rotation_of(xyzw: list[float]) -> np.ndarray:
    x, y, z, w = xyzw
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew


def leaves(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return [leaf for part in value.values() for leaf in leaves(part)]
    return [leaf for part in value for leaf in leaves(part)] if isinstance(value, list) else [value]


def is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


READERS: dict[str, Callable[[Path], Found]] = {
    "laspy": read_laspy,
    "copclib": read_copclib,
    "pyogrio": read_pyogrio,
    "rasterio": read_rasterio,
    "yaml": read_yaml,
    "pypcd4": read_pypcd4,
}


def main() -> None:
    """Print what each reader finds, or which module it lacks."""
    warnings.simplefilter("error")
    said: dict[str, Found] = {}
    for name, read in READERS.items():
        try:
            said[name] = read(Path(sys.argv[1]))
        except ModuleNotFoundError as error:
            said[name] = {"missing": str(error.name)}
        except Exception as error:
            said[name] = {"error": f"{type(error).__name__}: {error}"}
    print(json.dumps(said))


if __name__ == "__main__":
    main()
