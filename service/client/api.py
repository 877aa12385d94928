"""The service's resources as methods."""

from __future__ import annotations

import base64
import json
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar
from urllib.parse import quote, urlencode

import httpx
from pydantic import BaseModel, ValidationError

from schemas.api.aggregations import AggregationRequest
from schemas.api.drives import DeclaredFiles, DriveFileResource, DriveResource, PreflightResource, PreflightState
from schemas.api.exports import ExportFileResource, ExportRequest, ExportResource
from schemas.api.jobs import JobKind, JobResource, JobState, ReconstructionSettings
from schemas.api.maps import MapFileResource, MapResource, MapVersionResource
from schemas.api.resource import Page
from schemas.api.scenes import SceneFileResource, SceneResource
from schemas.api.status import ServiceStatus
from schemas.api.uploads import UploadResource
from schemas.api.webhooks import DeliveryResource, WebhookRequest, WebhookResource, WebhookWithSecret
from service.client.drive_folder import LocalFile
from service.client.errors import ClientError
from service.client.transport import (
    CHECK_TIMEOUT_S,
    IO_TIMEOUT_S,
    Body,
    RetryBudget,
    Transport,
    TroubleError,
    unexpected,
)
from service.digests import format_digest

Model = TypeVar("Model", bound=BaseModel)
Item = TypeVar("Item", bound=BaseModel)
Result = SceneResource | MapVersionResource | ExportResource
ResultFile = SceneFileResource | MapFileResource | ExportFileResource
PAGE = 200  # items that are asked for at one time
RETRY_S = 300.0  # a service that is being restarted, or moved
FIRST_RETRY_S = 6.0
_TUS = {"Tus-Resumable": "1.0.0"}
_STREAM_TIMEOUT_S = 40.0  # an event stream says something every 15 s


@dataclass(frozen=True)
class JobEvent:
    """An event of a job: `state`, `progress`, or `keep-alive`, which only says that the connection is well."""

    id: int | None
    kind: str
    data: dict[str, Any]


