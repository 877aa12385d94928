"""The checks of the chaos benchmark find what they are for: each defect is made, and found under its name."""

from __future__ import annotations

import hashlib
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text

from schemas.api.problems import PROBLEM_TYPE, Problem
from service.database.tables import new_id
from service.domain import jobs
from tests.benchmarks.chaos import checks
from tests.benchmarks.chaos.checks import Findings
from tests.benchmarks.chaos.drives import Sendable
from tests.benchmarks.chaos.ledger import Ledger
from tests.benchmarks.chaos.processes import left_of
from tests.benchmarks.chaos.records import Records
from tests.helpers.live_api import ONE_ATTEMPT, Api, Client, api_in_thread, settings_of
from tests.helpers.tiny_drive import TinyDrive, tiny_drive

pytestmark = pytest.mark.slow  # a benchmark checks with them

FILES = {"points.ply": b"ply\n" * 100, "report.json": b"{}"}


class Accepted:
    """Two drives, their scenes and the map of both, as a client of the benchmark remembers them."""

    def __init__(self, client: Client) -> None:
        self.client, self.ledger = client, Ledger()
        self.drives = [tiny_drive(f"drive-{i}", seed=f"{client.project_id}{i}") for i in range(2)]
        self.drive_ids = [self._drive(drive) for drive in self.drives]
        self.job_ids = [self._scene(drive_id) for drive_id in self.drive_ids]
        scenes = client.get("/v1/scenes").json()["items"]
        self.scene_id = str(scenes[0]["id"])
        asked = client.aggregate(scenes=[scene["id"] for scene in scenes])
        self.map_id = str(asked["map_id"])
        client.publish_map(client.claim(asked["id"]), {**FILES, "map.json": b"[]"})
        self.ledger.accept_job(asked["id"], "AGGREGATION", self.drive_ids)

    def _drive(self, drive: TinyDrive) -> str:
        drive_id = self.client.frozen(drive)
        job_id = self.client.get(f"/v1/drives/{drive_id}").json()["preflight_job_id"]
        with self.client.api.database.write() as session:
            held = jobs.claim(session, job_id, owner="checker@test:1", lease_us=60_000_000)
            assert held is not None
            jobs.record_findings(session, held, [], sound=True)
        self.ledger.accept_drive(drive_id, Sendable(drive.manifest["name"], drive.raw, drive.files))
        return drive_id

    def _scene(self, drive_id: str) -> str:
        job_id = str(self.client.reconstruct(drive_id)["id"])
        self.client.publish(self.client.claim(job_id), FILES)
        self.ledger.accept_job(job_id, "RECONSTRUCTION", [drive_id])
        return job_id

    def findings(self) -> Findings:
        """What all checks find that need the API."""
        found, shown = Findings(), checks.shown_by(self.client)
        checks.check_drives(self.client, self.ledger, shown, found)
        checks.check_jobs(self.ledger, shown, found)
        checks.check_scenes(self.client, shown, found)
        checks.check_maps(self.client, self.ledger, shown, found)
        return found

    def stored_findings(self) -> Findings:
        """What all checks find that need the data folder."""
        found, data = Findings(), self.client.api.settings.data_dir
        checks.check_records(Records(data), found)
        checks.check_store(Records(data), data, self.ledger, found)
        return found

    def execute(self, statement: str, **values: Any) -> None:
        with self.client.api.database.write() as session:
            session.execute(text(statement), values)

    def spoil(self, url: str) -> None:
        """Change one byte of the object behind a download."""
        sha256 = hashlib.sha256(self.client.get(url).content).hexdigest()
        (path,) = [path for path in self.client.api.objects(self.client.project_id) if digest(path) == sha256]
        spoil(path)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def spoil(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.chmod(0o600)
    path.write_bytes(data)


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """Not the one that most tests share: what is spoilt here stays so."""
    with api_in_thread(settings_of(tmp_path_factory.mktemp("spoilt"))) as running:
        yield running


@pytest.fixture
def accepted(client: Client) -> Accepted:
    return Accepted(client)


def kinds(findings: Findings) -> set[str]:
    return {name for name, lines in vars(findings).items() if lines}


def test_what_is_as_accepted_has_no_findings(start_api: Callable[..., Api]) -> None:
    alone = Accepted(start_api().client())
    assert alone.findings() == Findings()
    assert alone.stored_findings() == Findings()


def lose_drive(world: Accepted) -> None:
    world.execute("UPDATE drives SET state = 'OPEN' WHERE id = :id", id=world.drive_ids[0])


def lose_file(world: Accepted) -> None:
    path = next(iter(world.drives[0].files))
    world.execute(
        "UPDATE drive_files SET blob_id = NULL WHERE drive_id = :id AND path = :path", id=world.drive_ids[0], path=path
    )


def lose_job(world: Accepted) -> None:
    world.ledger.accept_job("job_that_is_not_there", "RECONSTRUCTION", world.drive_ids[:1])


def lose_scene(world: Accepted) -> None:
    world.execute("DELETE FROM map_scenes WHERE scene_id = :id", id=world.scene_id)
    world.execute("DELETE FROM scenes WHERE id = :id", id=world.scene_id)


def lose_drive_of_map(world: Accepted) -> None:
    world.execute("DELETE FROM map_scenes WHERE scene_id = :id", id=world.scene_id)


def lose_check(world: Accepted) -> None:
    world.execute("DELETE FROM jobs WHERE kind = 'PREFLIGHT' AND drive_id = :id", id=world.drive_ids[0])


def create_drive_twice(world: Accepted) -> None:
    world.client.create(world.drives[0])


def create_and_not_commit(world: Accepted) -> None:
    world.ledger.create_drive(world.client.create(world.drives[0]))


def ask_twice(world: Accepted) -> None:
    job_id = world.client.reconstruct(world.drive_ids[0])["id"]
    world.client.publish(world.client.claim(job_id), FILES)


def publish_twice(world: Accepted) -> None:
    columns = "project_id, drive_id, name, fence, summary, created_us"
    new = new_id("scn")
    world.execute(
        f"INSERT INTO scenes (id, job_id, {columns}) SELECT :new, :job, {columns} FROM scenes WHERE id = :id",
        new=new,
        job=new_id("job"),
        id=world.scene_id,
    )
    columns = "path, blob_id, media_type"
    world.execute(
        f"INSERT INTO scene_files (scene_id, {columns}) SELECT :new, {columns} FROM scene_files WHERE scene_id = :id",
        new=new,
        id=world.scene_id,
    )


def leave_waiting(world: Accepted) -> None:
    job_id = str(world.client.reconstruct(world.drive_ids[0])["id"])
    world.ledger.accept_job(job_id, "RECONSTRUCTION", world.drive_ids[:1])


def fail_for_kills(world: Accepted) -> None:
    job_id = str(world.client.reconstruct(world.drive_ids[0])["id"])
    world.ledger.accept_job(job_id, "RECONSTRUCTION", world.drive_ids[:1])
    held = world.client.claim(job_id)
    problem = Problem(
        type=f"{PROBLEM_TYPE}worker-lost", title="Lost", detail="killed three times", remedy="none", retryable=True
    )
    with world.client.api.database.write() as session:
        jobs.fail(session, held, problem, limits=ONE_ATTEMPT, retry_delay_us=0)


def spoil_manifest(world: Accepted) -> None:
    world.spoil(f"/v1/drives/{world.drive_ids[0]}/manifest")


def send_other_bytes(world: Accepted) -> None:
    drive = world.drives[0]
    path = next(iter(drive.files))
    other = Sendable(drive.manifest["name"], drive.raw, {**drive.files, path: drive.files[path] + b"!"})
    world.ledger.accept_drive(world.drive_ids[0], other)


def spoil_scene(world: Accepted) -> None:
    world.spoil(f"/v1/scenes/{world.scene_id}/files/points.ply")


def spoil_map(world: Accepted) -> None:
    world.spoil(f"/v1/maps/{world.map_id}/versions/1/files/map.json")


@pytest.mark.parametrize(
    ("make", "found"),
    [
        (lose_drive, {"lost"}),
        (lose_file, {"lost"}),
        (lose_job, {"lost"}),
        (lose_scene, {"lost"}),
        (lose_drive_of_map, {"lost"}),
        (lose_check, {"lost"}),
        (create_drive_twice, {"twice"}),
        (create_and_not_commit, set()),
        (ask_twice, {"twice"}),
        (publish_twice, {"twice"}),
        (leave_waiting, {"stuck"}),
        (fail_for_kills, {"failed"}),
        (spoil_manifest, {"wrong_bytes"}),
        (send_other_bytes, {"wrong_bytes"}),
        (spoil_scene, {"wrong_bytes"}),
        (spoil_map, {"wrong_bytes"}),
    ],
)
def test_what_the_service_shows(accepted: Accepted, make: Callable[[Accepted], None], found: set[str]) -> None:
    make(accepted)
    assert kinds(accepted.findings()) == found


def tell_success_twice(world: Accepted) -> None:
    world.execute(
        "INSERT INTO job_events (job_id, kind, data, created_us) SELECT job_id, kind, data, created_us FROM job_events "
        "WHERE job_id = :id AND kind = 'state' ORDER BY id DESC LIMIT 1",
        id=world.job_ids[0],
    )


def succeed_twice(world: Accepted) -> None:
    columns = "job_id, attempt, owner, started_us, finished_us, outcome"
    world.execute(
        f"INSERT INTO job_attempts (fence, {columns}) SELECT 9, {columns} FROM job_attempts WHERE job_id = :id",
        id=world.job_ids[0],
    )


def tell_no_success(world: Accepted) -> None:
    world.execute("DELETE FROM job_events WHERE job_id = :id", id=world.job_ids[0])


def leave_attempt(world: Accepted) -> None:
    world.execute("UPDATE job_attempts SET finished_us = NULL, outcome = NULL WHERE job_id = :id", id=world.job_ids[0])


def spoil_image(world: Accepted) -> None:
    (first, *_) = world.drives[0].files.values()
    (path,) = [
        path
        for path in world.client.api.objects(world.client.project_id)
        if digest(path) == hashlib.sha256(first).hexdigest()
    ]
    spoil(path)


def lose_object(world: Accepted) -> None:
    world.client.api.objects(world.client.project_id)[0].unlink()


def refer_to_nothing(world: Accepted) -> None:
    with closing(sqlite3.connect(Records(world.client.api.settings.data_dir).path)) as connection, connection:
        changed = "UPDATE drive_files SET blob_id = 'nothing' WHERE drive_id = ?"
        connection.execute(changed, (world.drive_ids[0],))


@pytest.mark.parametrize(
    ("make", "found"),
    [
        (tell_success_twice, {"twice"}),
        (succeed_twice, {"twice"}),
        (tell_no_success, {"lost"}),
        (leave_attempt, {"stuck"}),
        (spoil_image, {"wrong_bytes"}),
        (lose_object, {"lost"}),
        (refer_to_nothing, {"damaged"}),
    ],
)
def test_what_is_on_the_disk(accepted: Accepted, make: Callable[[Accepted], None], found: set[str]) -> None:
    before = vars(accepted.stored_findings())  # what earlier tests spoilt
    make(accepted)
    after = vars(accepted.stored_findings())
    assert {name for name in after if set(after[name]) - set(before[name])} == found


def test_a_file_under_other_bytes_is_compared_with_what_was_sent(accepted: Accepted) -> None:
    """Two files of one drive that took each other's bytes: records and objects agree, and both are wrong."""
    first, second = list(accepted.drives[0].files)[:2]
    rows = Records(accepted.client.api.settings.data_dir).rows(
        "SELECT path, blob_id FROM drive_files WHERE drive_id = ?", accepted.drive_ids[0]
    )
    blobs = dict(rows)
    for path, blob_id in ((first, blobs[second]), (second, blobs[first])):
        accepted.execute(
            "UPDATE drive_files SET blob_id = :blob WHERE drive_id = :id AND path = :path",
            blob=blob_id,
            id=accepted.drive_ids[0],
            path=path,
        )
    found = accepted.stored_findings().wrong_bytes
    assert sum(accepted.drive_ids[0] in line for line in found) == 2


def test_a_damaged_database(accepted: Accepted, tmp_path: Path) -> None:
    source = Records(accepted.client.api.settings.data_dir)
    with closing(sqlite3.connect(source.path)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    copy = tmp_path / "copy"
    copy.mkdir()
    target = Path(shutil.copy(source.path, copy / source.path.name))
    sound, found = Findings(), Findings()
    checks.check_records(Records(copy), sound)
    data = bytearray(target.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 8192] = bytes(8192)
    target.write_bytes(data)
    checks.check_records(Records(copy), found)
    assert set(found.damaged) - set(sound.damaged)


def test_files_that_are_left(tmp_path: Path) -> None:
    kept = [f"spool/{'0a' * 16}.part", f"uploads/upl_{'0' * 30}.bytes"]
    for name in [*kept, "spool/other", "scratch/job_1.1/request.json", "logs/api.log"]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert [path.relative_to(tmp_path).as_posix() for path in checks.kept_files(tmp_path)] == kept
    found = Findings()
    checks.check_folders(tmp_path, [Path("/tmp/mrasfm-x")], found)
    assert len(found.left) == 6, "a folder and a file of an attempt, three of uploads, a temporary one"
    assert not any("api.log" in line for line in found.left)


@pytest.fixture
def leftover(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process with the data folder in its command."""
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)", str(tmp_path)])
    yield process
    process.kill()
    process.wait()


def test_processes_that_are_left(leftover: subprocess.Popen[bytes], tmp_path: Path) -> None:
    (line,) = left_of(tmp_path, [])
    assert line.startswith(f"{leftover.pid} ")
    leftover.kill()
    leftover.wait()
    assert left_of(tmp_path, []) == []


def test_what_ended_must_stay_as_it_ended() -> None:
    ledger = Ledger()
    ledger.accept_job("job_1", "RECONSTRUCTION", ["drv_1"])
    for state in ("QUEUED", "RUNNING", "SUCCEEDED", "SUCCEEDED"):
        ledger.see_state("job_1", state)
    assert (ledger.unfinished(), list(ledger.broken_promises)) == ([], [])
    ledger.see_state("job_1", "RUNNING")
    assert len(ledger.broken_promises) == 1
