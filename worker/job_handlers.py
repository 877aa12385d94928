"""Handlers of the kinds of jobs: inputs, shelf of finished stages, and publication of the result.

The shelf is known once the inputs are laid out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

from sqlalchemy.orm import Session

from schemas.api.jobs import JobKind
from schemas.api.maps import MapSummary
from schemas.api.scenes import SceneSummary
from service.database.connections import Database
from service.database.tables import now_us
from service.domain import jobs, maps, scenes
from service.domain.checkpoints import DriveShelf, MapShelf, Shelf, settings_sha256
from service.domain.drive_checkout import materialise
from service.domain.map_inputs import MapInputs, inputs_of
from service.settings import Settings
from service.storage.artifacts import Fetch
from service.storage.blob_writer import StoredFile
from worker.attempt import AttemptFolder
from worker.child_protocol import Attempt, Work
from worker.outcomes import Succeeded


class DriveHandler:
    """The check of a drive, or its reconstruction."""

    def __init__(self, database: Database, held: jobs.Claim) -> None:
        self._database, self._held = database, held
        self._drive_id = held.drive_id or ""

    @property
    def shelf(self) -> Shelf | None:
        """The shelf of the drive under these settings; a check shares no stages."""
        if self._held.kind is not JobKind.RECONSTRUCTION:
            return None
        return DriveShelf(self._drive_id, settings_sha256(self._held.settings))

    def lay_out(self, folder: AttemptFolder, fetch: Fetch, progress: Callable[[int, int], None]) -> Attempt:
        """The drive as a folder.

        Raises
        ------
        DriveGoneError
            Where the drive was deleted.
        """
        drive = folder.root / "drive"
        contents = materialise(self._database, self._drive_id, drive, fetch=fetch, progress=progress)
        work, settings = Work(self._held.kind.lower()), self._held.settings
        return Attempt(work=work, drive=drive, content_sha256=contents, settings=settings)

    def publish(
        self, session: Session, done: Succeeded, files: Mapping[str, StoredFile], settings: Settings
    ) -> dict[str, Any]:
        """Record the scene of stored files, by path, and end the job; the ids of what was made, for the log."""
        scene_id = scenes.publish(
            session,
            self._held,
            files=files,
            summary=SceneSummary(**_figures(done.report)),
            expires_us=_expires_us(settings.scene_retention_days),
            reused=_reused(done.report),
        )
        return {"scene_id": scene_id}


class AggregationHandler:
    """An aggregation."""

    def __init__(self, database: Database, held: jobs.Claim) -> None:
        self._database, self._held = database, held

    @cached_property
    def _inputs(self) -> MapInputs:
        """Read where they are needed: what publishes must not fail for a database that is away for a moment."""
        with self._database.read() as session:
            return inputs_of(session, self._held.job_id)

    @property
    def shelf(self) -> Shelf | None:
        """The shelf of every pair of its scenes, under these settings."""
        held = self._held
        ids = self._inputs.scene_ids
        return MapShelf.from_scenes(held.map_id or "", held.project_id, scenes=ids, settings=held.settings)

    def lay_out(self, folder: AttemptFolder, fetch: Fetch, progress: Callable[[int, int], None]) -> Attempt:
        """The scenes as folders, and the version that they are added to."""
        inputs, root = self._inputs, folder.root
        into = root / "base" if inputs.base else None
        wanted = [(root / "scenes" / name / file.path, file) for name, files in inputs.scenes.items() for file in files]
        wanted += [(root / "base" / file.path, file) for file in inputs.base]
        for i, (target, file) in enumerate(wanted):
            target.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            fetch(file.key, target)
            progress(i + 1, len(wanted))
        return Attempt(
            work=Work.AGGREGATION,
            settings=self._held.settings,
            scenes={name: root / "scenes" / name for name in inputs.scenes},
            into=into,
            remove=inputs.remove,
            failed=inputs.failed,
            members=inputs.members,
            leave_out=not inputs.require_all,
        )

    def publish(
        self, session: Session, done: Succeeded, files: Mapping[str, StoredFile], settings: Settings
    ) -> dict[str, Any]:
        """Record the map's next version, likewise."""
        number = maps.publish(
            session,
            self._held,
            files=files,
            summary=_map_summary(done.report),
            unconnected=done.report["map"]["unconnected"],
            failed=done.report["failed_drives"],
            expires_us=_expires_us(settings.map_retention_days),
            reused=_reused(done.report),
        )
        return {"map_id": self._held.map_id, "version": number}


JobHandler = DriveHandler | AggregationHandler


def handler_of(database: Database, held: jobs.Claim) -> JobHandler:
    """The handler for a job's kind."""
    return (AggregationHandler if held.kind is JobKind.AGGREGATION else DriveHandler)(database, held)


def _expires_us(days: float | None) -> int | None:
    return None if days is None else now_us() + int(days * 86400e6)


def _reused(report: Mapping[str, Any]) -> Sequence[str]:
    return [stage["stage"] for stage in report["stages"] if stage["reused"]]


def _map_summary(report: Mapping[str, Any]) -> MapSummary:
    figures = report["map"]
    return MapSummary(
        **_figures(report),
        scenes=figures["scenes"],
        connected=figures["scenes"] - len(figures["unconnected"]),
        seams=figures["seams"],
    )


def _figures(report: Mapping[str, Any]) -> dict[str, Any]:
    summary = report["summary"]
    return {
        "registered_units": summary["registered_units"],
        "units": summary["total_units"],
        "registered_images": summary["registered_images"],
        "images": summary["total_images"],
        "points": summary["points"],
        "georeferenced": summary["georeferenced"],
        "warnings": len(report["findings"]),
        "engine_version": report["engine_version"],
    }
