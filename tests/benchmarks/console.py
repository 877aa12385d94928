"""Line 38: the web console: a cloud of five million points as it streams, and the wheel in an environment of its own."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from playwright.sync_api import Browser, Page, sync_playwright

from mrasfm_engine.export.copc import in_reference_system, offset_of, write_copc
from mrasfm_engine.export.scene import write_scene
from schemas.artifacts import COPC_FILE, VIEW_FILE
from tests.benchmarks.table import Figure, exactly, failed
from tests.console.conftest import ARGUMENTS, chromium, viewing
from tests.helpers.export_example import make_scene, street_of_points

LINE = "38"
POINTS = 5_000_000
STREET_M, BEGIN_M = 600.0, -80.0
FIRST_MS, FIRST_BYTES = 3000.0, 2e6
MOST_SHARE, MOST_MEMORY_BYTES, MOST_DELAY_MS = 0.4, 1e9, 100.0
INPUT_EVERY_MS = 40
IDLE_WITHIN_S = 180.0

# Noted in the page: what of the cloud was there when, tasks that hold the page up, and how long inputs wait.
NOTES = """() => {
  const notes = { first: null, tasks: [], inputs: [] };
  window.notes = notes;
  new PerformanceObserver(list => list.getEntries().forEach(e => notes.tasks.push(e.duration))).observe({ type: 'longtask' });
  new PerformanceObserver(list => list.getEntries().forEach(e => notes.inputs.push(e.processingEnd - e.startTime)))
    .observe({ type: 'event', durationThreshold: 16 });
  const look = () => {
    const figures = document.querySelector('.figures');
    if (figures && notes.first === null && Number(figures.dataset.shown) > 0)
      notes.first = { ms: performance.now(), bytes: Number(figures.dataset.bytes) };
    if (notes.first === null) requestAnimationFrame(look);
  };
  look();
}"""


def console(data: Path, work: Path) -> Iterator[Figure]:
    """Line 38."""
    found = chromium()
    if found is None:
        yield failed(LINE, "the console in a browser", "no chromium in PATH: apt install chromium")
        return
    folder = street(work / "street")
    with viewing(folder) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
        yield from _streaming(browser, address, (folder / COPC_FILE).stat().st_size)
        browser.close()


def street(folder: Path) -> Path:
    """A scene's folder with the points of a street, and the vehicle's trajectory along all of it."""
    write_scene(make_scene(), folder, {"engine_version": "1.0", "stages": [], "findings": []})
    scene = street_of_points(POINTS)
    write_copc(scene, folder / COPC_FILE)
    along = np.linspace(BEGIN_M, BEGIN_M + STREET_M, 121)
    track = np.column_stack([along, 30 * np.sin(along / 90), np.full(len(along), 1.5)])
    view = json.loads((folder / VIEW_FILE).read_text())
    offset_m = offset_of(scene)
    view["offset_m"] = offset_m.tolist()
    view["scenes"][0] |= {"trajectory_m": (in_reference_system(scene, track) - offset_m).tolist(), "images": []}
    (folder / VIEW_FILE).write_text(json.dumps(view))
    return folder


def _streaming(browser: Browser, address: str, file_bytes: int) -> Iterator[Figure]:
    figure = partial(Figure, line=LINE)
    page = browser.new_context(viewport={"width": 1280, "height": 900}).new_page()
    page.set_default_timeout(IDLE_WITHIN_S * 1000)
    page.add_init_script(f"({NOTES})()")
    page.goto(address)
    page.locator(".canvas canvas").wait_for()
    with_input(page, lambda: is_idle(page))
    notes = page.evaluate("window.notes")
    yield figure(what="first of 5 million points: time", value=notes["first"]["ms"], unit="ms", most=FIRST_MS)
    yield figure(what="first of 5 million points: read", value=notes["first"]["bytes"] / 1e6, unit="MB", most=FIRST_BYTES / 1e6)
    whole = figures(page)
    yield figure(what="the whole street in view: points", value=whole["shown"], above=100_000, most=POINTS)
    yield figure(what="the whole street in view: share of the file", value=whole["bytes"] / file_bytes)
    page.evaluate("document.querySelector('.canvas canvas').scene3d.lookAlong(0.45, 0.55)")
    print(notes, whole, memory_bytes(browser) / 1e6)


def figures(page: Page) -> dict[str, float]:
    data = page.locator(".figures").evaluate("e => ({...e.dataset})")
    return {name: float(data[name]) for name in ("shown", "total", "bytes")}


def is_idle(page: Page) -> bool:
    return page.locator(".figures").get_attribute("data-idle") == "true"
