"""Difficult drives: standing, moving objects, occlusion, cameras apart in time; each on a small rendered drive."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.benchmarks.moving_objects import VerifiedTracks, observed
from tests.integration.conftest import WITHOUT_PICTURES, CommandResult, Variant, read_report, synth

Run = Callable[..., CommandResult]


def reconstructed(run: Run, drive: Path, scene: Path, *options: str) -> dict:  # type: ignore[type-arg]
    """Errors of the scene against the truth."""
    result = run("reconstruct", drive, "--out", scene, *WITHOUT_PICTURES, *options)
    assert result.code == 0, result.err
    evaluated = run("evaluate", scene, "--truth", drive / "truth.tum", "--json")
    errors: dict = json.loads(evaluated.out)  # type: ignore[type-arg]
    return errors


@pytest.mark.slow
def test_standing_car_and_missing_images(tmp_path: Path, mrasfm: Run) -> None:
    drive = synth(
        tmp_path / "drive", "--cameras", 3, "--units", 10, "--standing", 4, "--drop-images", 0.15, "--seed", 5
    )
    errors = reconstructed(mrasfm, drive, tmp_path / "scene")
    assert errors["registered_units"] == 10
    assert errors["registered_images"] == errors["total_images"] < 30
    assert 0 < errors["metric"]["rmse_m"] < 0.15
    assert 0 < errors["similarity"]["rmse_m"] < 0.03


@pytest.mark.slow
def test_units_of_a_stop_are_posed_between_its_ends(tmp_path: Path, mrasfm: Run) -> None:
    """They are in no stage but the last, and the trajectory has them to a centimetre."""
    drive = synth(
        tmp_path / "drive", "--cameras", 3, "--units", 14, "--standing", 6, "--moving-cars", 3, "--no-gnss", "--seed", 5
    )
    errors = reconstructed(mrasfm, drive, tmp_path / "scene")
    report = read_report(tmp_path / "scene")
    (stop,) = report["standing"]["stops"]
    assert report["standing"]["units"] == stop["units_between"] >= 4
    assert stop["posed"]
    assert report["by_stage"]["features"]["images"] == errors["total_images"] - 3 * stop["units_between"]
    assert errors["registered_units"] == 14
    assert errors["registered_images"] == errors["total_images"]
    assert 0 < errors["similarity"]["rmse_m"] < 0.01
    poses = json.loads((tmp_path / "scene" / "poses.json").read_text())["units"]
    at_end, between = (poses[stop["first_unit"] + k]["sigma_position_m"] for k in (0, 1))
    assert all(b > a for a, b in zip(at_end, between, strict=True))


@pytest.mark.slow
def test_moving_cars_and_an_occluded_camera(tmp_path: Path, mrasfm: Run) -> None:
    drive = synth(
        tmp_path / "drive", "--cameras", 4, "--units", 8, "--moving-cars", 8, "--occlude", "left", "--seed", 6
    )
    errors = reconstructed(mrasfm, drive, tmp_path / "scene")
    assert errors["registered_units"] == 8
    assert 0 < errors["similarity"]["rmse_m"] < 0.03
    # 8 m of way with 0.3 m of noise say little about the scale, and the report says how little.
    sigma = read_report(tmp_path / "scene")["by_stage"]["refinement"]["scale"]["sigma_relative"]
    assert 0 < abs(errors["similarity"]["scale"] - 1) < 3 * sigma < 1


@pytest.mark.slow
def test_moving_cars_without_masks_give_no_points(tmp_path: Path, mrasfm: Run) -> None:
    drive = synth(
        tmp_path / "drive", "--cameras", 3, "--units", 8, "--moving-cars", 0, "--same-way-cars", 4, "--no-masks",
        "--moving-masks", "--seed", 8,
    )  # fmt: skip
    errors = reconstructed(mrasfm, drive, tmp_path / "scene", "--no-gnss")
    assert errors["registered_units"] == 8
    assert 0 < errors["similarity"]["rmse_m"] < 0.03
    report = read_report(tmp_path / "scene")["by_stage"]["refinement"]["moving_objects"]
    assert report["tracks_dropped"] == sum(report["tracks_dropped_because"].values()) > 20
    tracks, seen = VerifiedTracks.read(tmp_path / "scene", drive), observed(tmp_path / "scene")
    assert tracks.moving.sum() > 20
    assert tracks.share(tracks.moving, seen) <= 0.1


@pytest.mark.slow
def test_cameras_that_are_not_simultaneous(tmp_path: Path, mrasfm: Run, variant_of: Callable[[Path], Variant]) -> None:
    drive = synth(tmp_path / "drive", "--cameras", 3, "--units", 6, "--time-skew-ms", 40, "--seed", 7)
    errors = reconstructed(mrasfm, drive, tmp_path / "scene")
    assert errors["registered_units"] == 6
    assert 0 < errors["metric"]["rmse_m"] < 1.0  # not compensated: up to 0.2 m of way between cameras
    motion = read_report(tmp_path / "scene")["by_stage"]["refinement"]["motion_within_units"]
    assert motion["compensated"]
    assert motion["units_not_compensated"] == 0
    # The same instants seconds apart: nothing tells how the car moved between the images of one.
    slow = variant_of(drive)
    slow.document.pop("gnss")
    for u, frame in enumerate(slow.document["frames"]):
        for of in (frame, *frame["images"].values()):
            of["timestamp_us"] += 3_000_000 * u
    result = mrasfm("reconstruct", slow.save().root, "--out", slow.scene)
    assert result.code == 0, result.err
    assert "warning: 6 of 6 registered units have no other one within 2.5 s" in result.out
    motion = read_report(slow.scene)["by_stage"]["refinement"]["motion_within_units"]
    assert motion["units_not_compensated"] == 6


@pytest.mark.slow
def test_opposite_gnss_outliers(variant: Variant, mrasfm: Run) -> None:
    """Two samples that are 55 m off in opposite directions, whose mean looks right."""
    samples = variant.document["gnss"]["samples"]
    samples[2]["latitude_deg"] += 5e-4
    samples[5]["latitude_deg"] -= 5e-4
    errors = reconstructed(mrasfm, variant.save().root, variant.scene)
    assert 0 < errors["similarity"]["rmse_m"] < 0.02
    assert 0 < errors["metric"]["rmse_m"] < 0.5  # scale is known to a tenth on so short a way; an outlier counts metres
    report = read_report(variant.scene)
    assert "gnss-jump" in {finding["code"] for finding in report["findings"]}
    refinement = report["by_stage"]["refinement"]
    assert refinement["georeferenced"]
    assert 0 < refinement["gnss"]["residual_rms_m"] < 2.0


@pytest.mark.slow
def test_gnss_that_jumps_for_good(variant: Variant, mrasfm: Run) -> None:
    """From one sample on, all are 75 m off: no place on the earth is better than the wrong one."""
    for sample in variant.document["gnss"]["samples"][4:]:
        sample["longitude_deg"] += 1e-3
    result = mrasfm("reconstruct", variant.save().root, "--out", variant.scene)
    assert result.code == 0
    assert "warning: GNSS jumps at gnss.samples.4" in result.out
    refinement = read_report(variant.scene)["by_stage"]["refinement"]
    if refinement["georeferenced"]:  # by the part before the jump or the one after it, never by both
        assert refinement["gnss"]["units_used"] <= 4
        assert 0 < refinement["gnss"]["residual_rms_m"] < 2.0
    else:
        assert refinement["gnss"]["not_used"]
