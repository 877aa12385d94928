"""A broker, workers and a reconciler as processes of their own, over a database and a store in a folder."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import psutil

from schemas.api.jobs import JobKind
from schemas.parsing import parse_manifest
from service.database.connections import Database
from service.database.tables import Drive, Job, JobAttempt, JobEvent, Scene, WorkerSeen, new_id
from service.domain import drive_files, drives, jobs
from service.domain.keys import create_project
from service.domain.manifest_facts import facts_of
from service.job_queue import JobQueue
from service.settings import Settings
from service.standalone import broker
from service.storage.artifacts import ArtifactStore
from service.storage.blob_writer import StoredFile, file_sha256, store_file
from tests.helpers.migrated import migrated

REPOSITORY = Path(__file__).resolve().parents[2]
DEADLINE_S = 120.0
TERMINAL = ("SUCCEEDED", "FAILED", "CANCELLED")

# Short enough to wait for, long enough for a machine that does other things too.
SHORT_TIMES = {
    "heartbeat_seconds": 0.5,
    "lease_seconds": 6.0,
    "visibility_timeout_seconds": 6.0,
    "visibility_renew_seconds": 1.5,
    "reconcile_seconds": 0.5,
    "retry_delay_seconds": 0.2,
    "terminate_after_seconds": 1.0,
    "kill_after_seconds": 2.0,
    "engine_threads": 1,
}
FAST = {"max_keypoints": 600}  # of a reconstruction


class Broker:
    """A Valkey server that can be killed and started again where it was."""

    def __init__(self, folder: Path) -> None:
        self._prepared = broker.prepare(folder)
        self.url = self._prepared.url
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self._process = subprocess.Popen(self._prepared.argv, stdout=subprocess.DEVNULL)
        wait_until(lambda: broker.is_up(self.url), "the broker's start")

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


class World:
    """One installation of the service without its API."""

    def __init__(self, folder: Path, **changed: object) -> None:
        self.broker = Broker(folder / "broker")
        self.settings = Settings(
            data_dir=folder / "data",
            redis_url=self.broker.url,
            **{**SHORT_TIMES, **changed},
        )
        migrated(self.settings)
        self.database = Database.from_settings(self.settings)
        self.artifacts = ArtifactStore.open(self.settings, self.database)
        self._logs = folder / "logs"
        self._logs.mkdir()
        self._started: list[subprocess.Popen[bytes]] = []
        with self.database.write() as session:
            self.project_id = create_project(session, "test", self.settings).id

    # -- processes

    def start(
        self, *arguments: str, settings: Settings | None = None, command: Sequence[str] = ("-m", "worker")
    ) -> subprocess.Popen[bytes]:
        """Start `python -m worker ARGUMENTS`, in a session of its own."""
        environment = {**os.environ, **environment_of(settings or self.settings), "PYTHONUNBUFFERED": "1"}
        with (self._logs / f"{len(self._started):02d}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, *command, *arguments],
                cwd=REPOSITORY,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._started.append(process)
        return process

    def start_worker(
        self, queues: str = "reconstructions", *, settings: Settings | None = None
    ) -> subprocess.Popen[bytes]:
        """Start a worker, and wait until it takes work."""
        process = self.start("worker", "--queues", queues, settings=settings)
        name = f".{process.pid}@"
        wait_until(lambda: any(name in worker for worker in self._workers_seen()), "the worker's start")
        return process

    def start_reconciler(self) -> subprocess.Popen[bytes]:
        return self.start("reconciler")

    def log(self) -> str:
        """What all processes have printed."""
        return "".join(path.read_text(encoding="utf-8") for path in sorted(self._logs.iterdir()))

    def processes(self) -> list[psutil.Process]:
        """All processes that belong to this installation, but the broker and ourselves."""
        mine = str(self.settings.data_dir.resolve())
        found = []
        for process in psutil.process_iter():
            try:
                if process.pid == os.getpid() or process.status() == psutil.STATUS_ZOMBIE:
                    continue
                if process.environ().get("MRASFM_DATA_DIR") == mine or any(mine in part for part in process.cmdline()):
                    found.append(process)
            except (psutil.NoSuchProcess, psutil.AccessDenied):
                continue
        return found

    def children(self, job_id: str = "") -> list[psutil.Process]:
        """The processes of stages under way."""
        found = []
        for process in self.processes():
            try:
                command = process.cmdline()
            except psutil.NoSuchProcess:
                continue
            if "worker.child" in command and job_id in command[-1]:
                found.append(process)
        return found

    def wait_for_child(self, job_id: str) -> psutil.Process:
        """The process of a job's stage, once it has one."""
        wait_until(lambda: self.children(job_id) != [], f"a stage of {job_id}")
        return self.children(job_id)[0]

    def wait_for_begin(self, job_id: str) -> psutil.Process:
        """The process of a job's stage, once it works."""
        child = self.wait_for_child(job_id)
        wait_until(lambda: loads_the_engine(child), "the stage's begin")
        return child

    def hold(self, job_id: str) -> psutil.Process:
        """Stop a job's stage in its tracks: its worker keeps it alive, and it takes as long as one likes."""
        child = self.wait_for_begin(job_id)
        child.suspend()
        return child

    def close(self) -> None:
        """Kill everything that is left."""
        for process in self.processes():
            kill(process.pid)
        for started in self._started:
            started.wait()
        self.broker.kill()
        self.database.close()

    # -- records

    def add_drive(self, folder: Path) -> str:
        """Store a drive as uploads do, without asking for its check."""
        drive_id, preflight = self.add_unchecked_drive(folder)
        with self.database.write() as session:
            jobs.request_cancel(session, preflight)
        return drive_id

    def add_unchecked_drive(self, folder: Path) -> tuple[str, str]:
        """Store a drive; its id, and that of the job that checks it."""
        manifest = facts_of(parse_manifest((folder / "drive.json").read_bytes()))
        stored = self.store(folder / "drive.json")
        files = {path: self.store(folder / path) for path, _ in manifest.files}
        with self.database.write() as session:
            drive = drives.create(
                session,
                project_id=self.project_id,
                manifest=manifest,
                rows=drives.rows_of(manifest),
                stored=stored,
                expires_us=None,
            )
            for path, file in files.items():
                drive_files.fill(
                    session, drive_files.find(session, self.project_id, drive.id, path), file, replace=False
                )
            return drive.id, drives.commit(session, drive, []).id

    def store(self, path: Path) -> StoredFile:
        """Put a file into the artifact store."""
        spool = self.settings.spool_dir
        spool.mkdir(parents=True, exist_ok=True)
        copy = Path(shutil.copy(path, spool / new_id("f")))
        return store_file(
            self.database,
            self.artifacts,
            project_id=self.project_id,
            path=copy,
            sha256=file_sha256(copy),
            size_bytes=copy.stat().st_size,
        )

    def ask(self, drive_id: str, *, wake: bool = True, **asked: object) -> str:
        """Ask for a reconstruction; the job's id."""
        with self.database.write() as session:
            job = jobs.create(
                session,
                project_id=self.project_id,
                kind=JobKind.RECONSTRUCTION,
                drive_id=drive_id,
                settings={**FAST, **asked},
            )
        if wake:
            self.wake(job.id)
        return job.id

    def wake(self, job_id: str) -> None:
        """Send the job's message, as the API does."""
        JobQueue(self.settings).send([self.job(job_id)])

    def cancel(self, job_id: str) -> None:
        with self.database.write() as session:
            jobs.request_cancel(session, job_id)

    def job(self, job_id: str) -> Job:
        with self.database.read() as session:
            return session.get_one(Job, job_id)

    def drive(self, drive_id: str) -> Drive:
        with self.database.read() as session:
            return session.get_one(Drive, drive_id)

    def attempts(self, job_id: str) -> list[JobAttempt]:
        with self.database.read() as session:
            return list(session.query(JobAttempt).filter_by(job_id=job_id).order_by(JobAttempt.fence))

    def outcomes(self, job_id: str) -> list[str | None]:
        return [attempt.outcome for attempt in self.attempts(job_id)]

    def events(self, job_id: str) -> list[JobEvent]:
        with self.database.read() as session:
            return jobs.events_after(session, job_id, 0, limit=10_000)

    def scenes(self) -> list[Scene]:
        with self.database.read() as session:
            return list(session.query(Scene))

    def wait_for(self, job_id: str, *states: str) -> Job:
        """The job, once it is in one of the states."""
        wait_until(lambda: self.job(job_id).state in states, lambda: f"{states} ({self._told(job_id)})")
        return self.job(job_id)

    def wait_for_end(self, job_id: str) -> Job:
        return self.wait_for(job_id, *TERMINAL)

    def _told(self, job_id: str) -> str:
        job = self.job(job_id)
        return f"{job.state} {job.stage} {job.problem} {self.outcomes(job_id)}\n{self.log()}"

    def _workers_seen(self) -> list[str]:
        with self.database.read() as session:
            return [row.name for row in session.query(WorkerSeen)]


