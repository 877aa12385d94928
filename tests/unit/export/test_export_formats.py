"""The registry of export formats and the run of an export: what is written, read back, withheld and refused."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrasfm_engine.errors import CancelledError, InputError, MrasfmError, StorageError
from mrasfm_engine.export import copc as exports_of_points
from mrasfm_engine.export import run_export as exports
from mrasfm_engine.export.check import Check
from mrasfm_engine.export.comparisons import nothing
from mrasfm_engine.export.contract import ExportOptions, ExportWork, Written
from mrasfm_engine.export.formats import WRITERS
from mrasfm_engine.export.geojson import _cut
from mrasfm_engine.export.publishing import publishing
from mrasfm_engine.export.run_export import ExportRequest, run_export
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.export.stored_scene import read_source
from mrasfm_engine.io.stage_store import fingerprints_of_images, sha256_of_files
from mrasfm_engine.preflight.drive_reader import write_manifest
from schemas.exports import EXPORT_FORMATS
from tests.helpers.export_example import MISSING_UNIT, UNITS, make_scene
from tests.helpers.export_images import USUAL, written

SMALL = ("kitti", "geojson")


def _nothing(*_: object) -> None:
    return None


def _never() -> bool:
    return False


@pytest.fixture
def scene_folder(tmp_path: Path) -> Path:
    write_scene(make_scene(moving=True), tmp_path / "scene", {})
    return tmp_path / "scene"


def _exported(folder: Path, *formats: str, **options: object) -> dict[str, Any]:
    request = ExportRequest(
        folder=folder, out=folder.parent / "out", formats=formats, options=ExportOptions(**options), drives={}
    )
    return run_export(request, progress=_nothing, cancel=_never)


def test_every_format_that_users_can_name_has_a_writer() -> None:
    assert WRITERS.keys() == EXPORT_FORMATS.keys()
    assert all(name == known.name for name, known in EXPORT_FORMATS.items())


def test_a_written_scene_reads_back_as_it_was(scene_folder: Path) -> None:
    given, found = make_scene(moving=True), read_source(scene_folder).scene
    for name in ("unit_registered", "image_registered", "observation_point", "observation_image"):
        assert np.array_equal(getattr(found, name), getattr(given, name)), name
    assert np.array_equal(found.observation_keypoint, given.observation_keypoint)
    registered = given.image_registered
    assert np.allclose(found.world_from_cam[registered], given.world_from_cam[registered], atol=1e-9)
    assert np.allclose(found.points_m, given.points_m, atol=0)
    for one, other in zip(found.calibration, given.calibration, strict=True):
        assert np.allclose(one.rig_from_cam, other.rig_from_cam, atol=1e-12)
        assert np.array_equal(one.params, other.params)


@pytest.mark.parametrize("file", ["model/images.bin", "model/points3D.bin", "points.ply"])
@pytest.mark.parametrize("content", [None, b"", b"\x09"])
def test_a_damaged_file_of_a_scene_is_named(scene_folder: Path, file: str, content: bytes | None) -> None:
    (scene_folder / file).unlink()
    if content is not None:
        (scene_folder / file).write_bytes(content)
    with pytest.raises(InputError, match=rf"^{scene_folder}/{file} is damaged: "):
        read_source(scene_folder)


def test_kitti_poses_are_those_of_the_first_camera_from_its_first_one(scene_folder: Path) -> None:
    report = _exported(scene_folder, "kitti")
    scene, folder = make_scene(moving=True), scene_folder.parent / "out" / "kitti" / "00"
    rows = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    units = [u for u in range(UNITS) if u != MISSING_UNIT]
    world_from_cam = scene.world_from_rig[units] @ scene.calibration[0].rig_from_cam
    assert np.allclose(rows, (np.linalg.inv(world_from_cam[0]) @ world_from_cam)[:, :3], atol=1e-9)
    assert (folder / "times.txt").read_text().split() == ["0.000000", "1.000000", "1.500000", "2.000000"]
    assert (folder / "frames.txt").read_text().split() == ["0", "20", "30", "40"]
    right = (folder / "calib.txt").read_text().splitlines()[1]
    expected = np.linalg.inv(scene.calibration[1].rig_from_cam) @ scene.calibration[0].rig_from_cam
    assert right.startswith("Tr_right: ")
    assert np.allclose(np.array(right.split()[1:], dtype=float).reshape(3, 4), expected[:3], atol=1e-12)
    listed = {file["path"]: file["bytes"] for file in report["formats"]["kitti"]["files"]}
    assert listed["kitti/00/poses.txt"] == (folder / "poses.txt").stat().st_size
    assert json.loads((folder.parents[1] / "report.json").read_text()) == report


def test_geojson_has_the_positions_of_poses_json(scene_folder: Path) -> None:
    _exported(scene_folder, "geojson")
    images = [i for i in json.loads((scene_folder / "poses.json").read_text())["images"] if i["registered"]]
    document = json.loads((scene_folder.parent / "out" / "geojson" / "camera_positions.geojson").read_text())
    assert [f["properties"]["image"] for f in document["features"]] == [i["file"] for i in images]
    for feature, image in zip(document["features"], images, strict=True):
        place = image["geodetic"]
        longitude, latitude, height = feature["geometry"]["coordinates"]
        assert abs(longitude - place["longitude_deg"]) < 1e-9
        assert abs(latitude - place["latitude_deg"]) < 1e-9
        assert abs(height - place["ellipsoidal_height_m"]) < 1e-3


def test_a_line_is_cut_where_it_crosses_the_antimeridian() -> None:
    parts = _cut(np.array([[179.0, 10.0, 5.0], [-179.0, 12.0, 7.0], [-178.0, 12.0, 7.0]]))
    assert parts == [
        [[179.0, 10.0, 5.0], [180.0, 11.0, 6.0]],
        [[-180.0, 11.0, 6.0], [-179.0, 12.0, 7.0], [-178.0, 12.0, 7.0]],
    ]


def _changed(path: Path) -> Iterator[bytes]:
    """Its content with one digit changed, for digits all over the file."""
    content = path.read_bytes()
    digits = [at for at, byte in enumerate(content) if byte in b"123456789"]
    for at in digits[:: max(1, len(digits) // 25)]:
        yield content[:at] + (b"8" if content[at : at + 1] != b"8" else b"3") + content[at + 1 :]


@pytest.mark.parametrize("name", SMALL)
def test_a_changed_digit_withholds_the_format_and_names_the_file(name: str, scene_folder: Path) -> None:
    """By what the file says: digests, which would find it first, are left out."""
    source = read_source(scene_folder)
    work = ExportWork(source=source, options=ExportOptions(), folder=scene_folder.parent / "one", step=_nothing)
    work.folder.mkdir()
    written = replace(WRITERS[name](work), digests={})
    for path in [path for path in work.folder.rglob("*") if path.is_file()]:
        content = path.read_bytes()
        refused = total = 0
        for changed in _changed(path):
            path.write_bytes(changed)
            fault = exports._fault(written, work.folder)
            refused += fault is not None and path.name in fault
            total += 1
        path.write_bytes(content)
        assert exports._fault(written, work.folder) is None
        assert refused == total > 2, path.name
    path.write_bytes(content[:-5])
    assert path.name in str(exports._fault(written, work.folder))
    path.unlink()
    assert "it is missing" in str(exports._fault(written, work.folder))


def test_a_defect_withholds_one_format_and_leaves_the_others(
    scene_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(work: ExportWork) -> Written:
        written = WRITERS_BEFORE["kitti"](work)
        path = work.folder / "00" / "times.txt"
        path.write_text(path.read_text().replace("1.500000", "1.500001"))
        return written

    def unread(work: ExportWork) -> Written:
        (work.folder / "surplus").write_text("x")
        return Written(checks=[])

    def broken(work: ExportWork) -> Written:
        raise ZeroDivisionError("of nothing")

    for writer, said in (
        (damaged, "kitti is withheld: 00/times.txt was written but does not read back: it is not what was written"),
        (unread, "kitti is withheld: surplus was written but does not read back: no check covers it"),
        (broken, "kitti is withheld: it cannot be written: ZeroDivisionError: of nothing"),
    ):
        monkeypatch.setitem(WRITERS, "kitti", writer)
        report = _exported(scene_folder, *SMALL)
        assert report["formats"]["kitti"]["withheld"].startswith(said)
        assert not (scene_folder.parent / "out" / "kitti").exists()
        assert len(report["formats"]["geojson"]["files"]) == 3
        with pytest.raises(MrasfmError, match="nothing was exported") as found:
            _exported(scene_folder, "kitti")
        assert found.value.code == "export-check-failed"


WRITERS_BEFORE = dict(WRITERS)


def test_a_later_export_replaces_what_it_does_not_have(scene_folder: Path) -> None:
    _exported(scene_folder, *SMALL)
    _exported(scene_folder, "geojson")
    assert sorted(path.name for path in (scene_folder.parent / "out").iterdir()) == ["geojson", "report.json"]


def test_cancelling_publishes_nothing(scene_folder: Path) -> None:
    request = ExportRequest(folder=scene_folder, out=scene_folder.parent / "out", formats=SMALL, drives={})
    with pytest.raises(CancelledError):
        run_export(request, progress=_nothing, cancel=lambda: True)
    assert sorted(path.name for path in scene_folder.parent.iterdir()) == ["scene"]


def test_what_a_scene_does_not_have_is_refused_by_name(scene_folder: Path, tmp_path: Path) -> None:
    def refused(**changes: object) -> InputError:
        request = ExportRequest(folder=scene_folder, out=tmp_path / "out", formats=["kitti"], drives={})
        with pytest.raises(InputError) as found:
            run_export(replace(request, **changes), progress=_nothing, cancel=_never)
        return found.value

    write_scene(make_scene(georeferenced=False), tmp_path / "nowhere", {})
    assert "geojson needs" in refused(folder=tmp_path / "nowhere", formats=["geojson"]).what
    assert refused(formats=["dxf"]).code == "unknown-format"
    assert refused(formats=[]).code == "unknown-format"
    assert refused(options=ExportOptions(image_size_px=5)).code == "bad-image-size"
    elsewhere = tmp_path / "none"
    for formats in (["kitti"], ["mcap", "nuscenes"]):
        options = ExportOptions(crs="EPSG:25832")
        assert refused(folder=elsewhere, formats=formats, options=options).code == "crs-not-taken"
    for crs in ("EPSG:x", "EPSG:1", "EPSG:4326"):  # before the scene is read, which may be large
        assert refused(folder=elsewhere, formats=["mcap", "copc"], options=ExportOptions(crs=crs)).code == "bad-crs"
    assert refused(out=scene_folder).code == "bad-out-folder"
    (tmp_path / "mine" / "kitti").mkdir(parents=True)
    assert refused(out=tmp_path / "mine").code == "bad-out-folder"
    (tmp_path / "mine" / "report.json").write_text('{"version": 1, "formats": {}}')
    assert refused(out=tmp_path / "mine").code == "bad-out-folder", "another program's report"
    assert (tmp_path / "mine" / "kitti").is_dir()
    assert refused(folder=tmp_path / "none").code == "not-a-scene"
    (scene_folder / "poses.json").write_text("{}")
    assert "poses.json" in refused().what
    points = scene_folder / "model" / "points3D.bin"
    points.write_bytes(points.read_bytes()[:-9])
    assert not (tmp_path / "out").exists()


def test_what_a_scene_does_not_have_is_refused_before_anything_is_written(
    scene_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[str] = []

    def writer(work: ExportWork) -> Written:
        begun.append(work.folder.name)
        (work.folder / "poses.txt").touch()
        return Written(checks=[Check("poses.txt", Path.read_bytes, nothing)])

    monkeypatch.setitem(WRITERS, "kitti", writer)
    with pytest.raises(InputError, match=r"has no pictures/road.tif") as found:
        _exported(scene_folder, "kitti", "geotiff")
    assert found.value.code == "no-picture"
    report = json.loads((scene_folder / "report.json").read_text())
    stage = {"stage": "pictures", "birds_eye": {"not_drawn": "no image shows ground"}}
    (scene_folder / "report.json").write_text(json.dumps(report | {"stages": [stage]}))
    with pytest.raises(InputError, match=r"has no pictures/road.tif: no image shows ground") as found:
        _exported(scene_folder, "geotiff")
    for crs in ("EPSG:1", "EPSG:4326", "EPSG:2263"):  # unknown, in degrees, of another continent
        with pytest.raises(InputError, match="EPSG:") as found:
            _exported(scene_folder, "kitti", "geopackage", crs=crs)
        assert found.value.code in ("bad-crs", "outside-crs")
    monkeypatch.setattr(exports_of_points, "fits", lambda scene: False)
    with pytest.raises(InputError, match="do not fit into a COPC"):
        _exported(scene_folder, "kitti", "copc")
    assert not begun
    assert not (scene_folder.parent / "out").exists()


def test_an_export_removes_nothing_that_no_export_has_made(scene_folder: Path, tmp_path: Path) -> None:
    """Files that somebody put into its folders, changed there, or keeps beside them under a format's name."""
    out = tmp_path / "out"
    _exported(scene_folder, "kitti", "geojson")
    _exported(scene_folder, "kitti")
    assert not (out / "geojson").exists(), "the earlier export's own"
    kept = {
        "kitti/00/evaluation.txt": "in its folder",
        "kitti/00/times.txt": "changed",
        "geojson/map.geojson": "of a format that is asked for",
    }
    for name, text in kept.items():
        before = (out / name).read_bytes() if (out / name).exists() else None
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text(text)
        with pytest.raises(InputError, match=r"is no file of the export in .* would be removed") as found:
            _exported(scene_folder, "kitti", "geojson")
        assert found.value.code == "bad-out-folder"
        assert (out / name).read_text() == text
        if before is None:
            (out / name).unlink()
        else:
            (out / name).write_bytes(before)
    elsewhere = tmp_path / "elsewhere"
    (out / "kitti").rename(elsewhere)
    (out / "kitti").symlink_to(elsewhere)
    with pytest.raises(InputError, match="would be removed"):
        _exported(scene_folder, "kitti")
    (out / "kitti").unlink()
    # Of a format that neither export has: it stays.
    (out / "nuscenes").mkdir()
    (out / "nuscenes" / "mine").touch()
    _exported(scene_folder, "kitti")
    assert (out / "nuscenes" / "mine").is_file()
    assert (elsewhere / "00" / "poses.txt").is_file()


