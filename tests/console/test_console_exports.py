"""Exports from the page of a scene: of a component, its progress, its files."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import expect

from schemas.api.scenes import SceneComponent
from service.domain import exports
from tests.console.conftest import Open, go, log_in
from tests.helpers import live_api
from tests.helpers.live_api import SCENE_FILES, api_in_thread, settings_of

POSES = b"1 0 0 0 0 1 0 0 0 0 1 0\n"
RESULT = {"format": "kitti", "files": 1, "size_bytes": len(POSES), "withheld": None, "notes": ["as the test says"]}


def components(*folders: str) -> list[SceneComponent]:
    return [
        SceneComponent(
            component=number,
            folder=folder,
            georeferenced=False,
            registered_units=12 + number,
            registered_images=24,
            points=100,
        )
        for number, folder in enumerate(folders)
    ]


@pytest.mark.slow
def test_a_component_is_exported_from_its_scenes_page(
    open_console: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = components(".", "components/1", ".")  # the third lies in the frame of the first
    monkeypatch.setattr(live_api, "SUMMARY", live_api.SUMMARY.model_copy(update={"components": listed}))
    with api_in_thread(settings_of(tmp_path / "data")) as api:
        client = api.client()
        scene_id = client.scene({**SCENE_FILES, **{f"components/1/{path}": b"own" for path in SCENE_FILES}})
        watched = open_console(api.url)
        watched.expected = ("status of 422",)
        page = watched.new_page()
        log_in(page, api.url, client.key)
        go(page, api.url, f"scenes/{scene_id}/files")
        page.get_by_text("No export yet.").wait_for()
        ask = page.get_by_role("button", name="Export", exact=True)
        expect(ask).to_be_disabled()
        page.get_by_label("Part of the drive").select_option(label="Component 1: 13 units")
        expect(page.get_by_label("Part of the drive").locator("option")).to_have_count(2)
        page.get_by_label("positions for web maps (GeoJSON)").check()
        ask.click()
        expect(page.get_by_role("alert")).to_contain_text(f"component 1 of scene {scene_id}")  # it has no place
        page.get_by_label("positions for web maps (GeoJSON)").uncheck()
        page.get_by_label("poses as in KITTI odometry").check()
        ask.click()
        made = page.locator("[data-export]")
        expect(made.get_by_role("heading")).to_have_text("kitti · component 1")
        expect(page.get_by_role("alert")).to_have_count(0)
        (export,) = client.get(f"/v1/scenes/{scene_id}/exports").json()["items"]
        assert (export["component"], export["formats"]) == (1, ["kitti"])
        held, stored = client.claim(export["job_id"]), client._store({"kitti/00/poses.txt": POSES})
        with api.database.write() as session:
            exports.publish(session, held, files=stored, results=[RESULT], expires_us=None)
        expect(made.get_by_text("succeeded")).to_be_visible()  # by itself
        expect(made.get_by_text("1 file, 24 B")).to_be_visible()
        made.get_by_text("Files", exact=True).click()
        with page.expect_download() as download:
            made.get_by_role("link", name="kitti/00/poses.txt").click()
        assert Path(download.value.path()).read_bytes() == POSES
        made.get_by_role("link", name="Its job").click()
        page.get_by_role("link", name="Open the exports of the scene").click()
        expect(page.get_by_role("heading", name="Exports")).to_be_visible()
        made.get_by_role("button", name="Delete").click()
        made.get_by_role("button", name="Yes").click()
        page.get_by_text("No export yet.").wait_for()
        assert client.get(f"/v1/scenes/{scene_id}/exports").json()["items"] == []
