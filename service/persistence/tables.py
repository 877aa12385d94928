"""The database's tables.

Times are integer microseconds since 1970 (UTC), as everywhere in the product: SQLite has no type for them, and
comparing integers is the same in every database. Ids are random; foreign ids cannot be guessed.
"""

from __future__ import annotations

import secrets
import time
from enum import StrEnum
from typing import Any

from sqlalchemy import JSON, BigInteger, ForeignKey, Index, Integer, MetaData, String, UniqueConstraint
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from schemas.api.drives import DriveState, PreflightState

_NAMES = {  # so that migrations can name what they change in every database
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
    "pk": "pk_%(table_name)s",
}
_Id = String(40)
_Sha256 = String(64)
_Path = String(1024)


def now_us() -> int:
    """Microseconds since 1970."""
    return time.time_ns() // 1000


def new_id(prefix: str) -> str:
    """A random id of 120 bits whose prefix says what it names, such as `drv_`."""
    return f"{prefix}_{secrets.token_hex(15)}"


class JobState(StrEnum):
    """Where a job is in the database. The last three never change again; STALLED is only shown."""

    QUEUED = "QUEUED"
    RUNNING = "RUNNING"
    SUCCEEDED = "SUCCEEDED"
    FAILED = "FAILED"
    CANCELLED = "CANCELLED"


TERMINAL = frozenset({JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED})


class Base(DeclarativeBase):
    """Root of all tables."""

    metadata = MetaData(naming_convention=_NAMES)
    type_annotation_map = {int: BigInteger, dict[str, Any]: JSON, list[Any]: JSON}  # noqa: RUF012 (SQLAlchemy's way)


class Project(Base):
    """Who shares drives, scenes and quotas."""

    __tablename__ = "projects"

    id: Mapped[str] = mapped_column(_Id, primary_key=True, default=lambda: new_id("prj"))
    name: Mapped[str] = mapped_column(String(200), unique=True)
    used_bytes: Mapped[int] = mapped_column(default=0)  # of all its blobs
    max_bytes: Mapped[int]
    max_active_jobs: Mapped[int]
    max_drives: Mapped[int]
    created_us: Mapped[int] = mapped_column(default=now_us)


class ApiKey(Base):
    """A bearer key: only its hash is kept."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(_Id, primary_key=True, default=lambda: new_id("key"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    name: Mapped[str] = mapped_column(String(200))
    secret_sha256: Mapped[str] = mapped_column(_Sha256, unique=True)
    created_us: Mapped[int] = mapped_column(default=now_us)
    revoked_us: Mapped[int | None]


class Blob(Base):
    """Bytes in the artifact store, once a project for every content.

    The key holds a random part: bytes that are stored anew never meet the deletion of their predecessor.
    """

    __tablename__ = "blobs"
    __table_args__ = (UniqueConstraint("project_id", "sha256"),)

    id: Mapped[str] = mapped_column(_Id, primary_key=True, default=lambda: new_id("blb"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    sha256: Mapped[str] = mapped_column(_Sha256)
    size_bytes: Mapped[int]
    key: Mapped[str] = mapped_column(_Path, unique=True)
    # The start of the machine in which it was written, until it is safe from a power cut: see `durability`.
    written_in_boot: Mapped[str | None] = mapped_column(_Id)
    touched_us: Mapped[int] = mapped_column(default=now_us)  # collected only when unused and untouched for a while


class Drive(Base):
    """A recorded drive."""

    __tablename__ = "drives"
    __table_args__ = (Index(None, "project_id", "created_us", "id"),)

    id: Mapped[str] = mapped_column(_Id, primary_key=True, default=lambda: new_id("drv"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    name: Mapped[str] = mapped_column(String(200))
    state: Mapped[str] = mapped_column(String(16), default=DriveState.OPEN)
    manifest_blob_id: Mapped[str] = mapped_column(ForeignKey("blobs.id"), index=True)
    cameras: Mapped[int]
    frames: Mapped[int]
    files_expected: Mapped[int]
    has_gnss: Mapped[bool]
    preflight_state: Mapped[str] = mapped_column(String(16), default=PreflightState.NONE)
    findings: Mapped[list[Any]] = mapped_column(default=list)
    preflight_job_id: Mapped[str | None] = mapped_column(_Id)
    created_us: Mapped[int] = mapped_column(default=now_us)
    committed_us: Mapped[int | None]
    expires_us: Mapped[int | None] = mapped_column(index=True)


class DriveFile(Base):
    """A file that a drive's manifest names, with its bytes once they are here."""

    __tablename__ = "drive_files"

    drive_id: Mapped[str] = mapped_column(ForeignKey("drives.id", ondelete="CASCADE"), primary_key=True)
    path: Mapped[str] = mapped_column(_Path, primary_key=True)
    role: Mapped[str] = mapped_column(String(8))  # image or mask
    blob_id: Mapped[str | None] = mapped_column(ForeignKey("blobs.id"), index=True)
    stored_us: Mapped[int | None]


