"""Outcome of an attempt, in words that its user can act on."""

from __future__ import annotations

import signal
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from service.domain import jobs
from worker.child import EXIT_DONE, EXIT_OUT_OF_MEMORY
from worker.child_protocol import ChildError, ChildResult, ErrorKind
from worker.termination import StopReason

RETRYABLE = frozenset({ErrorKind.STORAGE, ErrorKind.OTHER})

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
        `map.json` as `map`; of a preflight, `findings` and `sound`.
    out
        Folder of the scene.
    """

    report: dict[str, Any]
    out: Path


@dataclass(frozen=True, kw_only=True)
class Failed:
    """The attempt failed.

    Attributes
    ----------
    code
        The engine's own, or out-of-memory, engine-killed, engine-abort, timeout, storage.
    retryable
        Whether another attempt may succeed.
    stage
        In which it failed; empty before the first.
    findings
        All that the check of the drive found, where that is what refused it.
    log_tail
        The end of what the child printed.
    is_storage
        Whether a store or a disk failed: each further attempt waits longer for it.
    blame
        How much the attempt counts against its job, see `service.domain.jobs`.
    """

    code: str
    what: str
    remedy: str
    retryable: bool
    stage: str
    findings: list[dict[str, str]] = field(default_factory=list)
    log_tail: str = ""
    is_storage: bool = False
    blame: float = jobs.FULL_BLAME


@dataclass(frozen=True, kw_only=True)
class Cancelled:
    """The attempt was cancelled, as its job's owner asked."""

    what: str
    remedy: str
    stage: str
    log_tail: str = ""


@dataclass(frozen=True, kw_only=True)
class Abandoned:
    """The attempt ended for reasons that are not the job's: it says nothing about it, and publishes nothing.

    After SHUT_DOWN the job waits for another worker; after FENCED and ORPHANED it may have one already.
    """

    reason: StopReason


Outcome = Succeeded | Failed | Cancelled | Abandoned


@dataclass(frozen=True, kw_only=True)
class Ending:
    """End of a child as its supervisor saw it.

    Attributes
    ----------
    returncode
        As in `subprocess`.
    stopped_for
        Why the supervisor stopped it, if it did.
    result
        What the child left, if it got so far.
    stage
        The last it reported.
    memory_kills
        How many processes the kernel has killed for lack of memory meanwhile; None where it does not say.
    """

    returncode: int
    stopped_for: StopReason | None
    result: ChildResult | None
    stage: str
    log_tail: str
    memory_kills: int | None
    out: Path
    timeout_s: float


def outcome_of(ending: Ending) -> Outcome:
    """Outcome of an attempt from the end of its child."""
    match ending.stopped_for:
        case StopReason.SHUT_DOWN | StopReason.FENCED | StopReason.ORPHANED as reason:
            return Abandoned(reason=reason)
        case StopReason.CANCEL:
            return Cancelled(
                what=f"the job was cancelled {_where(ending)}",
                remedy="Retry the job to go on: finished stages are reused.",
                stage=ending.stage,
                log_tail=ending.log_tail,
            )
    if ending.result is not None and ending.result.report is not None:
        return Succeeded(report=ending.result.report, out=ending.out)
    if ending.stopped_for is StopReason.TIMEOUT:
        return _failed(
            ending,
            code="timeout",
            what=f"the attempt was stopped {_where(ending)}: it took longer than {ending.timeout_s:g} s",
            remedy="Split the drive, or ask for fewer keypoints; who runs the service can set "
            "MRASFM_JOB_TIMEOUT_SECONDS. Finished stages are reused.",
            retryable=False,
        )
    if ending.result is not None and ending.result.error is not None:
        return _of_engine(ending, ending.result.error)
    return _of_exit(ending)


def _of_engine(ending: Ending, error: ChildError) -> Failed:
    """An error of the engine keeps its words."""
    return _failed(
        ending,
        code=error.code,
        what=error.what,
        remedy=error.remedy,
        retryable=error.kind in RETRYABLE,
        findings=error.findings,
        is_storage=error.kind is ErrorKind.STORAGE,
    )


def _of_exit(ending: Ending) -> Failed:
    """There is no result: what the exit code or signal says."""
    killed = ending.returncode == -signal.SIGKILL
    if ending.returncode == EXIT_OUT_OF_MEMORY or (killed and ending.memory_kills):
        return _failed(
            ending,
            code="out-of-memory",
            what=f"memory ran out {_where(ending)}",
            remedy=jobs.LESS_MEMORY,
            retryable=True,
        )
    if killed:
        unknown = ending.memory_kills is None
        return _failed(
            ending,
            code="engine-killed",
            what=f"the engine's process was killed {_where(ending)}"
            + (", most often because memory ran out" if unknown else ", and not by the kernel for lack of memory"),
            remedy=jobs.LESS_MEMORY if unknown else _KILLED,
            retryable=True,
            blame=jobs.blame_of_loss(engine_ran=True, memory_kills=ending.memory_kills),
        )
    return _failed(
        ending,
        code="engine-abort",
        what=f"the engine's process ended {_where(ending)} {_how(ending.returncode)}",
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


def _where(ending: Ending) -> str:
    return f"in stage {ending.stage!r}" if ending.stage else "before its first stage"


def _failed(
    ending: Ending,
    *,
    code: str,
    what: str,
    remedy: str,
    retryable: bool,
    findings: list[dict[str, str]] | None = None,
    is_storage: bool = False,
    blame: float = jobs.FULL_BLAME,
) -> Failed:
    return Failed(
        code=code,
        what=what,
        remedy=remedy,
        retryable=retryable,
        stage=ending.stage,
        findings=findings or [],
        is_storage=is_storage,
        blame=blame,
        log_tail=ending.log_tail,
    )
