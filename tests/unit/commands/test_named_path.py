"""NAME=PATH on the command line, where paths hold equals signs."""

from __future__ import annotations

from pathlib import Path

import pytest

from mrasfm_engine.commands.named_path import split_name


@pytest.mark.parametrize(
    ("word", "name", "path"),
    [
        ("truth.tum", None, "truth.tum"),
        ("a=truth.tum", "a", "truth.tum"),
        ("a=/data/run=3/truth.tum", "a", "/data/run=3/truth.tum"),
        ("/data/run=3/truth.tum", None, "/data/run=3/truth.tum"),
        ("./a=truth.tum", None, "./a=truth.tum"),
        ("../run=3/a=b", None, "../run=3/a=b"),
        ("=truth.tum", None, "=truth.tum"),
        ("a=", None, "a="),
        ("a-b.c_1=x", "a-b.c_1", "x"),
    ],
)
def test_what_stands_before_a_path(word: str, name: str | None, path: str) -> None:
    assert split_name(word) == (name, Path(path))


def test_what_is_there_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "date=2024-05-01").mkdir()
    assert split_name("date=2024-05-01") == (None, Path("date=2024-05-01"))
    assert split_name("date=2024-05-02") == ("date", Path("2024-05-02"))
    (tmp_path / "2024-05-01").mkdir()
    assert split_name("date=2024-05-01") == ("date", Path("2024-05-01"))
