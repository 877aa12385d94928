"""Scenes, maps and exports: what jobs publish."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ForeignKey, ForeignKeyConstraint, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from service.database.tables._base import Base, Id, Name, Path, Sha256, new_id, now_us


class Scene(Base):
    """The published result of one reconstruction; at most one a job."""

    __tablename__ = "scenes"
    __table_args__ = (Index(None, "project_id", "created_us", "id"),)

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("scn"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    job_id: Mapped[str] = mapped_column(Id, unique=True)
    drive_id: Mapped[str] = mapped_column(Id, index=True)
    name: Mapped[str] = mapped_column(Name)
    fence: Mapped[int]
    settings_sha256: Mapped[str | None] = mapped_column(Sha256)  # under which it was made; None: not known any more
    summary: Mapped[dict[str, Any]]
    created_us: Mapped[int] = mapped_column(default=now_us)
    expires_us: Mapped[int | None] = mapped_column(index=True)


class SceneFile(Base):
    """One artifact of a scene."""

    __tablename__ = "scene_files"

    scene_id: Mapped[str] = mapped_column(ForeignKey("scenes.id", ondelete="CASCADE"), primary_key=True)
    path: Mapped[str] = mapped_column(Path, primary_key=True)
    blob_id: Mapped[str] = mapped_column(ForeignKey("blobs.id"), index=True)
    media_type: Mapped[str] = mapped_column(String(100))


class Map(Base):
    """Result of aggregations, version by version.

    One that has no version yet is being made, or failed to be: it goes with the record of the job that tried last.
    """

    __tablename__ = "maps"
    __table_args__ = (Index(None, "project_id", "created_us", "id"),)

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("map"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    name: Mapped[str] = mapped_column(Name)
    current_version: Mapped[int | None]
    newest_version: Mapped[int] = mapped_column(default=0)  # its number is not given again, also where it is deleted
    created_us: Mapped[int] = mapped_column(default=now_us)
    expires_us: Mapped[int | None] = mapped_column(index=True)


class MapVersion(Base):
    """The published result of one aggregation; at most one a job, and it never changes."""

    __tablename__ = "map_versions"

    map_id: Mapped[str] = mapped_column(ForeignKey("maps.id", ondelete="CASCADE"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    job_id: Mapped[str] = mapped_column(Id, unique=True)
    fence: Mapped[int]
    summary: Mapped[dict[str, Any]]
    failed: Mapped[list[Any]] = mapped_column(default=list)  # drives that were asked for and have no scene
    created_us: Mapped[int] = mapped_column(default=now_us)


_VERSION = ("map_versions.map_id", "map_versions.number")


class MapScene(Base):
    """A scene of a map's version."""

    __tablename__ = "map_scenes"
    __table_args__ = (ForeignKeyConstraint(["map_id", "number"], _VERSION, ondelete="CASCADE"),)

    map_id: Mapped[str] = mapped_column(Id, primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    name: Mapped[str] = mapped_column(String(100), primary_key=True)
    # The scene stays while the map names it; its drive, too.
    drive_id: Mapped[str] = mapped_column(Id, index=True)
    scene_id: Mapped[str] = mapped_column(ForeignKey("scenes.id"), index=True)
    connected: Mapped[bool]


class MapFile(Base):
    """One artifact of a map's version."""

    __tablename__ = "map_files"
    __table_args__ = (ForeignKeyConstraint(["map_id", "number"], _VERSION, ondelete="CASCADE"),)

    map_id: Mapped[str] = mapped_column(Id, primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    path: Mapped[str] = mapped_column(Path, primary_key=True)
    blob_id: Mapped[str] = mapped_column(ForeignKey("blobs.id"), index=True)
    media_type: Mapped[str] = mapped_column(String(100))


class MapCheckpoint(Base):
    """A finished stage of an aggregation of certain scenes under certain settings; it goes with the map."""

    __tablename__ = "map_checkpoints"
    __table_args__ = (Index(None, "project_id", "inputs_sha256"),)

    map_id: Mapped[str] = mapped_column(ForeignKey("maps.id", ondelete="CASCADE"), primary_key=True)
    inputs_sha256: Mapped[str] = mapped_column(Sha256, primary_key=True)
    name: Mapped[str] = mapped_column(String(100), primary_key=True)
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    blob_id: Mapped[str] = mapped_column(ForeignKey("blobs.id"), index=True)
    created_us: Mapped[int] = mapped_column(default=now_us)


class Export(Base):
    """A scene or a version of a map in formats of other programs: recorded when it is asked for, with its job."""

    __tablename__ = "exports"
    __table_args__ = (
        ForeignKeyConstraint(["map_id", "map_version"], _VERSION, ondelete="CASCADE"),
        Index(None, "project_id", "created_us", "id"),
        Index(None, "project_id", "inputs_sha256"),
        Index(None, "map_id", "map_version"),
    )

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("exp"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    scene_id: Mapped[str | None] = mapped_column(ForeignKey("scenes.id", ondelete="CASCADE"), index=True)
    map_id: Mapped[str | None] = mapped_column(Id)
    map_version: Mapped[int | None]
    job_id: Mapped[str] = mapped_column(Id, index=True)  # the newest that makes it
    fence: Mapped[int | None]  # of the attempt that published it
    inputs_sha256: Mapped[str] = mapped_column(Sha256)  # of all that its files are made of: the same gives the same
    formats: Mapped[list[Any]]
    options: Mapped[dict[str, Any]]
    results: Mapped[list[Any] | None]  # by format; null until it is published
    created_us: Mapped[int] = mapped_column(default=now_us)
    expires_us: Mapped[int | None] = mapped_column(index=True)


class ExportFile(Base):
    """One file of an export."""

    __tablename__ = "export_files"

    export_id: Mapped[str] = mapped_column(ForeignKey("exports.id", ondelete="CASCADE"), primary_key=True)
    path: Mapped[str] = mapped_column(Path, primary_key=True)
    blob_id: Mapped[str] = mapped_column(ForeignKey("blobs.id"), index=True)
    media_type: Mapped[str] = mapped_column(String(100))
