"""Line 38: the web console: five million points as they stream, and the console of the wheel."""

from __future__ import annotations

import json
import re
import shutil
import sys
import time
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import httpx
import numpy as np
import psutil
from playwright.sync_api import Browser, Page, sync_playwright

from mrasfm_engine.export.copc import in_reference_system, offset_of, write_copc
from mrasfm_engine.export.scene import write_scene
from schemas.artifacts import COPC_FILE, REPORT_PAGE, VIEW_FILE
from tests.benchmarks.commands import CommandFailed, mrasfm
from tests.benchmarks.export_formats import run_apart
from tests.benchmarks.table import Figure, exactly, failed
from tests.console.conftest import ARGUMENTS, chromium, log_in, viewing
from tests.console.screenshots import service
from tests.helpers.export_example import make_scene, street_of_points
from tests.helpers.live_api import REPOSITORY

LINE = "38"
STATIC = "service/console/static/"
POINTS = 5_000_000
STREET_M, BEGIN_M = 600.0, -80.0
FIRST_MS, FIRST_BYTES = 3000.0, 2e6
MOST_SHARE, MOST_MEMORY_BYTES, MOST_DELAY_MS = 0.4, 1e9, 100.0
CAMERAS, UNITS, SIZE = 6, 20, ("--width", 640, "--height", 360)
TURNED, TURNED_BY_DEG = "front_left", 3.0
INPUT_EVERY_MS, MIN_INPUTS = 20, 20
LOADED_WITHIN_S = 120.0

# What the page notes of itself: when the first points were drawn, tasks that hold it up, and how long inputs wait.
NOTES = """(() => {
  const notes = { first: null, longest_ms: 0, inputs: 0, waited_ms: 0, waited_at_ms: 0 };
  window.notes = notes;
  new PerformanceObserver(list => {
    for (const one of list.getEntries()) notes.longest_ms = Math.max(notes.longest_ms, one.duration);
  }).observe({ type: 'longtask' });
  for (const kind of ['pointermove', 'keydown'])
    addEventListener(kind, event => {
      notes.inputs += 1;
      const waited = performance.now() - event.timeStamp;
      if (waited > notes.waited_ms) Object.assign(notes, { waited_ms: waited, waited_at_ms: event.timeStamp });
    }, true);
  const look = () => {
    const figures = document.querySelector('.figures');
    if (figures && Number(figures.dataset.shown) > 0)
      notes.first = { ms: performance.now(), bytes: Number(figures.dataset.bytes) };
    else requestAnimationFrame(look);
  };
  look();
})()"""
LOOK = """([begin, end]) => {
  const scene = document.querySelector('.canvas canvas').scene3d, track = scene.view.scenes[0].trajectory_m;
  const part = track.slice(Math.round(begin * track.length), Math.round(end * track.length));
  scene.lookAt(part, scene.camera.position.clone().set(0, -0.001, 1));
}"""
PARTS = {"dense end": (0.0, 0.1), "middle": (0.45, 0.55)}


def console(data: Path, work: Path) -> Iterator[Figure]:
    """Line 38."""
    found = chromium()
    if found is None:
        yield failed(LINE, "the console in a browser", "no chromium in PATH: apt install chromium")
        return
    folder = street(work / "street")
    with viewing(folder) as address, sync_playwright() as playwright:
        for part, ends in PARTS.items():  # in a browser of its own: the end of another's page takes the same cores
            browser = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
            yield from _streaming(browser, address, folder, part, ends)
            browser.close()


