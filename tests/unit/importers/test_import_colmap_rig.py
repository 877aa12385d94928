from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from PIL import Image

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.geotags import read_exif, read_geo_txt
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.preflight.drive_reader import check_drive, read_drive
from tests.helpers.exif import exif_of

FRAMES = 11
SIZE = (48, 32)
PARAMS = [40.0, 24.0, 16.0, 0.01]
LEFT_FROM_FRONT = se3.transform(se3.exp_so3([0.0, np.pi / 2, 0.0]), [0.3, 0.1, -0.2])  # looks to the left
PLACE = (-33.9, 18.4, 42.5)


def place(frame: int) -> tuple[float, float, float]:
    return PLACE[0] + 1e-5 * frame, PLACE[1] - 2e-5 * frame, PLACE[2] + 0.5 * frame


def config() -> list[dict[str, Any]]:
    w_first = np.roll(se3.quaternion_from_rotation(LEFT_FROM_FRONT[:3, :3]), 1).tolist()
    lens = {"camera_model_name": "SIMPLE_RADIAL", "camera_params": PARAMS}
    left = {"cam_from_rig_rotation": w_first, "cam_from_rig_translation": LEFT_FROM_FRONT[:3, 3].tolist()}
    cameras = [{"image_prefix": "rig1/front/", "ref_sensor": True}, {"image_prefix": "rig1/left/", **left}]
    return [{"cameras": [camera | lens for camera in cameras]}]


def write_images(folder: Path, exif: Callable[[int], Image.Exif] | None = None) -> None:
    rng = np.random.default_rng(2)
    for camera in ("front", "left"):
        (folder / "images" / "rig1" / camera).mkdir(parents=True, exist_ok=True)
        for f in range(FRAMES):
            pixels = Image.fromarray(rng.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8))
            # Without zeros before: the tenth comes after the second.
            path = folder / "images" / "rig1" / camera / f"image{f}.jpg"
            pixels.save(path, **({} if exif is None else {"exif": exif(f)}))


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    folder = tmp_path / "street"
    folder.mkdir()
    (folder / "rig_config.json").write_text(json.dumps(config()))
    return folder


def geotagged(f: int) -> Image.Exif:
    return exif_of(time=f"2026:03:04 10:11:{12 + f // 10:02d}", subsecond=f"{f % 10}", place=place(f), error_m=1.5)


def geo_txt(system: str, rows: list[tuple[str, float, float, str]]) -> str:
    return "\n".join([system, *(f"{name} {x!r} {y!r} {rest}" for name, x, y, rest in rows)]) + "\n"


