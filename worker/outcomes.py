"""Outcomes of attempts, in words that their users can act on."""

from __future__ import annotations

import errno
import signal
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from obstore.exceptions import BaseError as StoreError
from sqlalchemy.exc import SQLAlchemyError

from service.domain import jobs
from worker.child import EXIT_DONE, EXIT_OUT_OF_MEMORY
from worker.child_protocol import ChildError, ChildResult, SubmapPlan
from worker.retry import may_pass

_KILLED = (
    "Retry the job: finished stages are reused. If it happens again in one stage, a program that watches memory may "
    "have killed it: then ask for fewer keypoints (settings.max_keypoints) or smaller images (settings.max_side_px)."
)
_TRY_AGAIN = "Retry the job: finished stages are reused. If it fails again, report it with the end of its log."


@dataclass(frozen=True, kw_only=True)
class Succeeded:
    """The work is done.

    Attributes
    ----------
    report
        Of a reconstruction or aggregation, what `report.json` says, and of the latter what the version's record has of
        `map.json` as `map`; of a preflight, `findings` and `sound`; of a sub-map, `stages`, and whether
        each was reused; of an export, `results`, what became of each format.
    out
        Folder of the scene.
    """

    report: dict[str, Any]
    out: Path


@dataclass(frozen=True, kw_only=True)
class Planned:
    """The drive was cut, and its sub-maps come first."""

    plan: SubmapPlan


@dataclass(frozen=True, kw_only=True)
class Failed(ChildError):
    """The attempt failed.

    Attributes
    ----------
    code
        The engine's own, or out-of-memory, engine-killed, engine-abort, timeout, database, storage, worker-error,
        drive-deleted, export-deleted.
    is_storage
        Whether a store or a disk failed: each further attempt waits longer for it.
    stage
        In which it failed; empty before the first.
    log_tail
        The end of what the child printed.
    blame
        How much the attempt counts against its job, see `service.domain.jobs`.
    """

    stage: str
    log_tail: str = ""
    blame: float = jobs.FULL_BLAME


Outcome = Succeeded | Planned | Failed


@dataclass(frozen=True, kw_only=True)
class Ending:
    """The end of a child that was not stopped, or was stopped for its timeout.

    Attributes
    ----------
    returncode
        As in `subprocess`.
    timeout_s
        The time after which the supervisor stopped it; None where it did not.
    result
        What the child left, if it got so far.
    stage
        The last it reported.
    memory_kills
        How many processes the kernel has killed for lack of memory meanwhile; None where it does not say.
    """

    returncode: int
    timeout_s: float | None
    result: ChildResult | None
    stage: str
    log_tail: str
    memory_kills: int | None
    out: Path


def outcome_of(ending: Ending) -> Outcome:
    """The outcome of an attempt; a late result is better than a timeout."""
    result = ending.result or ChildResult()
    if result.report is not None:
        return Succeeded(report=result.report, out=ending.out)
    if result.plan is not None:
        return Planned(plan=result.plan)
    failed = partial(Failed, stage=ending.stage, log_tail=ending.log_tail)
    where = f"in stage '{ending.stage}'" if ending.stage else "before its first stage"
    if ending.timeout_s is not None:
        return failed(
            code="timeout",
            what=f"the attempt was stopped {where}: it took longer than {ending.timeout_s:g} s",
            remedy="Split the drive, or ask for fewer keypoints; who runs the service can set "
            "MRASFM_JOB_TIMEOUT_SECONDS. Finished stages are reused.",
            retryable=False,
        )
    if result.error is not None:
        return failed(**vars(result.error))
    killed = ending.returncode == -signal.SIGKILL
    if ending.returncode == EXIT_OUT_OF_MEMORY or (killed and ending.memory_kills):
        return failed(code="out-of-memory", what=f"memory ran out {where}", remedy=jobs.LESS_MEMORY, retryable=True)
    if killed:
        unknown = ending.memory_kills is None
        return failed(
            code="engine-killed",
            what=f"the engine's process was killed {where}"
            + (", most often because memory ran out" if unknown else ", and not by the kernel for lack of memory"),
            remedy=jobs.LESS_MEMORY if unknown else _KILLED,
            retryable=True,
            blame=jobs.blame_of_loss(engine_ran=True, memory_kills=ending.memory_kills),
        )
    return failed(
        code="engine-abort",
        what=f"the engine's process ended {where} {_how(ending.returncode)}",
        remedy=_TRY_AGAIN,
        retryable=True,
    )


def _how(returncode: int) -> str:
    if returncode == EXIT_DONE:
        return "without a result"
    if returncode > 0:
        return f"with an unexpected error (exit code {returncode})"
    try:
        return f"with {signal.Signals(-returncode).name}"
    except ValueError:
        return f"with signal {-returncode}"


def failed_here(error: Exception, stage: str) -> Failed:
    """The worker's own failure, without paths and addresses, which are the operator's and stand in the log."""
    if isinstance(error, SQLAlchemyError) and may_pass(error):
        return Failed(
            code="database",
            what="the service's database did not answer",
            remedy="Retry the job later; if it fails again, the operator finds the reason in the worker's log.",
            retryable=True,
            stage=stage,
            blame=jobs.NO_BLAME,
        )
    if not isinstance(error, OSError | StoreError):
        return Failed(
            code="worker-error",
            what="the worker failed outside of the engine",
            remedy="Retry the job; if it fails again, report it with the worker's log.",
            retryable=True,
            stage=stage,
        )
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