class Client:
    """A service, under one API key.

    Every request is tried again while trouble may pass: no connection, a broken one, 5xx, 408, 429. May be used by
    many threads.

    Parameters
    ----------
    url
        Of the service, for example `https://maps.example.org`.
    key
        An API key.
    connections
        At one time.
    retry_s
        For how long one request is tried again.
    first_retry_s
        The same, as long as nothing has ever answered under this URL.

    Raises
    ------
    ClientError
        Here, where URL or key cannot be one. Methods raise `ApiError` and `UnreachableError`.
    """

    def __init__(
        self,
        url: str,
        key: str,
        *,
        connections: int = 8,
        retry_s: float = RETRY_S,
        first_retry_s: float = FIRST_RETRY_S,
    ) -> None:
        self._transport = Transport(url, key, connections=connections, retry_s=retry_s, first_retry_s=first_retry_s)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def url(self) -> str:
        """URL of the service, without a slash at its end."""
        return self._transport.url

    def close(self) -> None:
        """End what waits, and close all connections."""
        self._transport.close()

    def stop(self) -> None:
        """End what waits, sends or receives in other threads, now. The client cannot be used again."""
        self._transport.stop()

    @property
    def stopped(self) -> bool:
        """`stop` or `close` was called."""
        return self._transport.closing.is_set()

    def require_open(self, what: str) -> None:
        """Raise ClientError where `stop` or `close` was called."""
        if self.stopped:
            raise ClientError(f"the {what} was interrupted")

    def pause(self, seconds: float) -> None:
        """Sleep, unless the client is closed."""
        self._transport.closing.wait(seconds)

    def retry_budget(self) -> RetryBudget:
        """Budget of a series of tries of one thing."""
        return self._transport.retry_budget()

    def status(self) -> ServiceStatus:
        """Status of the service."""
        return self._get("/v1/status", ServiceStatus)

    def create_drive(self, manifest: bytes, *, idempotency_key: str | None = None) -> DriveResource:
        """A new drive from the bytes of a `drive.json`."""
        return self._post("/v1/drives", DriveResource, content=manifest, key=idempotency_key)

    def drive(self, drive_id: str) -> DriveResource:
        """One drive."""
        return self._get(f"/v1/drives/{_part(drive_id)}", DriveResource)

    def drives(
        self, *, vehicle: str | None = None, preflight: Iterable[PreflightState] | PreflightState = ()
    ) -> Iterator[DriveResource]:
        """All drives of the project, newest first; of one vehicle or some states of the check where these are given."""
        return self._pages("/v1/drives", Page[DriveResource], vehicle=vehicle, preflight=_values(preflight))

    def delete_drive(self, drive_id: str) -> None:
        """Delete a drive. Its scenes stay."""
        self._delete(f"/v1/drives/{_part(drive_id)}")

    def declare(self, drive_id: str, files: Sequence[LocalFile]) -> DeclaredFiles:
        """Say which files there are, and learn which must be sent."""
        stated = [{"path": file.path, "size_bytes": file.size_bytes, "sha256": file.sha256} for file in files]
        content = json.dumps({"files": stated}).encode()
        return self._post(f"/v1/drives/{_part(drive_id)}/files:declare", DeclaredFiles, content=content)

    def put_file(
        self, drive_id: str, file: LocalFile, *, body: Body | None = None, replace: bool = False
    ) -> DriveFileResource:
        """Send one file.

        Parameters
        ----------
        body
            Gives the file's bytes anew for every try; by default they are read from the file.
        replace
            Whether other bytes that are stored under this name give way.
        """
        headers = {
            "Content-Length": str(file.size_bytes),
            "Content-Type": "application/octet-stream",
            "Content-Digest": format_digest(file.sha256),
        }
        path = f"/v1/drives/{_part(drive_id)}/files/{quote(file.path)}{'?replace=true' if replace else ''}"
        response = self._transport.request("PUT", path, headers=headers, body=body or file.pieces)
        return _parsed(response, DriveFileResource)

    def commit(self, drive_id: str, *, idempotency_key: str | None = None) -> DriveResource:
        """Freeze a drive whose files are all there."""
        path = f"/v1/drives/{_part(drive_id)}:commit"
        return self._post(path, DriveResource, key=idempotency_key, timeout_s=CHECK_TIMEOUT_S)

    def preflight(self, drive_id: str) -> PreflightResource:
        """Findings of the check of a drive."""
        return self._get(f"/v1/drives/{_part(drive_id)}/preflight", PreflightResource)

    def reconstruct(
        self, drive_id: str, settings: ReconstructionSettings | None = None, *, idempotency_key: str | None = None
    ) -> JobResource:
        """Ask for a committed drive's reconstruction."""
        asked = (settings or ReconstructionSettings()).model_dump(mode="json", exclude_none=True)
        content = json.dumps({"drive_id": drive_id, "settings": asked}).encode()
        return self._post("/v1/reconstructions", JobResource, content=content, key=idempotency_key)

    def job(self, job_id: str) -> JobResource:
        """One job."""
        return self._get(f"/v1/jobs/{_part(job_id)}", JobResource)

    def jobs(
        self,
        *,
        drive_id: str | None = None,
        states: Iterable[JobState] | JobState = (),
        kinds: Iterable[JobKind] | JobKind = (),
    ) -> Iterator[JobResource]:
        """All jobs of the project, newest first; of one drive, some states or kinds alone where these are given."""
        given = {"state": _values(states), "kind": _values(kinds)}
        return self._pages("/v1/jobs", Page[JobResource], drive_id=drive_id, **given)

    def poll_job(self, job_id: str, etag: str | None) -> tuple[JobResource | None, str | None, float]:
        """A job, if it has changed since it had this ETag.

        Returns
        -------
        job, etag, retry_after_s
            The job is None where nothing has changed; `retry_after_s` says when to ask again.
        """
        headers = {} if etag is None else {"If-None-Match": etag}
        response = self._transport.request("GET", f"/v1/jobs/{_part(job_id)}", headers=headers)
        retry_after = response.headers.get("retry-after", "")
        retry_after_s = float(retry_after) if retry_after.isdecimal() else 2.0
        job = None if response.status_code == httpx.codes.NOT_MODIFIED else _parsed(response, JobResource)
        return job, response.headers.get("etag"), retry_after_s

    def cancel_job(self, job_id: str) -> JobResource:
        """Ask for a job's end."""
        return self._post(f"/v1/jobs/{_part(job_id)}:cancel", JobResource)

    def retry_job(self, job_id: str, *, idempotency_key: str | None = None) -> JobResource:
        """A new job that does again what failed or was cancelled."""
        return self._post(f"/v1/jobs/{_part(job_id)}:retry", JobResource, key=idempotency_key)

    def events(self, job_id: str, *, after: int | None = None) -> Iterator[JobEvent]:
        """A job's events after the one with this id, as they come, until the job or the connection ends.

        A connection that breaks ends the iteration: call again with the last id that was seen.
        """
        headers = {"Accept": "text/event-stream"} | ({} if after is None else {"Last-Event-ID": str(after)})
        path = f"/v1/jobs/{_part(job_id)}/events"
        try:
            with self._transport.open("GET", path, headers=headers, read_timeout_s=_STREAM_TIMEOUT_S) as response:
                yield from _events(_lines(response.iter_bytes()))
        except TroubleError:
            return

    def scene(self, scene_id: str) -> SceneResource:
        """One scene and its files."""
        return self._get(f"/v1/scenes/{_part(scene_id)}", SceneResource)

    def scenes(self, *, drive_id: str | None = None) -> Iterator[SceneResource]:
        """All scenes of the project, newest first and without their files; of one drive where that is given."""
        return self._pages("/v1/scenes", Page[SceneResource], drive_id=drive_id)

    def delete_scene(self, scene_id: str) -> None:
        """Delete a scene and its exports."""
        self._delete(f"/v1/scenes/{_part(scene_id)}")

    def aggregate(self, asked: AggregationRequest, *, idempotency_key: str | None = None) -> JobResource:
        """Ask for a map of drives or scenes, or for a new version of one."""
        content = asked.model_dump_json(exclude_none=True).encode()
        return self._post("/v1/aggregations", JobResource, content=content, key=idempotency_key)

    def map(self, map_id: str) -> MapResource:
        """One map and its current version."""
        return self._get(f"/v1/maps/{_part(map_id)}", MapResource)

    def maps(self) -> Iterator[MapResource]:
        """All maps of the project, newest first."""
        return self._pages("/v1/maps", Page[MapResource])

    def delete_map(self, map_id: str) -> None:
        """Delete a map with all its versions. Its scenes stay."""
        self._delete(f"/v1/maps/{_part(map_id)}")

    def map_version(self, map_id: str, number: int | str) -> MapVersionResource:
        """One version of a map and its files, by its number or as `current`."""
        return self._get(_version_path(map_id, number), MapVersionResource)

    def map_versions(self, map_id: str) -> Iterator[MapVersionResource]:
        """All versions of a map, newest first and without their files."""
        return self._pages(f"/v1/maps/{_part(map_id)}/versions", Page[MapVersionResource])

    def show_map_version(self, map_id: str, number: int) -> MapResource:
        """Make another version of a map the current one."""
        content = json.dumps({"version": number}).encode()
        headers = {"Content-Type": "application/json", "Content-Length": str(len(content))}
        path = f"/v1/maps/{_part(map_id)}/current-version"
        return _parsed(
            self._transport.request("PUT", path, headers=headers, body=lambda: iter((content,))), MapResource
        )

    def delete_map_version(self, map_id: str, number: int) -> None:
        """Delete a version that is not the current one."""
        self._delete(_version_path(map_id, number))

    def export_scene(
        self, scene_id: str, asked: ExportRequest, *, idempotency_key: str | None = None
    ) -> ExportResource:
        """Ask for a scene in formats of other programs; what is there already is answered as it is."""
        return self._export(f"/v1/scenes/{_part(scene_id)}/exports", asked, idempotency_key)

    def export_map(
        self, map_id: str, number: int | str, asked: ExportRequest, *, idempotency_key: str | None = None
    ) -> ExportResource:
        """Ask for a version of a map in formats of other programs, as of a scene."""
        return self._export(f"{_version_path(map_id, number)}/exports", asked, idempotency_key)

    def export(self, export_id: str) -> ExportResource:
        """One export and its files."""
        return self._get(f"/v1/exports/{_part(export_id)}", ExportResource)

    def exports(self) -> Iterator[ExportResource]:
        """All exports of the project, newest first and without their files."""
        return self._pages("/v1/exports", Page[ExportResource])

    def delete_export(self, export_id: str) -> None:
        """Delete an export."""
        self._delete(f"/v1/exports/{_part(export_id)}")

    def create_webhook(self, asked: WebhookRequest, *, idempotency_key: str | None = None) -> WebhookWithSecret:
        """Register an address that is told when jobs end; its secret is shown here alone."""
        content = asked.model_dump_json().encode()
        return self._post("/v1/webhooks", WebhookWithSecret, content=content, key=idempotency_key)

    def webhooks(self) -> Iterator[WebhookResource]:
        """All webhooks of the project, newest first."""
        return self._pages("/v1/webhooks", Page[WebhookResource])

    def rotate_webhook(self, webhook_id: str, *, idempotency_key: str | None = None) -> WebhookWithSecret:
        """Give a webhook another secret; the one before signs as well for a day."""
        return self._post(f"/v1/webhooks/{_part(webhook_id)}:rotate", WebhookWithSecret, key=idempotency_key)

    def delete_webhook(self, webhook_id: str) -> None:
        """Delete a webhook and its messages."""
        self._delete(f"/v1/webhooks/{_part(webhook_id)}")

    def deliveries(self, webhook_id: str) -> Iterator[DeliveryResource]:
        """All messages to a webhook of the last month, newest first."""
        return self._pages(f"/v1/webhooks/{_part(webhook_id)}/deliveries", Page[DeliveryResource])

    def retry_delivery(self, webhook_id: str, delivery_id: str) -> DeliveryResource:
        """Send a message again that was given up or delivered."""
        path = f"/v1/webhooks/{_part(webhook_id)}/deliveries/{_part(delivery_id)}:retry"
        return self._post(path, DeliveryResource)

    @contextmanager
    def open_file(self, result: Result, file: ResultFile, *, start: int = 0) -> Iterator[tuple[int, Iterator[bytes]]]:
        """A file of a scene, an export or of a map's version, from byte `start` on where it still is this one. One try.

        Yields
        ------
        start, pieces
            Where the pieces begin: 0 where the service sends the file from its beginning.
        """
        headers = {} if start == 0 else {"Range": f"bytes={start}-", "If-Range": f'"{file.sha256}"'}
        with self._transport.open("GET", _file_path(result, file), headers=headers) as response:
            partial = response.status_code == httpx.codes.PARTIAL_CONTENT
            if partial and not response.headers.get("content-range", "").startswith(f"bytes {start}-"):
                raise unexpected(response, "the part of the file that was asked for")
            yield (start if partial else 0), response.iter_bytes()

    def read_file(self, result: Result, file: ResultFile) -> bytes:
        """Bytes of a small file of a scene, an export or of a map's version."""
        return self._transport.request("GET", _file_path(result, file)).content

    def create_upload(self, drive_id: str, size_bytes: int, metadata: Mapping[str, str]) -> str:
        """Begin a resumable upload; its id."""
        encoded = (f"{key} {base64.b64encode(value.encode()).decode()}" for key, value in metadata.items())
        headers = {
            **_TUS,
            "Upload-Length": str(size_bytes),
            "Upload-Metadata": ",".join(encoded),
            "Idempotency-Key": str(uuid.uuid4()),
        }
        response = self._transport.request("POST", f"/v1/drives/{_part(drive_id)}/uploads", headers=headers)
        return _parsed(response, UploadResource).id

    def upload_offset(self, drive_id: str, upload_id: str) -> int:
        """Number of bytes of a resumable upload that the service has."""
        response = self._transport.request("HEAD", _upload_path(drive_id, upload_id), headers=_TUS)
        offset = response.headers.get("upload-offset", "")
        if not offset.isdecimal():
            raise unexpected(response, "an upload's offset")
        return int(offset)

    def append_to_upload(self, drive_id: str, upload_id: str, offset: int, body: Body) -> None:
        """Send the bytes of a resumable upload from `offset` on. One try."""
        path = _upload_path(drive_id, upload_id)
        headers = {**_TUS, "Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream"}
        with self._transport.open("PATCH", path, headers=headers, body=body, read_timeout_s=CHECK_TIMEOUT_S) as answer:
            answer.read()

    def _export(self, path: str, asked: ExportRequest, key: str | None) -> ExportResource:
        return self._post(path, ExportResource, content=asked.model_dump_json(exclude_none=True).encode(), key=key)

    def _delete(self, path: str) -> None:
        """Delete something. Where an answer was lost and the request tried again, that is told as 404."""
        self._transport.request("DELETE", path)

    def _pages(self, path: str, model: type[Page[Item]], **where: str | Sequence[str] | None) -> Iterator[Item]:
        """All items of a list, page after page as they are asked for."""
        given = {name: value for name, value in where.items() if value is not None}
        cursor: str | None = None
        while True:
            place = {"limit": str(PAGE), **({} if cursor is None else {"cursor": cursor})}
            query = urlencode({**given, **place}, doseq=True)
            page = _parsed(self._transport.request("GET", f"{path}?{query}"), model)
            yield from page.items
            cursor = page.next
            if cursor is None:
                return

    def _get(self, path: str, model: type[Model]) -> Model:
        return _parsed(self._transport.request("GET", path), model)

    def _post(
        self,
        path: str,
        model: type[Model],
        *,
        content: bytes | None = None,
        key: str | None = None,
        timeout_s: float = IO_TIMEOUT_S,
    ) -> Model:
        # With a key also where the caller gave none: a try whose answer was lost may have had its effect.
        headers = {"Idempotency-Key": key or str(uuid.uuid4())}
        if content is not None:
            headers |= {"Content-Type": "application/json", "Content-Length": str(len(content))}
        body = None if content is None else lambda: iter((content,))
        response = self._transport.request("POST", path, headers=headers, body=body, timeout_s=timeout_s)
        return _parsed(response, model)


