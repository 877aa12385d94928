from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.row_bands import MAX_BAND_S, MAX_BANDS, RowBands
from schemas.drive import ReadoutDirection
from tests.helpers.simulated_drive import make_drive

WIDTH, HEIGHT = 960, 540


def drive(*, units: int = 3, **fields: object) -> Drive:
    poses, params = np.tile(np.eye(4), (2, 1, 1)), np.tile([600.0, 600, 480, 270], (2, 1))
    return make_drive(poses, params, units=units, **fields)


def test_without_readout_and_skew_bands_are_images() -> None:
    bands = RowBands.from_drive(drive())
    assert bands.simultaneous
    np.testing.assert_array_equal(bands.image, np.arange(6))
    np.testing.assert_array_equal(bands.middle_of_image, np.arange(6))
    np.testing.assert_array_equal(bands.unit, [0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(bands.camera, [0, 1] * 3)
    np.testing.assert_array_equal(bands.of_pixels(np.array([2, 5]), np.array([[9.0, 10.0], [9.0, 500.0]])), [2, 5])


def test_images_have_the_offsets_of_their_timestamps() -> None:
    recorded = drive(time_offset_us=[12_000, -40_000])
    bands = RowBands.from_drive(recorded)
    np.testing.assert_allclose(bands.time_offset_s, [0.012, -0.04] * 3)
    assert RowBands.from_drive(recorded, compensate=False).simultaneous


@pytest.mark.parametrize("readout_us", [200, 5_000, 17_300, 30_000])
def test_rows_are_cut_into_short_bands_about_the_images_timestamp(readout_us: int) -> None:
    bands = RowBands.from_drive(drive(time_offset_us=[0, 20_000], readout_us=readout_us))
    counts = np.diff(bands.first_of_image)
    assert len(set(counts.tolist())) == 1
    assert counts[0] % 2 == 1
    assert readout_us / 1e6 / counts[0] <= MAX_BAND_S
    np.testing.assert_allclose(bands.time_offset_s[bands.middle_of_image], [0.0, 0.02] * 3, atol=1e-12)
    rows = np.linspace(0.5, HEIGHT - 0.5, 200)
    own = bands.of_pixels(np.full(200, 3), np.stack([np.linspace(0, 900, 200), rows], 1))
    assert (bands.image[own] == 3).all()
    expected = 0.02 + (rows / HEIGHT - 0.5) * readout_us / 1e6
    assert 0 < np.abs(bands.time_offset_s[own] - expected).max() <= 0.5 * MAX_BAND_S + 1e-9
    # Rounding may put a keypoint on the edge of the image or just outside.
    edge = bands.of_pixels(np.array([3, 3]), np.array([[5.0, -0.4], [5.0, HEIGHT + 0.4]]))
    assert edge.tolist() == [bands.first_of_image[3], bands.first_of_image[4] - 1]


@pytest.mark.parametrize(
    ("direction", "first", "last"),
    [
        (ReadoutDirection.TOP_TO_BOTTOM, (300.0, 0.5), (700.0, HEIGHT - 0.5)),
        (ReadoutDirection.BOTTOM_TO_TOP, (300.0, HEIGHT - 0.5), (700.0, 0.5)),
        (ReadoutDirection.LEFT_TO_RIGHT, (0.5, 400.0), (WIDTH - 0.5, 100.0)),
        (ReadoutDirection.RIGHT_TO_LEFT, (WIDTH - 0.5, 400.0), (0.5, 100.0)),
    ],
)
def test_rows_or_columns_are_read_in_their_direction(
    direction: ReadoutDirection, first: tuple[float, float], last: tuple[float, float]
) -> None:
    given = drive(readout_us=30_000)
    cameras = [camera.model_copy(update={"readout_direction": direction}) for camera in given.cameras]
    rig = given.manifest.rig.model_copy(update={"cameras": cameras})
    bands = RowBands.from_drive(Drive(given.root, given.manifest.model_copy(update={"rig": rig})))
    middle = (np.array(first) + np.array(last)) / 2
    own = bands.of_pixels(np.array([3, 3, 3]), np.array([first, middle, last]))
    np.testing.assert_allclose(bands.time_offset_s[own], [-0.015, 0.0, 0.015], atol=MAX_BAND_S)


def test_the_number_of_bands_is_bounded() -> None:
    assert np.diff(RowBands.from_drive(drive(readout_us=200_000)).first_of_image).tolist() == [MAX_BANDS] * 6
