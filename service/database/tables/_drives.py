"""Drives and what is uploaded for them."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from schemas.api.drives import DriveState, PreflightState
from service.database.tables._base import Base, Id, Name, Path, Sha256, new_id, now_us


class Drive(Base):
    """A recorded drive."""

    __tablename__ = "drives"
    __table_args__ = (
        Index(None, "project_id", "created_us", "id"),
        Index(None, "project_id", "vehicle", "created_us", "id"),
    )

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("drv"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    name: Mapped[str] = mapped_column(Name)
    vehicle: Mapped[str | None] = mapped_column(String(64))  # as the manifest says
    state: Mapped[str] = mapped_column(String(16), default=DriveState.OPEN)
    manifest_blob_id: Mapped[str] = mapped_column(ForeignKey("blobs.id"), index=True)
    cameras: Mapped[int]
    frames: Mapped[int]
    files_expected: Mapped[int]
    files_stored: Mapped[int | None]  # None as long as they change
    bytes_stored: Mapped[int | None]
    has_gnss: Mapped[bool]
    preflight_state: Mapped[str] = mapped_column(String(16), default=PreflightState.NONE)
    findings: Mapped[list[Any]] = mapped_column(default=list)
    preflight_job_id: Mapped[str | None] = mapped_column(Id)
    created_us: Mapped[int] = mapped_column(default=now_us)
    committed_us: Mapped[int | None]
    expires_us: Mapped[int | None] = mapped_column(index=True)


class DriveFile(Base):
    """A file that a drive's manifest names, with its bytes once they are here."""

    __tablename__ = "drive_files"

    drive_id: Mapped[str] = mapped_column(ForeignKey("drives.id", ondelete="CASCADE"), primary_key=True)
    path: Mapped[str] = mapped_column(Path, primary_key=True)
    role: Mapped[str] = mapped_column(String(8))  # image or mask
    blob_id: Mapped[str | None] = mapped_column(ForeignKey("blobs.id"), index=True)
    stored_us: Mapped[int | None]


class Checkpoint(Base):
    """A finished stage of a drive under certain settings, for the next attempt or the next job."""

    __tablename__ = "checkpoints"

    drive_id: Mapped[str] = mapped_column(ForeignKey("drives.id", ondelete="CASCADE"), primary_key=True)
    settings_sha256: Mapped[str] = mapped_column(Sha256, primary_key=True)
    name: Mapped[str] = mapped_column(String(100), primary_key=True)
    blob_id: Mapped[str] = mapped_column(ForeignKey("blobs.id"), index=True)
    created_us: Mapped[int] = mapped_column(default=now_us)


class Upload(Base):
    """A resumable upload, of one file of a drive or of an archive of its files. Its bytes lie in the spool.

    How many of them count is in `service.storage.uploads.resumable`.
    """

    __tablename__ = "uploads"

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("upl"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"), index=True)
    drive_id: Mapped[str] = mapped_column(ForeignKey("drives.id", ondelete="CASCADE"), index=True)
    path: Mapped[str | None] = mapped_column(Path)  # None: an archive
    size_bytes: Mapped[int]
    sha256: Mapped[str | None] = mapped_column(Sha256)  # as announced
    given_metadata: Mapped[str] = mapped_column(String(8192))  # Upload-Metadata as it came
    replace: Mapped[bool]
    kept_bytes: Mapped[int] = mapped_column(default=0)  # are on the disk, and right where a checksum came with them
    # The start of the machine in which all bytes of the file count; None or another one: no more than kept_bytes.
    tail_boot: Mapped[str | None] = mapped_column(Id)
    is_done: Mapped[bool] = mapped_column(default=False)  # its bytes are the drive's
    created_us: Mapped[int] = mapped_column(default=now_us)
    expires_us: Mapped[int] = mapped_column(index=True)
