"""A tus client that others wrote gets its files in."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from tests.helpers.live_api import Client
from tests.helpers.tus_client import offset_of
from tests.service.test_uploads import PATH, image, stored

tusclient = pytest.importorskip("tusclient.client")
exceptions = pytest.importorskip("tusclient.exceptions")


def test_tuspy(client: Client, tmp_path: Path) -> None:
    """In pieces with checksums, stopped on the way and resumed by another uploader."""
    drive_id, data = client.create(), image(1_000_000)
    file = tmp_path / "image.png"
    file.write_bytes(data)
    api = str(client.base_url).rstrip("/")
    tus = tusclient.TusClient(f"{api}/v1/drives/{drive_id}/uploads", headers={"Authorization": f"Bearer {client.key}"})
    metadata = {"path": PATH, "sha256": hashlib.sha256(data).hexdigest()}
    with file.open("rb") as stream:
        first = tus.uploader(file_stream=stream, chunk_size=100_000, metadata=metadata, upload_checksum=True)
        first.upload(stop_at=300_000)
        assert offset_of(client, first.url.removeprefix(api)) == first.offset == 300_000
    with file.open("rb") as stream:
        second = tus.uploader(file_stream=stream, chunk_size=256_000, url=first.url)
        assert second.offset == 300_000
        second.upload()
        assert stored(client, drive_id) == metadata["sha256"]
        with pytest.raises(exceptions.TusCommunicationError):
            tus.uploader(file_stream=stream, metadata={"path": "no.png"}).upload()
