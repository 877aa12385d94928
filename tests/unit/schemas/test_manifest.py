from __future__ import annotations

import copy
import json
import re
import tracemalloc
import unicodedata
from collections.abc import Iterator
from typing import Any

import jsonschema
import numpy as np
import pytest

from schemas import (
    BodyAxes,
    DocumentError,
    DriveManifest,
    LabelMap,
    Pose,
    SemanticClass,
    parse_manifest,
    parse_new_manifest,
)
from schemas.drive import FIELDS_OF_VERSION_2
from schemas.export import SCHEMA_FILE, schema_text
from schemas.file_names import name_problems
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
        ("version", 3, "version", "1 or 2"),
        ("rig.cameras.0.sigma_time_offset_us", 500.0, "", "rig.cameras.0.sigma_time_offset_us is of version 2"),
        ("name", "", "name", "at least 1 character"),
        ("name", "ring\x1b[31m road", "name", "'ring\\x1b[31m road' holds control characters"),
        ("name", "ring\nroad", "name", "holds control characters"),
        ("rig.cameras.0.name", "front\x1b[31m", "rig.cameras.0.name", "holds control characters"),
        ("rig.body_axes", "xyz", "rig.body_axes", "'flu', 'rdf' or 'frd'"),
        ("rig.cameras", [], "rig.cameras", "at least 1 item"),
        ("rig.cameras.1.name", "front", "rig", "'front' is used twice"),
        ("rig.cameras.1.name", "../x", "rig.cameras.1.name", "letters (A-Z, a-z), digits and _ . -"),
        ("rig.cameras.1.name", "front left", "rig.cameras.1.name", "first a letter or digit (is 'front left')"),
        ("rig.cameras.0.model", "FISHEYE", "rig.cameras.0.model", "not supported"),
        ("rig.cameras.0.params", [1150.0, 960.5, 540.5], "rig.cameras.0.params", "4 parameters (fx, fy, cx, cy)"),
        ("rig.cameras.0.params", [0.0, 1150.0, 960.5, 540.5], "rig.cameras.0.params", "singular"),
        ("rig.cameras.0.params", [1150.0, 1150.0, 0.5, 5000.0], "rig.cameras.0.params", "principal point"),
        ("rig.cameras.0.params", ["1150", 1150.0, 960.5, 540.5], "rig.cameras.0.params.0", "valid number"),
        ("rig.cameras.0.width", 0, "rig.cameras.0.width", "greater than 0"),
        ("rig.cameras.0.width", 10**6, "rig.cameras.0.width", "20000"),
        ("rig.cameras.0.width", 1920.5, "rig.cameras.0.width", "integer"),
        ("rig.cameras.0.sigma_rotation_deg", 0, "rig.cameras.0.sigma_rotation_deg", "give 1e-09 or more"),
        ("rig.cameras.0.sigma_translation_m", 1e-154, "rig.cameras.0.sigma_translation_m", "give 1e-09 or more"),
        ("rig.cameras.0.sigma_focal_px", 1e-200, "rig.cameras.0.sigma_focal_px", "give 1e-09 or more"),
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
        ("frames.1.timestamp_us", 1714730400100000000, "frames.1.timestamp_us", "nanoseconds?"),
        ("frames.1.images.front.timestamp_us", 2**62, "frames.1.images.front.timestamp_us", "after the year 9999"),
        ("gnss.samples.1.timestamp_us", 2**62, "gnss.samples.1.timestamp_us", "after the year 9999"),
        ("rough_poses.poses.0.timestamp_us", 2**62, "rough_poses.poses.0.timestamp_us", "after the year 9999"),
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
        ("gnss.height_datum", "EGM96", "gnss.height_datum", "'ellipsoidal' or EPSG: with 4 to 6 digits (is 'EGM96')"),
        ("gnss.samples.1.latitude_deg", 98.0, "gnss.samples.1.latitude_deg", "swapped?"),
        ("gnss.samples.1.sigma_vertical_m", 0, "gnss.samples.1.sigma_vertical_m", "give 1e-09 or more"),
        ("rough_poses.sigma_rotation_deg", 1e-154, "rough_poses.sigma_rotation_deg", "give 1e-09 or more"),
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
        (b'{"ids": ' + b"1" * 5000 + b"}", "integer of over 4300 digits"),
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