def turned_camera(data: Path, work: Path) -> Iterator[Figure]:
    """A drive rendered with one camera turned: page and report flag this camera and no other."""
    found = chromium()
    if found is None:
        yield failed(LINE, "a turned camera in the browser", "no chromium in PATH: apt install chromium")
        return
    drive, scene = work / "turned", work / "turned, scene"
    mrasfm(
        "synth", "--cameras", CAMERAS, "--units", UNITS, "--seed", 1, "--no-masks", *SIZE,
        "--miscalibrated-camera", TURNED, "--miscalibrated-by-deg", TURNED_BY_DEG, "--out", drive,
    )  # fmt: skip
    mrasfm("reconstruct", drive, "--out", scene)
    with viewing(scene) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
        page = browser.new_page()
        for what, target in (
            ("page", address.replace("/3d", "/calibration")),
            ("report", (scene / REPORT_PAGE).as_uri()),
        ):
            page.goto(target)
            page.locator("[data-corrections=rotation]").wait_for()
            title = f"{TURNED} turned by {TURNED_BY_DEG:g} deg, {what}"
            flagged = page.locator("[data-corrections=rotation] tr[data-wrong=true]")
            names = flagged.evaluate_all("rows => rows.map(row => row.dataset.camera)")
            yield exactly(LINE, f"{title}: flagged", int(TURNED in names), 1)
            yield exactly(LINE, f"{title}: others flagged + 1", 1 + len(set(names) - {TURNED}), 1)
            said = page.get_by_text(re.compile(f"not mounted as given: {TURNED}$", re.IGNORECASE))
            yield exactly(LINE, f"{title}: said in words", int(said.count() > 0), 1)
            values = flagged.first.locator("[data-value]").evaluate_all("all => all.map(one => +one.dataset.value)")
            turned_deg = float(np.linalg.norm(values))
            yield Figure(
                line=LINE, what=f"{title}: correction shown", value=turned_deg, unit="deg",
                above=TURNED_BY_DEG - 0.3, most=TURNED_BY_DEG + 0.3,
            )  # fmt: skip
        browser.close()


def wheel(data: Path, work: Path) -> Iterator[Figure]:
    """The wheel in an environment of its own, from the lock, far from the sources."""
    dist, environment, elsewhere = work / "dist", work / "environment", work / "elsewhere"
    elsewhere.mkdir()
    sources = work / "sources"  # without what an earlier build left, which setuptools would pack again
    left = shutil.ignore_patterns(".git", ".venv", "build", "dist", "demo", "node_modules", "*.egg-info", "__pycache__")
    shutil.copytree(REPOSITORY, sources, ignore=left)
    try:
        build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", dist]
        run_apart([*build, sources], elsewhere)
        (built,) = dist.glob("mrasfm-*.whl")
        run_apart([sys.executable, "-m", "venv", environment], elsewhere)
        pip = [environment / "bin" / "python", "-m", "pip", "install", "--quiet"]
        run_apart([*pip, "--require-hashes", "-r", REPOSITORY / "requirements-runtime.lock"], elsewhere)
        run_apart([*pip, "--no-deps", built], elsewhere)
    except CommandFailed as error:
        yield failed(LINE, "the wheel in an environment of its own", str(error))
        return
    python, folder = environment / "bin" / "python", elsewhere / "data"
    keys = [python, "-P", "-m", "service", "keys", "--data", folder, "create", "--name", "wheel"]
    key = run_apart(keys, elsewhere).strip()
    with service(folder, python=python, cwd=elsewhere) as url:
        with zipfile.ZipFile(built) as archive:
            shipped = [name for name in archive.namelist() if name.startswith(STATIC)]
            static = {name.removeprefix(STATIC): archive.read(name) for name in shipped}
        page = httpx.get(url, trust_env=False)
        yield exactly(LINE, "wheel: status of /", page.status_code, 200)
        got = {name: httpx.get(f"{url}/console/files/{name}", trust_env=False) for name in static}
        same = [name for name, answer in got.items() if answer.status_code == 200 and answer.content == static[name]]
        yield exactly(LINE, "wheel: files of the console that are served as they were packed", len(same), len(static))
        committed = {path.name for path in (REPOSITORY / STATIC).iterdir()}
        yield exactly(LINE, "wheel: files of the console, none left out or stale", len(static), len(committed))
        yield from _logged_in(url, key)


def _logged_in(url: str, key: str) -> Iterator[Figure]:
    found = chromium()
    if found is None:
        yield failed(LINE, "wheel: the console in a browser", "no chromium in PATH: apt install chromium")
        return
    faults: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
        page = browser.new_page()
        page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("requestfailed", lambda request: faults.append(request.url))
        log_in(page, url, key)
        page.get_by_text("No drive yet.").wait_for()
        yield exactly(LINE, "wheel: the page of drives is there, without a fault", 1 + len(faults), 1)
        browser.close()


