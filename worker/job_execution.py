"""The execution of a job: claim it, run its attempt, and record the outcome."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from schemas.api.jobs import JobKind
from schemas.api.problems import PROBLEM_TYPE, Problem
from schemas.api.resource import Finding
from schemas.artifacts import Stage
from service.database.connections import Database
from service.domain import jobs
from service.domain.drive_checkout import DriveGoneError
from service.domain.exports import ExportGoneError
from service.job_queue import BrokerError, JobQueue
from service.logs import log_fields
from service.settings import Settings
from service.storage.artifacts import ArtifactStore
from service.storage.blob_writer import StoredFile, file_sha256, store_file
from service.storage.process_folder import process_folder, sweep
from service.storage.transfers import STORES, at_one_time
from worker.attempt import AttemptFolder, run_attempt
from worker.checkpoints import CheckpointKeeper
from worker.child_protocol import FileAddress, SubmapPlan, Work
from worker.commit_with_retry import commit_with_retry
from worker.file_server import FileServer
from worker.heartbeat import Heartbeat
from worker.job_handlers import ReconstructionHandler, handler_of
from worker.oom import MemoryKills, kills_since, memory_kills
from worker.outcomes import Failed, Outcome, Planned, Succeeded, failed_here
from worker.progress import ProgressMeter
from worker.retried_database import RetriedDatabase
from worker.retry import RETRY_BUDGET_S, retry, watched
from worker.termination import StopReason, StopRequest

log = logging.getLogger("mrasfm.worker")

_TITLES = {
    "out-of-memory": "Memory ran out",
    "engine-killed": "The engine was killed",
    "engine-abort": "The engine ended unexpectedly",
    "timeout": "The attempt took too long",
    "database": "The database did not answer",
    "storage": "The worker's files or the artifact store failed",
    "worker-error": "The worker failed",
}

_FAILED = {
    JobKind.PREFLIGHT: "The drive could not be checked",
    JobKind.RECONSTRUCTION: "The drive could not be reconstructed",
    JobKind.AGGREGATION: "No map could be made",
    JobKind.SUBMAP: "A part of the drive could not be mapped",
    JobKind.EXPORT: "Nothing could be exported",
}

_PARTING_BUDGET_S = 5.0  # a process that was told to end does not wait long for the database

T = TypeVar("T")


class Runner:
    """Executes jobs, one at a time, in this process, which has database and store from its start on.

    Parameters
    ----------
    shutting_down
        Asked several times a second: whether the worker was told to stop.
    """

    def __init__(self, settings: Settings, *, shutting_down: Callable[[], bool] = lambda: False) -> None:
        self._settings = settings
        self._shutting_down = shutting_down
        self._database = Database.from_settings(settings)
        self._artifacts = ArtifactStore.open(settings, self._database)
        self._artifacts.require_folder()
        self._job_queue = JobQueue(settings)
        self._owner = f"{socket.gethostname()}:{os.getpid()}"

    def run(self, job_id: str) -> None:
        """Do a job that waits; nothing where there is nothing to do any more."""
        if self._shutting_down():
            return
        with self._database.write() as session:
            held = jobs.claim(session, job_id, owner=self._owner, lease_us=int(self._settings.lease_seconds * 1e6))
        if held is None:
            log.info("nothing to do", extra={"fields": {"job_id": job_id}})
            return
        with log_fields(job_id=job_id, attempt=held.attempt, fence=held.fence):
            log.info("begins", extra={"fields": {"kind": held.kind}})
            execution = _Execution(self._settings, self._database, self._artifacts, held, self._shutting_down)
            try:
                execution.run(prepare=self.sweep_scratch)
            except jobs.FencedError:
                log.warning("the job is not ours any more; nothing was published")
            else:
                self._wake_up_after(job_id)

    def _wake_up_after(self, job_id: str) -> None:
        """Tell workers about jobs that may begin now; what fails here the reconciler does some seconds later."""
        try:
            with self._database.read() as session:
                waiting = jobs.due_after(session, job_id)
            if not waiting:
                return
            self._job_queue.send(waiting)
            with self._database.write() as session:
                jobs.mark_enqueued(session, [job.id for job in waiting])
        except (BrokerError, SQLAlchemyError) as error:
            fields = {"why": type(error).__name__}
            log.warning("no worker was woken up", extra={"fields": fields})

    def sweep_scratch(self) -> None:
        """Remove what killed processes of this machine left behind, and end the leases of their jobs at once."""
        sweep(self._settings.scratch_dir, self._disown)

    def _disown(self, left_behind: Path) -> None:
        job_id, _, fence = left_behind.name.rpartition(".")
        if not fence.isdecimal():
            return
        killed = kills_since(MemoryKills.read(AttemptFolder(left_behind).memory_kills))
        with self._database.write() as session:
            was_running = jobs.end_lease(session, job_id, int(fence), memory_kills=killed)
        if was_running:
            fields = {"job_id": job_id, "fence": int(fence), "memory_kills": killed}
            log.warning("its process has died", extra={"fields": fields})


class _Execution:
    """One attempt at a claimed job, up to the record of its outcome."""

    def __init__(
        self,
        settings: Settings,
        database: Database,
        artifacts: ArtifactStore,
        held: jobs.Claim,
        shutting_down: Callable[[], bool],
    ) -> None:
        self._settings = settings
        self._database = database
        self._artifacts = artifacts
        self._held = held
        self._shutting_down = shutting_down
        self._meter = meter = ProgressMeter(Work(held.kind.lower()), started_s=time.monotonic())
        self._heartbeat = Heartbeat(
            database, held, settings, progress=lambda: meter.at(time.monotonic()), shutting_down=shutting_down
        )
        self._check_stop = self._heartbeat.check_stop
        self._records = RetriedDatabase(database, budget_s=RETRY_BUDGET_S, check_stop=self._check_stop)
        self._handler = handler_of(self._records, held, settings)

    def run(self, *, prepare: Callable[[], None]) -> None:
        """Attempt the job, and record what came of it.

        Raises
        ------
        FencedError
            Where the job is not ours any more.
        """
        try:
            with (
                process_folder(self._settings.scratch_dir, f"{self._held.job_id}.{self._held.fence}") as root,
                self._heartbeat,
            ):
                folder = AttemptFolder(root)
                _note_memory_kills(folder)
                try:
                    retry(prepare, budget_s=RETRY_BUDGET_S, check_stop=self._check_stop)
                    self._record(self._attempt(folder))
                except StopRequest as stop:
                    self._give_up(stop.reason)
        except jobs.FencedError:
            raise
        except Exception as error:
            log.exception("the attempt failed on this machine")
            self._fail(failed_here(error, self._meter.stage))
        except SystemExit:
            # This process was told to end and not, or not only, the main one: by a cold shutdown, or by who signals
            # all of a service's processes at once.
            with suppress(jobs.FencedError, SQLAlchemyError):  # else the job's lease runs out
                self._release(budget_s=_PARTING_BUDGET_S)
            raise

    def _attempt(self, folder: AttemptFolder) -> Outcome:
        check_stop = self._check_stop
        count = partial(self._meter.update, Stage.FETCH)
        try:
            attempt = watched(lambda: self._handler.lay_out(folder, self._fetch, count), check_stop)
        except DriveGoneError as gone:
            return Failed(
                code="drive-deleted",
                what=f"drive {gone} was deleted",
                remedy="Upload it again.",
                retryable=False,
                stage=Stage.FETCH,
            )
        except ExportGoneError as gone:
            return Failed(
                code="export-deleted",
                what=f"export {gone} was deleted",
                remedy="Ask for it anew.",
                retryable=False,
                stage=Stage.FETCH,
            )
        with self._finished_stages(folder) as keeper, self._served() as address:
            outcome = run_attempt(
                replace(attempt, files=address),
                scratch=folder.root,
                check_stop=check_stop,
                meter=self._meter,
                settings=self._settings,
            )
            if keeper is not None and self._leaves_stages(outcome):
                self._retry(lambda: watched(keeper.keep_all, check_stop))
        if (files := self._handler.files) is not None:
            files.raise_error()  # what lacks a file is done again, also where it came to its end
        return outcome

    @contextmanager
    def _served(self) -> Iterator[FileAddress | None]:
        """Bring files of a large drive as the child asks for them; where it does so."""
        files = self._handler.files
        if files is None:
            yield None
            return
        with files, FileServer(files) as server:
            yield server.address

    def _leaves_stages(self, outcome: Outcome) -> bool:
        """Return whether finished stages are all that the attempt was for: then none may be missing."""
        return isinstance(outcome, Planned) or (self._held.kind is JobKind.SUBMAP and isinstance(outcome, Succeeded))

    def _finished_stages(self, folder: AttemptFolder) -> AbstractContextManager[CheckpointKeeper | None]:
        """Bring finished stages, and keep those that are finished in the block."""
        shelf = self._handler.shelf
        if shelf is None:
            return nullcontext()
        keeper = CheckpointKeeper(
            self._database,
            self._artifacts,
            shelf,
            held=self._held,
            folder=folder.finished_stages,
            spare=folder.root / "checkpoints",
        )
        watched(lambda: keeper.restore(self._records, self._fetch, self._handler.is_wanted), self._check_stop)
        return keeper

    def _fetch(self, key: str, target: Path) -> None:
        self._retry(lambda: self._artifacts.fetch(key, target, check_stop=self._check_stop))

    def _retry(self, step: Callable[[], T]) -> T:
        return retry(step, budget_s=self._settings.storage_patience_seconds, check_stop=self._check_stop)

    def _commit(self, transaction: Callable[[Session], T], *, budget_s: float = RETRY_BUDGET_S) -> T | None:
        return commit_with_retry(self._database, self._held, transaction, budget_s=budget_s)

    def _record(self, outcome: Outcome) -> None:
        match outcome:
            case Failed():
                self._fail(outcome)
            case Planned(plan=plan):
                self._wait_for_submaps(plan)
            case Succeeded():
                self._publish(outcome)

    def _wait_for_submaps(self, plan: SubmapPlan) -> None:
        handler = self._handler
        assert isinstance(handler, ReconstructionHandler), "no other is planned"
        made = self._commit(lambda session: handler.wait_for_submaps(session, plan))
        log.info("planned", extra={"fields": {"submaps": plan.total, "jobs": made}})

    def _give_up(self, reason: StopReason) -> None:
        match reason:
            case StopReason.CANCEL:
                self._commit(lambda session: jobs.cancelled(session, self._held))
                log.info("cancelled")
            case StopReason.SHUT_DOWN:
                self._release()
            case _:
                raise jobs.FencedError

    def _release(self, *, budget_s: float = RETRY_BUDGET_S) -> None:
        self._commit(lambda session: jobs.release(session, self._held), budget_s=budget_s)
        log.info("released: this worker stops")

    def _fail(self, failed: Failed) -> None:
        held = self._held
        if failed.retryable and self._shutting_down():
            # What was told to stop with this worker, or is gone with its machine, is not the job's fault.
            log.warning("failed while this worker stops", extra={"fields": {"code": failed.code, "what": failed.what}})
            self._release()
            return
        problem = Problem(
            type=PROBLEM_TYPE + failed.code,
            title=_TITLES.get(failed.code) or _FAILED[held.kind],
            detail=failed.what,
            remedy=failed.remedy,
            findings=[Finding.model_validate(finding) for finding in failed.findings],
            log_tail=failed.log_tail or None,
            stage=failed.stage or None,
            retryable=failed.retryable,
            job_id=held.job_id,
        )
        state = self._commit(
            lambda session: jobs.fail(
                session,
                held,
                problem,
                limits=jobs.RetryLimits.from_settings(self._settings),
                blame=failed.blame,
                retry_delay_us=int(self._retry_delay_s(failed) * 1e6),
            )
        )
        log.error("the attempt failed", extra={"fields": {"code": failed.code, "what": failed.what, "job": state}})

    def _retry_delay_s(self, failed: Failed) -> float:
        first_s = self._settings.retry_delay_seconds
        if not failed.is_storage:
            return first_s
        delay_s = first_s * float(self._settings.storage_retry_growth**self._held.blame)
        return max(first_s, min(delay_s, self._settings.longest_retry_delay_seconds))

    def _publish(self, done: Succeeded) -> None:
        found = _artifacts(done.out)
        contents = {name: file_sha256(path) for name, path in found.items()}
        # Each content once: masks are often alike, and an object whose blob is another's is nobody's.
        unlike = [(sha256, found[name]) for sha256, name in {contents[name]: name for name in sorted(found)}.items()]
        stored: dict[str, StoredFile] = {}
        with closing(at_one_time(STORES, lambda one: self._store(*one), unlike)) as stores:
            for place, ended in stores:
                stored[unlike[place][0]] = ended.result()
                self._meter.update(Stage.PUBLISH, len(stored), len(unlike))
        files = {name: stored[contents[name]] for name in sorted(found)}
        self._check_stop()
        made = self._commit(lambda session: self._handler.publish(session, done, files, self._settings))
        log.info("published", extra={"fields": made or {}})

    def _store(self, sha256: str, path: Path) -> StoredFile:
        store = partial(
            store_file,
            self._database,
            self._artifacts,
            project_id=self._held.project_id,
            path=path,
            sha256=sha256,
            size_bytes=path.stat().st_size,
        )
        return self._retry(lambda: watched(store, self._check_stop))


def _note_memory_kills(folder: AttemptFolder) -> None:
    """Leave the kernel's count in the folder: who finds this process dead compares."""
    now = memory_kills()
    if now is not None:
        with suppress(OSError):  # a full disk: then the count is unknown
            now.write(folder.memory_kills)


def _artifacts(out: Path) -> dict[str, Path]:
    """Files of a scene by the names they are served under; what begins with a dot is the engine's own."""
    found = {path.relative_to(out): path for path in out.rglob("*") if path.is_file()}
    return {name.as_posix(): path for name, path in found.items() if not any(p.startswith(".") for p in name.parts)}
