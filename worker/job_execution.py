"""Execution of a job: claim it, run its attempt, and record the outcome."""

from __future__ import annotations

import errno
import logging
import os
import socket
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path

from obstore.exceptions import BaseError as StoreError
from sqlalchemy.exc import SQLAlchemyError

from schemas.api.jobs import JobKind
from schemas.api.problems import PROBLEM_TYPE, Problem
from schemas.api.resource import Finding
from schemas.artifacts import Stage
from service.database.connections import Database
from service.domain import jobs
from service.domain.checkpoints import Shelf
from service.domain.drive_checkout import DriveGoneError
from service.logs import log_fields
from service.settings import Settings
from service.storage.artifacts import ArtifactStore, Fetch
from service.storage.blob_writer import StoredFile, file_sha256, store_file
from service.storage.process_folder import process_folder, sweep
from worker.attempt import AttemptFolder, StopRequest, run_attempt
from worker.checkpoints import CheckpointKeeper
from worker.commit_with_retry import commit_with_retry
from worker.heartbeat import Heartbeat
from worker.job_handlers import WORK, Counting, handler_of
from worker.oom import MemoryKills, kills_since, memory_kills
from worker.outcomes import Abandoned, Cancelled, Failed, Outcome, Succeeded
from worker.progress import Progress, ProgressMeter
from worker.retry import RETRY_BUDGET_S, CheckStop, RetryingFetch, retry, watched
from worker.termination import StopReason

log = logging.getLogger("mrasfm.worker")

_TITLES = {
    "out-of-memory": "Memory ran out",
    "engine-killed": "The engine was killed",
    "engine-abort": "The engine ended unexpectedly",
    "timeout": "The attempt took too long",
    "storage": "The worker's files or the artifact store failed",
    "worker-error": "The worker failed",
}

_FAILED = {
    JobKind.PREFLIGHT: "The drive could not be checked",
    JobKind.RECONSTRUCTION: "The drive could not be reconstructed",
    JobKind.AGGREGATION: "No map could be made",
}

_PARTING_BUDGET_S = 5.0  # a process that was told to end does not wait long for the database


class _StoppedError(Exception):
    """One of the worker's own stages was stopped."""

    def __init__(self, verdict: StopRequest) -> None:
        super().__init__(verdict)
        self.verdict = verdict