def test_images_with_exif(rig: Path, tmp_path: Path) -> None:
    write_images(rig, geotagged)
    summary = import_recording(rig, tmp_path / "drive")
    assert (summary.layout, summary.cameras, summary.units, summary.images) == ("COLMAP rig", 2, FRAMES, 2 * FRAMES)
    drive = read_drive(tmp_path / "drive")
    assert {f.code for f in check_drive(drive)} == set()
    front, left = drive.cameras
    # COLMAP's parameters are the manifest's.
    assert (front.name, front.model, front.width, front.params) == ("front", "SIMPLE_RADIAL", SIZE[0], PARAMS)
    assert left.params == PARAMS
    np.testing.assert_allclose(drive.rig_from_cam[0][:3, 2], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(drive.rig_from_cam[0][:3, 3], 0, atol=1e-12)
    np.testing.assert_allclose(drive.rig_from_cam[1][:3, 2], [0, 1, 0], atol=1e-12)
    between = se3.inverse(drive.rig_from_cam[1]) @ drive.rig_from_cam[0]
    np.testing.assert_allclose(between, LEFT_FROM_FRONT, atol=1e-12)
    assert np.diff(drive.timestamps_us).tolist() == [100_000] * (FRAMES - 1)
    assert drive.timestamps_us[0] == 1_772_619_072_000_000  # 2026-03-04 10:11:12 UTC
    gnss = drive.manifest.gnss
    assert gnss is not None
    found = [(s.latitude_deg, s.longitude_deg, s.height_m) for s in gnss.samples]
    np.testing.assert_allclose(found, [place(f) for f in range(FRAMES)], atol=1e-6)
    assert (gnss.samples[3].sigma_horizontal_m, gnss.samples[3].sigma_vertical_m) == (1.5, 3.0)
    source = rig / "images" / "rig1" / "left" / "image10.jpg"
    assert (drive.root / "images" / "left" / "000010.jpg").read_bytes() == source.read_bytes()
    assert sum("antenna" in note for note in summary.notes) == 1


def test_another_camera_looks_ahead(rig: Path, tmp_path: Path) -> None:
    write_images(rig, geotagged)
    options = {"forward_camera": "left", "antenna_m": [0.5, 0.0, 1.0]}
    summary = import_recording(rig, tmp_path / "drive", options=options)
    drive = read_drive(tmp_path / "drive")
    np.testing.assert_allclose(drive.rig_from_cam[1][:3, 2], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(drive.rig_from_cam[0][:3, 2], [0, -1, 0], atol=1e-12)
    assert drive.manifest.gnss is not None
    assert drive.manifest.gnss.antenna_in_rig_m == [0.5, 0.0, 1.0]
    assert "left is taken to look level" in summary.notes[0]
    with pytest.raises(InputError, match=r"no camera 'back'\n.*front, left"):
        import_recording(rig, tmp_path / "other", options={"forward_camera": "back"})


@pytest.mark.parametrize("system", ["EPSG:4326", "WGS84 UTM 34S", "+proj=utm +zone=34 +south +datum=WGS84 +units=m"])
@pytest.mark.parametrize("named", ["image{}.jpg", "rig1/front/image{}.jpg", "images/rig1/left/image{}.jpg"])
def test_geo_txt(rig: Path, tmp_path: Path, system: str, named: str) -> None:
    """Positions in any system, by names of images or by their paths; they come before those of EXIF."""
    write_images(rig, lambda f: exif_of(time=None, subsecond=None, place=(1.0, 2.0, 3.0), error_m=9.0))
    to_system = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32734", always_xy=True)
    rows = []
    for f in range(FRAMES):
        latitude, longitude, height = place(f)
        x, y = (longitude, latitude) if system == "EPSG:4326" else to_system.transform(longitude, latitude)
        rows.append((named.format(f), x, y, f"{height} 0 0 0 0.02 0.05 label {f}"))
    (rig / "geo.txt").write_text(geo_txt(system, rows))
    import_recording(rig, tmp_path / "drive", options={"rate_hz": 4.0})
    drive = read_drive(tmp_path / "drive")
    gnss = drive.manifest.gnss
    assert gnss is not None
    found = [(s.latitude_deg, s.longitude_deg, s.height_m) for s in gnss.samples]
    np.testing.assert_allclose(found, [place(f) for f in range(FRAMES)], atol=1e-9)
    assert (gnss.samples[0].sigma_horizontal_m, gnss.samples[0].sigma_vertical_m) == (0.02, 0.05)
    assert drive.timestamps_us.tolist() == [250_000 * f for f in range(FRAMES)]


@pytest.mark.parametrize(
    ("exif", "options", "message", "remedy"),
    [
        (None, {}, "do not make frames: 11 frames have none", "--rate-hz"),
        (lambda f: exif_of(time="2026:03:04 10:11:12", subsecond=None), {}, "do not increase", "--rate-hz"),
        (lambda f: exif_of(place=place(f)), {"rate_hz": 5.0}, "11 of 11 positions state no accuracy", "--gnss-sigma"),
        (
            lambda f: exif_of(place=(*PLACE[:2], None), error_m=1.0),
            {"rate_hz": 5.0},
            "11 of 11 positions have no height",
            "geo.txt",
        ),
    ],
)
def test_what_images_do_not_say_is_asked_for(
    rig: Path, tmp_path: Path, exif: Any, options: dict[str, float], message: str, remedy: str
) -> None:
    write_images(rig, exif)
    with pytest.raises(InputError) as caught:
        import_recording(rig, tmp_path / "drive", options=options)
    assert message in caught.value.what
    assert remedy in caught.value.remedy
    assert not (tmp_path / "drive").exists()


def test_images_without_positions(rig: Path, tmp_path: Path) -> None:
    write_images(rig)
    summary = import_recording(rig, tmp_path / "drive", options={"rate_hz": 10.0})
    assert summary.gnss_samples == 0
    assert [f.code for f in check_drive(read_drive(tmp_path / "drive"))] == []
    (rig / "images" / "rig1" / "left" / "image3.jpg").unlink()  # a frame of one camera
    assert import_recording(rig, tmp_path / "drive", options={"rate_hz": 10.0}, force=True).images == 2 * FRAMES - 1


def test_images_under_no_prefix_are_counted_and_named(rig: Path, tmp_path: Path) -> None:
    """Those of another rig in the same file are not among them."""
    write_images(rig)
    other = config()[0]
    for camera in other["cameras"]:
        camera["image_prefix"] = camera["image_prefix"].replace("rig1", "rig2")
    (rig / "rig_config.json").write_text(json.dumps([*config(), other]))
    options = {"rate_hz": 10.0}
    source = rig / "images" / "rig1" / "front" / "image0.jpg"
    for name in ("rig2/front/image0.jpg", *(f"rig1/rear/image{f}.jpg" for f in range(5))):
        (rig / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (rig / "images" / name).write_bytes(source.read_bytes())
    summary = import_recording(rig, tmp_path / "drive", scene="rig1", options=options)
    assert summary.images == 2 * FRAMES
    note = next(note for note in summary.notes if "image_prefix" in note)
    named = "rig1/rear/image0.jpg, rig1/rear/image1.jpg, rig1/rear/image2.jpg and 2 more"
    assert note == f"Images that begin with no camera's image_prefix, left out: 5 ({named})."
    shutil.rmtree(rig / "images" / "rig1" / "rear")
    summary = import_recording(rig, tmp_path / "drive", scene="rig1", options=options, force=True)
    assert not any("image_prefix" in note for note in summary.notes)


def test_what_macos_leaves_beside_images_is_none(rig: Path, tmp_path: Path) -> None:
    """Unpacked elsewhere, its archives have a second file for every image, of the same suffix."""
    write_images(rig)
    for name in ("rig1/front/._image0.jpg", "__MACOSX/rig1/front/image0.jpg", "__MACOSX/rig1/front/._image0.jpg"):
        (rig / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (rig / "images" / name).write_bytes(b"\x00\x05\x16\x07")
    summary = import_recording(rig, tmp_path / "drive", options={"rate_hz": 10.0})
    assert (summary.units, summary.images) == (FRAMES, 2 * FRAMES)
    assert not any("image_prefix" in note for note in summary.notes)


def edited(edit: Callable[[list[dict[str, Any]]], Any]) -> str:
    rigs = config()
    edit(rigs)
    return json.dumps(rigs)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "holds no scenes"),
        ("{}", r"rig_config\.json: "),
        (edited(lambda r: r[0]["cameras"][0].pop("ref_sensor")), "0 cameras are ref_sensor"),
        (edited(lambda r: r[0]["cameras"][1].pop("cam_from_rig_rotation")), "left has no cam_from_rig_rotation"),
        (edited(lambda r: r[0]["cameras"][1].update(cam_from_rig_rotation=[1, 1, 0, 0])), "is no unit quaternion"),
        (edited(lambda r: r[0]["cameras"][0].pop("camera_params")), "front has no camera_model_name and camera_params"),
        (edited(lambda r: r[0]["cameras"][0].update(camera_model_name="THIN_PRISM")), "front: model: camera model"),
        (edited(lambda r: r[0]["cameras"][1].update(image_prefix="rig1/right/")), "begin with 'rig1/right/'"),
        (edited(lambda r: r[0]["cameras"].append(r[0]["cameras"][0])), "two cameras have one image_prefix"),
    ],
)
def test_malformed_configurations_are_named(rig: Path, tmp_path: Path, text: str, message: str) -> None:
    write_images(rig)
    (rig / "rig_config.json").write_text(text)
    with pytest.raises(InputError, match=message):
        import_recording(rig, tmp_path / "drive", options={"rate_hz": 10.0})
    assert not (tmp_path / "drive").exists()


def test_one_of_several_rigs(rig: Path, tmp_path: Path) -> None:
    write_images(rig)
    (rig / "images" / "rig1").rename(rig / "images" / "rig2")
    write_images(rig)
    second = json.loads(json.dumps(config()).replace("rig1/", "rig2/"))
    (rig / "rig_config.json").write_text(json.dumps([*config(), *second]))
    with pytest.raises(InputError, match="2 scenes: rig1, rig2"):
        import_recording(rig, tmp_path / "drive", options={"rate_hz": 10.0})
    import_recording(rig, tmp_path / "drive", scene="rig2", options={"rate_hz": 10.0})
    assert read_drive(tmp_path / "drive").manifest.name == "street-rig2"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:4326\n", "has no rows"),
        ("EPSG:4326\na.jpg 8.4\n", "line 2: has no two coordinates"),
        ("EPSG:4326\na.jpg nan 49\n", "line 2: has no two coordinates"),
        ("EPSG:4326\na.jpg 8 49\na.jpg 8 49\n", "line 3: a.jpg has two lines"),
        ("EPSG:4326\na.jpg 49.0 98.4 1\n", "line 2: coordinates are outside of 'EPSG:4326': are x and y swapped"),
        ("EPSG:32632\na.jpg 8.4 49 1\nb.jpg 8.5 49 1\n", "line 2: 8.4, 49 and all others look like degrees"),
        ("WGS84 UTM 32N\n\na.jpg 8.4 49\n", "line 3: 8.4, 49 and all others look like degrees"),
        ("+proj=utm +zone=32 +datum=WGS84\na.jpg 8.4 49\n", "look like degrees"),
        ("EPSG:3857\na.jpg 8.4 49\n", "look like degrees"),
        ("EPSG:32632\na.jpg 456000 5428000\nb.jpg 5428000 456000\n", "line 3: lies at .*, far outside of the area of"),
        ("Gauss\na.jpg 8 49\n", "line 1: 'Gauss'"),
    ],
)
def test_malformed_positions_are_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "geo.txt").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_geo_txt(tmp_path / "geo.txt")
    assert "geo.txt" in caught.value.what


