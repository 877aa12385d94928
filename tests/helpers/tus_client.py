"""What a tus client does, over httpx."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator

import httpx

VERSION = {"Tus-Resumable": "1.0.0"}
OFFSET_TYPE = "application/offset+octet-stream"


def metadata(**values: str) -> str:
    return ",".join(f"{key} {base64.b64encode(value.encode()).decode()}".strip() for key, value in values.items())


def create(client: httpx.Client, drive_id: str, size_bytes: int, **values: str) -> httpx.Response:
    headers = {**VERSION, "Upload-Length": str(size_bytes), "Upload-Metadata": metadata(**values)}
    return client.post(f"/v1/drives/{drive_id}/uploads", headers=headers)


def begin(client: httpx.Client, drive_id: str, path: str, data: bytes, **values: str) -> str:
    """Create an upload of a file; its URL."""
    answer = create(client, drive_id, len(data), path=path, **values)
    assert answer.status_code == 201, answer.text
    assert answer.headers["tus-resumable"] == "1.0.0"
    return answer.headers["location"]


def patch(client: httpx.Client, url: str, offset: int, data: bytes | Iterator[bytes], **headers: str) -> httpx.Response:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    headers = {**VERSION, "Content-Type": OFFSET_TYPE, "Upload-Offset": str(offset), **named}
    return client.patch(url, content=data, headers=headers)


def head(client: httpx.Client, url: str) -> httpx.Response:
    return client.head(url, headers=VERSION)


def offset_of(client: httpx.Client, url: str) -> int:
    answer = head(client, url)
    assert answer.status_code == 200, answer.status_code
    return int(answer.headers["upload-offset"])


def checksum(data: bytes, algorithm: str = "sha256") -> str:
    return f"{algorithm} {base64.b64encode(hashlib.new(algorithm, data).digest()).decode()}"
