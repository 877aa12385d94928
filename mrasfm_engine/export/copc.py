"""`points.copc.laz`: the points as a cloud-optimised point cloud (COPC 1.0), which is a LAZ 1.4 file as well.

Layout: the header; the records: COPC's information comes first, then laszip's, right after it the coordinate reference
system, last the extra attributes; the points, a chunk for each node of the octree; laszip's table of chunks; the nodes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import SEEK_END, BytesIO
from pathlib import Path

import lazrs
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.export.file_contents import write_content
from mrasfm_engine.export.octree import GRID, Octree, build_octree
from mrasfm_engine.geometry.earth_system import EarthSystem, utm_system
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.scene.semantics import CLASS_NAMES, ROAD
from mrasfm_engine.types import Floats, Ints32

STEP_M = 1e-4  # of the coordinates, which are whole numbers of steps from the offset
REACH_M = 200_000.0  # from the origin: 32 bits count steps to 214 km
BLOCK = 1_000_000  # points that are projected at one time

POINT_FORMAT = 7
POINT = np.dtype(
    [("xyz", "<i4", 3), ("intensity", "<u2"), ("returns", "u1"), ("flags", "u1"), ("classification", "u1"),
     ("user_data", "u1"), ("scan_angle", "<i2"), ("source", "<u2"), ("gps_time", "<f8"), ("rgb", "<u2", 3),
     ("point_id", "<u4"), ("track_length", "<u4"), ("error_px", "<f4"), ("road_patch", "<i4"), ("component", "<i4")]
)  # fmt: skip
EXTRA = {  # name: LAS's number of its type, description
    "point_id": (5, "its id in model/"),
    "track_length": (5, "images that observe it"),
    "error_px": (9, "mean reprojection error"),
    "road_patch": (6, "patch of road.json, -1: none"),
    "component": (6, "as report.json numbers them"),
}
ONE_OF_ONE_RETURN = 0x11
# ASPRS: 0 never classified, 1 unclassified, 11 road surface; from 64 on a user's own
CLASSIFICATION = {code: code if code < ROAD else 64 + code for code in CLASS_NAMES} | {ROAD: 11}

_HEADER = "<4sHH16sBB32s32sHHHIIBHI5I12dQQIQ15Q"
_HEADER_BYTES = struct.calcsize(_HEADER)
_INFO_BYTES = 54 + 160
_HAS_WKT, _IS_COMPRESSED = 16, 0x80


def fits(scene: Scene) -> bool:
    """Return whether the points can be written: there are some, and none is beyond `REACH_M`."""
    reach_m = np.sqrt(np.max(np.einsum("ij,ij->i", scene.points_m, scene.points_m), initial=0.0))
    return len(scene.points_m) > 0 and bool(reach_m <= REACH_M)


def write_copc(scene: Scene, path: Path, system: EarthSystem | None = None) -> str:
    """Write the points in steps of 0.1 mm: as UTM and ellipsoidal height, in the local frame without a place on earth.

    They must fit. The SHA-256 of the file's content is returned.

    Parameters
    ----------
    system
        In place of UTM, of a scene with a place on the earth; steps are then a tenth of a thousandth of its unit.

    Raises
    ------
    OSError
        Where the file cannot be written.
    InputError
        Where the points have no coordinates in the system.
    """
    system = system or _system_of(scene)
    wkt = "" if system is None else system.well_known_text
    offset_m, steps = coordinates(scene, system)
    low, high = steps.min(axis=0), steps.max(axis=0)
    octree = build_octree((steps - low).view(np.uint32))  # without a sign: they may be 400 km apart
    laszip = lazrs.LazVlr.new_for_compression(POINT_FORMAT, POINT["point_id"].itemsize * len(EXTRA), True)
    records = [
        _record("laszip encoded", 22204, "lazrs", bytes(laszip.record_data())),
        *([_record("LASF_Projection", 2112, "OGC WKT", wkt.encode("ascii") + b"\0")] if wkt else []),
        _record("LASF_Spec", 4, "extra attributes", b"".join(_extra(name, *EXTRA[name]) for name in EXTRA)),
    ]
    points_at = _HEADER_BYTES + _INFO_BYTES + sum(map(len, records))
    file = BytesIO(b"".join([bytes(_HEADER_BYTES + _INFO_BYTES), *records]))  # lazrs would hide that a disk is full
    file.seek(points_at)
    _compress(file, laszip, _chunks(scene, steps, octree))
    nodes_at = file.seek(0, SEEK_END)
    file.seek(points_at)
    sizes = [size for _, size in lazrs.read_chunk_table(file, laszip)]
    entries = _entries(octree, points_at, sizes)
    file.seek(nodes_at)
    file.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(entries), b"EPT Hierarchy") + entries)
    file.seek(0)
    bounds_m = low * STEP_M + offset_m, high * STEP_M + offset_m
    file.write(_header(bounds_m, offset_m, count=len(steps), records=len(records), offsets=(points_at, nodes_at)))
    file.write(_information(bounds_m[0], octree, nodes_at + 60, len(entries)))
    return write_content(path, file.getbuffer())


def coordinates(scene: Scene, system: EarthSystem | None) -> tuple[Floats, Ints32]:
    """Offset (3,) in metres, and the points (n, 3) in steps from it, in the file's coordinate reference system."""
    offset_m = _offset(scene, system)
    steps = np.empty(scene.points_m.shape, dtype=np.int32)
    for first in range(0, len(steps), BLOCK):
        block = slice(first, first + BLOCK)
        counted = np.rint((_projected(scene, scene.points_m[block], system) - offset_m) / STEP_M)
        if np.abs(counted).max() > np.iinfo(np.int32).max:
            raise ValueError("a point is too far from the origin for its 32 bits")
        steps[block] = counted
    return offset_m, steps