@pytest.mark.parametrize(
    ("system", "message"),
    [
        ("EPSG:25832+7837", "has heights of its own"),
        ("EPSG:2227+6360", "has heights of its own"),  # feet
        ("EPSG:27700", "needs uk_os_OSTN15"),  # without the grid 2 m off
        ("WGS84 UTM 61N", "WGS84 UTM 61N"),  # 32661 is no zone, but the system of the pole
    ],
)
def test_systems_that_would_be_metres_off_are_refused(tmp_path: Path, system: str, message: str) -> None:
    (tmp_path / "geo.txt").write_text(f"{system}\na.jpg 530000 180000 40\n")
    with pytest.raises(InputError, match=message):
        read_geo_txt(tmp_path / "geo.txt")


@pytest.mark.parametrize(
    ("system", "x", "y", "longitude"),
    [
        ("EPSG:32632", 900_000.0, 5_430_000.0, 14.46),  # the next zone, on purpose
        ("+proj=tmerc +lat_0=49 +lon_0=8.4 +datum=WGS84", 20.0, 30.0, 8.400273),  # a site's own system
    ],
)
def test_systems_around_their_area_are_taken(tmp_path: Path, system: str, x: float, y: float, longitude: float) -> None:
    (tmp_path / "geo.txt").write_text(f"{system}\na.jpg {x} {y}\n")
    assert read_geo_txt(tmp_path / "geo.txt")["a.jpg"].longitude_deg == pytest.approx(longitude, abs=0.01)


