"""All that the service has accepted, as the client remembers it."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field

from tests.benchmarks.chaos.drives import Sendable, sha256_of

TERMINAL = ("SUCCEEDED", "FAILED", "CANCELLED")


@dataclass(frozen=True, kw_only=True)
class AcceptedDrive:
    """A drive whose commit was answered with success."""

    id: str
    name: str
    manifest: bytes = field(repr=False)
    files: Mapping[str, str] = field(repr=False)  # path -> SHA-256


@dataclass(frozen=True, kw_only=True)
class AcceptedJob:
    """A job that was answered with 202, and the drives that it is of."""

    id: str
    kind: str
    drive_ids: tuple[str, ...]


class Ledger:
    """May be written to by many threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._created: set[str] = set()
        self._drives: dict[str, AcceptedDrive] = {}
        self._jobs: dict[str, AcceptedJob] = {}
        self._ends: dict[str, str] = {}
        self._broken_promises: list[str] = []

    @property
    def created(self) -> Set[str]:
        """Ids of all drives whose creation was answered, committed or not."""
        with self._lock:
            return set(self._created)

    @property
    def drives(self) -> Mapping[str, AcceptedDrive]:
        """By id."""
        with self._lock:
            return dict(self._drives)

    @property
    def jobs(self) -> Mapping[str, AcceptedJob]:
        """By id."""
        with self._lock:
            return dict(self._jobs)

    @property
    def ends(self) -> Mapping[str, str]:
        """The first terminal state that was seen of a job."""
        with self._lock:
            return dict(self._ends)

    @property
    def broken_promises(self) -> Sequence[str]:
        """What the service answered and must not: refusals of sound requests, bytes that were there and are not."""
        with self._lock:
            return list(self._broken_promises)

    def create_drive(self, drive_id: str) -> None:
        """The creation was answered; nothing more is promised until the commit is."""
        with self._lock:
            self._created.add(drive_id)

    def accept_drive(self, drive_id: str, sent: Sendable) -> None:
        """The commit was answered."""
        files = {path: sha256_of(data) for path, data in sent.files.items()}
        with self._lock:
            self._created.add(drive_id)
            self._drives[drive_id] = AcceptedDrive(id=drive_id, name=sent.name, manifest=sent.manifest, files=files)

    def accept_job(self, job_id: str, kind: str, drive_ids: Sequence[str]) -> None:
        """The job was answered."""
        with self._lock:
            self._jobs[job_id] = AcceptedJob(id=job_id, kind=kind, drive_ids=tuple(drive_ids))

    def see_state(self, job_id: str, state: str) -> None:
        """A job was shown in this state; what ended must never be shown in another."""
        with self._lock:
            ended = self._ends.get(job_id)
            if ended is not None and state != ended:
                self._broken_promises.append(f"job {job_id} was {ended} and is {state}")
            elif state in TERMINAL:
                self._ends[job_id] = state

    def note_broken_promise(self, what: str) -> None:
        """Something was answered that must not be."""
        with self._lock:
            self._broken_promises.append(what)

    def unfinished(self) -> list[str]:
        """Ids of accepted jobs whose end has not been seen."""
        with self._lock:
            return [job_id for job_id in self._jobs if job_id not in self._ends]
