"""Large files in pieces, after tus 1.0.0: a connection that breaks, and a command that is stopped, lose no bytes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from http import HTTPStatus

from service.client.api import Client
from service.client.drive_folder import LocalFile
from service.client.errors import ApiError
from service.client.parallel import FileMeter, Meter
from service.client.transport import RetryBudget, TroubleError
from service.errors import UploadLocked, WrongOffset

# Smaller ones are sent again from their beginning: the questions where to go on would take as long.
FROM_BYTES = 8 << 20

# Answers to HEAD, which have no words, about uploads that have ended: refused where that answer was lost, or deleted.
_NOT_ANY_MORE = (
    HTTPStatus.NOT_FOUND,
    HTTPStatus.GONE,
    HTTPStatus.CONFLICT,
    HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
    HTTPStatus.UNPROCESSABLE_ENTITY,
)


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
        self._meter = FileMeter(meter)
        self._id = upload_id or ""
        self._has_begun_anew = False

    def begin(self) -> str:
        """The upload's id: as before, where the service still knows it; else anew."""
        self._has_begun_anew = False
        if self._id:
            self._offset(self._client.retry_budget())
        else:
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
            self._meter.set(offset)
            try:
                self._append(offset)
            except TroubleError as trouble:
                budget.pause(trouble)
            except ApiError as error:
                # Another request, perhaps an earlier one of ours, is still being served, or has just been.
                if error.code not in (WrongOffset.code, UploadLocked.code):
                    raise
                budget.pause(TroubleError(error, 1.0))
        self._meter.set(self._file.size_bytes)

    def _append(self, offset: int) -> None:
        body = partial(counted_pieces, self._client, self._file, self._meter, offset)
        self._client.append_to_upload(self._drive_id, self._id, offset, body)

    def _offset(self, budget: RetryBudget) -> int:
        while True:
            try:
                return self._client.upload_offset(self._drive_id, self._id)
            except ApiError as error:
                if error.status == HTTPStatus.LOCKED:
                    budget.pause(TroubleError(error, 1.0))
                elif error.status in _NOT_ANY_MORE and not self._has_begun_anew:
                    self._has_begun_anew = True
                    self._id = self._create()  # says why, or begins anew
                else:
                    raise


def counted_pieces(client: Client, file: LocalFile, meter: FileMeter, offset: int = 0) -> Iterator[bytes]:
    """Bytes of a file from `offset` on, counted as they are sent.

    Raises
    ------
    ClientError
        The client was stopped.
    """
    meter.set(offset)
    for piece in file.pieces(offset):
        client.require_open("upload")
        yield piece
        meter.set(meter.done_bytes + len(piece))