def test_a_prefix_that_another_one_begins_with(rig: Path, tmp_path: Path) -> None:
    """Images of cam10 begin with cam1, too."""
    write_images(rig, geotagged)
    for old, new in (("front", "cam1"), ("left", "cam10")):
        (rig / "images" / "rig1" / old).rename(rig / "images" / "rig1" / new)
    document = config()
    for camera, new in zip(document[0]["cameras"], ("cam1", "cam10"), strict=True):
        camera["image_prefix"] = f"rig1/{new}"
    (rig / "rig_config.json").write_text(json.dumps(document))
    assert import_recording(rig, tmp_path / "drive").images == 2 * FRAMES


def test_positions_of_images_that_are_not_there(rig: Path, tmp_path: Path) -> None:
    write_images(rig)
    (rig / "geo.txt").write_text("EPSG:4326\nimage99.jpg 8.4 49 100\n")
    with pytest.raises(InputError, match=r"has image99\.jpg, which no image is"):
        import_recording(rig, tmp_path / "drive", options={"rate_hz": 10.0, "gnss_sigma_m": 1.0})


def test_images_in_folders_that_are_links(rig: Path, tmp_path: Path) -> None:
    """All images on another disk, and a camera's own folder there; a link back to the images is no circle."""
    write_images(rig)
    (rig / "images").rename(tmp_path / "disk")
    (tmp_path / "disk" / "rig1" / "left").rename(tmp_path / "left")
    (tmp_path / "disk" / "rig1" / "left").symlink_to(tmp_path / "left")
    (rig / "images").symlink_to(tmp_path / "disk")
    (tmp_path / "left" / "back").symlink_to(tmp_path / "disk")
    rows = [(f"rig1/front/image{f}.jpg", *place(f)[1::-1], f"{place(f)[2]} 0 0 0 1 2") for f in range(FRAMES)]
    (rig / "geo.txt").write_text(geo_txt("EPSG:4326", rows))
    summary = import_recording(rig, tmp_path / "drive", options={"rate_hz": 10.0})
    assert (summary.images, summary.gnss_samples) == (2 * FRAMES, FRAMES)
    assert not any("image_prefix" in note for note in summary.notes)


