"""Reader of `points.copc.laz` and its comparison with the scene, for the check before it is put in place.

It shares no code with the writer: fields are read by their place in the standards, every node's points through the
octree's entries, as viewers do, and coordinates are computed by the coordinate reference system that the file names.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lazrs
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.projection_readback import projected
from mrasfm_engine.geometry import utm
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.scene.semantics import ROAD
from mrasfm_engine.types import Floats

BATCH = 500_000  # points that are in memory at one time, or those of a node
STEP_M = 1e-4
# A projected coordinate may lie halfway between two steps.
TIE = 0.501

_HEADER = np.dtype(
    [("signature", "S4"), ("source", "<u2"), ("encoding", "<u2"), ("guid", "S16"), ("version", "u1", 2),
     ("system", "S32"), ("software", "S32"), ("day", "<u2"), ("year", "<u2"), ("size", "<u2"), ("points_at", "<u4"),
     ("records", "<u4"), ("point_format", "u1"), ("point_size", "<u2"), ("old_counts", "<u4", 6),
     ("scale", "<f8", 3), ("offset", "<f8", 3), ("ranges", "<f8", (3, 2)), ("waveforms_at", "<u8"),
     ("late_records_at", "<u8"), ("late_records", "<u4"), ("points", "<u8"), ("by_return", "<u8", 15)]
)  # fmt: skip
_RECORD = np.dtype([("reserved", "<u2"), ("user", "S16"), ("id", "<u2"), ("size", "<u2"), ("description", "S32")])
_LATE_RECORD = np.dtype([("reserved", "<u2"), ("user", "S16"), ("id", "<u2"), ("size", "<u8"), ("description", "S32")])
_INFORMATION = np.dtype(
    [("centre", "<f8", 3), ("half", "<f8"), ("spacing", "<f8"), ("root_at", "<u8"), ("root_size", "<u8"),
     ("gps_time", "<f8", 2), ("reserved", "<u8", 11)]
)  # fmt: skip
_ENTRY = np.dtype([("level", "<i4"), ("place", "<i4", 3), ("at", "<u8"), ("size", "<i4"), ("count", "<i4")])
_EXTRA = np.dtype(
    [("reserved", "<u2"), ("kind", "u1"), ("options", "u1"), ("name", "S32"), ("undeclared", "u1", 124),
     ("description", "S32")]
)  # fmt: skip
_POINT = np.dtype(
    [("x", "<i4"), ("y", "<i4"), ("z", "<i4"), ("intensity", "<u2"), ("returns", "u1"), ("flags", "u1"),
     ("classification", "u1"), ("user_data", "u1"), ("scan_angle", "<i2"), ("source", "<u2"), ("gps_time", "<f8"),
     ("red", "<u2"), ("green", "<u2"), ("blue", "<u2"), ("point_id", "<u4"), ("track_length", "<u4"),
     ("error_px", "<f4"), ("road_patch", "<i4"), ("component", "<i4")]
)  # fmt: skip
_UNUSED = ("intensity", "flags", "user_data", "scan_angle", "source", "gps_time")
_ATTRIBUTES = {5: "<u4", 6: "<i4", 9: "<f4"}  # LAS's number of a type


class Record(NamedTuple):
    """A variable length record."""

    head: Any
    data: bytes


class CopcFile(NamedTuple):
    """Everything that the file holds but its points, which are read node by node."""

    path: Path
    header: Any
    records: list[Record]
    information: Any
    late_record: Any  # the last of the file, with the nodes
    nodes: NDArray[Any]
    chunks: list[tuple[int, int]]  # points and bytes, as laszip's table has them
    end: int

    def points(self) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
        """Nodes and their points one after the other, of some nodes at one time."""
        laszip = self.records[1].data
        batches = np.cumsum(self.nodes["count"]) // BATCH
        with self.path.open("rb") as file:
            for batch in np.unique(batches):
                nodes = self.nodes[batches == batch]
                file.seek(int(nodes["at"][0]))
                data = file.read(int(nodes["size"].sum()))
                points = np.zeros(nodes["count"].sum(), dtype=_POINT)
                table = list(zip(nodes["count"].tolist(), nodes["size"].tolist(), strict=True))
                _decompress(data, laszip, points.view(np.uint8), table)
                yield nodes, points


def read_copc(path: Path) -> CopcFile:
    """The file with all its records; ValueError where they are not where they must be."""
    with path.open("rb") as file:
        header = np.frombuffer(file.read(_HEADER.itemsize), dtype=_HEADER)[0]
        records = [_record(file, _RECORD) for _ in range(min(int(header["records"]), 9))]
        if file.tell() != header["points_at"]:
            raise ValueError("its points do not begin after its records")
        if [len(record.data) for record in records[:1]] != [_INFORMATION.itemsize]:
            raise ValueError("its first record is not COPC's")
        late_at = int(header["late_records_at"])
        file.seek(late_at)
        late = _record(file, _LATE_RECORD)
        end = file.tell() + len(file.read(1))
        nodes = np.frombuffer(late.data, dtype=_ENTRY)
        _require_chunk_table(file, int(header["points_at"]), late_at, len(nodes))
        chunks = lazrs.read_chunk_table(file, lazrs.LazVlr(records[1].data))
        information = np.frombuffer(records[0].data, dtype=_INFORMATION)[0]
        return CopcFile(
            path=path,
            header=header,
            records=records,
            information=information,
            late_record=late.head,
            nodes=nodes,
            chunks=chunks,
            end=end,
        )


def _decompress(data: bytes, laszip: bytes, out: NDArray[np.uint8], table: list[tuple[int, int]]) -> None:
    try:
        lazrs.decompress_points_with_chunk_table(data, laszip, out, table)
    except BaseException as error:
        if type(error).__name__ == "PanicException":  # of bytes that cannot be: it is no Exception
            raise ValueError("its points cannot be decompressed") from error
        raise


def _require_chunk_table(file: BinaryIO, points_at: int, end: int, chunks: int) -> None:
    """Go to the points; laszip takes the number of chunks, whatever it is, for the size of what it allocates."""
    file.seek(points_at)
    (table_at,) = struct.unpack("<Q", file.read(8))
    if not points_at < table_at < end:
        raise ValueError("its table of chunks is not where it must be")
    file.seek(table_at)
    if struct.unpack("<2I", file.read(8)) != (0, chunks):
        raise ValueError("its table of chunks has not one for each node")
    file.seek(points_at)


def _record(file: BinaryIO, kind: np.dtype[Any]) -> Record:
    head = np.frombuffer(file.read(kind.itemsize), dtype=kind)[0]
    size = int(head["size"])
    if size > os.fstat(file.fileno()).st_size:
        raise ValueError("a record is larger than the file")
    return Record(head, file.read(size))


def copc(scene: Scene, found: CopcFile, *, text: str | None = None) -> Rows:
    """Every field of the file, and every point's coordinates in the file's coordinate reference system.

    Parameters
    ----------
    text
        WKT 1 of that system, where it is not UTM.
    """
    yield from _records(scene, found)
    yield from _header(scene, found)
    yield from _nodes(found)
    yield from _points(scene, found, text)


def _records(scene: Scene, found: CopcFile) -> Rows:
    """Names and texts of the records, and what the extra attributes are called."""
    heads = [record.head[["reserved", "user", "id", "description"]].tolist() for record in found.records]
    system = [] if scene.georeference is None else [(0, b"LASF_Projection", 2112, b"OGC WKT")]
    expected = [
        (0, b"copc", 1, b"COPC info"),
        (0, b"laszip encoded", 22204, b"lazrs"),
        *system,
        (0, b"LASF_Spec", 4, b"extra attributes"),
    ]
    yield Row("its records", heads, expected)
    extra = np.frombuffer(found.records[-1].data, dtype=_EXTRA)
    names = list(_POINT.names or ())[-len(extra) :]
    yield Row("its extra attributes", extra["name"].tolist(), [name.encode() for name in names])
    yield Row("their types", [_ATTRIBUTES.get(k) for k in extra["kind"].tolist()], [_POINT[n].str for n in names])
    descriptions = [b"its id in model/", b"images that observe it", b"mean reprojection error"]
    descriptions += [b"patch of road.json, -1: none", b"as report.json numbers them"]
    yield Row("their descriptions", extra["description"].tolist(), descriptions)
    declared = extra["reserved"].any() or extra["options"].any() or extra["undeclared"].any()
    yield Row("what they declare besides", bool(declared), False)
    items = lazrs.LazVlr.new_for_compression(7, 4 * len(extra), True).record_data()
    yield Row("laszip's record", found.records[1].data, bytes(items))


def _header(scene: Scene, found: CopcFile) -> Rows:
    header, count = found.header, len(scene.points_m)
    beginning = header[["signature", "source", "encoding", "guid", "system"]].tolist()
    yield Row("its header: signature and encoding", beginning, (b"LASF", 0, 16, b"", b"OTHER"))
    yield Row("its header: version", header["version"], np.array([1, 4]))
    yield Row("its header: software and date", header[["software", "day", "year"]].tolist(), (b"MRASfM", 0, 0))
    layout = header[["size", "point_format", "point_size", "waveforms_at", "late_records"]].tolist()
    yield Row("its header: sizes", layout, (_HEADER.itemsize, 128 + 7, _POINT.itemsize, 0, 1))
    yield Row("its header: old counts", header["old_counts"], np.zeros(6))
    yield Row("its header: points", int(header["points"]), count)
    yield Row("its header: points by return", header["by_return"], np.array([count, *[0] * 14]))
    yield Row("its header: scale", header["scale"], np.full(3, STEP_M))
    late = found.late_record
    described = late[["reserved", "user", "id", "description"]].tolist()
    yield Row("the nodes' record", described, (0, b"copc", 1000, b"EPT Hierarchy"))
    root = int(header["late_records_at"]) + _LATE_RECORD.itemsize
    yield Row("its end", found.end, root + found.nodes.nbytes)
    information = found.information
    sizes = [int(information["root_at"]), int(information["root_size"]), int(late["size"])]
    yield Row("where its nodes are", sizes, [root, found.nodes.nbytes, found.nodes.nbytes])
    yield Row("its GPS times", information["gps_time"], np.zeros(2))
    yield Row("its reserved fields", information["reserved"], np.zeros(11))
    yield Row("the spacing of the root", information["spacing"], 2 * information["half"] / 128)


def _nodes(found: CopcFile) -> Rows:
    """The octree has no gaps, and its nodes are the chunks of the file one after the other."""
    nodes, header = found.nodes, found.header
    keys = {(level, *place) for level, place in zip(nodes["level"].tolist(), nodes["place"].tolist(), strict=True)}
    parents = {(level - 1, x >> 1, y >> 1, z >> 1) for level, x, y, z in keys if level}
    yield Row("the number of its nodes", len(keys), len(nodes))
    yield Row("the nodes that it lacks", sorted(parents - keys), [])
    yield Row("its root", (0, 0, 0, 0) in keys, True)
    sizes = list(zip(nodes["count"].tolist(), nodes["size"].tolist(), strict=True))
    yield Row("its chunks", found.chunks, sizes)
    yield Row("an empty node", bool((nodes["count"] <= 0).any()), False)
    begins = int(header["points_at"]) + 8 + np.cumsum(nodes["size"].astype(np.int64)) - nodes["size"]
    yield Row("where a node's points are", nodes["at"].astype(np.int64), begins)


def _points(scene: Scene, found: CopcFile, wanted: str | None) -> Rows:
    header, information = found.header, found.information
    offset_m = header["offset"]
    place, system = scene.georeference, None
    if place is not None:
        text = found.records[2].data
        code = utm.epsg_code(*place.origin_deg)
        expected = utm.well_known_text(code) if wanted is None else wanted
        yield Row("its coordinate reference system", text, expected.encode() + b"\0")
        system = CRS.from_wkt(text.decode("ascii").removesuffix("\0"))

    def in_system(points_m: Floats) -> Floats:
        return points_m if place is None or system is None else projected(place, points_m, system)

    origin_m = np.zeros(3) if system is None else in_system(np.zeros((1, 3)))[0] - 0.5
    yield Row("its offset, whole metres,", offset_m, np.rint(offset_m))
    yield Row("its offset", offset_m, origin_m, 0.0 if system is None else 0.5 + 1e-6)
    lengths = np.bincount(scene.observation_point, minlength=len(scene.points_m))
    components = _components(scene)
    low, high = np.full(3, np.iinfo(np.int32).max), np.full(3, np.iinfo(np.int32).min)
    unseen = np.ones(len(scene.points_m), dtype=np.bool_)
    cube_m = information["centre"] - information["half"]
    for nodes, points in found.points():
        index = points["point_id"].astype(np.int64) - 1
        yield Row("a point's id", bool(((index >= 0) & (index < len(unseen))).all()), True)
        unseen[index] = False
        steps = np.stack([points[axis] for axis in "xyz"], -1).astype(np.int64)
        low, high = np.minimum(low, steps.min(axis=0)), np.maximum(high, steps.max(axis=0))
        yield Row("a point", steps, (in_system(scene.points_m[index]) - offset_m) / STEP_M, TIE)
        side_m = np.repeat(information["half"] * 2.0 ** (1 - nodes["level"]), nodes["count"])[:, None]
        corner_m = cube_m + np.repeat(nodes["place"], nodes["count"], axis=0) * side_m
        inside = np.abs(steps * STEP_M + offset_m - corner_m - side_m / 2) - side_m / 2
        yield Row("a point outside its node", bool((inside > STEP_M / 2).any()), False)
        colors = np.stack([points[name] for name in ("red", "green", "blue")], -1)
        yield Row("a colour", colors, scene.point_colors[index] * np.uint16(257))
        yield Row("a classification", points["classification"], _classification(scene.point_classes[index]))
        yield Row("a track's length", points["track_length"], lengths[index])
        yield Row("a reprojection error", points["error_px"], scene.point_error_px[index].astype(np.float32))
        yield Row("a patch", points["road_patch"], scene.point_patches[index])
        yield Row("a component", points["component"], components[index])
        yield Row("a return", bool((points["returns"] == 1 + 16).all()), True)
        yield Row("a field without use", [name for name in _UNUSED if points[name].any()], [])
    yield Row("the points that it lacks", bool(unseen.any()), False)
    yield Row("its header: bounds", header["ranges"], np.stack([high, low], -1) * STEP_M + offset_m[:, None])
    half_m = max(1, int((high - low).max())) * STEP_M / 2
    yield Row("half the side of its cube", information["half"], half_m)
    yield Row("the centre of its cube", information["centre"], header["ranges"][:, 1] + half_m)


def _components(scene: Scene) -> NDArray[np.int64]:
    """Component (p,) of every point: that of the first unit that observes it."""
    if not scene.unit_component.any():
        return np.zeros(len(scene.points_m), dtype=np.int64)
    unit = np.array([image.unit for image in scene.drive.images], dtype=np.int64)[scene.observation_image]
    found = np.zeros(len(scene.points_m), dtype=np.int64)
    found[scene.observation_point[::-1]] = scene.unit_component[unit][::-1]  # the first of each point is written last
    return found


def _classification(classes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """ASPRS's numbers: those of the road are 11, and other classes than unknown and static are a user's own."""
    return np.where(classes == ROAD, 11, np.where(classes < ROAD, classes, classes + 64)).astype(np.uint8)