def _part(identifier: str) -> str:
    return quote(identifier, safe="")


def _version_path(map_id: str, number: int | str) -> str:
    return f"/v1/maps/{_part(map_id)}/versions/{_part(str(number))}"


def _upload_path(drive_id: str, upload_id: str) -> str:
    return f"/v1/drives/{_part(drive_id)}/uploads/{_part(upload_id)}"


def _file_path(result: Result, file: ResultFile) -> str:
    if isinstance(result, SceneResource):
        return f"/v1/scenes/{_part(result.id)}/files/{quote(file.path)}"
    if isinstance(result, ExportResource):
        return f"/v1/exports/{_part(result.id)}/files/{quote(file.path)}"
    return f"{_version_path(result.map_id, result.number)}/files/{quote(file.path)}"


def _parsed(response: httpx.Response, model: type[Model]) -> Model:
    try:
        return model.model_validate_json(response.content)
    except ValidationError:
        raise unexpected(response, f"a {model.__name__} of this version's service") from None


def _values(given: Iterable[str] | str) -> list[str]:
    return [given] if isinstance(given, str) else [*given]  # a member of an enumeration is a string as well


def _lines(pieces: Iterator[bytes]) -> Iterator[str]:
    """Lines of an event stream. httpx would also break lines at characters that JSON may hold in its strings."""
    rest = b""
    for piece in pieces:
        *whole, rest = (rest + piece).split(b"\n")
        yield from (line.removesuffix(b"\r").decode("utf-8", "replace") for line in whole)


def _events(lines: Iterator[str]) -> Iterator[JobEvent]:
    fields: dict[str, list[str]] = {}
    for line in lines:
        name, _, value = line.partition(":")
        if line == "":
            if "data" in fields:
                yield _event(fields)
            fields = {}
        elif name == "":
            yield JobEvent(None, "keep-alive", {})
        else:
            fields.setdefault(name, []).append(value.removeprefix(" "))


def _event(fields: dict[str, list[str]]) -> JobEvent:
    number = fields.get("id", [""])[-1]
    try:
        data = json.loads("\n".join(fields["data"]))
    except ValueError:
        data = None
    kind = fields.get("event", ["message"])[-1]
    return JobEvent(int(number) if number.isdecimal() else None, kind, data if isinstance(data, dict) else {})