@pytest.mark.parametrize("version", [True, 1.0])
def test_a_version_that_only_equals_one(example: dict[str, Any], version: object) -> None:
    """A new drive is refused, and one that was accepted before is read."""
    example["version"] = version
    with pytest.raises(
        DocumentError, match=f"version: must be the integer 1 or 2, is {json.dumps(version)}"
    ) as refused:
        parse_new_manifest(encoded(example))
    assert [problem.path for problem in refused.value.problems] == ["version"]
    read = parse_manifest(encoded(example)).version
    assert (read, type(read)) == (1, int)


def test_version_2_says_how_well_more_of_a_camera_is_known(example: dict[str, Any]) -> None:
    new = {
        "sigma_principal_point_px": 1.5,
        "sigma_distortion": 0.01,
        "sigma_time_offset_us": 500.0,
        "readout_direction": "left_to_right",
    }
    example["rig"]["cameras"][0] |= new
    example["version"] = 2
    camera = parse_manifest(json.dumps(example).encode()).rig.cameras[0].model_dump()
    assert {name: camera[name] for name in new} == new
    assert set(new) == FIELDS_OF_VERSION_2


def test_version_2_says_how_well_the_antenna_is_known(example: dict[str, Any]) -> None:
    example["gnss"]["sigma_antenna_m"] = 0.2
    with pytest.raises(DocumentError, match=r"gnss.sigma_antenna_m is of version 2 of the contract: set version to 2"):
        parse_new_manifest(encoded(example))
    example["version"] = 2
    gnss = parse_new_manifest(encoded(example)).gnss
    assert gnss is not None
    assert gnss.sigma_antenna_m == 0.2
    example["gnss"]["sigma_antenna_m"] = 0.0
    with pytest.raises(DocumentError, match=r"^gnss.sigma_antenna_m: "):
        parse_new_manifest(encoded(example))


@pytest.mark.parametrize("vehicle", ["n015", "M-AB:1234", "7", "a" * 64])
def test_version_2_names_the_vehicle(example: dict[str, Any], vehicle: str) -> None:
    assert parse_new_manifest(encoded(example)).vehicle is None
    example["vehicle"] = vehicle
    with pytest.raises(DocumentError, match="vehicle is of version 2 of the contract: set version to 2"):
        parse_new_manifest(encoded(example))
    example["version"] = 2
    assert parse_new_manifest(encoded(example)).vehicle == vehicle


@pytest.mark.parametrize("vehicle", ["", "a" * 65, "a b", "-a", "a\n", "ä", "a/b", 7, True])
def test_vehicles_in_another_form_are_refused(example: dict[str, Any], vehicle: object) -> None:
    example |= {"version": 2, "vehicle": vehicle}
    with pytest.raises(DocumentError, match=r"^vehicle: ") as refused:
        parse_new_manifest(encoded(example))
    assert [problem.path for problem in refused.value.problems] == ["vehicle"]


def test_a_version_may_be_left_out(example: dict[str, Any]) -> None:
    del example["version"]
    assert parse_new_manifest(encoded(example)).version == 1


@pytest.mark.parametrize("key", ["00", " 0", "0 ", "+0", "-0", "0.0", "1_0"])
def test_ids_in_another_form(example: dict[str, Any], key: str) -> None:
    example["label_map"]["ids"] = {key: "road"}
    with pytest.raises(DocumentError, match=r"label_map\.ids: '.*' must be an integer without"):
        parse_new_manifest(encoded(example))
    assert parse_manifest(encoded(example)).label_map is not None


def test_all_defects_of_a_new_manifest_are_told_at_once(example: dict[str, Any]) -> None:
    example["version"], example["name"] = True, ""
    with pytest.raises(DocumentError) as refused:
        parse_new_manifest(encoded(example))
    assert [problem.path for problem in refused.value.problems] == ["version", "name"]


def is_refused(raw: bytes) -> bool:
    try:
        parse_new_manifest(raw)
    except DocumentError:
        return True
    return False


