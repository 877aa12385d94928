"""`report.html`: one file that loads nothing, with the exact numbers, and withheld where it cannot be made."""

from __future__ import annotations

import copy
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mrasfm_engine.export.picture_files import png_of
from mrasfm_engine.export.report_page._figures import camera_residuals, gnss_residuals
from mrasfm_engine.export.report_page._html import preview
from mrasfm_engine.export.report_page._maps import map_page
from mrasfm_engine.export.report_page._read_back import MOST_BYTES, faults_of
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.geometry import geodesy
from schemas import Gnss, GnssSample
from schemas.artifacts import REPORT_PAGE
from tests.helpers.export_example import make_scene

REPORT: dict[str, Any] = {
    "engine_version": "1.2.3",
    "drive": "ring <road>",
    "findings": [{"severity": "warning", "code": "gnss-jump", "what": "GNSS jumps & returns", "remedy": "Nothing."}],
    "stages": [
        {"stage": "matches", "seconds": 1.25, "reused": True, "rejected_pairs": {"few matches": 3}},
        {
            "stage": "mapping",
            "seconds": 2.5,
            "images_occluded": [{"file": "left/001.png", "unit": 1, "camera": "left"}],
            "units_not_registered": [{"unit": 1, "source_frame": 1, "reason": "its images have 0 keypoints"}],
        },
        {"stage": "refinement", "seconds": 4.0, "scale": {"sigma_relative": 0.0123, "from": "the rig"}},
    ],
}


def pictures() -> dict[str, bytes]:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (300, 2000, 3), dtype=np.uint8)
    return {"birds_eye_before.png": png_of(noise), "birds_eye_after.png": png_of(noise[::-1])}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report") / "scene"
    write_scene(make_scene(), out, REPORT, pictures)
    return out


@pytest.fixture(scope="module")
def page(written: Path) -> str:
    return (written / REPORT_PAGE).read_text()


