"""COLMAP's text model, as the check reads it beside the binary one: in parts, in whatever order COLMAP writes it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from mrasfm_engine.export import colmap, colmap_io, readers
from mrasfm_engine.export.text_model import FILES, find_fault, write_text_model
from tests.helpers.export_example import make_scene


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, colmap_io.ModelRead]:
    folder = tmp_path_factory.mktemp("model")
    colmap.write_model(make_scene(), folder)
    (folder / "text").mkdir()
    return folder, write_text_model(folder, folder / "text").binary


@pytest.fixture
def fault(
    written: tuple[Path, colmap_io.ModelRead], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str, list[str]], str]:
    """What the check finds where one file has some lines, of points three at one time."""
    monkeypatch.setattr(readers, "POINTS_AT_ONE_TIME", 3)
    folder, binary = written

    def find(file: str, lines: list[str]) -> str:
        for name in FILES:
            (tmp_path / name).write_bytes((folder / "text" / name).read_bytes())
        (tmp_path / file).write_text("".join(lines), encoding="utf-8")
        return find_fault(binary, folder, tmp_path)

    return find


@pytest.fixture
def lines_of(written: tuple[Path, colmap_io.ModelRead]) -> Callable[[str], list[str]]:
    return lambda name: (written[0] / "text" / name).read_text(encoding="utf-8").splitlines(keepends=True)


def test_all_points_in_any_order(lines_of: Callable[[str], list[str]], fault: Callable[[str, list[str]], str]) -> None:
    lines = lines_of("points3D.txt")
    heads, points = [x for x in lines if x.startswith("#")], [x for x in lines if not x.startswith("#")]
    assert len(points) > 6
    assert fault("points3D.txt", heads + points) == ""
    assert fault("points3D.txt", heads + points[::-1]) == ""


@pytest.mark.parametrize("at", [-1, -4])
def test_what_is_wrong_with_a_point_is_found_in_every_part(
    lines_of: Callable[[str], list[str]], fault: Callable[[str, list[str]], str], at: int
) -> None:
    lines = lines_of("points3D.txt")
    words = lines[at].split(" ")
    before, after = lines[:at], lines[at:][1:]

    def found(*changed: str) -> str:
        return fault("points3D.txt", [*before, *changed, *after]).partition(" is not ")[0]

    assert found() == "points3D.txt: the number of its lines about a point"
    assert found(lines[at], lines[at]) == "points3D.txt: the number of its lines about a point"
    assert found(" ".join(["1000000", *words[1:]])) == "points3D.txt: a point id"
    assert found(" ".join([words[0], "99.5", *words[2:]])) == "points3D.txt: a point"
    assert found(" ".join([*words[:4], str(255 - int(words[4])), *words[5:]])) == "points3D.txt: a colour"
    assert found(" ".join([*words[:7], "99.5", *words[8:]])) == "points3D.txt: an error"
    assert found(" ".join([*words[:8], str(int(words[8]) + 1), *words[9:]])) == "points3D.txt: a track"


@pytest.mark.parametrize(
    ("file", "line", "word", "what"),
    [
        ("cameras.txt", -1, 0, "the list of cameras"),
        ("cameras.txt", -1, 1, "camera 2"),
        ("cameras.txt", -1, 3, "camera 2"),
        ("cameras.txt", -1, 4, "the params of camera 2"),
        ("rigs.txt", -1, 0, "the list of rigs"),
        ("rigs.txt", -1, 1, "rig 1"),
        ("rigs.txt", -1, 2, "rig 1"),
        ("rigs.txt", -1, 5, "rig 1"),
        ("rigs.txt", -1, 12, "the pose of camera 1"),
        ("frames.txt", -1, 1, "KeyError"),
        ("frames.txt", -1, 7, "the pose of frame"),
        ("frames.txt", -1, 9, "ValueError: frame"),
        ("frames.txt", -1, 10, "ValueError: frame"),
        ("frames.txt", -1, 11, "the cameras of its images"),
        ("frames.txt", -1, 12, "the cameras of its images"),
        ("images.txt", -2, 0, "image 12"),
        ("images.txt", -2, 6, "the pose of "),
        ("images.txt", -2, 8, "image "),
        ("images.txt", -2, 9, "image "),
        ("images.txt", -1, 0, "a keypoint of "),
        ("images.txt", -1, 2, "a point seen in "),
    ],
)
def test_a_word_that_is_off_is_found(
    lines_of: Callable[[str], list[str]],
    fault: Callable[[str, list[str]], str],
    file: str,
    line: int,
    word: int,
    what: str,
) -> None:
    lines = lines_of(file)
    words = lines[line].removesuffix("\n").split(" ")
    try:
        words[word] = str(float(words[word]) + 5e-6 if "." in words[word] else int(words[word]) + 3)
    except ValueError:
        words[word] = "OPENCV" if words[word] == "PINHOLE" else "LIDAR"
    lines[line] = " ".join(words) + "\n"
    assert fault(file, lines).startswith(f"{file}: {what}")


def test_a_quaternion_and_its_negative_are_one_pose(
    lines_of: Callable[[str], list[str]], fault: Callable[[str, list[str]], str]
) -> None:
    lines = lines_of("images.txt")
    number, *words = lines[-2].split(" ")
    negative = [str(-float(word)) for word in words[:4]]
    assert fault("images.txt", [*lines[:-2], " ".join([number, *negative, *words[4:]]), lines[-1]]) == ""


@pytest.mark.parametrize("file", FILES)
def test_a_file_that_ends_early(
    lines_of: Callable[[str], list[str]], fault: Callable[[str, list[str]], str], file: str
) -> None:
    lines = lines_of(file)
    assert fault(file, [*lines[:-1], lines[-1].removesuffix("\n")]) == f"{file}: ValueError: it ends early"
    assert fault(file, lines[:3]) != ""