def environment_of(settings: Settings) -> dict[str, str]:
    """The settings as variables."""
    assert settings.redis_url is not None
    changed = {name: getattr(settings, name) for name in settings.model_fields_set}
    changed |= {"redis_url": settings.redis_url.get_secret_value(), "data_dir": settings.data_dir.resolve()}
    changed["database_url"] = settings.resolved_database_url
    changed["artifacts_url"] = settings.resolved_artifacts_url
    return {f"MRASFM_{name.upper()}": str(value) for name, value in changed.items() if value is not None}


def loads_the_engine(child: psutil.Process) -> bool:
    """Whether a stage's process is past its first steps, in which it ties itself to its parent."""
    return any("numpy" in mapped.path for mapped in child.memory_maps())


def is_gone(process: psutil.Process) -> bool:
    """Whether a process has ended; one that only waits to be reaped has."""
    try:
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def kill(pid: int, number: signal.Signals = signal.SIGKILL) -> None:
    """Send a signal; who is gone needs none."""
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return


def wait_until(is_so: Callable[[], bool], what: str | Callable[[], str], *, within_s: float = DEADLINE_S) -> float:
    """Wait for something that happens soon; after how many seconds it did."""
    begin_s = time.monotonic()
    while not is_so():
        if time.monotonic() - begin_s > within_s:
            raise AssertionError(f"did not happen: {what if isinstance(what, str) else what()}")
        time.sleep(0.02)
    return time.monotonic() - begin_s
