from __future__ import annotations

import copy
import json
import re
from typing import Any

import jsonschema
import numpy as np
import pytest

from schemas import BodyAxes, DocumentError, DriveManifest, LabelMap, Pose, SemanticClass, parse_manifest
from schemas.export import SCHEMA_FILE, schema_text
from schemas.parsing import parse_document

README = SCHEMA_FILE.with_name("README.md")


@pytest.fixture
def example() -> dict[str, Any]:
    blocks = re.findall(r"```json\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert len(blocks) == 1
    result: dict[str, Any] = json.loads(blocks[0])
    return result


def encoded(document: object) -> bytes:
    return json.dumps(document).encode()


def test_committed_schema_is_up_to_date() -> None:
    assert SCHEMA_FILE.read_text(encoding="utf-8") == schema_text(), "run 'python -m schemas.export'"


def test_documented_example_fits_model_and_schema(example: dict[str, Any]) -> None:
    manifest = parse_manifest(encoded(example))
    assert manifest.rig.body_axes is BodyAxes.FLU
    assert [camera.name for camera in manifest.rig.cameras] == ["front", "left"]
    assert manifest.label_map is not None
    assert manifest.label_map.ids[255] is SemanticClass.OWN_CAR
    validator = jsonschema.Draft202012Validator(json.loads(SCHEMA_FILE.read_text(encoding="utf-8")))
    assert list(validator.iter_errors(example)) == []
    example["rig"]["surprise"] = 1
    assert len(list(validator.iter_errors(example))) == 1


def test_documentation_names_every_field() -> None:
    text = README.read_text(encoding="utf-8")
    definitions = json.loads(SCHEMA_FILE.read_text(encoding="utf-8"))["$defs"]
    fields = {name for definition in definitions.values() for name in definition.get("properties", {})}
    fields |= set(DriveManifest.model_fields)
    assert len(fields) > 30
    missing = [name for name in sorted(fields) if not re.search(rf"\b{name}\b", text)]
    assert missing == []


def test_round_trip_keeps_everything(example: dict[str, Any]) -> None:
    manifest = parse_manifest(encoded(example))
    assert parse_manifest(manifest.model_dump_json(exclude_none=True).encode()) == manifest


def change(document: Any, path: str, value: Any) -> Any:
    document = copy.deepcopy(document)
    *parents, last = path.split(".")
    target = document
    for part in parents:
        target = target[int(part)] if part.isdigit() else target[part]
    target[int(last) if last.isdigit() else last] = value
    return document


@pytest.mark.parametrize(
    ("path", "value", "named", "message"),
    [
        ("version", 2, "version", "1"),
        ("name", "", "name", "at least 1 character"),
        ("rig.body_axes", "xyz", "rig.body_axes", "'flu', 'rdf' or 'frd'"),
        ("rig.cameras", [], "rig.cameras", "at least 1 item"),
        ("rig.cameras.1.name", "front", "rig", "'front' is used twice"),
        ("rig.cameras.1.name", "../x", "rig.cameras.1.name", "pattern"),
        ("rig.cameras.0.model", "FISHEYE", "rig.cameras.0.model", "not supported"),
        ("rig.cameras.0.params", [1150.0, 960.5, 540.5], "rig.cameras.0.params", "4 parameters (fx, fy, cx, cy)"),
        ("rig.cameras.0.params", [0.0, 1150.0, 960.5, 540.5], "rig.cameras.0.params", "singular"),
        ("rig.cameras.0.params", [1150.0, 1150.0, 0.5, 5000.0], "rig.cameras.0.params", "principal point"),
        ("rig.cameras.0.params", ["1150", 1150.0, 960.5, 540.5], "rig.cameras.0.params.0", "valid number"),
        ("rig.cameras.0.width", 0, "rig.cameras.0.width", "greater than 0"),
        ("rig.cameras.0.width", 10**6, "rig.cameras.0.width", "20000"),
        ("rig.cameras.0.width", 1920.5, "rig.cameras.0.width", "integer"),
        ("rig.cameras.0.sigma_rotation_deg", 0, "rig.cameras.0.sigma_rotation_deg", "greater than 0"),
        (
            "rig.cameras.0.rig_from_cam.rotation_xyzw",
            [0, 0, 0, 0],
            "rig.cameras.0.rig_from_cam.rotation_xyzw",
            "norm 1",
        ),
        ("rig.cameras.0.rig_from_cam.translation_m", [1700, 0, 1500], "rig.cameras.0.rig_from_cam", "metres"),
        ("frames", [], "frames", "at least 1 item"),
        ("frames.0.timestamp_us", 0.1, "frames.0.timestamp_us", "integer number of microseconds"),
        ("frames.0.timestamp_us", -1, "frames.0.timestamp_us", "greater than or equal to 0"),
        ("frames.1.timestamp_us", 1714730400000000, "", "frames.1.timestamp_us repeats"),
        ("frames.1.timestamp_us", 1, "", "frames.1.timestamp_us goes back"),
        ("frames.1.source_frame", 0, "", "frames.1.source_frame 0 is used twice"),
        ("frames.1.images", {"rear": {"file": "a.png"}}, "", "'rear', which the rig does not have: front, left"),
        ("frames.1.images.front.file", "images/front/000000.jpg", "", "used by two images"),
        ("frames.0.images.front.file", "../secret.png", "frames.0.images.front.file", "relative path"),
        ("frames.0.images.front.file", "/etc/passwd", "frames.0.images.front.file", "relative path"),
        ("frames.0.images.front.file", "images//a.png", "frames.0.images.front.file", "relative path"),
        ("frames.0.images.front.file", "images\\a.png", "frames.0.images.front.file", "relative path"),
        ("frames.0.images.front.file", "a\n.png", "frames.0.images.front.file", "relative path"),
        ("frames.0.images.front.file", "a" * 256, "frames.0.images.front.file", "relative path"),
        ("frames.0.images.front.mask", "./m.png", "frames.0.images.front.mask", "relative path"),
        ("gnss.height_datum", "EGM96", "gnss.height_datum", "pattern"),
        ("gnss.samples.1.latitude_deg", 98.0, "gnss.samples.1.latitude_deg", "swapped?"),
        ("gnss.samples.1.sigma_vertical_m", 0, "gnss.samples.1.sigma_vertical_m", "greater than 0"),
        ("gnss.antenna_in_rig_m", [0, 0, 1800], "gnss.antenna_in_rig_m", "metres"),
        ("rough_poses.poses", [], "rough_poses.poses", "at least 1 item"),
        ("rough_poses.poses.0.world_from_rig.translation_m", [1e9, 0, 0], "rough_poses.poses.0", "millimetres"),
        ("label_map.ids", {"256": "road"}, "label_map.ids.256", "less than or equal to 255"),
        ("label_map.ids", {"1": "lawn"}, "label_map.ids.1", "'own_car'"),
        ("frame", [], "frame", "not a field"),
    ],
)
def test_bad_field_is_named(example: dict[str, Any], path: str, value: Any, named: str, message: str) -> None:
    with pytest.raises(DocumentError) as caught:
        parse_manifest(encoded(change(example, path, value)))
    first = caught.value.problems[0]
    assert first.path.startswith(named)
    assert bool(first.path) == bool(named)
    assert message in first.what


def test_missing_field_is_named(example: dict[str, Any]) -> None:
    del example["rig"]["cameras"][1]["params"]
    with pytest.raises(DocumentError, match=r"^rig\.cameras\.1\.params: is missing$"):
        parse_manifest(encoded(example))


def test_many_problems_are_counted(example: dict[str, Any]) -> None:
    for i in range(8):
        example[f"extra{i}"] = 0
    with pytest.raises(DocumentError, match=r"extra4.*and 3 more") as caught:
        parse_manifest(encoded(example))
    assert len(caught.value.problems) == 8


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (b'{"ids": {"0": NaN}}', "NaN"),
        (b'{"ids": {"0": -Infinity}}', "-Infinity"),
        (b'{"ids": {"0": "road", "0": "sky"}}', "'0' appears twice"),
        (b'{"ids": {"0": "road",}}', "not valid JSON"),
        (b"", "not valid JSON"),
        (b"[" * 100_000, "nested too deeply"),
        (b'{"ids": {"\xff": "road"}}', "not UTF-8"),
        (b'{"ids": ' + b"1" * 5000 + b"}", "not valid JSON"),
        (b"[]", "object"),
        (b" " * 101, "bound of 100"),
    ],
)
def test_what_is_not_plain_json_is_refused(raw: bytes, message: str) -> None:
    with pytest.raises(DocumentError, match=message):
        parse_document(raw, LabelMap, max_bytes=100 if raw.isspace() else 10**6)


