"""The API behind a real socket: in a thread of the test, or in a process of its own that can be killed."""

from __future__ import annotations

import hashlib
import os
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import httpx

from schemas.api.maps import MapSummary
from schemas.api.scenes import SceneSummary
from schemas.exports import EXPORTED_OF_MAP, EXPORTED_OF_SCENE
from service.api.app import create_app
from service.api.server import server_of
from service.database.connections import Database
from service.database.tables import Project, new_id
from service.domain import drives, jobs, maps, scenes
from service.domain.keys import create_key, create_project
from service.domain.map_inputs import inputs_of
from service.settings import Settings
from service.storage import blobs
from service.storage.blob_writer import StoredFile, store_file
from service.storage.durability import secure_drive
from tests.helpers.migrated import migrated
from tests.helpers.tiny_drive import TinyDrive, tiny_drive

HOST = "127.0.0.1"
# Of clients that speak no TLS: to load all certificates of the system takes 50 ms of each.
NO_CERTIFICATES = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
DEADLINE_S = 60.0
GRACE_S = 10  # for what is under way when the API stops
REPOSITORY = Path(__file__).resolve().parents[2]
LIMITS = jobs.RetryLimits(max_attempts=3)
ONE_ATTEMPT = jobs.RetryLimits(max_attempts=1)
# Files of a scene that is exported and of a map's version, as far as the service looks at them.
SCENE_FILES = {path: path.encode() for path in EXPORTED_OF_SCENE}
MAP_FILES = {path: path.encode() for path in EXPORTED_OF_MAP}
SUMMARY = SceneSummary(
    registered_units=3,
    units=3,
    registered_images=6,
    images=6,
    points=7,
    georeferenced=False,
    warnings=0,
    engine_version=version("mrasfm"),
)
MAP_SUMMARY = MapSummary(**SUMMARY.model_dump(exclude={"components"}), scenes=2, connected=2, seams=1)


def settings_of(data_dir: Path, **changed: Any) -> Settings:
    """Settings of a test: no broker, and streams that look for news often."""
    values = {"data_dir": data_dir, "poll_seconds": 0.05, "min_free_disk_bytes": 0, **changed}
    return Settings(**values)


class Api:
    """What a test needs of a running API: its database, and clients of new projects."""

    def __init__(self, settings: Settings, url: str) -> None:
        self.settings = settings
        self.url = url
        self.context: Any = None  # of an API in this process
        self._database: Database | None = None
        self._clients: list[httpx.Client] = []

    @property
    def database(self) -> Database:
        if self._database is None:
            self._database = Database.from_settings(self.settings)
        return self._database

    def new_key(self, **quotas: int) -> tuple[str, str]:
        """A new project's id, and a key of it."""
        with self.database.write() as session:
            project = create_project(session, new_id("test"), self.settings)
            for name, value in quotas.items():
                setattr(project, name, value)
            return project.id, create_key(session, project, "test")[1]

    def client(self, **quotas: int) -> Client:
        """A client with the key of a new project."""
        project_id, key = self.new_key(**quotas)
        return self.client_of(project_id, key)

    def client_of(self, project_id: str, key: str) -> Client:
        client = Client(self, project_id, key)
        self._clients.append(client)
        return client

    def anonymous(self, **headers: str) -> httpx.Client:
        client = httpx.Client(base_url=self.url, headers=headers, timeout=DEADLINE_S, verify=NO_CERTIFICATES)
        self._clients.append(client)
        return client

    def project(self, project_id: str) -> Project:
        with self.database.read() as session:
            return session.get_one(Project, project_id)

    def spooled(self) -> list[str]:
        """Names of all files in the spool folder."""
        folder = self.settings.spool_dir
        return sorted(os.listdir(folder)) if folder.is_dir() else []

    def objects(self, project_id: str) -> list[Path]:
        """Files of a project in the artifact store."""
        folder = self.settings.data_dir.resolve() / "artifacts" / "blobs" / project_id
        return sorted(path for path in folder.rglob("*") if path.is_file())

    def close(self) -> None:
        for client in self._clients:
            client.close()
        if self._database is not None:
            self._database.close()