def leaves(document: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    inner = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in inner:
        if isinstance(value, dict | list):
            yield from leaves(value, (*path, key))
        else:
            yield (*path, key), value


def test_no_field_takes_a_value_of_another_type(example: dict[str, Any]) -> None:
    example["rig"]["cameras"][0] |= {"sigma_focal_px": 2.0, "readout_us": 1}
    for path, value in leaves(example):
        others: list[Any] = [True, str(value)] if not isinstance(value, str) else [True, 1]
        if isinstance(value, int) and path[-1] not in (0, 1, 2, 3):  # in a list of floats JSON may leave the point out
            others.append(float(value))
        for other in others:
            changed = copy.deepcopy(example)
            inner: Any = changed
            for key in path[:-1]:
                inner = inner[key]
            inner[path[-1]] = other
            assert is_refused(encoded(changed)), f"{path} takes {other!r}"


COMPOSED, DECOMPOSED = unicodedata.normalize("NFC", "stra\u00dfe/\u00fc.png"), "stra\u00dfe/u\u0308.png"


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ("images/A.png", "images/a.png", "one file with 'images/A.png'"),
        ("Images/a.png", "images/a.png", "one file with 'Images/a.png'"),
        (COMPOSED, DECOMPOSED, "one file with"),
        ("STRASSE/a.png", "stra\u00dfe/a.png", "one file with"),
        ("front", "FRONT/a.png", "a folder that has the name of the file 'front'"),
        ("Drive.JSON", "b.png", "the manifest's own name"),
        ("drive.json/a.png", "b.png", "a folder that has the name of the file 'drive.json'"),
    ],
)
@pytest.mark.parametrize("field", ["file", "mask"])
def test_files_that_are_one_on_many_systems(
    example: dict[str, Any], first: str, second: str, words: str, field: str
) -> None:
    images = example["frames"][0]["images"]
    images["front"]["file"], images["left"][field] = first, second
    with pytest.raises(DocumentError, match=re.escape(words)) as refused:
        parse_new_manifest(encoded(example))
    assert {problem.path for problem in refused.value.problems} <= {first, second}
    assert parse_manifest(encoded(example)).frames[0].images["front"].file == first


def test_how_names_of_one_look_differ_is_shown(example: dict[str, Any]) -> None:
    images = example["frames"][0]["images"]
    images["front"]["file"], images["left"]["file"] = DECOMPOSED, COMPOSED
    with pytest.raises(DocumentError) as refused:
        parse_new_manifest(encoded(example))
    assert ascii(DECOMPOSED) in str(refused.value)


def test_one_mask_may_serve_several_images(example: dict[str, Any]) -> None:
    for image in example["frames"][0]["images"].values():
        image["mask"] = "masks/Same.png"
    assert parse_new_manifest(encoded(example))


def test_deep_folders_take_no_more_memory_than_their_paths() -> None:
    """All folders of a path of a kilobyte are a hundred times its length."""
    paths = [f"{number:05d}/" + "a/" * 480 + "b.png" for number in range(500)]
    tracemalloc.start()
    try:
        assert list(name_problems(paths)) == []
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 5 * sum(map(len, paths))


@pytest.mark.parametrize("depth", [1, 2, 40])
def test_a_file_is_no_folder_of_another(depth: int) -> None:
    folder = "/".join(["a"] * depth)
    assert [path for path, _ in name_problems([folder.upper(), f"{folder}/b/c.png"])] == [f"{folder}/b/c.png"]
    assert [path for path, _ in name_problems([f"drive.json/{folder}/c.png"])] == [f"drive.json/{folder}/c.png"]


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("null", "(is null)"),
        ("true", "(is true)"),
        ("1.5", "(is 1.5)"),
        ('"1"', "(is '1')"),
        ("1e400", "(is a number beyond 1.8e308)"),
        ("1" * 5001, "holds an integer of over 4300 digits"),
    ],
)
def test_values_are_shown_as_json_has_them(example: dict[str, Any], value: str, words: str) -> None:
    example["rig"]["cameras"][0]["width"] = "HERE"
    with pytest.raises(DocumentError) as caught:
        parse_manifest(encoded(example).replace(b'"HERE"', value.encode()))
    assert words in str(caught.value)
    assert "sys." not in str(caught.value)
