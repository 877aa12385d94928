"""A map of seven drives as a team gets it: over HTTP, with two workers, of which one is killed, and a broken drive."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import psutil
import pytest

from mrasfm_engine.synthetic.drive_writer import render_drives
from mrasfm_engine.synthetic.options import SynthOptions
from schemas.api.aggregations import AggregationRequest
from schemas.api.jobs import JobResource
from schemas.api.maps import MapFileResource, MapVersionResource
from service.client import Client, DriveFolder, UploadState, download, start_aggregation, upload_drive
from service.database.tables import Project
from service.domain.keys import create_key
from tests.helpers.live_api import ApiProcess, api_process
from tests.helpers.service_world import TERMINAL, World, environment_of, kill, wait_until

DRIVES, BROKEN = 7, 4
UNITS, CAMERAS = 24, 4  # drives so long that their positions place them
CUT_BYTES = 2000
WITHIN_S = 1500.0  # on a machine that does other things too

pytestmark = pytest.mark.slow


@pytest.fixture
def folders(tmp_path: Path) -> list[Path]:
    """Seven drives along one street; the images of one end early."""
    options = SynthOptions(
        cameras=CAMERAS, units=UNITS, seed=7, drives=DRIVES, width=480, height=270, texture_px=256, masks=False
    )
    drives = render_drives(options, tmp_path / "drives")
    for image in (drives[BROKEN] / "images").rglob("*.jpg"):
        image.write_bytes(image.read_bytes()[:-CUT_BYTES])
    return drives


@pytest.fixture
def api(world: World, tmp_path: Path) -> Iterator[ApiProcess]:
    """The API of the workers' installation."""
    with api_process(world.settings, tmp_path, **environment_of(world.settings)) as started:
        yield started


@pytest.fixture
def key(world: World) -> str:
    with world.database.write() as session:
        return create_key(session, session.get_one(Project, world.project_id), "test")[1]


@pytest.fixture
def client(api: ApiProcess, key: str) -> Iterator[Client]:
    with Client(api.url, key, connections=DRIVES * 2) as opened:
        yield opened


@pytest.fixture
def plain(api: ApiProcess, key: str) -> Iterator[httpx.Client]:
    """Of downloads, without what the library does for one."""
    with httpx.Client(base_url=api.url, headers={"Authorization": f"Bearer {key}"}, timeout=60) as opened:
        yield opened


def test_seven_drives_become_one_version(
    world: World, client: Client, plain: httpx.Client, folders: list[Path], tmp_path: Path
) -> None:
    world.start_reconciler()
    workers = [world.start_worker(), world.start_worker()]
    with ThreadPoolExecutor(DRIVES) as pool:
        drive_ids = list(pool.map(lambda folder: sent(client, folder), folders))
    job = start_aggregation(client, AggregationRequest(drives=drive_ids, name="street"), state=None)
    assert [member.drive_id for member in job.members] == drive_ids
    wait_until(lambda: len(world.scenes()) >= 2, lambda: told(world, job), within_s=WITHIN_S)
    lost = kill_at_work(world, workers[0].pid, job)
    wait_until(lambda: client.job(job.id).state in TERMINAL, lambda: told(world, job), within_s=WITHIN_S)

    ended = client.job(job.id)
    assert (ended.state, ended.map_version, ended.progress.percent) == ("SUCCEEDED", 1, 100), told(world, job)
    assert len(world.attempts(lost)) == 2, "what the killed worker did was done by the other"
    assert sorted(scene.drive_id for scene in world.scenes()) == sorted(set(drive_ids) - {drive_ids[BROKEN]})
    assert ended.map_id is not None
    version = client.map_version(ended.map_id, 1)
    assert (version.summary.scenes, version.summary.connected, version.unconnected) == (DRIVES - 1, DRIVES - 1, [])
    assert version.summary.registered_units == (DRIVES - 1) * UNITS
    (failed,) = version.failed
    assert failed.drive_id == drive_ids[BROKEN]
    assert f"-{BROKEN}-" in failed.name, "as the drive is called, in letters that a file's name may have"
    assert "jpg" in failed.problem.detail
    for file in wanted(version):
        assert_downloads(plain, file)
    out = tmp_path / "map"
    download(client, version, out)
    assert {file.path for file in version.files} <= {p.relative_to(out).as_posix() for p in out.rglob("*")}


def sent(client: Client, folder: Path) -> str:
    drive = DriveFolder.read(folder)
    return upload_drive(client, drive, state=UploadState(drive, client.url)).drive_id


def kill_at_work(world: World, worker: int, job: JobResource) -> str:
    """Kill a worker and what holds its job, once it is at work; the job."""
    ids = [job.id, *(str(member.job_id) for member in job.members)]
    held: dict[str, int] = {}

    def works() -> bool:
        held.clear()
        for found in map(world.job, ids):
            process = int(found.owner.rpartition(":")[2]) if found.owner is not None else 0
            if found.state == "RUNNING" and process and started_by(worker, process):
                held[found.id] = process
        return bool(held)

    wait_until(works, "the worker's work", within_s=WITHIN_S)
    (job_id, holder), *_ = held.items()
    for process in (worker, holder):
        kill(process)
    return job_id


def started_by(worker: int, process: int) -> bool:
    try:
        return worker in {parent.pid for parent in psutil.Process(process).parents()} | {process}
    except psutil.NoSuchProcess:
        return False


def wanted(version: MapVersionResource) -> list[MapFileResource]:
    """What a team downloads of a map."""
    files = [file for file in version.files if file.path in {"points.ply", "poses.json", "poses.tum", "frame.json"}]
    calibration = [file for file in version.files if file.path.startswith("calibration/")]
    assert (len(files), len(calibration)) == (4, DRIVES - 1), [file.path for file in version.files]
    return [*files, *calibration]


def assert_downloads(client: httpx.Client, file: MapFileResource) -> None:
    """Whole, in two parts, and not at all where it is there."""
    whole = client.get(file.url)
    assert (whole.status_code, hashlib.sha256(whole.content).hexdigest()) == (200, file.sha256)
    etag, middle = whole.headers["etag"], file.size_bytes // 2
    parts = [
        client.get(file.url, headers={"Range": f"bytes={asked}", "If-Range": etag})
        for asked in (f"0-{middle - 1}", f"{middle}-")
    ]
    assert [part.status_code for part in parts] == [206, 206]
    assert b"".join(part.content for part in parts) == whole.content
    assert client.get(file.url, headers={"If-None-Match": etag}).status_code == 304


def told(world: World, job: JobResource) -> str:
    states = {member.job_id: world.job(str(member.job_id)).state for member in job.members}
    return f"{world.job(job.id).state} {world.job(job.id).problem} {states}\n{world.log()[-3000:]}"
