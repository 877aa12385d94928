"""A browser, and a project with drives, scenes and a map to look at."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Route, sync_playwright
from sqlalchemy import select

from mrasfm_engine.export.picture_files import png_of
from mrasfm_engine.export.scene import write_scene
from schemas.api.problems import Problem
from schemas.drive import DriveManifest
from service.database.tables import Drive, MapVersion, Scene
from service.domain import jobs
from tests.helpers.export_example import make_scene
from tests.helpers.live_api import ONE_ATTEMPT, REPOSITORY, Api, Client, api_in_thread, settings_of
from tests.helpers.tiny_drive import TinyDrive, png

VIEW = "import sys; from mrasfm_engine.cli import main; sys.exit(main())"
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
# Without a graphics card WebGL is computed; QUIC and the network's services are not asked for.
ARGUMENTS = [
    "--host-resolver-rules=MAP mrasfm.test 127.0.0.1",
    "--no-sandbox",
    "--disable-quic",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]
DEADLINE_MS = 20_000
VEHICLE = "test-car-7"


def chromium() -> str | None:
    """The system's chromium; None where there is none."""
    return next(filter(None, map(shutil.which, CHROMIUM)), None)


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """The system's chromium; skips where there is none, fails if MRASFM_REQUIRE_BROWSER is 1."""
    found = chromium()
    if found is None:
        message = "no chromium in PATH: apt install chromium"
        if os.environ.get("MRASFM_REQUIRE_BROWSER") == "1":
            pytest.fail(message)
        pytest.skip(message)
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
        yield running
        running.close()


@dataclass
class Watched:
    """A browser's context, and what went wrong in its pages."""

    context: BrowserContext
    url: str
    faults: list[str] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)
    expected: tuple[str, ...] = ()  # parts of faults that a test provokes

    def new_page(self) -> Page:
        page = self.context.new_page()
        page.set_default_timeout(DEADLINE_MS)
        page.on("console", self._note)
        page.on("pageerror", lambda error: self.faults.append(f"page error: {error}"))
        return page

    def _note(self, message: ConsoleMessage) -> None:
        if message.type == "error" and not any(part in message.text for part in self.expected):
            self.faults.append(f"console: {message.text} ({message.location.get('url')})")

    def route(self, route: Route) -> None:
        """Let no request leave this machine's service."""
        if route.request.url.startswith((self.url, "data:", "blob:", "file:")):
            route.continue_()
        else:
            self.foreign.append(route.request.url)
            route.abort()


MAP_FINDING = {
    "severity": "warning",
    "code": "drive-left-out",
    "what": "drive third has no scene",
    "remedy": "Look at its job.",
}

DRIVE_FINDING = {"severity": "warning", "code": "dark", "what": "an image is dark", "remedy": "Look at it."}


@dataclass(frozen=True, kw_only=True)
class World:
    """A project and what is in it."""

    api: Api
    client: Client
    folder: Path  # the scene's files
    drive_id: str
    scene_id: str
    map_id: str
    failed_job: str
    running_job: str

    @property
    def pages(self) -> dict[str, str]:
        scene, of_map = f"scenes/{self.scene_id}", f"maps/{self.map_id}"
        return {
            "drives": "drives",
            "drive": f"drives/{self.drive_id}",
            "upload": "upload",
            "jobs": "jobs",
            "failed job": f"jobs/{self.failed_job}",
            "running job": f"jobs/{self.running_job}",
            "scenes": "scenes",
            "scene": scene,
            "scene in 3D": f"{scene}/3d",
            "scene on the map": f"{scene}/place",
            "calibration": f"{scene}/calibration",
            "files": f"{scene}/files",
            "maps": "maps",
            "map": of_map,
            "map in 3D": f"{of_map}/3d",
            "map on the map": f"{of_map}/place",
            "seams": f"{of_map}/seams",
            "map's calibration": f"{of_map}/calibration",
            "versions": f"{of_map}/versions",
            "map's files": f"{of_map}/files",
            "status": "status",
            "key": "keys",
        }


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """A service with a drive, its scene, a map of two versions, a job that failed and one that runs."""
    folder = tmp_path_factory.mktemp("console")
    with api_in_thread(settings_of(folder / "data", project_max_active_jobs=50)) as api:
        yield _filled(api, api.client(), folder)


def example_drive(name: str) -> TinyDrive:
    """The drive that the example's scene is of, with gray images."""
    named = {"version": 2, "name": name, "vehicle": VEHICLE}
    document = make_scene().drive.manifest.model_copy(update=named).model_dump(mode="json", exclude_none=True)
    files = [image["file"] for frame in document["frames"] for image in frame["images"].values()]
    DriveManifest.model_validate(document)
    return TinyDrive(document, {path: png(960, 600, seed=f"{name} {path}") for path in files})


