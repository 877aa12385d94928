"""Brings a drive to the service in one of three ways: file by file, as an archive, or by tus in pieces."""

from __future__ import annotations

import base64
import hashlib
import random
from collections.abc import Callable

from tests.benchmarks.chaos.conversation import CarefulClient
from tests.benchmarks.chaos.drives import Sendable, sha256_of
from tests.benchmarks.chaos.ledger import Ledger
from tests.helpers.tus_client import OFFSET_TYPE, VERSION, checksum, metadata

CREATE, COMMIT, FOLLOW = "create", "commit", "follow"
UPLOADS = ("put", "archive", "tus")  # kinds of requests that bring bytes
UPLOAD_SECONDS = (2.0, 8.0)  # for all of a drive's bytes
_PIECES = (2, 5)  # of one tus upload


class Sender:
    """Sends drives over one client."""

    def __init__(self, client: CarefulClient, ledger: Ledger, rng: random.Random) -> None:
        self._client, self._ledger, self._rng = client, ledger, rng

    def new_key(self) -> dict[str, str]:
        """An Idempotency-Key for one request and all its repetitions."""
        return {"Idempotency-Key": f"chaos-{self._rng.getrandbits(96):024x}"}

    def send(self, drive: Sendable) -> str:
        """Create, fill and commit a drive; its id."""
        created = self._client.ask(CREATE, "POST", "/v1/drives", headers=self.new_key(), data=drive.manifest)
        drive_id = str(created.json()["id"])
        self._ledger.create_drive(drive_id)
        seconds = self._rng.uniform(*UPLOAD_SECONDS)
        way: Callable[[str, Sendable, float], None] = self._rng.choice(
            [self._put_files, self._put_archive, self._append_archive, self._append_files]
        )
        way(drive_id, drive, seconds)
        self._client.ask(COMMIT, "POST", f"/v1/drives/{drive_id}:commit", headers=self.new_key())
        self._ledger.accept_drive(drive_id, drive)
        return drive_id

    def _put_files(self, drive_id: str, drive: Sendable, seconds: float) -> None:
        for path, data in drive.files.items():
            url = f"/v1/drives/{drive_id}/files/{path}"
            each_s = seconds / len(drive.files)
            self._client.ask("put", "PUT", url, headers=_digest(data), data=data, seconds=each_s)

    def _put_archive(self, drive_id: str, drive: Sendable, seconds: float) -> None:
        data = drive.zipped()
        url = f"/v1/drives/{drive_id}/archive"
        self._client.ask("archive", "PUT", url, headers=_digest(data), data=data, seconds=seconds)

    def _append_archive(self, drive_id: str, drive: Sendable, seconds: float) -> None:
        self._append(drive_id, drive.zipped(), seconds, archive="")

    def _append_files(self, drive_id: str, drive: Sendable, seconds: float) -> None:
        for path, data in drive.files.items():
            self._append(drive_id, data, seconds / len(drive.files), path=path)

    def _append(self, drive_id: str, data: bytes, seconds: float, **named: str) -> None:
        """One tus upload, from where the service says that it is, until it has all bytes."""
        headers = {**VERSION, **self.new_key(), "Upload-Length": str(len(data))}
        headers["Upload-Metadata"] = metadata(sha256=sha256_of(data), **named)
        begun = self._client.ask("tus", "POST", f"/v1/drives/{drive_id}/uploads", headers=headers)
        url, offset = begun.headers["location"], int(begun.headers["upload-offset"])
        piece_bytes = -(-len(data) // self._rng.randint(*_PIECES))
        while offset < len(data):
            piece = data[offset : offset + piece_bytes]
            offset = self._append_piece(url, offset, piece, seconds * len(piece) / len(data))

    def _append_piece(self, url: str, offset: int, piece: bytes, seconds: float) -> int:
        """One PATCH, and where its answer was lost what HEAD says; the offset after it."""
        headers = {**VERSION, "Content-Type": OFFSET_TYPE, "Upload-Offset": str(offset)}
        if self._rng.random() < 0.5:
            headers["Upload-Checksum"] = checksum(piece)
        # A PATCH that is repeated after a lost answer meets 409: its bytes are there. No other answer is one.
        answer = self._client.ask("tus", "PATCH", url, headers=headers, data=piece, seconds=seconds, also=(409,))
        if answer.is_success:
            return int(answer.headers["upload-offset"])
        shown = int(self._client.ask(FOLLOW, "HEAD", url, headers=VERSION).headers["upload-offset"])
        if shown < offset:
            self._ledger.note_broken_promise(f"{url} had {offset} bytes, and now has {shown}")
        return shown


def _digest(data: bytes) -> dict[str, str]:
    encoded = base64.b64encode(hashlib.sha256(data).digest()).decode()
    return {"Content-Digest": f"sha-256=:{encoded}:"}
