"""Projects, who may act for them, and their bytes."""

from __future__ import annotations

from sqlalchemy import ForeignKey, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from service.database.tables._base import Base, Id, Name, Path, Sha256, new_id, now_us


class Project(Base):
    """Owner of drives, scenes and quotas."""

    __tablename__ = "projects"

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("prj"))
    name: Mapped[str] = mapped_column(Name, unique=True)
    used_bytes: Mapped[int] = mapped_column(default=0)  # of all its blobs
    max_bytes: Mapped[int]
    max_active_jobs: Mapped[int]
    max_drives: Mapped[int]
    created_us: Mapped[int] = mapped_column(default=now_us)


class ApiKey(Base):
    """A bearer key: only its hash is kept."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("key"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    name: Mapped[str] = mapped_column(Name)
    secret_sha256: Mapped[str] = mapped_column(Sha256, unique=True)
    created_us: Mapped[int] = mapped_column(default=now_us)
    revoked_us: Mapped[int | None]


class Blob(Base):
    """Bytes in the artifact store, once a project for every content.

    The key holds a random part: bytes that are stored anew never meet the deletion of their predecessor.
    """

    __tablename__ = "blobs"
    __table_args__ = (UniqueConstraint("project_id", "sha256"),)

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("blb"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    sha256: Mapped[str] = mapped_column(Sha256)
    size_bytes: Mapped[int]
    key: Mapped[str] = mapped_column(Path, unique=True)
    # The start of the machine in which it was written, until it is safe from a power cut: see `durability`.
    written_in_boot: Mapped[str | None] = mapped_column(Id)
    touched_us: Mapped[int] = mapped_column(default=now_us)  # collected only when unused and untouched for a while
