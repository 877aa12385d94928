from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.read_scene import read_calibration
from mrasfm_engine.io.trajectory_file import format_tum, read_tum


def test_round_trip_keeps_microseconds(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    poses = se3.transform(se3.exp_so3(rng.normal(size=(5, 3))), rng.normal(size=(5, 3)) * 1e4)
    # Beyond 2^53 nanoseconds, where a float of seconds loses microseconds.
    times = [0, 1, 1_533_151_603_547_590, 1_533_151_603_547_591, 4_000_000_000_000_000_001]
    (tmp_path / "a.tum").write_text(format_tum(times, poses))
    read = read_tum(tmp_path / "a.tum")
    assert read.timestamps_us.tolist() == times
    np.testing.assert_allclose(read.world_from_rig, poses, atol=1e-8)


def test_foreign_files(tmp_path: Path) -> None:
    path = tmp_path / "kitti.tum"
    path.write_text("# a comment\r\n\r\n2e0,1,2,3,0,0,0,1\r\n1.036000e-01 4 5 6 0 0 0.70711 0.70711 # turned\r\n")
    read = read_tum(path)
    assert read.timestamps_us.tolist() == [103_600, 2_000_000]
    np.testing.assert_allclose(read.world_from_rig[0, :3, 3], [4, 5, 6])
    np.testing.assert_allclose(read.world_from_rig[0, :3, 0], [0, 1, 0], atol=1e-4)


def test_a_byte_order_mark_is_no_value(tmp_path: Path) -> None:
    path = tmp_path / "notepad.tum"
    for first in ("# a comment\n", ""):
        path.write_text(f"{first}1 2 3 4 0 0 0 1\n", encoding="utf-8-sig")
        assert read_tum(path).timestamps_us.tolist() == [1_000_000]


def test_an_empty_file_is_an_empty_trajectory(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text("")
    assert read_tum(tmp_path / "a.tum").world_from_rig.shape == (0, 4, 4)


def test_true_calibrations_are_read(tmp_path: Path) -> None:
    path = tmp_path / "truth_calibration.json"
    path.write_text('{"front": {"rotation_xyzw": [0, 0, 0, 1], "translation_m": [1, 2, 3]}}')
    np.testing.assert_allclose(read_calibration(path)["front"][:3, 3], [1, 2, 3])


@pytest.mark.parametrize("text", ["[]", "{", '{"front": 3}', '{"front": {"rotation_xyzw": [0, 0, 0, 2]}}'])
def test_what_is_no_calibration_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "truth_calibration.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"truth_calibration\.json"):
        read_calibration(path)
