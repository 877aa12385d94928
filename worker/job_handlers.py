"""Handlers of the kinds of jobs: inputs, shelf of finished stages, and publication of the result.

The shelf is known once the inputs are laid out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from sqlalchemy.orm import Session

from schemas.api.jobs import JobKind
from schemas.api.maps import MapSummary
from schemas.api.scenes import SceneSummary
from schemas.artifacts import PLAN_CHECKPOINTS, SUBMAP_STAGES, checkpoint_file, submap_checkpoint, submap_number
from service.database.connections import Transactions
from service.database.tables import now_us
from service.domain import checkpoints, exports, jobs, maps, scenes, workers
from service.domain.checkpoints import DriveShelf, MapShelf, Shelf, settings_sha256
from service.domain.drive_checkout import check_out
from service.domain.export_inputs import ExportInputs
from service.domain.map_inputs import MapInputs, StoredArtifact, inputs_of
from service.job_queue import QUEUES
from service.settings import Settings
from service.storage.artifacts import Fetch
from service.storage.blob_writer import StoredFile
from service.storage.on_demand import OnDemandFolder
from service.storage.transfers import fetch_each
from worker.attempt import AttemptFolder
from worker.child_protocol import Attempt, SubmapPlan, Work
from worker.outcomes import Succeeded


class PreflightHandler:
    """The check of a drive."""

    shelf: Shelf | None = None  # it shares no stages
    files: OnDemandFolder | None = None  # of a drive, where not all that are needed were laid out

    def __init__(self, records: Transactions, held: jobs.Claim, settings: Settings) -> None:
        self._records, self._held, self._settings = records, held, settings
        self._drive_id = held.drive_id or ""

    def is_wanted(self, name: str) -> bool:
        """Return whether a finished stage of the shelf is brought, by the name of its file."""
        return True

    def lay_out(self, folder: AttemptFolder, fetch: Fetch, progress: Callable[[int, int], None]) -> Attempt:
        """The drive as a folder; of one that is too large for this disk the manifest.

        Raises
        ------
        DriveGoneError
            Where the drive was deleted.
        """
        return self._attempt(folder, fetch, progress)

    def _attempt(
        self,
        folder: AttemptFolder,
        fetch: Fetch,
        progress: Callable[[int, int], None],
        *,
        units: range | None = None,
    ) -> Attempt:
        drive = check_out(self._records, self._drive_id, folder.root / "drive", fetch=fetch, units=units)
        room_bytes = self._settings.drive_room_bytes
        # In a folder the files exist once, however many drives are laid out.
        if drive.size_bytes <= room_bytes or self._settings.stores_in_folder:
            drive.bring_all(fetch, progress)
        else:
            self.files = drive.on_demand(fetch, room_bytes=room_bytes)
        return Attempt(
            work=Work(self._held.kind.lower()),
            drive=drive.folder,
            content_sha256=drive.content_sha256,
            settings=self._held.settings,
        )

    def publish(
        self, session: Session, done: Succeeded, files: Mapping[str, StoredFile], settings: Settings
    ) -> dict[str, Any]:
        """Record the findings and end the job; what was found, for the log."""
        sound = bool(done.report["sound"])
        jobs.record_findings(session, self._held, done.report["findings"], sound=sound)
        return {"sound": sound}


class _StagesHandler(PreflightHandler):
    """A job whose finished stages lie on the shelf of its drive under its settings."""

    def __init__(self, records: Transactions, held: jobs.Claim, settings: Settings) -> None:
        super().__init__(records, held, settings)
        self._stages = DriveShelf(self._drive_id, settings_sha256(held.settings))
        self.shelf = self._stages

    def _require_stored(self, session: Session, names: Iterable[str]) -> None:
        """Refuse to go on where others would not find what was finished here.

        Raises
        ------
        FileNotFoundError
            Where a stage is not on the shelf.
        """
        missing = checkpoints.missing(session, self._stages, [checkpoint_file(name) for name in names])
        if missing:
            raise FileNotFoundError(f"finished stages are not in the artifact store: {', '.join(missing)}")


class ReconstructionHandler(_StagesHandler):
    """The reconstruction of a drive: at first its plan, where the drive may be cut into sub-maps."""

    def lay_out(self, folder: AttemptFolder, fetch: Fetch, progress: Callable[[int, int], None]) -> Attempt:
        """The drive as a folder, likewise."""
        return replace(self._attempt(folder, fetch, progress), submap_workers=self._submap_workers())

    def _submap_workers(self) -> int:
        """Number of workers that the drive is cut for; 0 where its sub-maps were made already."""
        if self._held.has_submaps:
            return 0
        if self._settings.submap_workers is not None:
            return self._settings.submap_workers
        return self._records.query(lambda session: workers.count_processes(session, QUEUES[JobKind.SUBMAP]))

    def wait_for_submaps(self, session: Session, plan: SubmapPlan) -> list[str]:
        """Record jobs for the sub-maps and give the reconstruction back until they have ended; ids of the jobs."""
        self._require_stored(session, [PLAN_CHECKPOINTS[-1]])
        checkpoints.drop_submaps(session, self._stages, after=plan.total)
        places = [
            jobs.SubmapPlace(number=number, total=plan.total, first_unit=first, last_unit=last)
            for number, first, last in plan.unfinished
        ]
        return jobs.wait_for_submaps(session, self._held, places)

    def publish(
        self, session: Session, done: Succeeded, files: Mapping[str, StoredFile], settings: Settings
    ) -> dict[str, Any]:
        """Record the scene of stored files, by path, and end the job; the ids of what was made, for the log."""
        scene_id = scenes.publish(
            session,
            self._held,
            files=files,
            summary=SceneSummary(**_figures(done.report), components=done.report["components"]),
            expires_us=_expires_us(settings.scene_retention_days),
            reused=_reused(done.report),
        )
        return {"scene_id": scene_id}


class SubmapHandler(_StagesHandler):
    """A sub-map of a long drive, which needs a part of the drive and leaves finished stages alone."""

    @property
    def _number(self) -> int:
        return int(self._held.request["number"])

    def is_wanted(self, name: str) -> bool:
        """Return whether a finished stage of the shelf is brought: those of the plan and its own."""
        return name in map(checkpoint_file, PLAN_CHECKPOINTS) or submap_number(name) == self._number

    def lay_out(self, folder: AttemptFolder, fetch: Fetch, progress: Callable[[int, int], None]) -> Attempt:
        """The part of the drive as a folder, likewise."""
        place = self._held.request
        units = range(place["first_unit"], place["last_unit"] + 1)
        return replace(self._attempt(folder, fetch, progress, units=units), submap=self._number)

    def publish(
        self, session: Session, done: Succeeded, files: Mapping[str, StoredFile], settings: Settings
    ) -> dict[str, Any]:
        """End the job, whose stages are stored."""
        self._require_stored(session, [submap_checkpoint(self._number, stage) for stage in SUBMAP_STAGES])
        jobs.succeed(session, self._held, reused=_reused(done.report))
        return {"submap": self._number}


class AggregationHandler:
    """An aggregation."""

    files: OnDemandFolder | None = None

    def __init__(self, records: Transactions, held: jobs.Claim) -> None:
        self._records, self._held = records, held

    def is_wanted(self, name: str) -> bool:
        """Return whether a finished stage is brought, likewise."""
        return True

    @cached_property
    def _inputs(self) -> MapInputs:
        """Read where they are needed: what publishes must not fail for a database that is away for a moment."""
        return self._records.query(lambda session: inputs_of(session, self._held.job_id))

    @property
    def shelf(self) -> Shelf | None:
        """The shelf of every pair of its scenes, under these settings."""
        held = self._held
        ids = self._inputs.scene_ids
        return MapShelf(held.map_id or "", held.project_id, ids, settings_sha256(held.settings))

    def lay_out(self, folder: AttemptFolder, fetch: Fetch, progress: Callable[[int, int], None]) -> Attempt:
        """The scenes as folders, and the version that they are added to."""
        inputs, root = self._inputs, folder.root
        into = root / "base" if inputs.base else None
        wanted = [
            (file.key, root / "scenes" / name / file.path) for name, files in inputs.scenes.items() for file in files
        ]
        wanted += [(file.key, root / "base" / file.path) for file in inputs.base]
        fetch_each(fetch, wanted, progress=progress)
        return Attempt(
            work=Work.AGGREGATION,
            settings=self._held.settings,
            name=inputs.name,
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
            names=done.report["map"]["names"],
            unconnected=done.report["map"]["unconnected"],
            failed=done.report["failed_drives"],
            expires_us=_expires_us(settings.map_retention_days),
            reused=_reused(done.report),
        )
        return {"map_id": self._held.map_id, "version": number}


class ExportHandler:
    """An export of a scene or a version of a map."""

    shelf: Shelf | None = None  # it shares no stages
    files: OnDemandFolder | None = None

    def __init__(self, records: Transactions, held: jobs.Claim) -> None:
        self._records, self._held = records, held

    def is_wanted(self, name: str) -> bool:
        """Return whether a finished stage is brought, likewise."""
        return True

    def lay_out(self, folder: AttemptFolder, fetch: Fetch, progress: Callable[[int, int], None]) -> Attempt:
        """The scene or map as a folder, and the drives whose images are needed.

        Raises
        ------
        DriveGoneError, ExportGoneError
            Where a drive or the export was deleted.
        """
        inputs, files, drives = self._records.query(self._found)
        source = folder.root / "source"
        total = len(files) + len(drives)  # a drive counts as one until its files are known
        wanted = [(file.key, source / file.path) for file in files]
        fetch_each(fetch, wanted, progress=lambda done, _: progress(done, total))
        folders: dict[str, Path] = {}
        for drive_id in sorted(set(drives.values())):
            folders[drive_id] = folder.root / "drives" / drive_id
            # All of it: most of these images are part of the export, which lies on this disk too.
            check_out(self._records, drive_id, folders[drive_id], fetch=fetch).bring_all(fetch, progress)
        return Attempt(
            work=Work.EXPORT,
            settings=self._held.settings,
            source=source,
            drives={name: folders[drive_id] for name, drive_id in drives.items()},
            formats=inputs.formats,
            options=inputs.engine_options,
        )

    def _found(self, session: Session) -> tuple[ExportInputs, list[StoredArtifact], dict[str, str]]:
        """The inputs of the export, its files, and its drives by the names of scenes."""
        inputs = exports.inputs_of(session, self._held)
        return inputs, inputs.files(session), inputs.drives(session)

    def publish(
        self, session: Session, done: Succeeded, files: Mapping[str, StoredFile], settings: Settings
    ) -> dict[str, Any]:
        """Record the export's files, likewise."""
        export_id = exports.publish(
            session,
            self._held,
            files=files,
            results=done.report["results"],
            expires_us=_expires_us(settings.export_retention_days),
        )
        return {"export_id": export_id}


JobHandler = PreflightHandler | ReconstructionHandler | SubmapHandler | AggregationHandler | ExportHandler


def handler_of(records: Transactions, held: jobs.Claim, settings: Settings) -> JobHandler:
    """The handler for a job's kind."""
    match held.kind:
        case JobKind.AGGREGATION:
            return AggregationHandler(records, held)
        case JobKind.RECONSTRUCTION:
            return ReconstructionHandler(records, held, settings)
        case JobKind.SUBMAP:
            return SubmapHandler(records, held, settings)
        case JobKind.EXPORT:
            return ExportHandler(records, held)
        case _:
            return PreflightHandler(records, held, settings)


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