class Client(httpx.Client):
    """A client of one project, with the steps that most tests begin with."""

    def __init__(self, api: Api, project_id: str, key: str) -> None:
        headers = {"Authorization": f"Bearer {key}"}
        super().__init__(base_url=api.url, headers=headers, timeout=DEADLINE_S, verify=NO_CERTIFICATES)
        self.api = api
        self.project_id = project_id
        self.key = key

    def create(self, drive: TinyDrive | None = None, **headers: str) -> str:
        """Create a drive; its id."""
        answer = self.post("/v1/drives", content=(drive or tiny_drive()).raw, headers=headers)
        assert answer.status_code == 201, answer.text
        return str(answer.json()["id"])

    def send_files(self, drive_id: str, drive: TinyDrive) -> None:
        """Send all files."""
        for path, data in drive.files.items():
            answer = self.put(f"/v1/drives/{drive_id}/files/{path}", content=data)
            assert answer.status_code == 201, answer.text

    def filled(self, drive: TinyDrive | None = None) -> str:
        """Create a drive and send all its files."""
        drive = drive or tiny_drive()
        drive_id = self.create(drive)
        answer = self.put(f"/v1/drives/{drive_id}/archive", content=drive.zipped())
        assert answer.status_code == 200, answer.text
        return drive_id

    def committed(self, drive: TinyDrive | None = None) -> str:
        """Create, fill and commit a drive."""
        drive_id = self.filled(drive)
        answer = self.post(f"/v1/drives/{drive_id}:commit")
        assert answer.status_code == 200, answer.text
        return drive_id

    def frozen(self, drive: TinyDrive | None = None) -> str:
        """A drive as after its commit, without the check of its manifest: that takes a process, half a second."""
        drive_id, database = self.filled(drive), self.api.database
        secure_drive(database, self.api.context.artifacts, drive_id)
        with database.write() as session:
            drives.commit(session, drives.get(session, self.project_id, drive_id, lock=True), [])
        return drive_id

    def reconstruct(self, drive_id: str, **headers: str) -> dict[str, Any]:
        """Ask for a reconstruction; its job."""
        answer = self.post("/v1/reconstructions", json={"drive_id": drive_id}, headers=headers)
        assert answer.status_code == 202, answer.text
        return dict(answer.json())

    def claim(self, job_id: str) -> jobs.Claim:
        """Take a job as a worker would."""
        with self.api.database.write() as session:
            held = jobs.claim(session, job_id, owner="worker@test", lease_us=60_000_000)
        assert held is not None
        return held

    def publish(self, held: jobs.Claim, files: dict[str, bytes]) -> str:
        """Publish a scene as a worker would; its id."""
        stored = self._store(files)
        with self.api.database.write() as session:
            return scenes.publish(session, held, files=stored, summary=SUMMARY, expires_us=None)

    def aggregate(self, **asked: Any) -> dict[str, Any]:
        """Ask for a map; its job."""
        answer = self.post("/v1/aggregations", json=asked)
        assert answer.status_code == 202, answer.text
        return dict(answer.json())

    def publish_map(
        self,
        held: jobs.Claim,
        files: dict[str, bytes],
        *,
        unconnected: tuple[str, ...] = (),
        components: tuple[str, ...] = (),
    ) -> int:
        """Publish a map's version as a worker would; its number."""
        stored = self._store(files)
        with self.api.database.write() as session:
            inputs = inputs_of(session, held.job_id)
            return maps.publish(
                session,
                held,
                files=stored,
                summary=MAP_SUMMARY,
                names=[*inputs.scene_ids, *components],
                unconnected=unconnected,
                failed=inputs.failed,
                expires_us=None,
            )

    def _store(self, files: dict[str, bytes]) -> dict[str, StoredFile]:
        folder = self.api.settings.spool_dir
        folder.mkdir(parents=True, exist_ok=True)
        artifacts = self.api.context.artifacts
        stored = {}
        for path, data in files.items():
            scratch = folder / f"published-{new_id('tmp')}"
            scratch.write_bytes(data)
            stored[path] = store_file(
                self.api.database,
                artifacts,
                project_id=self.project_id,
                path=scratch,
                sha256=sha256_of(data),
                size_bytes=len(data),
            )
        return stored

    def scene(self, files: dict[str, bytes], drive: TinyDrive | None = None) -> str:
        """Publish a scene of a new recording, with these files; its id."""
        job = self.reconstruct(self.frozen(drive or tiny_drive(seed=new_id("drv"))))
        return self.publish(self.claim(job["id"]), files)