def test_numbers_beyond_float_are_refused(example: dict[str, Any]) -> None:
    raw = encoded(example).replace(b'"height_m": 48.1', b'"height_m": 1e999', 1)
    with pytest.raises(DocumentError, match=r"gnss\.samples\.0\.height_m"):
        parse_manifest(raw)


def test_byte_order_mark_is_accepted(example: dict[str, Any]) -> None:
    assert parse_manifest(b"\xef\xbb\xbf" + encoded(example)).name == example["name"]


def test_cityscapes_labels() -> None:
    ids = LabelMap.cityscapes().ids
    assert (ids[0], ids[10], ids[13], ids[8]) == (
        SemanticClass.ROAD,
        SemanticClass.SKY,
        SemanticClass.DYNAMIC,
        SemanticClass.STATIC,
    )
    assert sorted(ids) == list(range(20))


def test_a_pose_that_was_written_reads_back_as_it_was() -> None:
    """Else a scene that is taken out of a map would pass for another one."""
    rng = np.random.default_rng(0)
    for _ in range(1000):
        quaternion = rng.normal(size=4)
        pose = Pose(rotation_xyzw=(quaternion / np.linalg.norm(quaternion)).tolist(), translation_m=[0.0, 0.0, 0.0])
        again = Pose.model_validate_json(pose.model_dump_json())
        assert again == pose
    assert 0 < np.linalg.norm(Pose(rotation_xyzw=[0, 0, 0, 1.0005], translation_m=[0, 0, 0]).rotation_xyzw) < 1 + 1e-12
