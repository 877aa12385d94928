"""State of an upload, so that the same command goes on after an interruption.

Under a name that is kept before the first request is made, a request whose answer was lost is repeated without a
second effect.

The record lies in the drive's folder, which may come from anybody: it holds ids and names, checked for their form, and
no address that a key would be sent to.
"""

from __future__ import annotations

import hashlib
import os
import threading
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, StringConstraints, ValidationError

from schemas.file_names import UPLOAD_RECORD_NAME
from service.client.drive_folder import DriveFolder
from service.storage.data_folder import write_private_file

_RequestName = Annotated[str, StringConstraints(pattern=r"^[0-9a-f-]{36}$")]
_DriveId = Annotated[str, StringConstraints(pattern=r"^drv_[0-9a-f]{1,40}$")]
_JobId = Annotated[str, StringConstraints(pattern=r"^job_[0-9a-f]{1,40}$")]
_UploadId = Annotated[str, StringConstraints(pattern=r"^upl_[0-9a-f]{1,40}$")]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid")


class JobRecord(_Record):
    """A reconstruction that was asked for: `key` names the request."""

    key: _RequestName
    job_id: _JobId | None = None


class UploadRecord(_Record):
    """One drive on one service: `upload` names the attempt to send it."""

    upload: _RequestName
    drive_id: _DriveId | None = None
    jobs: dict[str, JobRecord] = {}  # by the digest of what was asked for
    resumable: dict[str, _UploadId] = {}  # uploads under way, by what they send


class _Document(_Record):
    version: int = 1
    uploads: dict[str, UploadRecord] = {}


class UploadState:
    """The record of a drive that is sent to a service.

    It lies in the drive's folder, or where that is not writable, in the user's cache. Where neither is, an interrupted
    upload begins anew, and sends no file again that the service has.

    Parameters
    ----------
    folder
        The drive.
    url
        Of the service.
    """

    def __init__(self, folder: DriveFolder, url: str) -> None:
        self._name = f"{url} {folder.manifest_sha256}"
        self._places = [folder.root / UPLOAD_RECORD_NAME, _cache_of(folder.root)]
        self._lock = threading.Lock()
        self._document = next((found for place in self._places if (found := _read(place)) is not None), _Document())
        self.record = self._document.uploads.get(self._name) or _new_record()

    def begin_anew(self) -> None:
        """Forget the drive: it is gone, or is not this one any more."""
        self.record = _new_record()
        self.save()

    def begin_job(self, asked: BaseModel) -> JobRecord:
        """Forget the job that was asked for so, and name the next request."""
        record = self.record.jobs[_digest(asked)] = JobRecord(key=str(uuid.uuid4()))
        self.save()
        return record

    def job(self, asked: BaseModel) -> JobRecord | None:
        """Job that was requested under this key."""
        return self.record.jobs.get(_digest(asked))

    @property
    def uploads(self) -> Mapping[str, str]:
        """Ids of resumable uploads that an earlier run left under way, by what they send."""
        return self.record.resumable

    def note_upload(self, name: str, upload_id: str | None) -> None:
        """Remember where something is being sent; None: it is there. May be called from several threads."""
        with self._lock:
            if upload_id is None:
                self.record.resumable.pop(name, None)
            else:
                self.record.resumable[name] = upload_id
            self.save()

    def save(self) -> None:
        """Keep the record, where there is a place for it."""
        self._document.uploads[self._name] = self.record
        text = self._document.model_dump_json(indent=1)
        for place in self._places:
            try:
                if place.parent != self._places[0].parent:
                    place.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                write_private_file(place, text)
                return
            except OSError:
                continue


def _new_record() -> UploadRecord:
    return UploadRecord(upload=str(uuid.uuid4()))


def _read(place: Path) -> _Document | None:
    try:
        return _Document.model_validate_json(place.read_bytes())
    except (OSError, ValidationError):
        return None  # begins anew, which costs no more than the answers to `declare`


def _cache_of(root: Path) -> Path:
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(cache) / "mrasfm" / "uploads" / f"{hashlib.sha256(str(root.resolve()).encode()).hexdigest()[:32]}.json"


def _digest(asked: BaseModel) -> str:
    values: dict[str, Any] = asked.model_dump(mode="json", exclude_none=True)
    return hashlib.sha256(repr(sorted(values.items())).encode()).hexdigest()[:16]