def offset_of(scene: Scene) -> Floats:
    """Offset (3,) of the scene's own file in metres: zero in the local frame."""
    return _offset(scene, _system_of(scene))


def in_reference_system(scene: Scene, points_m: Floats) -> Floats:
    """Local points (n, 3) in the reference system of the scene's own file: UTM and ellipsoidal height, or local."""
    return _projected(scene, points_m, _system_of(scene))


def epsg_code_of(scene: Scene) -> int | None:
    """EPSG code of the horizontal coordinate reference system of the scene's own file; None in the local frame."""
    system = _system_of(scene)
    return None if system is None else system.code


def _offset(scene: Scene, system: EarthSystem | None) -> Floats:
    offset_m: Floats = np.floor(_projected(scene, np.zeros((1, 3)), system)[0])
    return offset_m


def _projected(scene: Scene, points_m: Floats, system: EarthSystem | None) -> Floats:
    if system is None:
        return points_m
    assert scene.georeference is not None
    return system.projected(points_m, scene.georeference.ecef_from_local)


def _system_of(scene: Scene) -> EarthSystem | None:
    place = scene.georeference
    return None if place is None else utm_system(*place.origin_deg)


def _chunks(scene: Scene, steps: Ints32, octree: Octree) -> Iterator[NDArray[np.void]]:
    """The points of each node."""
    lengths = np.bincount(scene.observation_point, minlength=len(steps))
    components = scene.point_component
    classification = np.array([CLASSIFICATION[code] for code in sorted(CLASSIFICATION)], dtype=np.uint8)
    for first, end in octree.bounds.tolist():
        of_node = octree.order[first:end]
        points = np.zeros(end - first, dtype=POINT)
        points["xyz"] = steps[of_node]
        points["returns"] = ONE_OF_ONE_RETURN
        points["classification"] = classification[scene.point_classes[of_node]]
        points["rgb"] = scene.point_colors[of_node].astype(np.uint16) * 257
        points["point_id"] = of_node + 1
        points["track_length"] = lengths[of_node]
        points["error_px"] = scene.point_error_px[of_node]
        points["road_patch"] = scene.point_patches[of_node]
        points["component"] = components[of_node]
        yield points


def _compress(file: BytesIO, laszip: lazrs.LazVlr, chunks: Iterator[NDArray[np.void]]) -> None:
    compressor = lazrs.LasZipCompressor(file, laszip)
    compressor.reserve_offset_to_chunk_table()
    for number, points in enumerate(chunks):
        if number:  # the last chunk is finished with the file: one more would be an empty one
            compressor.finish_current_chunk()
        compressor.compress_many(points.view(np.uint8))
    compressor.done()


def _record(user: str, number: int, description: str, data: bytes) -> bytes:
    """A variable length record."""
    return struct.pack("<H16sHH32s", 0, user.encode(), number, len(data), description.encode()) + data


def _extra(name: str, kind: int, description: str) -> bytes:
    """Description of an extra attribute; minimum, maximum, scale and offset are not declared, and so zero."""
    return struct.pack("<HBB32s4x120x32s", 0, kind, 0, name.encode(), description.encode())


def _entries(octree: Octree, points_at: int, sizes: list[int]) -> bytes:
    """Place of each node's chunk in the file."""
    entries = np.zeros(len(sizes), dtype=[("node", "<i4", 4), ("at", "<u8"), ("size", "<i4"), ("count", "<i4")])
    entries["node"] = octree.nodes
    entries["size"] = sizes
    entries["at"] = points_at + 8 + np.cumsum(sizes) - sizes  # after the offset of the table of chunks
    entries["count"] = octree.bounds[:, 1] - octree.bounds[:, 0]
    return entries.tobytes()


def _header(
    bounds_m: tuple[Floats, Floats], offset_m: Floats, *, count: int, records: int, offsets: tuple[int, int]
) -> bytes:
    points_at, nodes_at = offsets
    ranges = np.column_stack(bounds_m[::-1]).ravel().tolist()
    return struct.pack(
        _HEADER,
        *(b"LASF", 0, _HAS_WKT, b"", 1, 4, b"OTHER", b"MRASfM", 0, 0),  # no date: the same scene is the same file
        *(_HEADER_BYTES, points_at, 1 + records, POINT_FORMAT | _IS_COMPRESSED, POINT.itemsize),
        *(0, 0, 0, 0, 0, 0),  # counts as LAS 1.2 has them
        *(STEP_M, STEP_M, STEP_M, *offset_m, *ranges),
        *(0, nodes_at, 1),
        *(count, count, *[0] * 14),
    )


def _information(low_m: Floats, octree: Octree, entries_at: int, entries_bytes: int) -> bytes:
    """The COPC information record. The cube begins at the header's minimum: some readers take it for that."""
    half_m = octree.side * STEP_M / 2
    data = struct.pack("<5d2Q2d88x", *(low_m + half_m), half_m, 2 * half_m / GRID, entries_at, entries_bytes, 0.0, 0.0)
    return _record("copc", 1, "COPC info", data)