def street(folder: Path) -> Path:
    """A scene's folder with the points of a street, and the vehicle's trajectory along all of it."""
    write_scene(make_scene(), folder, {"engine_version": "1.0", "stages": [], "findings": []})
    scene = street_of_points(POINTS)
    write_copc(scene, folder / COPC_FILE)
    along = np.linspace(BEGIN_M, BEGIN_M + STREET_M, 121)
    track = np.column_stack([along, 30 * np.sin(along / 90), np.full(len(along), 1.5)])
    view, offset_m = json.loads((folder / VIEW_FILE).read_text()), offset_of(scene)
    view["offset_m"] = offset_m.tolist()
    view["scenes"][0] |= {"trajectory_m": (in_reference_system(scene, track) - offset_m).tolist(), "images": []}
    (folder / VIEW_FILE).write_text(json.dumps(view))
    return folder


def _streaming(browser: Browser, address: str, folder: Path, part: str, ends: tuple[float, float]) -> Iterator[Figure]:
    """Open the scene, look at all of it, then at a tenth of the street from above."""
    figure, file_bytes = partial(Figure, line=LINE), (folder / COPC_FILE).stat().st_size
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    page.add_init_script(NOTES)
    page.goto(address)
    page.locator(".canvas canvas").wait_for()
    _load(page)
    first = page.evaluate("window.notes.first")
    what = f"5 million points, {part}"
    yield figure(what=f"{what}: first points after", value=first["ms"], unit="ms", most=FIRST_MS)
    yield figure(what=f"{what}: read until then", value=first["bytes"] / 1e6, unit="MB", most=FIRST_BYTES / 1e6)
    whole = _figures(page)
    yield exactly(LINE, f"{what}: points that the page counts", int(whole["total"]), POINTS)
    yield figure(what=f"{what}: share of the file that the whole street needs", value=whole["bytes"] / file_bytes)
    page.evaluate(LOOK, list(ends))
    page.wait_for_timeout(100)
    seconds = _load(page)
    near = _figures(page)
    yield figure(what=f"{what}: points in view", value=near["shown"], above=whole["shown"], most=POINTS)
    yield figure(what=f"{what}: time to load them", value=seconds, unit="s")
    yield figure(what=f"{what}: share of the file that was read", value=near["bytes"] / file_bytes, most=MOST_SHARE)
    notes = page.evaluate("window.notes")
    yield figure(what=f"{what}: inputs that were measured", value=notes["inputs"], above=MIN_INPUTS - 1, most=1e6)
    yield figure(
        what=f"{what}: longest wait of an input",
        value=notes["waited_ms"],
        unit="ms",
        most=MOST_DELAY_MS,
        remark=f"at {notes['waited_at_ms']:.0f} ms",
    )
    yield figure(what=f"{what}: longest task of the page", value=notes["longest_ms"], unit="ms", above=-1)
    page_bytes, card_bytes = _memory_bytes()
    most = MOST_MEMORY_BYTES / 1e6
    yield figure(what=f"{what}: memory of the page", value=page_bytes / 1e6, unit="MB", most=most)
    yield figure(what=f"{what}: memory of what stands for a graphics card", value=card_bytes / 1e6, unit="MB")
    context.close()


def _load(page: Page) -> float:
    """Wait until nothing is loaded any more, while the pointer moves and a key is pressed; seconds."""
    box = page.locator(".canvas").bounding_box()
    assert box is not None
    began_s = time.monotonic()
    for step in range(round(LOADED_WITHIN_S * 1000 / INPUT_EVERY_MS)):
        page.mouse.move(box["x"] + 50 + 7 * step % 600, box["y"] + 60)
        page.keyboard.press("Shift")
        page.wait_for_timeout(INPUT_EVERY_MS)
        if step > 5 and page.locator(".figures").get_attribute("data-idle") == "true":
            return time.monotonic() - began_s
    raise AssertionError(f"the points were not loaded within {LOADED_WITHIN_S} s")


def _figures(page: Page) -> dict[str, float]:
    data = page.locator(".figures").evaluate("e => ({...e.dataset})")
    return {name: float(data[name]) for name in ("shown", "total", "bytes")}


def _memory_bytes() -> tuple[int, int]:
    """Of the largest of the browser's pages with its workers, and of the process that computes what a card would."""
    pages, cards = [0], [0]
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            kind = next((part for part in process.cmdline() if part.startswith("--type=")), "")
            if kind == "--type=renderer":
                pages.append(process.memory_full_info().uss)
            if kind == "--type=gpu-process":
                cards.append(process.memory_full_info().uss)
    return max(pages), max(cards)
