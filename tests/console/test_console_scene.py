"""The scene in 3D and on the map, the image of a frustum, and the report, against the files."""

from __future__ import annotations

import io
import json
import random
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser, Page, expect

from mrasfm_engine.export.report_page._read_back import MOST_BYTES
from tests.console.conftest import Open, World, go, log_in, wait_for
from tests.console.test_console_pages import corrections_agree

SCENE_COLOR = (0xFF, 0xB0, 0x00)
NEAR_PX = 2


@pytest.fixture
def viewer(open_console: Open, world: World) -> Page:
    page = open_console(world.api.url, viewport={"width": 1280, "height": 900}).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, world.pages["scene in 3D"])
    page.locator("[data-idle=true]").wait_for()
    return page


def screenshot(page: Page, selector: str) -> NDArray[np.uint8]:
    """Pixels (h, w, 3) of a part of the page, red first."""
    data = page.locator(selector).screenshot()
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture[..., ::-1].astype(np.uint8)


def has_color(picture: NDArray[np.uint8], x: float, y: float, color: tuple[int, int, int], reach: int) -> bool:
    """Whether a pixel near a place is of this hue, which lines that are half transparent keep."""
    x0, y0 = round(x), round(y)
    part = (
        picture[max(y0 - reach, 0) : y0 + reach + 1, max(x0 - reach, 0) : x0 + reach + 1].reshape(-1, 3).astype(float)
    )
    wanted = np.array(color, dtype=float) / np.linalg.norm(color)
    length = np.linalg.norm(part, axis=1)
    return bool(((part @ wanted > 0.97 * length) & (length > 90)).any())


def test_all_points_are_shown(viewer: Page, world: World) -> None:
    figures = viewer.locator(".figures")
    count = len(laspy.read(world.folder / "points.copc.laz").points)
    assert int(figures.get_attribute("data-shown") or 0) == int(figures.get_attribute("data-total") or 0) == count > 0


def test_units_are_where_the_camera_shows_them(viewer: Page, world: World) -> None:
    document = json.loads((world.folder / "view.json").read_text())
    track = document["scenes"][0]["trajectory_m"]
    places = [track[0], *random.Random(1).choices(track, k=20)]
    on_screen = viewer.evaluate("p => p.map(x => document.querySelector('.canvas canvas').scene3d.project(x))", places)
    picture = screenshot(viewer, ".canvas canvas")
    assert all(has_color(picture, x, y, SCENE_COLOR, NEAR_PX) for x, y in on_screen)
    off = [(x + 60, y - 120) for x, y in on_screen]
    assert not all(has_color(picture, x, y, SCENE_COLOR, NEAR_PX) for x, y in off), "the test can fail"


