"""Jobs, their attempts and their events."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from sqlalchemy import BigInteger, ForeignKey, Index, Integer, String
from sqlalchemy.orm import Mapped, mapped_column

from service.database.tables._base import Base, Id, Name, new_id, now_us


class JobState(StrEnum):
    """State of a job in the database. The last three never change again; STALLED is only shown."""

    QUEUED = "QUEUED"
    RUNNING = "RUNNING"
    SUCCEEDED = "SUCCEEDED"
    FAILED = "FAILED"
    CANCELLED = "CANCELLED"


TERMINAL = frozenset({JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED})


class Job(Base):
    """Work that was accepted. `service.domain.jobs` holds the only statements that change its state."""

    __tablename__ = "jobs"
    __table_args__ = (
        Index(None, "project_id", "created_us", "id"),
        # No index has a column that heartbeats change: in PostgreSQL each would write to all indexes of the table.
        Index(None, "state"),
        # The quota counts active jobs. Not a partial index: SQLite uses none for states that are given as parameters.
        Index(None, "project_id", "state", "kind"),
    )

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("job"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    kind: Mapped[str] = mapped_column(String(16))
    # No foreign keys: a job's record outlives the drive and the map. An aggregation has no drive, only it has a map.
    drive_id: Mapped[str | None] = mapped_column(Id, index=True)
    map_id: Mapped[str | None] = mapped_column(Id, index=True)
    request: Mapped[dict[str, Any] | None]  # of an aggregation, as asked; of a sub-map, its place; of an export, its id
    settings: Mapped[dict[str, Any]] = mapped_column(default=dict)
    state: Mapped[str] = mapped_column(String(16), default=JobState.QUEUED)
    revision: Mapped[int] = mapped_column(default=1)  # rises with every change that a reader can see
    attempt: Mapped[int] = mapped_column(default=0)  # as shown: rises with every claim
    blame: Mapped[float] = mapped_column(default=0.0)  # attempts that count against the job; some count half
    losses: Mapped[int] = mapped_column(default=0)  # that do not count, since the last finished stage
    engine_ran: Mapped[bool] = mapped_column(default=False)  # in this attempt
    memory_kills: Mapped[int | None]  # by the kernel during this attempt; known where its process was found dead
    fence: Mapped[int] = mapped_column(default=0)  # rises with every claim; an older holder can publish nothing
    owner: Mapped[str | None] = mapped_column(Name)
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
    scene_id: Mapped[str | None] = mapped_column(Id)
    map_version: Mapped[int | None]
    is_child: Mapped[bool] = mapped_column(default=False)  # made for another job, and ends when none needs it
    # The reconstruction that a sub-map is a piece of. No foreign key: its record may be deleted first.
    parent_id: Mapped[str | None] = mapped_column(Id, index=True)
    waiting_for: Mapped[int] = mapped_column(default=0)  # other jobs that have to end before this one can begin
    children_percent: Mapped[float] = mapped_column(default=0.0)  # of the whole, what these are worth
    retry_of: Mapped[str | None] = mapped_column(Id)
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
    owner: Mapped[str] = mapped_column(Name)
    started_us: Mapped[int] = mapped_column(default=now_us)
    finished_us: Mapped[int | None]
    outcome: Mapped[str | None] = mapped_column(String(40))  # succeeded, cancelled, released, or a problem's code
    problem: Mapped[dict[str, Any] | None]


class JobEvent(Base):
    """Event of a job's stream. Ids rise; a reader goes on after the last one it saw."""

    __tablename__ = "job_events"
    __table_args__ = (Index(None, "job_id", "id"), {"sqlite_autoincrement": True})

    # SQLite counts by itself only in a column of type INTEGER.
    id: Mapped[int] = mapped_column(BigInteger().with_variant(Integer, "sqlite"), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    kind: Mapped[str] = mapped_column(String(16))  # state or progress
    data: Mapped[dict[str, Any]]
    created_us: Mapped[int] = mapped_column(default=now_us)


class JobMember(Base):
    """A drive that an aggregation brings into its map: by a scene that is there, or by a job that makes one."""

    __tablename__ = "job_members"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    drive_id: Mapped[str] = mapped_column(Id, primary_key=True, index=True)
    name: Mapped[str] = mapped_column(String(100))  # of the scene in the map
    child_id: Mapped[str | None] = mapped_column(Id, index=True)
    scene_id: Mapped[str | None] = mapped_column(Id, index=True)
    problem: Mapped[dict[str, Any] | None]  # why there will be no scene
