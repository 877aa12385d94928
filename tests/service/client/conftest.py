"""Drives in folders, and the library's client of a project."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from schemas.api.problems import PROBLEM_TYPE, Problem
from service.client import Client
from service.database.tables import Job
from service.domain import exports, jobs
from tests.helpers.live_api import ONE_ATTEMPT, SCENE_FILES
from tests.helpers.live_api import Client as TestClient
from tests.helpers.tiny_drive import TinyDrive, tiny_drive

MAP_FILES = {"points.ply": b"ply" * 1000, "calibration/a.json": b"{}", "map.json": b"{}", "report.json": b"{}"}
BROKEN = Problem(type=PROBLEM_TYPE + "no-overlap", title="T", detail="it broke", remedy="Look.", retryable=False)

EXPORT_FILES = {"kitti/poses.txt": b"1 0 0\n", "report.json": b"{}"}

WriteTiny = Callable[..., Path]
Connect = Callable[..., Client]


def written(drive: TinyDrive, folder: Path) -> Path:
    """A drive as a folder."""
    for path, data in drive.files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    (folder / "drive.json").write_bytes(drive.raw)
    return folder


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A sound drive of six small images, whose contents no other test has."""
    return written(tiny_drive(seed=tmp_path.name), tmp_path / "drive")


@pytest.fixture
def connect() -> Iterator[Connect]:
    """A function that makes a library client of a test client's project."""
    with ExitStack() as opened:

        def make(of: TestClient, *, url: str | None = None, retry_s: float = 30.0) -> Client:
            return opened.enter_context(Client(url or of.api.url, of.key, retry_s=retry_s))

        yield make


@pytest.fixture
def worker(client: TestClient) -> Iterator[Callable[[set[str]], None]]:
    """Does jobs of the client's project as they become due; drives of the names that it is given fail."""
    ended, broken = threading.Event(), set[str]()

    def work() -> None:
        while not ended.wait(0.05):
            with client.api.database.read() as session:
                due = [job.id for job in jobs.all_due(session)]
                mine = [j for j in session.query(Job).filter(Job.id.in_(due)) if j.project_id == client.project_id]
            for job in mine:
                held = client.claim(job.id)
                if job.kind == "AGGREGATION":
                    client.publish_map(held, MAP_FILES, unconnected=("d2",))
                elif job.kind == "PREFLIGHT":
                    with client.api.database.write() as session:
                        jobs.record_findings(session, held, [], sound=True)
                elif job.kind == "EXPORT":
                    stored = client._store(EXPORT_FILES)
                    with client.api.database.write() as session:
                        exports.publish(session, held, files=stored, results=[], expires_us=None)
                elif client.get(f"/v1/drives/{job.drive_id}").json()["name"] in broken:
                    with client.api.database.write() as session:
                        jobs.fail(session, held, BROKEN, limits=ONE_ATTEMPT, retry_delay_us=0)
                else:
                    client.publish(held, {**SCENE_FILES, "points.ply": job.id.encode()})

    thread = threading.Thread(target=work)
    thread.start()
    yield broken.update
    ended.set()
    thread.join()
