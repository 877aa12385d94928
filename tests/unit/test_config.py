"""Files of settings, and bounds of what they may ask for."""

from __future__ import annotations

from pathlib import Path

import pytest

from mrasfm_engine.config import EngineConfig, read_config
from mrasfm_engine.errors import InputError


@pytest.mark.parametrize(
    ("text", "bound"),
    [
        ("threads = 100000", 1024),
        ("[submaps]\nprocesses = 1025", 1024),
        ("[features]\nmax_keypoints = 100000000000", 100_000),
        ("[matching]\nmax_keypoints = 100001", 100_000),
        ("[features]\nmax_side_px = 1000000000", 20_000),
        ("[pairs]\nrevisit_pairs_per_unit = 1000001", 1_000_000),
    ],
)
def test_counts_have_an_upper_bound(tmp_path: Path, text: str, bound: int) -> None:
    """OpenCV and the operating system would answer such numbers with tracebacks."""
    (tmp_path / "settings.toml").write_text(text)
    name = text.split("\n")[-1].split(" ")[0]
    with pytest.raises(InputError, match=rf"settings.toml: .*{name}: Input should be less than or equal to {bound}"):
        read_config(tmp_path / "settings.toml")


@pytest.mark.parametrize(
    ("text", "bound"),
    [
        ("[pairs]\nmax_depth_m = 1e160", "less than or equal to 1000000000"),
        ("[mapping]\nkeyframe_motion_px = 1e160", "less than or equal to 1000000000"),
        ("[bundle_adjustment]\nsigma_rotation_deg = 1e-300", "greater than or equal to 0.000000001"),
        ("[bundle_adjustment]\nsigma_translation_m = 1e300", "less than or equal to 1000000000"),
        ("[bundle_adjustment]\nsigma_focal = 1e300", "less than or equal to 1000000000"),
        ("[bundle_adjustment]\nloss_scale = 1e-300", "greater than or equal to 0.000000001"),
    ],
)
def test_numbers_that_equations_cannot_hold(tmp_path: Path, text: str, bound: str) -> None:
    (tmp_path / "settings.toml").write_text(text)
    name = text.split("\n")[-1].split(" ")[0]
    with pytest.raises(InputError, match=rf"settings.toml: .*{name}: Input should be {bound}"):
        read_config(tmp_path / "settings.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('use_gnss = "no"', "use_gnss: Input should be a valid boolean"),
        ("use_gnss = 0", "use_gnss: Input should be a valid boolean"),
        ('seed = "4"', "seed: Input should be a valid integer"),
        ('[matching]\nmax_error_px = "4"', "matching.max_error_px: Input should be a valid number"),
        ("[features]\nmax_keypoints = 512.0", "features.max_keypoints: Input should be a valid integer"),
    ],
)
def test_a_value_of_another_type_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "settings.toml").write_text(text)
    with pytest.raises(InputError, match=message):
        read_config(tmp_path / "settings.toml")


def test_an_integer_is_a_number_and_text_a_path_or_a_name(tmp_path: Path) -> None:
    text = """
    [matching]
    matcher = "nearest"
    max_error_px = 4
    [aggregation]
    final_adjustment = "all"
    [models]
    folder = "of/models"
    """
    (tmp_path / "settings.toml").write_text(text)
    config = read_config(tmp_path / "settings.toml")
    assert (config.matching.max_error_px, config.aggregation.final_adjustment) == (4.0, "all")
    assert config.models.folder == Path("of/models")


def test_all_mistakes_of_a_file_are_listed(tmp_path: Path) -> None:
    text = 'use_gnss = "no"\nthread = 1\n[pairs]\nmax_depth_m = 0\n[mapping]\nlocal_units = 1.5\nlocal_every = 0\n'
    names = ["use_gnss", "thread", "pairs.max_depth_m", "mapping.local_units", "mapping.local_every"]
    (tmp_path / "settings.toml").write_text(text)
    with pytest.raises(InputError) as caught:
        read_config(tmp_path / "settings.toml")
    assert [name for name in names if f"{name}: " not in caught.value.what] == []
    (tmp_path / "settings.toml").write_text(text + "local_unit = 1\n")
    with pytest.raises(InputError, match="; and 1 more"):
        read_config(tmp_path / "settings.toml")


def test_a_file_with_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "settings.toml").write_bytes(b"\xef\xbb\xbfthreads = 1\r\n[output]\r\npictures = false\r\n")
    config = read_config(tmp_path / "settings.toml")
    assert (config.threads, config.output.pictures) == (1, False)


def test_the_defaults_are_within_their_bounds() -> None:
    assert EngineConfig.model_validate(EngineConfig().model_dump()) == EngineConfig()
