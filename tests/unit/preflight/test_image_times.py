from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from schemas.findings import Finding, Severity
from schemas.manifest_check import check_manifest
from schemas.parsing import parse_manifest

Document = dict[str, Any]
START_US = 1_700_000_000_000_000
FRAMES = 12


@pytest.fixture
def document(drive_document: Document) -> Document:
    """Twelve frames, 0.1 s apart, with GNSS."""
    frame, sample = drive_document["frames"][0], drive_document["gnss"]["samples"][0]
    times_us = [START_US + 100_000 * i for i in range(FRAMES)]
    drive_document["frames"] = [
        {
            "timestamp_us": time_us,
            "source_frame": i,
            "images": {name: {"file": f"images/{name}/{i:06d}.png"} for name in frame["images"]},
        }
        for i, time_us in enumerate(times_us)
    ]
    drive_document["gnss"]["samples"] = [sample | {"timestamp_us": time_us} for time_us in times_us]
    return drive_document


def found(document: Document, **options: Any) -> dict[str, Finding]:
    return {
        finding.code: finding for finding in check_manifest(parse_manifest(json.dumps(document).encode()), **options)
    }


def left_at(document: Document, time_us: Callable[[int], int]) -> Document:
    for i, frame in enumerate(document["frames"]):
        frame["images"]["left"]["timestamp_us"] = time_us(i)
    return document


def usual(i: int) -> int:
    return START_US + 100_000 * i


@pytest.mark.parametrize(
    ("later", "leap"),
    [
        (lambda i: usual(i) + 5_000_000, "+5000 ms"),  # a clock that is set
        (lambda i: 100_000 * (i - 7), "-1700000000700 ms"),  # a camera that begins anew
    ],
)
def test_a_clock_that_leaps_is_named_with_its_first_image(
    document: Document, later: Callable[[int], int], leap: str
) -> None:
    left_at(document, lambda i: usual(i) if i < 7 else later(i))
    finding = found(document, use_gnss=False)["unsynchronised"]
    assert finding.severity is Severity.WARNING
    assert finding.what.endswith(f"timestamps of camera left leap by {leap} at images/left/000007.png")
    assert "timestamp_us" in finding.remedy


def test_a_clock_that_leaps_and_returns_leaps_twice(document: Document) -> None:
    left_at(document, lambda i: usual(i) + (1_000_000 if 4 <= i < 8 else 0))
    assert found(document, use_gnss=False)["unsynchronised"].what.endswith("at images/left/000004.png and 1 more")


@pytest.mark.parametrize("drift_us", [20_000, 100_000])
def test_single_images_and_drifting_clocks_are_no_leaps(document: Document, drift_us: int) -> None:
    left_at(document, lambda i: usual(i) + (500_000 if i == 5 else 0))
    assert "leap" not in found(document, use_gnss=False)["unsynchronised"].what
    left_at(document, lambda i: usual(i) + drift_us * i)
    assert "leap" not in found(document, use_gnss=False)["unsynchronised"].what


def test_times_of_a_camera_in_another_unit(document: Document) -> None:
    left_at(document, lambda i: usual(i) // 1000)
    finding = found(document, use_gnss=False)["unsynchronised"]
    assert finding.severity is Severity.ERROR
    assert f"timestamps of camera left look like milliseconds, as {START_US // 1000}" in finding.what


def test_a_camera_takes_one_image_after_the_other(document: Document) -> None:
    left_at(document, lambda i: usual(i) + (50_000 if i in (3, 7) else -50_000 if i in (4, 8) else 0))
    finding = found(document)["image-times-order"]
    assert finding.severity is Severity.WARNING
    assert f"images/left/000004.png is {usual(4) - 50_000}, as that of images/left/000003.png" in finding.what
    assert "(2 such images)" in finding.what
    left_at(document, lambda i: usual(FRAMES - 1 - i))
    assert "before that of images/left/000000.png" in found(document, use_gnss=False)["image-times-order"].what


def apart(document: Document, moved_us: int, *, before: bool = False) -> Document:
    """Put the left images of the last four frames into frames of their own, at another time."""
    frames = document["frames"]
    own = [
        {"timestamp_us": f["timestamp_us"] + moved_us, "images": {"left": f["images"].pop("left")}} for f in frames[8:]
    ]
    for number, frame in enumerate(own):
        frame["source_frame"] = FRAMES + number
    document["frames"] = [*own, *frames] if before else [*frames, *own]
    return document


def test_images_that_a_clock_puts_elsewhere_are_named(document: Document) -> None:
    finding = found(apart(document, 5_000_000), use_gnss=False)["camera-alone"]
    assert finding.what.startswith("from frames.12 on there are images of left alone")
    assert "between frames.11 and frames.12 is the longest pause, 4.7 s" in finding.what


def test_images_of_a_clock_that_begins_anew_are_named(document: Document) -> None:
    finding = found(apart(document, -START_US, before=True), use_gnss=False)["camera-alone"]
    assert finding.what.startswith("up to frames.3 there are images of left alone")


def test_a_camera_that_ends_later_than_others_is_none(document: Document) -> None:
    for frame in document["frames"][6:]:
        del frame["images"]["right"]
        frame["timestamp_us"] += 20_000  # the longest interval of all, and no pause
    assert found(document) == {}


@pytest.mark.parametrize(("per_us", "unit"), [(1_000, "milliseconds"), (100_000, "")])
def test_gnss_times_in_another_unit(document: Document, per_us: int, unit: str) -> None:
    for sample in document["gnss"]["samples"]:
        sample["timestamp_us"] //= per_us
    finding = found(document)["gnss-not-covering"]
    assert finding.what.endswith(f"gnss.samples look like {unit}" if unit else "images have none")
    assert "timestamp_us in microseconds" in finding.remedy


def test_gnss_times_in_whole_seconds(document: Document) -> None:
    for i, (frame, sample) in enumerate(zip(document["frames"], document["gnss"]["samples"], strict=True)):
        frame["timestamp_us"] = START_US + 500_000 * i
        sample["timestamp_us"] = START_US // 1_000_000 + i
    assert found(document)["gnss-not-covering"].what.endswith("look like seconds")


def test_rough_poses_in_another_unit(document: Document) -> None:
    pose = {"rotation_xyzw": [0.0, 0.0, 0.0, 1.0], "translation_m": [0.0, 0.0, 0.0]}
    document["rough_poses"] = {
        "poses": [{"timestamp_us": usual(i) // 1000, "world_from_rig": pose} for i in range(FRAMES)]
    }
    assert found(document)["rough-poses-not-covering"].what.endswith("their timestamps look like milliseconds")