def test_what_comes_while_an_export_is_made_stays(scene_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = scene_folder.parent / "out"

    def slow(work: ExportWork) -> Written:
        (out / "kitti").mkdir(parents=True)
        (out / "kitti" / "notes.txt").write_text("mine")
        return write(work)

    write = WRITERS["kitti"]
    monkeypatch.setitem(WRITERS, "kitti", slow)
    with pytest.raises(InputError, match="holds no earlier export"):
        _exported(scene_folder, "kitti")
    assert (out / "kitti" / "notes.txt").read_text() == "mine"
    assert [path.name for path in scene_folder.parent.iterdir() if "partial" in path.name] == []


def test_two_exports_at_once_leave_one_of_them_whole(scene_folder: Path) -> None:
    out = scene_folder.parent / "out"
    _exported(scene_folder, "geojson")
    with ThreadPoolExecutor(4) as pool:
        names = [("kitti", "geojson"), ("kitti",), ("geojson",), ("kitti", "geojson")]
        reports = list(pool.map(lambda formats: _exported(scene_folder, *formats), names))
    report = json.loads((out / "report.json").read_text())
    assert report in reports
    assert {path.name for path in out.iterdir()} == {*report["formats"], "report.json"}
    listed = [file["path"] for result in report["formats"].values() for file in result["files"]]
    assert sorted(listed) == sorted(p.relative_to(out).as_posix() for p in out.glob("*/**/*") if p.is_file())


def _publish(out: Path, *names: str) -> None:
    with publishing(out, 0, replaced=names) as work:
        for name in names:
            (work / name).mkdir()
            (work / name / "new").touch()
        (work / "report.json").write_text("new")


def test_whoever_runs_it_may_hold_the_folder_around_it(tmp_path: Path) -> None:
    """As the service's workers do: their lock tells others that a job's folder is in use."""
    with ThreadPoolExecutor(1) as pool:
        descriptor = os.open(tmp_path, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            for _ in range(2):  # into a new folder, and into one that is there
                pool.submit(_publish, tmp_path / "out", "a").result(timeout=20)
        finally:
            os.close(descriptor)  # also lets a thread go on that waits for it
    assert (tmp_path / "out" / "report.json").read_text() == "new"


def test_a_folder_that_appears_at_the_last_moment_is_replaced_as_any_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, exists = tmp_path / "out", Path.exists

    def appearing(path: Path) -> bool:
        before = exists(path)
        if path == out and not before and [*tmp_path.glob(".out.partial*/report.json")]:
            out.mkdir()
            (out / "report.json").write_text("of a faster run")
        return before

    monkeypatch.setattr(Path, "exists", appearing)
    _publish(out, "a")
    assert (out / "report.json").read_text() == "new"
    assert {path.name for path in out.iterdir()} == {"a", "report.json"}


def test_what_was_there_is_there_again_where_moving_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    for name in ("a", "b"):
        (out / name).mkdir(parents=True)
        (out / name / "old").touch()
    (out / "report.json").write_text("old")
    rename = Path.rename

    def failing(path: Path, target: Path) -> Path:
        if path.name == "b" and target.parent == out and path.parent.name.startswith(".out.partial"):
            raise OSError(28, "No space left on device")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(StorageError, match="No space left"):
        _publish(out, "a", "b")
    assert (out / "report.json").read_text() == "old"
    found = sorted(path.relative_to(out).as_posix() for path in out.rglob("*"))
    assert found == ["a", "a/old", "b", "b/old", "report.json"]


def test_a_run_that_lives_keeps_its_folder_however_long_it_takes(tmp_path: Path) -> None:
    with publishing(tmp_path / "out", 0) as work:
        os.utime(work, (0.0, 0.0))
        with publishing(tmp_path / "out", 0) as other:
            (other / "report.json").touch()
        assert work.is_dir()
    killed = tmp_path / ".a[1].partial-1"
    killed.mkdir()
    os.utime(killed, (0.0, 0.0))
    with publishing(tmp_path / "a[1]", 0):
        assert not killed.exists()


def test_another_drive_with_the_same_names_is_refused(tmp_path: Path) -> None:
    """All imported drives of a vehicle have files of the same names: only their times tell them apart."""
    scene = written(tmp_path, USUAL)
    frames = [
        frame.model_copy(update={"timestamp_us": frame.timestamp_us + 60_000_000})
        for frame in scene.drive.manifest.frames
    ]
    write_manifest(scene.drive.manifest.model_copy(update={"frames": frames}), tmp_path / "drive")
    drives = {"": tmp_path / "drive"}
    request = ExportRequest(folder=tmp_path / "scene", out=tmp_path / "out", formats=["mcap"], drives=drives)
    with pytest.raises(
        InputError, match=r"drive .*/drive has image left/0.png at \d+ us, the scene at \d+ us"
    ) as found:
        run_export(request, progress=_nothing, cancel=_never)
    assert found.value.code == "other-drive"


def test_a_drive_with_the_same_names_and_times_is_refused_by_its_images(tmp_path: Path) -> None:
    """Of drives whose clocks begin at 0, as KITTI's do, only the images differ."""
    scene = written(tmp_path, USUAL)
    drive = tmp_path / "drive"
    files = [scene.drive.images[i].file for i in np.flatnonzero(scene.image_registered)]
    fingerprints = fingerprints_of_images(scene, sha256_of_files(drive, files, threads=1))
    write_scene(scene, tmp_path / "scene", {"images_sha256": fingerprints})
    request = ExportRequest(folder=tmp_path / "scene", out=tmp_path / "out", formats=["mcap"], drives={"": drive})
    run_export(request, progress=_nothing, cancel=_never)
    assert cv2.imwrite(str(drive / files[-1]), np.zeros((600, 960, 3), np.uint8))
    camera = scene.drive.cameras[scene.drive.images[np.flatnonzero(scene.image_registered)[-1]].camera].name
    with pytest.raises(InputError, match=rf"has other images of camera {camera} than") as found:
        run_export(request, progress=_nothing, cancel=_never)
    assert found.value.code == "other-drive"
    (drive / files[-1]).unlink()
    with pytest.raises(InputError, match=r"cannot be read: No such file"):
        run_export(request, progress=_nothing, cancel=_never)


def test_a_drive_that_no_format_needs_is_looked_for(tmp_path: Path) -> None:
    write_scene(make_scene(), tmp_path / "scene", {})
    drives = {"": tmp_path / "nowhere"}
    request = ExportRequest(folder=tmp_path / "scene", out=tmp_path / "out", formats=["kitti"], drives=drives)
    with pytest.raises(InputError, match="nowhere does not exist"):
        run_export(request, progress=_nothing, cancel=_never)
    assert not (tmp_path / "out").exists()


def test_components_that_are_scenes_of_their_own_are_said(tmp_path: Path) -> None:
    scene = make_scene()
    write_scene(scene, tmp_path / "scene", {}, components=[(make_scene(georeferenced=False), {"component": 1})])
    notes = _exported(tmp_path / "scene", "kitti")["formats"]["kitti"]["notes"]
    assert notes == ["components/1 is a scene of its own, and not in it"]
    assert _exported(tmp_path / "scene" / "components" / "1", "kitti")["formats"]["kitti"]["notes"] == []


def test_checks_can_be_given_for_folders(tmp_path: Path) -> None:
    """As formats with many images do it: one check reads all files of a folder."""
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a").write_text("a")
    assert exports._fault(Written(checks=[Check("images", sorted, nothing)]), tmp_path) is not None
    assert exports._fault(Written(checks=[Check("images", lambda p: None, nothing)]), tmp_path) is None