def test_a_frustum_opens_its_image_with_its_observations(viewer: Page, world: World) -> None:
    document = json.loads((world.folder / "view.json").read_text())
    images = document["scenes"][0]["images"]
    poses = {
        image["file"]
        for image in json.loads((world.folder / "poses.json").read_text())["images"]
        if image["registered"]
    }
    image = max(images, key=lambda one: one["unit"])
    x, y = viewer.evaluate(
        """p => { const c = document.querySelector('.canvas canvas'), b = c.getBoundingClientRect();
             const [x, y] = c.scene3d.project(p); return [b.left + x, b.top + y]; }""",
        np.mean([image["frustum_m"][1], image["frustum_m"][2]], axis=0).tolist(),
    )
    viewer.mouse.click(x, y)
    aside = viewer.get_by_role("complementary")
    aside.wait_for()
    file = aside.locator("code").inner_text()
    assert file in poses
    expect(aside.get_by_role("img")).to_have_attribute("src", f"v1/drives/{world.drive_id}/files/{file}")
    wait_for(viewer, "document.querySelector('.photo img').naturalWidth === 960")
    viewer.locator("[data-observations='50']").wait_for()
    wait_for(viewer, "document.querySelector('.photo canvas').width === 960")  # it is drawn after the page is
    drawn = viewer.evaluate(
        """() => { const c = document.querySelector('.photo canvas');
             const d = c.getContext('2d').getImageData(0, 0, c.width, c.height), drawn = [];
             d.data.forEach((v, i) => i % 4 === 3 && v && drawn.push((i - 3) / 4));
             return [c.width, c.height, drawn]; }"""
    )
    width, height, pixels = drawn
    assert (width, height) == (960, 600)
    found = next(one for one in images if one["file"] == file)
    rows = np.frombuffer(
        (world.folder / "model/images.bin").read_bytes(),
        [("xy", "<f8", 2), ("point", "<u8")],
        found["observations"][1],
        found["observations"][0],
    )
    observed = rows["xy"][rows["point"] != 2**64 - 1]
    inside = observed[((observed > 6) & (observed < (954, 594))).all(axis=1)]
    marks = np.column_stack([np.array(pixels) % width, np.array(pixels) // width]) + 0.5
    for xy in inside:
        radius = np.linalg.norm(marks - xy, axis=1)
        assert radius.min() < 4.5, "a ring is drawn around each"
    nearest = np.linalg.norm(marks[:, None] - observed[None], axis=2).min(axis=1)
    assert nearest.max() < 6.0, "and nothing elsewhere"


def test_the_map_shows_the_trajectory_without_tiles(open_console: Open, world: World) -> None:
    page = open_console(world.api.url, viewport={"width": 1280, "height": 900}).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, world.pages["scene on the map"])
    wait_for(page, "document.querySelector('.place')?.map?.loaded()")
    page.wait_for_timeout(300)
    track = json.loads((world.folder / "view.json").read_text())["scenes"][0]["longitude_latitude_deg"]
    fractions = np.linspace(0, len(track) - 1, 10)
    places = np.column_stack([np.interp(fractions, range(len(track)), np.array(track)[:, axis]) for axis in (0, 1)])
    on_screen = page.evaluate(
        "p => p.map(x => { const q = document.querySelector('.place').map.project(x); return [q.x, q.y]; })",
        places.tolist(),
    )
    picture = screenshot(page, ".place")
    assert all(has_color(picture, x + 1, y + 1, SCENE_COLOR, 3) for x, y in on_screen)


@pytest.mark.parametrize("has_script", [True, False])
def test_the_report_opens_from_the_disk(browser: Browser, world: World, has_script: bool) -> None:
    path = world.folder / "report.html"
    assert 10_000 < path.stat().st_size < MOST_BYTES
    context = browser.new_context(java_script_enabled=has_script, offline=True)
    page = context.new_page()
    requests, faults = [], []
    page.on("request", lambda request: requests.append(request.url))
    page.on("console", lambda message: faults.append(message.text))
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(path.as_uri())
    assert [url for url in requests if not url.startswith("data:")] == [path.as_uri()]
    assert page.locator("table").count() >= 4
    assert page.locator("figure.pair img").count() == 2
    for index in range(2):
        assert page.locator("figure.pair img").nth(index).is_visible()
    assert page.locator("input[type=range]").count() == (1 if has_script else 0)
    assert page.locator("tr[data-wrong=true]").count() == 2
    assert faults == []
    if has_script:
        pdf = page.pdf(prefer_css_page_size=True)
        assert pdf.startswith(b"%PDF")
        width, height = (float(v) for v in io.BytesIO(pdf).read().split(b"/MediaBox [0 0 ")[1].split(b"]")[0].split())
        assert [width, height] == pytest.approx([595, 842], abs=1.5), "A4 in points"
    context.close()


def test_the_report_says_what_the_calibration_says(world: World, tmp_path: Path) -> None:
    page, document = (
        (world.folder / "report.html").read_text(),
        json.loads((world.folder / "calibration.json").read_text()),
    )
    values = [
        v
        for camera in document["cameras"].values()
        for name in ("rotation_vector_deg", "translation_m")
        for v in camera["difference"][name]
    ]
    assert len(values) == 12
    assert all(f'data-value="{value!r}"' in page for value in values)


def test_the_report_shows_the_corrections_in_enough_digits(browser: Browser, world: World) -> None:
    page = browser.new_context(offline=True).new_page()
    page.goto((world.folder / "report.html").as_uri())
    corrections_agree(page, json.loads((world.folder / "calibration.json").read_text()))
    page.context.close()