class Tags(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_it_loads_nothing_and_is_small(written: Path, page: str) -> None:
    targets = [v for _, attrs in Tags(page).found for k, v in attrs.items() if k in ("src", "href")]
    assert len(targets) >= 3
    assert all(target is not None and target.startswith("data:") for target in targets)
    assert "url(" not in page
    assert (written / REPORT_PAGE).stat().st_size < MOST_BYTES


def test_text_from_outside_is_escaped(page: str) -> None:
    assert "ring &lt;road&gt;" in page
    assert "ring <road>" not in page
    assert "jumps &amp; returns" in page


def test_every_correction_is_there_exactly_and_rounded_as_its_sigma(written: Path, page: str) -> None:
    calibration = json.loads((written / "calibration.json").read_text())
    with_sigma = 0
    for camera in calibration["cameras"].values():
        for field, of_sigma in (("rotation_vector_deg", "rotation_deg"), ("translation_m", "translation_m")):
            sigmas = camera["sigma"].get(of_sigma)
            for value, sigma in zip(camera["difference"][field], sigmas or [None] * 3, strict=True):
                exact = f'data-value="{value!r}"' + ("" if sigma is None else f' data-sigma="{sigma!r}"')
                assert exact in page
                if sigma is not None:
                    found = re.search(re.escape(exact) + r">([^<]+) <small>± ([^<]+)", page)
                    assert found is not None
                    decimals = len(found[2].partition(".")[2])
                    assert len(found[2].replace(".", "").lstrip("0")) >= 3
                    assert (found[1], found[2]) == (f"{value:.{decimals}f}", f"{sigma:.{decimals}f}")
                    with_sigma += 1
    assert with_sigma >= 6


def test_what_was_rejected_is_named_with_its_reason(page: str) -> None:
    for words in (
        "few matches",
        "left/001.png: images that something covers",
        "units without a pose: 1 (its images have 0 keypoints)",
        "1.25",
        "(reused)",
    ):
        assert words in page
    assert 'data-value="1.23"' in page  # the scale's sigma in per cent


def test_a_wrong_camera_is_flagged_and_no_other(tmp_path: Path) -> None:
    scene = make_scene()
    scene.calibration[1].__dict__["is_wrong"] = True
    write_scene(scene, tmp_path / "scene", REPORT)
    rows = [a for t, a in Tags((tmp_path / "scene" / REPORT_PAGE).read_text()).found if t == "tr" and "data-wrong" in a]
    assert len(rows) == 4
    assert {(row["data-camera"], row["data-wrong"]) for row in rows} == {("left", "false"), ("right", "true")}
    assert {row["data-camera"] for row in rows if row.get("class") == "wrong"} == {"right"}


@pytest.mark.parametrize("code", ["camera-miscalibrated", "calibration-contradicted", "calibration-unexplained"])
def test_a_calibration_that_a_finding_says_is_contradicted_is_not_called_good(
    tmp_path: Path, page: str, code: str
) -> None:
    """Of two cameras that contradict each other none is the wrong one."""
    good = "no camera contradicts its calibration"
    assert good in page
    write_scene(make_scene(), tmp_path / "scene", REPORT | {"findings": [REPORT["findings"][0] | {"code": code}]})
    contradicted = (tmp_path / "scene" / REPORT_PAGE).read_text()
    assert good not in contradicted
    assert "images contradict the calibration, see findings" in contradicted


@pytest.mark.parametrize(
    ("use_gnss", "why"), [(True, "no GNSS that could be used"), (False, "GNSS is left out, as the settings ask")]
)
def test_the_reason_why_a_scene_is_not_on_the_earth(tmp_path: Path, use_gnss: bool, why: str) -> None:
    scene = replace(make_scene(), georeference=None)
    write_scene(scene, tmp_path / "scene", REPORT | {"settings": {"use_gnss": use_gnss}})
    assert f"not placed on the earth: {why}" in (tmp_path / "scene" / REPORT_PAGE).read_text()


def test_the_reason_for_a_missing_picture_is_shown(tmp_path: Path) -> None:
    stage = {"stage": "pictures", "seconds": 0.1, "birds_eye": {"not_drawn": "too few points <lie> on the ground"}}
    write_scene(make_scene(), tmp_path / "scene", REPORT | {"stages": [stage]})
    page = (tmp_path / "scene" / REPORT_PAGE).read_text()
    assert "The picture of the road from above is not drawn: too few points &lt;lie&gt; on the ground." in page
    assert "they were switched off" not in page


def test_residuals_are_those_of_the_scene() -> None:
    scene = make_scene()
    scene.point_error_px[:] = 0.0  # points are projected exactly
    found = camera_residuals(scene)
    assert found is not None
    assert [camera.name for camera in found] == ["left", "right"]
    assert sum(camera.observations for camera in found) == len(scene.observation_point)
    assert all(0 <= camera.rms_px < 1e-4 for camera in found)
    for features in scene.features:
        features.xy_px[:, 0] += 0.5
    scene.point_error_px[:] = 0.5
    shifted = camera_residuals(scene)
    assert shifted is not None
    assert [round(camera.rms_px, 3) for camera in shifted] == [0.5, 0.5]
    scene.point_error_px[:] = 3.0
    assert camera_residuals(scene) is None, "the scene says something else: poses by row, for example"


def test_without_gnss_there_is_no_chart_of_it(page: str) -> None:
    assert gnss_residuals(make_scene(), {}) is None
    assert "GNSS residuals" not in page


def test_residuals_are_those_of_the_antenna_and_the_clock_that_the_scene_found() -> None:
    scene, antenna_m, late_us = make_scene(), [0.5, -0.3, 1.7], 40_000
    units = np.flatnonzero(scene.unit_registered)
    poses = scene.world_from_rig[units]
    assert scene.georeference is not None
    places = geodesy.geodetic_from_local(
        poses[:, :3, :3] @ antenna_m + poses[:, :3, 3], scene.georeference.ecef_from_local
    )
    samples = [
        GnssSample(
            timestamp_us=int(at) - late_us, latitude_deg=latitude, longitude_deg=longitude, height_m=height,
            sigma_horizontal_m=0.02, sigma_vertical_m=0.03,
        )
        for at, (latitude, longitude, height) in zip(scene.drive.timestamps_us[units], places.tolist(), strict=True)
    ]  # fmt: skip
    gnss = Gnss(height_datum="ellipsoidal", antenna_in_rig_m=[0.0, 0.0, 0.0], samples=samples)
    manifest = scene.drive.manifest.model_copy(update={"gnss": gnss})
    scene = replace(scene, drive=replace(scene.drive, manifest=manifest))
    as_given = gnss_residuals(scene, {})
    assert as_given is not None
    assert np.abs(as_given[1]).max() > 1.0
    found = gnss_residuals(
        scene, {"antenna": {"used_in_rig_m": antenna_m}, "clock_offset_s": late_us / 1e6, "units_used": len(units)}
    )
    assert found is not None
    assert len(found[0]) == len(units)
    np.testing.assert_allclose(found[1], 0.0, atol=1e-3)


def test_previews_are_bounded(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    cv2.imwrite(str(tmp_path / "a.png"), rng.integers(0, 256, (3000, 5000, 3), dtype=np.uint8))
    found = preview(tmp_path / "a.png")
    assert found is not None
    assert 10_000 < len(found) < 1_000_000
    assert preview(tmp_path / "none.png") is None


def test_a_page_that_says_something_else_is_noticed(written: Path, tmp_path: Path, page: str) -> None:
    calibration = json.loads((written / "calibration.json").read_text())
    assert list(faults_of(written / REPORT_PAGE, {"": calibration})) == []
    calibration["cameras"]["left"]["difference"]["rotation_vector_deg"][1] += 1e-9
    assert list(faults_of(written / REPORT_PAGE, {"": calibration})) == ["the rotation of left about y is another"]
    other = tmp_path / "other.html"
    other.write_text(page.replace("</main>", '<img src="https://example.org/a.png"></main>'))
    assert list(faults_of(other)) == ["it would load something"]


def test_what_cannot_be_made_is_withheld(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> str:
        raise ValueError("no page")

    monkeypatch.setattr("mrasfm_engine.export.report_page._scenes.page", fail)
    write_scene(make_scene(), tmp_path / "scene", REPORT)
    assert not (tmp_path / "scene" / REPORT_PAGE).exists()
    notes = json.loads((tmp_path / "scene" / "report.json").read_text())["summary"]["notes"]
    assert "report.html is withheld: it cannot be written: ValueError: no page" in notes


MAP_SUMMARY = {"registered_images": 4, "total_images": 4, "georeferenced": True}


def map_document(seams: int) -> dict[str, Any]:
    """Of two scenes; all seams have the same pictures."""
    shown = {"pictures": {"before": "pictures/birds_eye_before.png", "after": "pictures/birds_eye_after.png"}}
    seam = {"a": "one", "b": "two", "accepted": True, "inliers": 12, "residual_after_px": 0.7316933881054083}
    return {
        "scenes": [
            {"name": name, "verdict": "connected", "registered_units": 2, "total_units": 2, "points": 5}
            for name in ("one", "two")
        ],
        "seams": [seam | shown] * seams
        + [{"a": "one", "b": "three", "accepted": False, "reason": "two hypotheses"}, seam | {"b": "four"}],
        "unconnected": [], "left_out": [], "loops": [],
    }  # fmt: skip


def page_of_map(folder: Path, seams: int, calibrations: dict[str, Any], image: NDArray[np.uint8] | None = None) -> str:
    (folder / "pictures").mkdir()
    for name, data in pictures().items():
        if image is None:
            (folder / "pictures" / name).write_bytes(data)
        else:
            cv2.imwrite(str(folder / "pictures" / name), image)
    return map_page(map_document(seams), folder, REPORT | {"summary": MAP_SUMMARY}, calibrations)


def test_a_map_names_its_seams_and_shows_the_calibration_of_each_drive(written: Path, tmp_path: Path) -> None:
    calibration = json.loads((written / "calibration.json").read_text())
    other = copy.deepcopy(calibration)
    other["cameras"]["left"]["wrong"] = True
    other["cameras"]["left"]["difference"]["rotation_vector_deg"][0] = 3.0001
    calibrations = {"one": calibration, "two": other}
    found = page_of_map(tmp_path, 1, calibrations)
    assert "Seam of one and two" in found
    assert 'data-value="0.7316933881054083">0.732</span> px' in found
    assert found.count("data:image/jpeg;base64,") == 2
    assert "rejected: two hypotheses" in found
    assert "There are no pictures: they were switched off." in found
    assert "not mounted as given: left in two" in found
    assert found.index("<h3>two</h3>") < found.index("<h3>one</h3>"), "what needs a look comes first"
    (tmp_path / "report.html").write_text(found)
    assert list(faults_of(tmp_path / "report.html", calibrations)) == []
    other["cameras"]["left"]["difference"]["rotation_vector_deg"][0] = 3.0
    faults = list(faults_of(tmp_path / "report.html", calibrations))
    assert faults == ["the rotation of left about x is another in two"]


@pytest.mark.parametrize(
    ("named", "title", "heading"),
    [
        (
            {"name": "kitti <street>"},
            "kitti &lt;street&gt;: map",
            '<p class="kind">Map</p><h1>kitti &lt;street&gt;</h1>',
        ),
        ({}, "Map", "<header><h1>Map</h1>"),
    ],
)
def test_a_map_is_titled_by_its_name_and_without_one_as_a_map(
    tmp_path: Path, named: dict[str, str], title: str, heading: str
) -> None:
    found = map_page(map_document(0), tmp_path, REPORT | {"summary": MAP_SUMMARY} | named, {})
    assert f"<title>{title}</title>" in found
    assert heading in found


def test_a_map_names_the_drives_that_are_not_in_it_once(tmp_path: Path) -> None:
    document = map_document(0) | {"left_out": [{"name": "three", "reason": "no seam places it"}]}
    report = REPORT | {"summary": MAP_SUMMARY, "failed_drives": [{"name": "b<size"}, {"name": "three"}]}
    found = map_page(document, tmp_path, report, {})
    assert "1 drive is not in the map: b&lt;size" in found
    assert found.count("not in the map") == 1
    assert "</span> finding, see below" in found
    assert "finding, see below" not in map_page(document, tmp_path, report | {"findings": []}, {})


@pytest.mark.parametrize(
    ("sigma", "words"),
    [(0.0005312, "1.00213 <small>± 0.00053"), (0.0412, "1.002 <small>± 0.041"), (None, "1.0021"), (0.0, "1.0021")],
)
def test_the_scale_of_a_seam_has_the_digits_that_its_sigma_is_worth(
    tmp_path: Path, sigma: float | None, words: str
) -> None:
    document = map_document(0)
    document["seams"][1] |= {"scale": 1.0021299} | ({} if sigma is None else {"sigma_scale": sigma})
    found = map_page(document, tmp_path, REPORT | {"summary": MAP_SUMMARY}, {})
    shown = re.search(r"<dt>Scale of the second scene against the first</dt><dd>(.*?)</dd>", found)
    assert shown is not None
    assert 'data-value="1.0021299"' in shown[1]
    assert f">{words}<" in shown[1]


@pytest.mark.parametrize(("seams", "drawn"), [(12, 12), (120, 20)])
def test_all_seams_of_a_map_show_their_pictures_while_the_page_has_room(tmp_path: Path, seams: int, drawn: int) -> None:
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.integers(0, 256, (60, 60, 3), dtype=np.uint8), (500, 500))
    found = page_of_map(tmp_path, seams, {}, image)
    assert drawn <= found.count("data:image/jpeg;base64,") / 2 <= seams
    assert found.count("Its pictures: pictures/") == seams - found.count("data:image/jpeg;base64,") // 2
    assert 100_000 < len(found.encode()) < MOST_BYTES
