"""A drive that is uploaded in the browser: only what its manifest names, and only once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.console.conftest import Open, World, go, log_in
from tests.helpers.live_api import Client
from tests.helpers.tiny_drive import TinyDrive, tiny_drive


def folder_of(drive: TinyDrive, folder: Path) -> Path:
    for path, data in {**drive.files, "drive.json": drive.raw, "notes.txt": b"mine", "more/a.bin": b"x"}.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    return folder


def upload(page: Page, url: str, folder: Path) -> list[str]:
    """Upload a folder; the paths of the files that were sent."""
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url) if request.method == "PUT" else None)
    go(page, url, "upload")
    page.locator("input[type=file]").set_input_files(folder)
    page.locator("[data-step=done]").wait_for()
    return [one.partition("/files/")[2] for one in sent]


@pytest.mark.parametrize("host", ["127.0.0.1", "mrasfm.test"])
def test_a_folder_is_uploaded_once(open_console: Open, world: World, tmp_path: Path, host: str) -> None:
    """Also on a host name that is no secure context, where browsers have no crypto.subtle."""
    client, drive = world.api.client(), tiny_drive("uploaded", seed=f"uploaded {host}")
    folder = folder_of(drive, tmp_path / "drive")
    url = world.api.url.replace("127.0.0.1", host)
    watched = open_console(url)
    page = watched.new_page()
    log_in(page, url, client.key)
    assert page.evaluate("window.isSecureContext") is (host == "127.0.0.1")
    assert sorted(upload(page, url, folder)) == sorted(drive.files)
    expect(page.get_by_text("2 files of the folder are not named by the manifest and stay here.")).to_be_visible()
    (first,) = client.get("/v1/drives").json()["items"]
    assert (first["state"], first["files_stored"]) == ("COMMITTED", len(drive.files))
    assert upload(page, url, folder) == []
    assert len(client.get("/v1/drives").json()["items"]) == 2
    page.get_by_role("link", name="Open uploaded").click()
    page.get_by_role("heading", name="uploaded").wait_for()


def test_another_browser_goes_on(open_console: Open, world: World, tmp_path: Path) -> None:
    client, drive = world.api.client(), tiny_drive("interrupted", seed="interrupted", frames=12)
    folder = folder_of(drive, tmp_path / "drive")
    first = open_console(world.api.url).new_page()
    log_in(first, world.api.url, client.key)
    go(first, world.api.url, "upload")
    names = sorted(drive.files)

    def stop_later(route: Any) -> None:
        if stored_files(client) < len(names) // 4:
            route.continue_()

    first.route("**/files/**/*.png", stop_later)
    first.locator("input[type=file]").set_input_files(folder)
    while stored_files(client) < len(names) // 4:
        first.wait_for_timeout(50)
    first.close()
    stored = {f["path"] for f in client.get(f"/v1/drives/{drive_of(client)}/files?stored=true").json()["items"]}
    assert len(names) // 4 <= len(stored) < len(names)
    second = open_console(world.api.url).new_page()
    log_in(second, world.api.url, client.key)
    sent = upload(second, world.api.url, folder)
    assert set(sent).isdisjoint(stored)
    assert 0 < len(sent) <= len(names) - len(stored)  # the service may have finished what the first had in flight
    assert client.get(f"/v1/drives/{drive_of(client)}").json()["state"] == "COMMITTED"


def drive_of(client: Client) -> str:
    (drive,) = client.get("/v1/drives").json()["items"]
    return str(drive["id"])


def stored_files(client: Client) -> int:
    return sum(drive["files_stored"] for drive in client.get("/v1/drives").json()["items"])


def test_a_large_file_goes_in_pieces_and_on_where_it_was(open_console: Open, world: World, tmp_path: Path) -> None:
    client, drive = world.api.client(), tiny_drive("large", seed="large")
    name = next(iter(drive.files))
    drive.files[name] += bytes(20 << 20)  # after the picture's end
    folder = folder_of(drive, tmp_path / "drive")
    watched = open_console(world.api.url)
    page = watched.new_page()
    log_in(page, world.api.url, client.key)
    pieces: list[int] = []
    page.on(
        "request", lambda r: pieces.append(int(r.headers.get("upload-offset", -1))) if r.method == "PATCH" else None
    )
    upload(page, world.api.url, folder)
    assert pieces == [0, 8 << 20, 16 << 20]
    stored = client.get(f"/v1/drives/{drive_of(client)}/files/{name}")
    assert stored.content == drive.files[name]


def test_a_folder_without_a_manifest_is_refused_with_a_remedy(open_console: Open, world: World, tmp_path: Path) -> None:
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, "upload")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "a.txt").write_text("a")
    page.locator("input[type=file]").set_input_files(tmp_path / "folder")
    expect(page.get_by_role("alert")).to_contain_text("There is no drive.json in it.")
    expect(page.get_by_role("alert")).to_contain_text("mrasfm import")