def _filled(api: Api, client: Client, folder: Path) -> World:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (200, 300, 3), dtype=np.uint8)
    names = ("birds_eye_before.png", "birds_eye_after.png", "road_before.png", "road_after.png")
    report = {"engine_version": "1.0", "stages": [{"stage": "mapping", "seconds": 2.5}], "findings": []}
    scene = make_scene()
    scene.calibration[1].__dict__["is_wrong"] = True
    write_scene(scene, folder / "scene", report, lambda: {name: png_of(noise) for name in names})
    files = {
        p.relative_to(folder / "scene").as_posix(): p.read_bytes() for p in (folder / "scene").rglob("*") if p.is_file()
    }
    drives = [client.frozen(example_drive(name)) for name in ("example", "other")]
    scene_ids = []
    for drive_id in drives:
        job = client.reconstruct(drive_id)
        scene_ids.append(client.publish(client.claim(job["id"]), files))
    map_files = {path: data for path, data in files.items() if not path.startswith("pictures/")}
    map_files |= {
        "map.json": json.dumps(_map_document()).encode(),
        "pictures/a.png": png_of(noise),
        "pictures/b.png": png_of(noise),
        "calibration/example.json": files["calibration.json"],
        "report.json": json.dumps({**json.loads(files["report.json"]), "findings": [MAP_FINDING]}).encode(),
    }
    job = client.aggregate(scenes=scene_ids, name="crossing")
    client.publish_map(client.claim(job["id"]), map_files)
    third = client.frozen(example_drive("third"))
    again = client.aggregate(map_id=job["map_id"], drives=[third])
    child = again["members"][-1]["job_id"]
    client.publish(client.claim(child), files)
    client.publish_map(client.claim(again["id"]), map_files, unconnected=("third",))
    with api.database.write() as session:  # the helpers' summary is of a scene without a place on the earth
        for row in (*session.scalars(select(Scene)), *session.scalars(select(MapVersion))):
            row.summary = {**row.summary, "georeferenced": True}
        session.get_one(Drive, drives[0]).findings = [DRIVE_FINDING]
    return World(
        api=api,
        client=client,
        folder=folder / "scene",
        drive_id=drives[0],
        scene_id=scene_ids[0],
        map_id=job["map_id"],
        failed_job=_failed(api, client, drives[1]),
        running_job=_running(client),
    )


def _failed(api: Api, client: Client, drive_id: str) -> str:
    job = client.reconstruct(drive_id)
    problem = Problem(
        type="urn:mrasfm:problem:engine-abort",
        title="The engine ended",
        status=None,
        detail="the process ended with signal 6",
        remedy="Report it with the end of the log.",
        log_tail="line one\nline two",
    )
    with api.database.write() as session:
        held = jobs.claim(session, job["id"], owner="worker@test", lease_us=60_000_000)
        assert held is not None
        jobs.fail(session, held, problem, limits=ONE_ATTEMPT, retry_delay_us=0)
    return str(job["id"])


def _running(client: Client) -> str:
    job = client.reconstruct(client.frozen(example_drive("running")))
    client.claim(job["id"])
    return str(job["id"])


def _map_document() -> dict[str, Any]:
    seam = {
        "a": "example",
        "b": "other",
        "accepted": True,
        "units_tried": 8,
        "units_agreeing": 7,
        "inliers": 7226,
        "residual_before_px": 51.42735919250217,
        "residual_after_px": 0.7316933881054083,
        "sigma_translation_m": 0.0004037270226296414,
        "sigma_rotation_deg": 0.0017833277732603437,
        "scale": 1.0179450682149156,
        "pictures": {"before": "pictures/a.png", "after": "pictures/b.png"},
    }
    rejected = {
        "a": "example",
        "b": "third",
        "accepted": False,
        "reason": "two hypotheses have a similar number of inliers",
    }
    return {"seams": [seam, rejected], "unconnected": ["third"], "left_out": []}


Open = Callable[..., Watched]


@pytest.fixture
def open_console(browser: Browser) -> Iterator[Open]:
    """A function that makes a fresh browser context; at the end no page has had a fault or asked another host."""
    opened: list[Watched] = []

    @contextmanager
    def closing() -> Iterator[None]:
        yield
        for watched in opened:
            watched.context.close()
            assert watched.faults == []
            assert watched.foreign == []

    def make(url: str, **options: Any) -> Watched:
        watched = Watched(browser.new_context(base_url=url, **options), url)
        watched.context.route("**/*", watched.route)
        opened.append(watched)
        return watched

    with closing():
        yield make


def log_in(page: Page, url: str, key: str) -> None:
    """As a user does."""
    page.goto(url)
    page.get_by_label("API key").fill(key)
    page.get_by_role("button", name="Log in").click()
    page.get_by_role("heading", name="Drives").wait_for()


def go(page: Page, url: str, address: str) -> None:
    """Open a page of the console, and wait until nothing of it loads any more."""
    page.goto(f"{url}/#/{address}")
    page.locator("main h1").wait_for()
    wait_for(page, "!document.querySelector('[aria-busy=true]')")


def wait_for(page: Page, condition: str) -> None:
    """Wait until an expression is true. Playwright's own way evaluates text in the page, which its policy forbids."""
    end_s = time.monotonic() + DEADLINE_MS / 1000
    while not page.evaluate(condition):
        assert time.monotonic() < end_s, condition
        page.wait_for_timeout(50)


@contextmanager
def viewing(*arguments: str | Path) -> Iterator[str]:
    """The address that the command prints; Ctrl-C ends it well."""
    command = [sys.executable, "-P", "-c", VIEW, "view", *map(str, arguments), "--no-browser"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert process.stdout is not None
        found = re.search(r"http://\S+", process.stdout.readline())
        assert found is not None
        yield found[0].rstrip(";")
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
    finally:
        process.kill()
        process.communicate()