class Runner:
    """Executes jobs, one at a time, in this process.

    Parameters
    ----------
    shutting_down
        Asked several times a second: whether the worker was told to stop.
    """

    def __init__(self, settings: Settings, *, shutting_down: Callable[[], bool] = lambda: False) -> None:
        self._settings = settings
        self._shutting_down = shutting_down
        self._database = Database.from_settings(settings)
        self._artifacts = ArtifactStore(settings)
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
            try:
                self._run_held(held)
            except jobs.FencedError:
                log.warning("the job is not ours any more; nothing was published")

    def _run_held(self, held: jobs.Claim) -> None:
        meter = ProgressMeter(WORK[held.kind], started_s=time.monotonic())
        try:
            with (
                process_folder(self._settings.scratch_dir, f"{held.job_id}.{held.fence}") as folder,
                Heartbeat(self._database, held, self._settings) as heartbeat,
            ):
                attempt = AttemptFolder(folder)
                _note_memory_kills(attempt)
                self.sweep_scratch()
                self._do(held, attempt, heartbeat, meter)
        except jobs.FencedError:
            raise
        except (OSError, StoreError) as error:
            log.exception("the attempt failed on this machine")
            self._fail(held, _of_machine(error, meter.stage))
        except Exception:
            log.exception("the attempt failed on this machine")
            self._fail(held, _of_worker(meter.stage))
        except SystemExit:
            # This process was told to end and not, or not only, the main one: by a cold shutdown, or by who signals
            # all of a service's processes at once.
            with suppress(jobs.FencedError, SQLAlchemyError):  # else the job's lease runs out
                self._release(held, budget_s=_PARTING_BUDGET_S)
            raise

    def _do(self, held: jobs.Claim, folder: AttemptFolder, heartbeat: Heartbeat, meter: ProgressMeter) -> None:
        check_stop = self._stop_check(heartbeat, meter)
        publishing = _counting(meter, Stage.PUBLISH, check_stop)
        try:
            outcome = self._attempt(held, folder, heartbeat, meter, check_stop)
            self._record(held, outcome, publishing, check_stop)
        except _StoppedError as stopped:
            self._record(held, _of_verdict(stopped.verdict, meter.stage), publishing, check_stop)

    def _attempt(
        self, held: jobs.Claim, folder: AttemptFolder, heartbeat: Heartbeat, meter: ProgressMeter, check_stop: CheckStop
    ) -> Outcome:
        handler = handler_of(self._database, held)
        fetch = RetryingFetch(self._artifacts, budget_s=self._settings.storage_patience_seconds, check_stop=check_stop)
        count = _counting(meter, Stage.FETCH, check_stop)
        try:
            attempt = watched(lambda: handler.lay_out(folder, fetch, count), check_stop)
        except DriveGoneError:
            return Failed(
                code="drive-deleted",
                what=f"drive {held.drive_id} was deleted",
                remedy="Upload it again.",
                retryable=False,
                stage=Stage.FETCH,
            )
        with self._keeping(held, handler.shelf, folder, fetch, check_stop):
            return run_attempt(
                attempt,
                scratch=folder.root,
                tick=lambda progress: self._tick(heartbeat, progress),
                meter=meter,
                settings=self._settings,
            )

    def _keeping(
        self, held: jobs.Claim, shelf: Shelf | None, folder: AttemptFolder, fetch: Fetch, check_stop: CheckStop
    ) -> AbstractContextManager[object]:
        """Finished stages brought, and those that are finished now kept."""
        if shelf is None:
            return nullcontext()
        keeper = CheckpointKeeper(
            self._database,
            self._artifacts,
            shelf,
            held=held,
            folder=folder.finished_stages,
            spare=folder.root / "checkpoints",
        )
        watched(lambda: keeper.restore(fetch), check_stop)
        return keeper

    def _stop_check(self, heartbeat: Heartbeat, meter: ProgressMeter) -> CheckStop:
        """Make the check that ends the worker's own steps where a child would be stopped."""

        def check_stop() -> None:
            verdict = self._tick(heartbeat, meter.at(time.monotonic()))
            if verdict is not StopRequest.GO_ON:
                raise _StoppedError(verdict)

        return check_stop

    def _tick(self, heartbeat: Heartbeat, progress: Progress) -> StopRequest:
        verdict = heartbeat.tell(progress)
        return StopRequest.SHUT_DOWN if verdict is StopRequest.GO_ON and self._shutting_down() else verdict

    def _record(self, held: jobs.Claim, outcome: Outcome, progress: Counting, check_stop: CheckStop) -> None:
        match outcome:
            case Succeeded() if held.kind is JobKind.PREFLIGHT:
                findings, sound = outcome.report["findings"], outcome.report["sound"]
                commit_with_retry(self._database, held, lambda s: jobs.record_findings(s, held, findings, sound=sound))
                log.info("checked", extra={"fields": {"sound": sound}})
            case Succeeded():
                self._publish(held, outcome, progress, check_stop)
            case Failed():
                self._fail(held, outcome)
            case Cancelled():
                commit_with_retry(self._database, held, lambda session: jobs.cancelled(session, held))
                log.info("cancelled")
            case Abandoned(reason=StopReason.SHUT_DOWN):
                self._release(held)
            case Abandoned():
                raise jobs.FencedError

    def _release(self, held: jobs.Claim, *, budget_s: float = RETRY_BUDGET_S) -> None:
        commit_with_retry(self._database, held, lambda session: jobs.release(session, held), budget_s=budget_s)
        log.info("released: this worker stops")

    def _fail(self, held: jobs.Claim, failed: Failed) -> None:
        if failed.retryable and self._shutting_down():
            # What was told to stop with this worker, or is gone with its machine, is not the job's fault.
            log.warning("failed while this worker stops", extra={"fields": {"code": failed.code, "what": failed.what}})
            self._release(held)
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
        state = commit_with_retry(
            self._database,
            held,
            lambda session: jobs.fail(
                session,
                held,
                problem,
                limits=jobs.RetryLimits.from_settings(self._settings),
                blame=failed.blame,
                retry_delay_us=int(self._retry_delay_s(held, failed) * 1e6),
            ),
        )
        log.error("the attempt failed", extra={"fields": {"code": failed.code, "what": failed.what, "job": state}})

    def _retry_delay_s(self, held: jobs.Claim, failed: Failed) -> float:
        first_s = self._settings.retry_delay_seconds
        if not failed.is_storage:
            return first_s
        delay_s = first_s * float(self._settings.storage_retry_growth**held.blame)
        return max(first_s, min(delay_s, self._settings.longest_retry_delay_seconds))

    def _publish(self, held: jobs.Claim, done: Succeeded, progress: Counting, check_stop: CheckStop) -> None:
        found = sorted(_artifacts(done.out).items())
        files = {}
        for i, (name, path) in enumerate(found):
            files[name] = self._store(held, path, check_stop)
            progress(i + 1, len(found))
        handler = handler_of(self._database, held)
        made = commit_with_retry(
            self._database, held, lambda session: handler.publish(session, done, files, self._settings)
        )
        log.info("published", extra={"fields": made or {}})

    def _store(self, held: jobs.Claim, path: Path, check_stop: CheckStop) -> StoredFile:
        sha256, size_bytes = file_sha256(path), path.stat().st_size

        def store() -> StoredFile:
            return store_file(
                self._database,
                self._artifacts,
                project_id=held.project_id,
                path=path,
                sha256=sha256,
                size_bytes=size_bytes,
            )

        budget_s = self._settings.storage_patience_seconds
        return retry(lambda: watched(store, check_stop), budget_s=budget_s, check_stop=check_stop)

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


