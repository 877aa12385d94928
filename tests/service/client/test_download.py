"""Bringing scenes into folders: whole, resumed, tampered with, and refused."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from service.client import ApiError, Downloaded, SceneFolderError, download
from service.client import Client as LibraryClient
from service.client.download import MARKER_NAME
from tests.helpers.bad_network import Cut, bad_network
from tests.helpers.live_api import Api, Client, sha256_of
from tests.helpers.tiny_drive import tiny_drive
from tests.service.client.conftest import Connect

LARGE = os.urandom(3_000_000)
FILES = {
    "points.ply": LARGE,
    "model/cameras.bin": b"cameras",
    "model/text/a file.txt": b"100 % text",
    "empty": b"",
    "report.json": b'{"done": true}',
}


class Shop:
    """A client of one project, and scenes of its one drive."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self._drive_id = client.frozen(tiny_drive(seed="shop"))

    def scene(self, files: dict[str, bytes]) -> str:
        job = self.client.reconstruct(self._drive_id)
        return self.client.publish(self.client.claim(job["id"]), files)


@pytest.fixture(scope="module")
def shop(api: Api) -> Shop:
    return Shop(api.client())


def download_scene(library: LibraryClient, scene_id: str, out: Path, **options: Any) -> Downloaded:
    return download(library, library.scene(scene_id), out, **options)


