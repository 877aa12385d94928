"""Records of the service about itself."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ForeignKey, String
from sqlalchemy.orm import Mapped, mapped_column

from service.database.tables._base import Base, Id, Name, Sha256, now_us


class IdempotencyKey(Base):
    """A POST that was made under a client's key, and its answer once there is one."""

    __tablename__ = "idempotency_keys"

    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"), primary_key=True)
    key: Mapped[str] = mapped_column(String(255), primary_key=True)
    request_sha256: Mapped[str] = mapped_column(Sha256)
    holder: Mapped[str] = mapped_column(Id)  # of the request in flight
    held_until_us: Mapped[int]
    status: Mapped[int | None]
    headers: Mapped[dict[str, Any] | None]
    body: Mapped[str | None]
    created_us: Mapped[int] = mapped_column(default=now_us, index=True)


class WorkerSeen(Base):
    """A worker's main process, as it last reported."""

    __tablename__ = "workers"

    name: Mapped[str] = mapped_column(Name, primary_key=True)
    queues: Mapped[str] = mapped_column(Name)
    concurrency: Mapped[int]
    started_us: Mapped[int] = mapped_column(default=now_us)
    seen_us: Mapped[int] = mapped_column(default=now_us)


class Pass(Base):
    """Time at which something that is done rarely was last done, by whichever process."""

    __tablename__ = "passes"

    name: Mapped[str] = mapped_column(String(40), primary_key=True)
    done_us: Mapped[int]
