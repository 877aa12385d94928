"""The points of a text model, as the check reads them: in parts, in whatever order COLMAP writes them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from mrasfm_engine.export import colmap, colmap_io, comparisons, readers
from mrasfm_engine.scene.scene import Scene
from tests.helpers.export_example import make_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


@pytest.fixture(scope="module")
def lines(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("model")
    colmap.write_model(scene, folder)
    (folder / "text").mkdir()
    colmap_io.read_binary_and_write_text(folder, folder / "text")
    return (folder / "text" / "points3D.txt").read_text(encoding="utf-8").splitlines(keepends=True)


@pytest.fixture
def fault(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], str | None]:
    """What the check finds in a file of some lines that it reads by threes."""
    monkeypatch.setattr(readers, "POINTS_AT_ONE_TIME", 3)

    def find(changed: list[str]) -> str | None:
        path = tmp_path / "points3D.txt"
        path.write_text("".join(changed), encoding="utf-8")
        rows = comparisons.points_text(scene, readers.points_text(path))
        return next((row.what for row in rows if not row.agrees), None)

    return find


def test_all_points_in_any_order(lines: list[str], fault: Callable[[list[str]], str | None]) -> None:
    heads, points = [x for x in lines if x.startswith("#")], [x for x in lines if not x.startswith("#")]
    assert len(points) > 6
    assert fault(heads + points) is None
    assert fault(heads + points[::-1]) is None


@pytest.mark.parametrize("at", [-1, -4])
def test_what_is_wrong_is_found_in_every_part(
    lines: list[str], fault: Callable[[list[str]], str | None], at: int
) -> None:
    words = lines[at].split(" ")
    before, after = lines[:at], lines[at:][1:]
    assert fault(before + after) == "the number of its lines about a point"
    assert fault([*lines, lines[at]]) == "the number of its lines about a point"
    assert fault([*before, " ".join(["1000000", *words[1:]]), *after]) == "a point id"
    assert fault([*before, " ".join([words[0], "99.5", *words[2:]]), *after]) == "a point"
    assert fault([*before, " ".join([*words[:4], str(255 - int(words[4])), *words[5:]]), *after]) == "a colour"
    assert fault([*before, " ".join([*words[:8], str(int(words[8]) + 1), *words[9:]]), *after]) == "a track"


def test_a_file_that_ends_early(lines: list[str], fault: Callable[[list[str]], str | None]) -> None:
    with pytest.raises(ValueError, match="ends early"):
        fault([*lines[:-1], lines[-1].rstrip("\n")])
