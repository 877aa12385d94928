"""Lens models that do not reach over their whole image are findings."""

from __future__ import annotations

import pytest

from mrasfm_engine.preflight.lenses import lens_findings, share_without_ray
from schemas import Camera, DriveManifest, Frame, FrameImage, Pose, Rig
from schemas.findings import Severity


def camera(model: str, params: list[float]) -> Camera:
    return Camera(
        name="cam",
        model=model,
        width=960,
        height=600,
        params=params,
        rig_from_cam=Pose(rotation_xyzw=[0, 0, 0, 1], translation_m=[0, 0, 0]),
    )


def findings(model: str, params: list[float]) -> list[str]:
    frame = Frame(timestamp_us=0, source_frame=0, images={"cam": FrameImage(file="0.png")})
    manifest = DriveManifest(name="lens", rig=Rig(cameras=[camera(model, params)]), frames=[frame])
    return [f"{finding.code}: {finding.what}" for finding in lens_findings(manifest)]


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("PINHOLE", [500.0, 500.0, 480.0, 300.0]),
        ("OPENCV", [700.0, 700.0, 480.0, 300.0, -0.3, 0.1, 0.001, -0.001]),
        ("FULL_OPENCV", [700.0, 700.0, 480.0, 300.0, -0.3, 0.1, 0.001, -0.001, 0.01, 0.0, 0.0, 0.0]),
        ("OPENCV_FISHEYE", [330.0, 330.0, 480.0, 300.0, 0.02, -0.008, 0.002, -0.0005]),
        # An image circle of 190 deg in a wider image: its corners show nothing.
        ("OPENCV_FISHEYE", [180.0, 180.0, 480.0, 300.0, 0.0, -0.012, 0.0, 0.0]),
        ("MEI", [1300.0, 1300.0, 480.0, 300.0, 0.016, 1.6, 0.0006, -0.0004, 2.2]),
    ],
)
def test_lenses_that_reach_the_corners_are_no_finding(model: str, params: list[float]) -> None:
    assert findings(model, params) == []


@pytest.mark.parametrize(
    ("center", "is_named"),
    [
        ((480.0, 300.0), False),
        ((480.0, 140.0), False),
        ((480.0, 40.0), True),
        ((940.0, 300.0), True),
        ((0.5, 0.5), True),
    ],
)
def test_a_principal_point_at_the_edge_is_named(center: tuple[float, float], is_named: bool) -> None:
    found = findings("PINHOLE", [500.0, 500.0, *center])
    assert [text.split(":")[0] for text in found] == (["principal-point"] if is_named else [])


@pytest.mark.parametrize(
    ("center", "times"),
    [((960.0, 600.0), "2"), ((240.0, 150.0), "0.5"), ((725.0, 440.0), "1.5"), ((490.0, 450.0), None)],
)
def test_params_of_images_of_another_size_are_named(center: tuple[float, float], times: str | None) -> None:
    """Images that were reduced, and params of the whole ones; a cut at the top moves the principal point alone."""
    found = findings("PINHOLE", [500.0, 500.0, *center])
    if times is None:
        assert found == []
    else:
        (text,) = found
        assert f"as in an image {times} times the size of its image of 960x600 pixels" in text


def test_a_fold_inside_the_image_is_named_with_its_angle_and_share() -> None:
    # Half of the image is 43 deg wide, the polynomial ends at 31 deg.
    params = [500.0, 500.0, 480.0, 300.0, -0.9, 0.0, 0.0, 0.0]
    share, angle_rad = share_without_ray(camera("OPENCV", params))
    assert 0.541 < angle_rad < 0.551  # tan(angle)^2 = 1 / 2.7
    assert 0.5 < share < 0.9
    (found,) = findings("OPENCV", params)
    assert found.startswith("lens-folds: rig.cameras: the distortion of camera cam folds back 31 deg off its axis")
    assert f"{share:.0%} of the pixels" in found


def test_a_lens_that_shows_next_to_nothing_is_an_error() -> None:
    frame = Frame(timestamp_us=0, source_frame=0, images={"cam": FrameImage(file="0.png")})
    lens = camera("OPENCV", [500.0, 500.0, 480.0, 300.0, -40.0, 0.0, 0.0, 0.0])
    (found,) = lens_findings(DriveManifest(name="lens", rig=Rig(cameras=[lens]), frames=[frame]))
    assert (found.code, found.severity) == ("lens-folds", Severity.ERROR)


def test_distortion_with_a_wrong_sign_is_seen() -> None:
    assert findings("OPENCV", [700.0, 700.0, 480.0, 300.0, -0.3, 0.1, 0.0, 0.0]) == []
    assert len(findings("OPENCV", [700.0, 700.0, 480.0, 300.0, -0.3, -0.1, 0.0, 0.0])) == 1
