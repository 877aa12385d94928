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


def test_a_file_with_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "settings.toml").write_bytes(b"\xef\xbb\xbfthreads = 1\r\n[output]\r\npictures = false\r\n")
    config = read_config(tmp_path / "settings.toml")
    assert (config.threads, config.output.pictures) == (1, False)


def test_the_defaults_are_within_their_bounds() -> None:
    assert EngineConfig.model_validate(EngineConfig().model_dump()) == EngineConfig()
