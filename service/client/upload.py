"""Sending a drive: create it, declare its files, send what is missing, commit, and ask for its scene."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

from pydantic import BaseModel

from schemas.api.aggregations import AggregationRequest
from schemas.api.drives import DriveResource, DriveState
from schemas.api.jobs import JobResource, JobState, ReconstructionSettings
from service.client import resumable
from service.client.api import Client
from service.client.drive_folder import DriveFolder, LocalFile, identify
from service.client.errors import ApiError
from service.client.parallel import FileMeter, Item, Meter, Report, Result, in_parallel, no_report
from service.client.resumable import ResumableUpload, counted_pieces
from service.client.upload_state import UploadState
from service.errors import DriveCommitted, NotFound, WrongDigest

PARALLEL = 4
DECLARED_AT_ONCE = 1000


@dataclass(frozen=True)
class Sent:
    """Requests and bytes until the service had the drive."""

    drive_id: str
    bytes_sent: int
    files_sent: int
    files_skipped: int
    seconds: dict[str, float] = field(default_factory=dict)


def upload_drive(
    client: Client,
    folder: DriveFolder,
    *,
    state: UploadState | None = None,
    parallel: int = PARALLEL,
    report: Report = no_report,
) -> Sent:
    """Bring a drive to the service and commit it.

    What an earlier call brought is not sent again, and a drive that is there already is taken as it is.

    Parameters
    ----------
    state
        Where the upload stands; by default what is kept beside the drive.
    parallel
        Files at one time.
    report
        Told how many bytes are done, for the stages `hash` and `send`.

    Raises
    ------
    ApiError
        The service refuses the drive.
    DriveFolderError
        A file cannot be read, or changes.
    UnreachableError
        The service does not answer.
    """
    return _Upload(client, folder, state or UploadState(folder, client.url), parallel, report).run()


def start_reconstruction(
    client: Client,
    drive_id: str,
    settings: ReconstructionSettings | None = None,
    *,
    state: UploadState | None = None,
) -> JobResource:
    """Ask for a committed drive's scene.

    With a state, what was asked for before is asked for again only where it failed, was cancelled, or its scene is
    gone.
    """
    settings = settings or ReconstructionSettings()
    return _asked(client, settings, state, lambda key: client.reconstruct(drive_id, settings, idempotency_key=key))


def start_aggregation(client: Client, asked: AggregationRequest, *, state: UploadState | None = None) -> JobResource:
    """Ask for a map of committed drives; as `start_reconstruction`."""
    return _asked(client, asked, state, lambda key: client.aggregate(asked, idempotency_key=key))


def known_job(client: Client, what: BaseModel, *, state: UploadState) -> JobResource | None:
    """Job that the same request made before, unless it failed, was cancelled, or its result is gone."""
    record = state.job(what)
    return None if record is None or record.job_id is None else _usable_job(client, record.job_id)


def _asked(
    client: Client, what: BaseModel, state: UploadState | None, ask: Callable[[str | None], JobResource]
) -> JobResource:
    if state is None:
        return ask(None)
    known = known_job(client, what, state=state)
    if known is not None:
        return known
    record = state.job(what)
    if record is None or record.job_id is not None:
        record = state.begin_job(what)
    job = ask(record.key)
    record.job_id = job.id
    state.save()
    return job


def _usable_job(client: Client, job_id: str) -> JobResource | None:
    try:
        job = client.job(job_id)
        if job.scene_id is not None:
            client.scene(job.scene_id)
        if job.map_id is not None and job.map_version is not None:
            client.map_version(job.map_id, job.map_version)
    except ApiError as error:
        if error.code != NotFound.code:
            raise
        return None
    return None if job.state in (JobState.FAILED, JobState.CANCELLED) else job


class _Upload:
    def __init__(self, client: Client, folder: DriveFolder, state: UploadState, parallel: int, report: Report) -> None:
        self._client = client
        self._folder = folder
        self._state = state
        self._parallel = parallel
        self._report = report
        self._began_s = time.monotonic()
        self._seconds: dict[str, float] = {}

    def run(self) -> Sent:
        drive = self._open_drive()
        self._passed("create")
        files = self._identified()
        self._passed("hash")
        to_send = self._declared(drive.id, files)
        if to_send and drive.state == DriveState.COMMITTED:
            # Its manifest is this one and its images are not: what is here is another drive.
            self._state.begin_anew()
            drive = self._open_drive()
            to_send = self._declared(drive.id, files)
        self._passed("declare")
        meter = Meter(self._report, "send", sum(file.size_bytes for file in to_send))
        self._in_parallel(lambda file: self._send(drive.id, file, meter), to_send)
        self._passed("send")
        self._commit(drive)
        self._passed("commit")
        return Sent(drive.id, meter.done_bytes, len(to_send), len(files) - len(to_send), self._seconds)

    def _passed(self, phase: str) -> None:
        now_s = time.monotonic()
        self._seconds[phase] = round(now_s - self._began_s, 3)
        self._began_s = now_s

    def _in_parallel(self, work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        return in_parallel(work, items, threads=self._parallel, stop=self._client.stop)

    def _open_drive(self) -> DriveResource:
        record = self._state.record
        if record.drive_id is not None:
            try:
                return self._client.drive(record.drive_id)
            except ApiError as error:
                if error.code != NotFound.code:
                    raise
                self._state.begin_anew()
        self._state.save()  # before the request, so that a repetition has the same name
        record = self._state.record
        drive = self._client.create_drive(self._folder.raw_manifest, idempotency_key=f"{record.upload}-create")
        record.drive_id = drive.id
        self._state.save()
        return drive

    def _identified(self) -> list[LocalFile]:
        meter = Meter(self._report, "hash", self._folder.size_bytes())

        def identified(path: str) -> LocalFile:
            file = identify(self._folder.root, path)
            meter.add(file.size_bytes)
            return file

        return self._in_parallel(identified, self._folder.paths)

    def _declared(self, drive_id: str, files: Sequence[LocalFile]) -> list[LocalFile]:
        """The files that must be sent."""
        wanted: set[str] = set()
        for i in range(0, len(files), DECLARED_AT_ONCE):
            wanted.update(self._client.declare(drive_id, files[i : i + DECLARED_AT_ONCE]).to_send)
        return [file for file in files if file.path in wanted]

    def _send(self, drive_id: str, file: LocalFile, meter: Meter) -> None:
        try:
            if file.size_bytes >= resumable.FROM_BYTES:
                self._send_resumably(drive_id, file, meter)
            else:
                # The drive is this folder's: where a file was changed here since it was sent, the new bytes count.
                body = partial(counted_pieces, self._client, file, FileMeter(meter))
                self._client.put_file(drive_id, file, body=body, replace=True)
        except ApiError as error:
            if error.code == WrongDigest.code:
                raise file.changed() from error
            raise

    def _send_resumably(self, drive_id: str, file: LocalFile, meter: Meter) -> None:
        name = f"{file.path} {file.sha256}"
        upload = ResumableUpload(self._client, drive_id, file, meter, upload_id=self._state.uploads.get(name))
        self._state.note_upload(name, upload.begin())
        upload.send()
        self._state.note_upload(name, None)

    def _commit(self, drive: DriveResource) -> None:
        if drive.state == DriveState.COMMITTED:
            return
        try:
            self._client.commit(drive.id, idempotency_key=f"{self._state.record.upload}-commit")
        except ApiError as error:
            if error.code != DriveCommitted.code:  # by another run of the same command
                raise
