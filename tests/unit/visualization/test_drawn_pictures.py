"""Pictures that cannot be made cost no scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.visualization import pictures
from mrasfm_engine.visualization.birds_eye import BirdsEye
from mrasfm_engine.visualization.pictures import draw_pictures
from tests.helpers.export_example import make_scene

PICTURE = np.full((3, 4, 3), 7, np.uint8)


def test_what_is_drawn_becomes_files(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = BirdsEye(pictures={"a.png": PICTURE}, report={"images": 3})
    monkeypatch.setattr(pictures, "birds_eye", lambda *_, **__: drawn)
    monkeypatch.setattr(pictures, "road_points", lambda _: {"b.png": PICTURE})
    files, report = draw_pictures(make_scene())
    assert set(files) == {"a.png", "b.png"}
    assert all(data.startswith(b"\x89PNG") for data in files.values())
    assert report == {"birds_eye": {"images": 3}}


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (InputError("image x is gone", remedy="Put it back."), "image x is gone"),
        (MemoryError("no room"), "MemoryError: no room"),
        (np.linalg.LinAlgError("singular"), "LinAlgError: singular"),
    ],
)
def test_an_error_is_the_reason_in_the_report(error: Exception, reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(pictures, "birds_eye", fail)
    monkeypatch.setattr(pictures, "road_points", lambda _: {"b.png": PICTURE})
    files, report = draw_pictures(make_scene())
    assert set(files) == {"b.png"}
    assert report == {"birds_eye": {"not_drawn": reason}}
    monkeypatch.setattr(pictures, "road_points", fail)
    assert draw_pictures(make_scene()) == ({}, {name: {"not_drawn": reason} for name in ("birds_eye", "road_points")})


def test_a_picture_that_is_no_png_is_not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = BirdsEye(pictures={"a.png": PICTURE, "c.png": PICTURE[:0]}, report={"images": 3})
    monkeypatch.setattr(pictures, "birds_eye", lambda *_, **__: drawn)
    files, report = draw_pictures(make_scene())
    assert "a.png" not in files  # one alone would have nothing to be compared with
    assert "4 x 0 pixels cannot be made a PNG" in report["birds_eye"]["not_drawn"]


def test_a_road_whose_files_are_left_out_is_not_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "road.tif").touch()
    drawn = BirdsEye(pictures={"a.png": PICTURE, "road.png": PICTURE[:0]}, road_report={"images": 3})
    monkeypatch.setattr(pictures, "birds_eye", lambda *_, **__: drawn)
    _, report = draw_pictures(make_scene(), scratch=tmp_path)
    assert not list(tmp_path.iterdir())
    assert report["road"] == {"not_drawn": report["birds_eye"]["not_drawn"]}


@pytest.mark.parametrize("stop", [CancelledError(), KeyboardInterrupt()])
def test_a_cancelled_run_is_no_missing_picture(stop: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    def cancel(*_: object, **__: object) -> None:
        raise stop

    monkeypatch.setattr(pictures, "birds_eye", cancel)
    with pytest.raises(type(stop)):
        draw_pictures(make_scene())
