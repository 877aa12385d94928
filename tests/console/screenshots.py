"""Pictures of all pages of the console, with what `mrasfm demo` made: `python -m tests.console.screenshots DEMO`.

They are pages as somebody sees them: light at 1280 px, long ones down to a heading or a row, and with `--look` whole,
also dark and at the width of a phone, into another folder, to be looked at and not to be kept.
"""

from __future__ import annotations

import argparse
import io
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from tests.console.conftest import ARGUMENTS, chromium, go, log_in
from tests.helpers.live_api import REPOSITORY

KEPT = REPOSITORY / "docs" / "images" / "console"
MOST_BYTES = 150_000
COLORS = (256, 128, 64, 32)
SIZES = {"light": ("light", 1280, 860), "dark": ("dark", 1280, 860), "narrow": ("light", 400, 860)}
MOST_HEIGHT_PX = 1500
# Where a page that is longer than this ends in its picture: before a heading or a row, none of which is cut.
END_PX = """most => {
  const whole = document.documentElement.scrollHeight;
  const tops = [...document.querySelectorAll('main h2, main tr')].map(one => one.getBoundingClientRect().top + scrollY);
  return whole <= most ? whole : Math.floor(Math.max(...tops.filter(top => top <= most)));
}"""
READY_WITHIN_S = 60.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Take all pictures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("demo", type=Path, help="folder that 'mrasfm demo --out DEMO' made")
    parser.add_argument("--out", type=Path, default=KEPT, help="folder of the pictures (default: docs/images/console)")
    parser.add_argument("--look", type=Path, metavar="DIR", help="take them in all sizes, whole pages, into DIR")
    parser.add_argument("--only", nargs="*", metavar="PAGE", help="names of pages")
    options = parser.parse_args(arguments)
    key = (options.demo / "api-key").read_text().strip()
    found = chromium()
    if found is None:
        parser.error("no chromium in PATH: apt install chromium")
    with service(options.demo / "service") as url, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
        for name in SIZES if options.look else ("light",):
            folder = options.look / name if options.look else options.out
            for page, size_bytes in pictures(
                browser, url, key, folder, name, whole=bool(options.look), only=options.only
            ):
                print(f"{folder / page}.png: {size_bytes / 1000:.0f} kB")
        browser.close()
    return 0


@contextmanager
def service(data: Path, *, python: str | Path = sys.executable, cwd: Path | None = None) -> Iterator[str]:
    """The service over a data folder, on a free port; its address."""
    with closing(socket.socket()) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    argv = [python, "-P", "-m", "service", "standalone", "--data", data, "--port", str(port)]
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    if cwd is not None:  # an installation: nothing of these sources
        del environment["PYTHONPATH"]
    process = subprocess.Popen(argv, cwd=cwd, env=environment, **quiet)
    url = f"http://127.0.0.1:{port}"
    try:
        until_s = time.monotonic() + READY_WITHIN_S
        while not _is_ready(url):
            if process.poll() is not None or time.monotonic() > until_s:
                raise SystemExit(f"the service over {data} did not start: see its logs there")
            time.sleep(0.2)
        yield url
    finally:
        process.terminate()
        process.wait(60)


def _is_ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz", trust_env=False).is_success
    except httpx.TransportError:
        return False


def addresses(url: str, key: str) -> dict[str, str]:
    """All pages by name, of the newest scene and map."""

    def newest(what: str, **fields: str) -> dict[str, Any]:
        headers = {"Authorization": f"Bearer {key}"}
        items = httpx.get(f"{url}/v1/{what}", headers=headers, trust_env=False).json()["items"]
        for item in items:
            if fields.items() <= item.items():
                return dict(item)
        raise SystemExit(f"the service has none of: {what}. Give the folder of a finished 'mrasfm demo'.")

    scene, of_map, drive = newest("scenes"), newest("maps"), newest("drives")
    aggregation = newest("jobs", kind="AGGREGATION")
    scene_page, map_page = f"scenes/{scene['id']}", f"maps/{of_map['id']}"
    return {
        "drives": "drives",
        "drive": f"drives/{drive['id']}",
        "upload": "upload",
        "jobs": "jobs",
        "job": f"jobs/{aggregation['id']}",
        "scenes": "scenes",
        "scene": scene_page,
        "scene-3d": f"{scene_page}/3d",
        "scene-map": f"{scene_page}/place",
        "calibration": f"{scene_page}/calibration",
        "scene-files": f"{scene_page}/files",
        "scene-exports": f"{scene_page}/files",
        "maps": "maps",
        "map": map_page,
        "map-3d": f"{map_page}/3d",
        "map-map": f"{map_page}/place",
        "seams": f"{map_page}/seams",
        "map-calibration": f"{map_page}/calibration",
        "versions": f"{map_page}/versions",
        "map-files": f"{map_page}/files",
        "status": "status",
        "key": "keys",
    }


def pictures(
    browser: Browser, url: str, key: str, folder: Path, size: str, *, whole: bool, only: Sequence[str] | None
) -> Iterator[tuple[str, int]]:
    """Take the pictures of one size; name and bytes of each."""
    scheme, width, height = SIZES[size]
    context = browser.new_context(color_scheme=scheme, viewport={"width": width, "height": height})
    page = context.new_page()
    page.goto(url)
    page.get_by_label("API key").wait_for()
    folder.mkdir(parents=True, exist_ok=True)
    yield "login", keep(page, folder / "login.png", whole)
    log_in(page, url, key)
    for name, address in addresses(url, key).items():
        if only and name not in only:
            continue
        go(page, url, address)
        if name == "scene-exports":  # they are below the files
            page.get_by_label("Find a file").fill("points.")
        _let_load(page)
        yield name, keep(page, folder / f"{name}.png", whole)
    context.close()


def _let_load(page: Page) -> None:
    """Wait for points, tiles and pictures, and pick a camera in the 3D view."""
    if page.locator(".canvas").count():
        page.locator("[data-idle=true]").wait_for(timeout=60_000)
        page.get_by_text("Choose an image without the mouse").click()
        page.get_by_role("button", name="Show", exact=True).click()
        page.locator("[data-observations]:not([data-observations=''])").wait_for()
        page.get_by_text("Choose an image without the mouse").click()
        page.get_by_role("button", name="Show all").click()
        page.locator("[data-idle=true]").wait_for(timeout=60_000)
    for image in page.locator("main img").all():
        image.scroll_into_view_if_needed()
    page.evaluate("window.scrollTo(0, 0)")
    page.wait_for_timeout(700)


def keep(page: Page, path: Path, whole: bool) -> int:
    """Write what is seen as a PNG with few colours, which is small; its bytes."""
    picture = Image.open(io.BytesIO(page.screenshot(full_page=True))).convert("RGB")
    if not whole:
        picture = picture.crop((0, 0, picture.width, page.evaluate(END_PX, MOST_HEIGHT_PX)))
    for colors in COLORS:
        stream = io.BytesIO()
        picture.quantize(colors, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
        if stream.tell() <= MOST_BYTES:
            break
    path.write_bytes(stream.getvalue())
    return stream.tell()


if __name__ == "__main__":
    sys.exit(main())