def held(out: Path) -> dict[str, bytes]:
    found = {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert found.pop(MARKER_NAME)
    return found


def test_a_scene_arrives_whole_and_is_not_brought_twice(shop: Shop, connect: Connect, tmp_path: Path) -> None:
    scene_id = shop.scene(FILES)
    library, out = connect(shop.client), tmp_path / "deep" / "scene"
    reported: list[tuple[str, int, int]] = []
    first = download_scene(library, scene_id, out, report=lambda *news: reported.append(news))
    assert held(out) == FILES
    total = sum(map(len, FILES.values()))
    assert (first.bytes_received, first.files_received, first.files_skipped) == (total, 5, 0)
    assert reported[-1] == ("download", total, total)
    second = download_scene(library, scene_id, out)
    assert (second.bytes_received, second.files_received, second.files_skipped) == (0, 0, 5)


def test_the_report_comes_last(shop: Shop, connect: Connect, tmp_path: Path) -> None:
    scene_id = shop.scene(FILES)
    out = tmp_path / "scene"
    seen: list[bool] = []
    report = out / "report.json"
    download_scene(connect(shop.client), scene_id, out, report=lambda *news: seen.append(report.exists()))
    times = {path: (out / path).stat().st_mtime_ns for path in FILES}
    assert seen
    assert not any(seen)
    assert max(times, key=lambda path: times[path]) == "report.json"


def partial_of(out: Path) -> Path:
    (partial,) = (path for path in out.iterdir() if path.name.endswith(".partial"))
    return partial


def interrupted(shop: Shop, connect: Connect, scene_id: str, out: Path) -> Path:
    """A download whose connection broke for good in the middle of the large file; what is there of it."""
    cut = Cut(b"GET /v1/scenes/" + scene_id.encode() + b"/files/points", answer_bytes=1_000_000, times=1)
    refuse = Cut(cut.part, answer_bytes=0, times=1000)
    with bad_network(shop.client.api.url, cut, refuse) as network:
        library = connect(shop.client, url=network.url, retry_s=0.3)
        with pytest.raises(Exception, match="cannot be reached"):
            download_scene(library, scene_id, out)
    partial = partial_of(out)
    assert 0 < partial.stat().st_size < 1_000_000
    assert not (out / "points.ply").exists()
    assert not (out / "report.json").exists()
    return partial


def test_an_interrupted_download_brings_only_the_rest(shop: Shop, connect: Connect, tmp_path: Path) -> None:
    scene_id, out = shop.scene(FILES), tmp_path / "scene"
    there_bytes = interrupted(shop, connect, scene_id, out).stat().st_size
    rest = download_scene(connect(shop.client), scene_id, out)
    assert held(out) == FILES
    assert len(LARGE) - there_bytes <= rest.bytes_received <= sum(map(len, FILES.values())) - there_bytes


def test_breaks_in_the_middle_are_mended_within_one_call(shop: Shop, connect: Connect, tmp_path: Path) -> None:
    scene_id, out = shop.scene(FILES), tmp_path / "scene"
    cut = Cut(b"GET /v1/scenes/" + scene_id.encode() + b"/files/points", answer_bytes=700_000, times=3)
    with bad_network(shop.client.api.url, cut) as network:
        done = download_scene(connect(shop.client, url=network.url), scene_id, out)
    assert held(out) == FILES
    assert [b"\r\nrange: bytes=" in head.lower() for head in cut.seen] == [False, True, True]
    assert f'if-range: "{sha256_of(LARGE)}"'.encode() in cut.seen[1].lower()
    assert done.bytes_received == sum(map(len, FILES.values()))  # no byte came twice


@pytest.mark.parametrize("longer", [False, True])
def test_a_tampered_part_is_brought_again(shop: Shop, connect: Connect, tmp_path: Path, longer: bool) -> None:
    scene_id, out = shop.scene(FILES), tmp_path / "scene"
    partial = interrupted(shop, connect, scene_id, out)
    partial.write_bytes(b"x" * (len(LARGE) + 1 if longer else 500_000))
    download_scene(connect(shop.client), scene_id, out)
    assert held(out) == FILES


def test_a_tampered_file_is_brought_again(shop: Shop, connect: Connect, tmp_path: Path) -> None:
    scene_id, out = shop.scene(FILES), tmp_path / "scene"
    download_scene(connect(shop.client), scene_id, out)
    (out / "points.ply").write_bytes(LARGE[:-1] + b"?")
    (out / "model" / "cameras.bin").unlink()
    again = download_scene(connect(shop.client), scene_id, out)
    assert held(out) == FILES
    assert (again.files_received, again.bytes_received) == (2, len(LARGE) + len(b"cameras"))


def test_bytes_that_are_not_what_the_service_states_are_not_kept(shop: Shop, connect: Connect, tmp_path: Path) -> None:
    scene_id, out = shop.scene({"points.ply": b"the right bytes", "report.json": b"{}"}), tmp_path / "scene"
    (stored,) = (
        path for path in shop.client.api.objects(shop.client.project_id) if path.read_bytes() == b"the right bytes"
    )
    stored.chmod(0o600)
    stored.write_bytes(b"the wrong bytes")
    with pytest.raises(SceneFolderError, match=r"points\.ply.*damaged"):
        download_scene(connect(shop.client), scene_id, out)
    assert held(out) == {}


@pytest.mark.parametrize(
    "name", ["../evil", "/evil", "a/../../evil", "a/./evil", "a\\evil", ".mrasfm-scene.json", "out/evil"]
)
def test_names_that_lead_elsewhere_are_refused(shop: Shop, connect: Connect, tmp_path: Path, name: str) -> None:
    scene_id = shop.scene({name: b"evil", "report.json": b"{}"})
    out = tmp_path / "scene"
    out.mkdir()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (out / MARKER_NAME).write_text(f'{{"scene_id": "{scene_id}"}}')
    (out / "out").symlink_to(elsewhere)
    with pytest.raises(SceneFolderError, match="does not belong"):
        download_scene(connect(shop.client), scene_id, out)
    assert list(elsewhere.iterdir()) == []
    assert sorted(path.name for path in tmp_path.rglob("*")) == [MARKER_NAME, "elsewhere", "out", "scene"]


def test_a_folder_of_something_else_is_left_alone(shop: Shop, connect: Connect, tmp_path: Path) -> None:
    first, second = shop.scene(FILES), shop.scene({"report.json": b"{}"})
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")
    with pytest.raises(SceneFolderError, match="not empty"):
        download_scene(connect(shop.client), first, mine)
    assert [path.name for path in mine.iterdir()] == ["notes.txt"]
    out = tmp_path / "scene"
    download_scene(connect(shop.client), second, out)
    with pytest.raises(SceneFolderError, match=f"holds the scene {second}, not {first}"):
        download_scene(connect(shop.client), first, out)
    assert held(out) == {"report.json": b"{}"}
    with pytest.raises(SceneFolderError, match="cannot be"):
        download_scene(connect(shop.client), first, mine / "notes.txt")


def test_a_scene_that_is_not_there_makes_no_folder(shop: Shop, connect: Connect, tmp_path: Path) -> None:
    with pytest.raises(ApiError, match="no scene 'scn_0'") as refused:
        download_scene(connect(shop.client), "scn_0", tmp_path / "scene")
    assert refused.value.status == 404
    assert not (tmp_path / "scene").exists()