def test_an_antenna_that_is_not_on_the_vehicle(rig: Path, tmp_path: Path) -> None:
    write_images(rig, geotagged)
    with pytest.raises(InputError, match=r"antenna is at \[0\.0, 0\.0, 1800\.0\] m .* over 100 m away") as caught:
        import_recording(rig, tmp_path / "drive", options={"antenna_m": [0.0, 0.0, 1800.0]})
    assert "--antenna" in caught.value.remedy
    assert not (tmp_path / "drive").exists()


def test_times_with_an_offset(rig: Path, tmp_path: Path) -> None:
    write_images(rig, lambda f: exif_of(time=f"2026:03:04 12:11:{12 + f:02d}", subsecond="25", offset="+02:00"))
    import_recording(rig, tmp_path / "drive")
    assert read_drive(tmp_path / "drive").timestamps_us[0] == 1_772_619_072_250_000


@pytest.mark.parametrize(
    ("references", "signs"),
    [
        (("s", "w"), (-1, -1)),
        ((b"S\0", b"E\0"), (-1, 1)),
        (("North", " West"), (1, -1)),
        (("N", None), None),
        ((None, "E"), None),
        (("N", "?"), None),
        (("", "E"), None),
    ],
)
def test_hemispheres(tmp_path: Path, references: tuple[Any, Any], signs: tuple[int, int] | None) -> None:
    """A position without them may lie on another continent, and is none."""
    exif = exif_of(place=(33.5, 70.25, 5.0))
    gps = exif.get_ifd(0x8825)
    for field, reference in zip((1, 3), references, strict=True):
        del gps[field]
        gps.update({} if reference is None else {field: reference})
    Image.new("L", SIZE).save(tmp_path / "image.jpg", exif=exif)
    tag = read_exif(tmp_path / "image.jpg")[1]
    found = None if tag is None else (tag.latitude_deg, tag.longitude_deg)
    assert found == (None if signs is None else pytest.approx((33.5 * signs[0], 70.25 * signs[1])))