class Job(Base):
    """Work that was accepted. `persistence.jobs` holds the only statements that change its state."""

    __tablename__ = "jobs"
    __table_args__ = (
        Index(None, "project_id", "created_us", "id"),
        Index(None, "state", "lease_until_us"),
    )

    id: Mapped[str] = mapped_column(_Id, primary_key=True, default=lambda: new_id("job"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    kind: Mapped[str] = mapped_column(String(16))
    # No foreign key: a job's record outlives the drive.
    drive_id: Mapped[str] = mapped_column(_Id, index=True)
    settings: Mapped[dict[str, Any]] = mapped_column(default=dict)
    state: Mapped[str] = mapped_column(String(16), default=JobState.QUEUED)
    revision: Mapped[int] = mapped_column(default=1)  # rises with every change that a reader can see
    attempt: Mapped[int] = mapped_column(default=0)
    fence: Mapped[int] = mapped_column(default=0)  # rises with every claim; an older holder can publish nothing
    owner: Mapped[str | None] = mapped_column(String(200))
    lease_until_us: Mapped[int | None]
    heartbeat_us: Mapped[int | None]
    cancel_requested_us: Mapped[int | None]
    not_before_us: Mapped[int] = mapped_column(default=0)
    enqueued_us: Mapped[int | None]
    stage: Mapped[str | None] = mapped_column(String(40))
    done: Mapped[int | None]
    total: Mapped[int | None]
    unit: Mapped[str | None] = mapped_column(String(40))
    percent: Mapped[float] = mapped_column(default=0.0)
    eta_low_s: Mapped[float | None]
    eta_high_s: Mapped[float | None]
    reused: Mapped[list[Any]] = mapped_column(default=list)  # stages whose results were there already
    problem: Mapped[dict[str, Any] | None]
    scene_id: Mapped[str | None] = mapped_column(_Id)
    retry_of: Mapped[str | None] = mapped_column(_Id)
    created_us: Mapped[int] = mapped_column(default=now_us)
    started_us: Mapped[int | None]
    finished_us: Mapped[int | None]
    expires_us: Mapped[int | None] = mapped_column(index=True)


class JobAttempt(Base):
    """One try at a job, by one worker."""

    __tablename__ = "job_attempts"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    fence: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    attempt: Mapped[int]
    owner: Mapped[str] = mapped_column(String(200))
    started_us: Mapped[int] = mapped_column(default=now_us)
    finished_us: Mapped[int | None]
    outcome: Mapped[str | None] = mapped_column(String(40))  # succeeded, cancelled, or a problem's code
    problem: Mapped[dict[str, Any] | None]


class JobEvent(Base):
    """What a job's event stream says. Ids rise; a reader goes on after the last one it saw."""

    __tablename__ = "job_events"
    __table_args__ = (Index(None, "job_id", "id"), {"sqlite_autoincrement": True})

    # SQLite counts by itself only in a column of type INTEGER.
    id: Mapped[int] = mapped_column(BigInteger().with_variant(Integer, "sqlite"), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    kind: Mapped[str] = mapped_column(String(16))  # state or progress
    data: Mapped[dict[str, Any]]
    created_us: Mapped[int] = mapped_column(default=now_us)


class Scene(Base):
    """The published result of one reconstruction; at most one a job."""

    __tablename__ = "scenes"
    __table_args__ = (Index(None, "project_id", "created_us", "id"),)

    id: Mapped[str] = mapped_column(_Id, primary_key=True, default=lambda: new_id("scn"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    job_id: Mapped[str] = mapped_column(_Id, unique=True)
    drive_id: Mapped[str] = mapped_column(_Id, index=True)
    name: Mapped[str] = mapped_column(String(200))
    fence: Mapped[int]
    summary: Mapped[dict[str, Any]]
    created_us: Mapped[int] = mapped_column(default=now_us)
    expires_us: Mapped[int | None] = mapped_column(index=True)


class SceneFile(Base):
    """One artifact of a scene."""

    __tablename__ = "scene_files"

    scene_id: Mapped[str] = mapped_column(ForeignKey("scenes.id", ondelete="CASCADE"), primary_key=True)
    path: Mapped[str] = mapped_column(_Path, primary_key=True)
    blob_id: Mapped[str] = mapped_column(ForeignKey("blobs.id"), index=True)
    media_type: Mapped[str] = mapped_column(String(100))


class Checkpoint(Base):
    """A finished stage of a drive under certain settings, for the next attempt or the next job."""

    __tablename__ = "checkpoints"

    drive_id: Mapped[str] = mapped_column(ForeignKey("drives.id", ondelete="CASCADE"), primary_key=True)
    settings_sha256: Mapped[str] = mapped_column(_Sha256, primary_key=True)
    name: Mapped[str] = mapped_column(String(100), primary_key=True)
    blob_id: Mapped[str] = mapped_column(ForeignKey("blobs.id"), index=True)
    created_us: Mapped[int] = mapped_column(default=now_us)


class IdempotencyKey(Base):
    """A POST that was made under a client's key, and its answer once there is one."""

    __tablename__ = "idempotency_keys"

    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"), primary_key=True)
    key: Mapped[str] = mapped_column(String(255), primary_key=True)
    request_sha256: Mapped[str] = mapped_column(_Sha256)
    holder: Mapped[str] = mapped_column(_Id)  # of the request in flight
    held_until_us: Mapped[int]
    status: Mapped[int | None]
    headers: Mapped[dict[str, Any] | None]
    body: Mapped[str | None]
    created_us: Mapped[int] = mapped_column(default=now_us, index=True)


class WorkerSeen(Base):
    """A worker's main process, as it last reported."""

    __tablename__ = "workers"

    name: Mapped[str] = mapped_column(String(200), primary_key=True)
    queues: Mapped[str] = mapped_column(String(200))
    concurrency: Mapped[int]
    started_us: Mapped[int] = mapped_column(default=now_us)
    seen_us: Mapped[int] = mapped_column(default=now_us)