def _note_memory_kills(folder: AttemptFolder) -> None:
    """Leave the kernel's count in the folder: who finds this process dead compares."""
    now = memory_kills()
    if now is not None:
        with suppress(OSError):  # a full disk: then the count is unknown
            now.write(folder.memory_kills)


def _counting(meter: ProgressMeter, stage: Stage, check_stop: CheckStop) -> Counting:
    """A callback for one of the worker's own stages, which stops where a child would be stopped."""

    def count(done: int, total: int) -> None:
        meter.update(stage, done, total)
        check_stop()

    return count


def _artifacts(out: Path) -> dict[str, Path]:
    """Files of a scene by the names they are served under; what begins with a dot is the engine's own."""
    found = {path.relative_to(out): path for path in out.rglob("*") if path.is_file()}
    return {name.as_posix(): path for name, path in found.items() if not any(p.startswith(".") for p in name.parts)}


def _of_verdict(verdict: StopRequest, stage: str) -> Outcome:
    match verdict:
        case StopRequest.CANCEL:
            return Cancelled(
                what=f"the job was cancelled in stage {stage!r}",
                remedy="Retry the job to go on: finished stages are reused.",
                stage=stage,
            )
        case StopRequest.SHUT_DOWN:
            return Abandoned(reason=StopReason.SHUT_DOWN)
    return Abandoned(reason=StopReason.FENCED)


def _of_machine(error: Exception, stage: str) -> Failed:
    """Without paths and addresses, which are the operator's and stand in the log."""
    remedy = "Retry the job later; if it fails again, the operator finds the reason in the worker's log."
    if isinstance(error, FileNotFoundError):
        what = "a file that belongs to the drive or the attempt is missing"
    elif not isinstance(error, OSError):
        what = "the artifact store did not answer as it should"
    elif error.errno in (errno.ENOSPC, errno.EDQUOT):
        what = "the worker's disk is full"
        remedy = "The operator has to free space in the worker's data folder; then retry the job."
    else:
        what = f"the worker could not work on its files: {error.strerror or type(error).__name__}"
    return Failed(code="storage", what=what, remedy=remedy, retryable=True, stage=stage, is_storage=True)


def _of_worker(stage: str) -> Failed:
    return Failed(
        code="worker-error",
        what="the worker failed outside of the engine",
        remedy="Retry the job; if it fails again, report it with the worker's log.",
        retryable=True,
        stage=stage,
    )
