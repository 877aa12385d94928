"""Large files in pieces, after tus 1.0.0: a connection that breaks, and a command that is stopped, lose no bytes."""

from __future__ import annotations

from collections.abc import Iterator
from http import HTTPStatus

from service.client.api import Client
from service.client.drive_folder import LocalFile
from service.client.errors import ApiError, ClientError
from service.client.parallel import Meter
from service.client.transport import RetryBudget, TroubleError
from service.errors import UploadLocked, WrongOffset

# Smaller ones are sent again from their beginning: the questions where to go on would take as long.
FROM_BYTES = 8 << 20

_ENDED = (HTTPStatus.NOT_FOUND, HTTPStatus.GONE)


class ResumableUpload:
    """One file of a drive.

    Parameters
    ----------
    upload_id
        Of the upload that an earlier run began; None: begin.
    """

    def __init__(
        self, client: Client, drive_id: str, file: LocalFile, meter: Meter, *, upload_id: str | None = None
    ) -> None:
        self._client = client
        self._drive_id = drive_id
        self._file = file
        self._meter = meter
        self._counted_bytes = 0
        self._id = upload_id or ""

    def begin(self) -> str:
        """The upload's id: as before, where the service still knows it; else anew."""
        if self._id:
            try:
                self._offset(self._client.retry_budget())
                return self._id
            except ApiError as error:
                if error.status not in _ENDED:
                    raise
        self._id = self._create()
        return self._id

    def _create(self) -> str:
        file = self._file
        metadata = {"path": file.path, "sha256": file.sha256, "replace": "true"}
        return self._client.create_upload(self._drive_id, file.size_bytes, metadata)

    def send(self) -> None:
        """All that is missing, from wherever the service is; again and again while trouble may pass.

        Raises
        ------
        ApiError
            The service refuses the file.
        UnreachableError
            It does not answer.
        """
        self.begin()
        budget, reached_bytes = self._client.retry_budget(), 0
        while (offset := self._offset(budget)) < self._file.size_bytes:
            if offset > reached_bytes:  # however little of what was sent: it goes on
                budget.renew()
            reached_bytes = offset
            self._count(offset)
            try:
                self._append(offset)
            except TroubleError as trouble:
                budget.pause(trouble)
            except ApiError as error:
                # Another request, perhaps an earlier one of ours, is still being served, or has just been.
                if error.code not in (WrongOffset.code, UploadLocked.code):
                    raise
                budget.pause(TroubleError(error, 1.0))
        self._count(self._file.size_bytes)

    def _append(self, offset: int) -> None:
        self._client.append_to_upload(self._drive_id, self._id, offset, lambda: self._pieces(offset))

    def _offset(self, budget: RetryBudget) -> int:
        while True:
            try:
                return self._client.upload_offset(self._drive_id, self._id)
            except ApiError as error:
                match error.status:
                    case HTTPStatus.LOCKED:
                        budget.pause(TroubleError(error, 1.0))
                    case HTTPStatus.CONFLICT:  # an answer to HEAD has no words: this one says why, or begins anew
                        self._id = self._create()
                    case _:
                        raise

    def _pieces(self, offset: int) -> Iterator[bytes]:
        for piece in self._file.pieces(offset):
            if self._client.stopped:
                raise ClientError("the upload was interrupted")
            yield piece
            self._count(self._counted_bytes + len(piece))

    def _count(self, size_bytes: int) -> None:
        self._meter.add(size_bytes - self._counted_bytes)
        self._counted_bytes = size_bytes