def sha256_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def forget_all(api: Api) -> list[str]:
    """Collect blobs that nothing needs, as if an hour had passed; keys of their objects."""
    with api.database.write() as session:
        return blobs.forget_unused(session, untouched_since_us=2**62)


@contextmanager
def api_in_thread(settings: Settings) -> Iterator[Api]:
    """The API served by uvicorn in a thread of this process: a real socket, without the start of a process."""
    migrated(settings)
    app = create_app(settings)
    server = server_of(app, host=HOST, port=0, timeout_graceful_shutdown=GRACE_S)
    thread = threading.Thread(target=server.run, name="api", daemon=True)
    thread.start()
    wait_until(lambda: server.started or not thread.is_alive(), "the API's start")
    port = server.servers[0].sockets[0].getsockname()[1]
    api = Api(settings, f"http://{HOST}:{port}")
    api.context = app.state.context
    try:
        yield api
    finally:
        api.close()
        server.should_exit = True
        thread.join(DEADLINE_S)
        assert not thread.is_alive(), "the API does not stop"


class ApiProcess(Api):
    """The API as `python -m service api`."""

    def __init__(self, settings: Settings, folder: Path, **environment: str) -> None:
        self.port = free_port()
        super().__init__(settings, f"http://{HOST}:{self.port}")
        self.log = folder / "api.log"
        self._environment = environment
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        migrated(self.settings)
        own = {name: value for name, value in os.environ.items() if not name.startswith("MRASFM_")}
        given = {
            "MRASFM_DATA_DIR": str(self.settings.data_dir),
            "MRASFM_POLL_SECONDS": "0.05",
            "MRASFM_API_PROCESSES": "1",
            "MRASFM_MIN_FREE_DISK_BYTES": str(self.settings.min_free_disk_bytes),
        }
        command = [sys.executable, "-m", "service", "api", "--host", HOST, "--port", str(self.port)]
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                command, cwd=REPOSITORY, env={**own, **given, **self._environment}, stdout=log, stderr=log
            )
        wait_until(self._is_live, "the API's start")

    def _is_live(self) -> bool:
        assert self.process is not None
        assert self.process.poll() is None, self.log.read_text()[-3000:]
        try:
            return httpx.get(f"{self.url}/livez", timeout=5, verify=NO_CERTIFICATES).status_code == 200
        except httpx.TransportError:
            return False

    def kill(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def close(self) -> None:
        super().close()
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(DEADLINE_S)
            except subprocess.TimeoutExpired:
                self.kill()
                raise


@contextmanager
def api_process(settings: Settings, folder: Path, **environment: str) -> Iterator[ApiProcess]:
    """The API in a process of its own, started."""
    api = ApiProcess(settings, folder, **environment)
    try:
        api.start()
        yield api
    finally:
        api.close()


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind((HOST, 0))
        return int(listener.getsockname()[1])


def wait_until(is_so: Any, what: str) -> None:
    """Wait for something that happens soon."""
    end_s = time.monotonic() + DEADLINE_S
    while not is_so():
        assert time.monotonic() < end_s, f"{what} did not happen"
        time.sleep(0.02)


def problem_of(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    """The problem that an answer must be."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = answer.json()
    assert problem["type"] == f"urn:mrasfm:problem:{code}", problem
    assert problem["status"] == status
    assert problem["detail"]
    assert problem["remedy"]
    return problem
