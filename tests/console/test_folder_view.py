"""`mrasfm view`: the console over a folder, to read and for this machine only."""

from __future__ import annotations

import json
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import expect

from service.api.folder_view import DriveFolder, FolderViewError, create_view
from tests.console.conftest import Open, World, example_drive, viewing, wait_for


@pytest.fixture(scope="module")
def drive_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    drive, folder = example_drive("example"), tmp_path_factory.mktemp("drive")
    for path, data in {**drive.files, "drive.json": drive.raw, "secret.txt": b"secret"}.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    return folder


def test_a_scene_is_shown_with_its_images(open_console: Open, world: World, drive_folder: Path) -> None:
    with viewing(world.folder, "--drive", drive_folder) as address:
        host = address.partition("#")[0]
        watched = open_console(host.rstrip("/"))
        page = watched.new_page()
        page.goto(address)
        page.locator("[data-idle=true]").wait_for()
        assert int(page.locator(".figures").get_attribute("data-shown") or 0) == 50
        page.get_by_text("Choose an image without the mouse").click()
        page.get_by_role("button", name="Show", exact=True).click()
        wait_for(page, "document.querySelector('.photo img')?.naturalWidth === 960")
        for tab in ("Overview", "Calibration", "Files"):
            page.get_by_label("Parts of this page").get_by_role("link", name=tab).click()
            page.get_by_role("heading", level=2).first.wait_for()
        expect(page.get_by_role("button", name="Delete")).to_have_count(0)
        expect(page.get_by_role("button", name="Log out")).to_have_count(0)
        refused = httpx.get(f"{host}v1/scenes", headers={"Host": "evil.example"})
        assert refused.status_code == 400, "another site's name leads nowhere"
        for name in ("127.0.0.1.evil.example", "evil.example:80", "10.0.0.1", ""):
            for path in ("", "v1/session", "v1/scenes/local/files/points.ply", "console/files/console.js"):
                assert httpx.get(f"{host}{path}", headers={"Host": name}).status_code == 400
        with pytest.raises(httpx.ConnectError):  # another address of this machine, also on loopback
            httpx.get(host.replace("127.0.0.1", "127.0.0.2"))
        for path in (
            "drives/drive-0/files/secret.txt",
            "drives/drive-0/files/../secret.txt",
            "scenes/local/files/../../x",
        ):
            assert httpx.get(f"{host}v1/{path}").status_code == 404
        part = httpx.get(f"{host}v1/scenes/local/files/points.ply", headers={"Range": "bytes=0-2"})
        assert (part.status_code, part.content) == (206, b"ply")


def test_a_folder_that_is_none_is_named(tmp_path: Path) -> None:
    with pytest.raises(FolderViewError, match=r"has no report\.json: give the folder of a complete scene or map"):
        create_view(tmp_path)
    for damaged in ("[", "[" * 100_000):
        (tmp_path / "report.json").write_text(damaged)
        with pytest.raises(FolderViewError, match=r"report\.json cannot be read"):
            create_view(tmp_path)
    for report in ({"formats": {}}, {"summary": []}, {"summary": {}, "components": 1}):  # the first is an export's
        (tmp_path / "report.json").write_text(json.dumps(report))
        with pytest.raises(FolderViewError, match=r"report\.json is not a scene's: give the folder of"):
            create_view(tmp_path)
    (tmp_path / "map.json").write_text("{}")
    with pytest.raises(FolderViewError, match=r"report\.json and map\.json are not those of a map"):
        create_view(tmp_path)


@pytest.mark.parametrize("path", ["/etc/hostname", "../secret.png", "front/../../secret.png"])
def test_a_manifest_that_leads_out_of_its_folder_is_refused(tmp_path: Path, path: str) -> None:
    """The folder may come from anybody, and every program of this machine may ask for the images."""
    manifest = {"name": "d", "frames": [{"images": {"front": {"file": path}}}]}
    (tmp_path / "drive.json").write_text(json.dumps(manifest))
    with pytest.raises(FolderViewError, match="which is not in its folder"):
        DriveFolder.read(tmp_path)
