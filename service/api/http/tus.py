"""The headers of tus 1.0.0, resumable uploads: https://tus.io/protocols/resumable-upload"""

from __future__ import annotations

import base64
import binascii
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import format_datetime

from service.domain.uploads import Announced
from service.errors import MalformedUpload, ServiceError, TusVersion

VERSION = "1.0.0"
EXTENSIONS = "creation,checksum,expiration,termination"
CONTENT_TYPE = "application/offset+octet-stream"
# SHA-1 is what the protocol demands of a server; it finds accidents, which is all that a checksum here is for.
ALGORITHMS = ("sha1", "sha256")
MAX_METADATA = 8192

_MAX_DIGITS = 18  # of a number that databases hold
_NUMBER = re.compile(rf"[0-9]{{1,{_MAX_DIGITS}}}", re.ASCII)
_DIGITS = re.compile(r"[0-9]+", re.ASCII)
_SHA256 = re.compile(r"[0-9a-f]{64}", re.ASCII)


@dataclass(frozen=True)
class Checksum:
    """Checksum of one request's body."""

    algorithm: str
    digest: bytes


def require_version(given: str | None) -> None:
    """Refuse clients of another version of the protocol.

    Raises
    ------
    ServiceError
        412.
    """
    if given != VERSION:
        was = "missing" if given is None else repr(given[:40])
        raise TusVersion(
            f"the header Tus-Resumable is {was}, this service speaks {VERSION}",
            remedy=f"Send Tus-Resumable: {VERSION}.",
            headers={"Tus-Version": VERSION},
        )


def parse_number(name: str, given: str | None) -> int:
    """Upload-Length or Upload-Offset.

    Raises
    ------
    ServiceError
        400 where it is missing or no number of bytes.
    """
    remedy = f"Send {name}: and a whole number of bytes."
    if given is None:
        raise malformed(f"the header {name} is missing", remedy)
    if not _NUMBER.fullmatch(given):
        if _DIGITS.fullmatch(given):
            what = f"{name} has {len(given)} digits, over the bound of {_MAX_DIGITS}"
            raise malformed(what, f"Send {name}: and the number of bytes that it is; no file is that large.")
        raise malformed(f"{name} is {given[:40]!r}, which is no number of bytes", remedy)
    return int(given)


def parse_checksum(given: str | None) -> Checksum | None:
    """Upload-Checksum; None where it is missing.

    Raises
    ------
    ServiceError
        400 where it cannot be read, or its algorithm is none of ours.
    """
    if given is None:
        return None
    algorithm, _, value = given.strip().partition(" ")
    if algorithm not in ALGORITHMS:
        raise malformed(f"Upload-Checksum names {algorithm[:40]!r}", f"Use one of {', '.join(ALGORITHMS)}.")
    digest = _decoded("Upload-Checksum", value)
    if len(digest) != {"sha1": 20, "sha256": 32}[algorithm]:
        raise malformed(f"Upload-Checksum has {len(digest)} bytes for {algorithm}", "Send the whole digest in base64.")
    return Checksum(algorithm, digest)


def parse_announced(length: str | None, metadata: str | None) -> Announced:
    """Parse an upload's creation: Upload-Length, and in Upload-Metadata `path` or `archive`, `sha256`, `replace`.

    Clients that know no better name for it send `filename`; it counts as `path`.

    Raises
    ------
    ServiceError
        400.
    """
    size_bytes = parse_number("Upload-Length", length)
    given = parse_metadata(metadata or "")
    is_archive = "archive" in given
    path = given.get("path") if is_archive else given.get("path", given.get("filename"))
    if is_archive == (path is not None):
        raise malformed(
            "Upload-Metadata names neither a path nor an archive, or both",
            "Give path and the name of a file in the manifest, or archive without a value for a zip or tar of files.",
        )
    sha256 = given.get("sha256")
    if sha256 is not None and not _SHA256.fullmatch(sha256):
        raise malformed("sha256 in Upload-Metadata is no digest", "Give 64 hexadecimal digits in lower case.")
    return Announced(
        path=path,
        size_bytes=size_bytes,
        sha256=sha256,
        replace="replace" in given and given["replace"] in ("", "true", "1"),
        metadata=metadata or "",
    )


def parse_metadata(given: str) -> dict[str, str]:
    """Upload-Metadata: pairs of a key and a value in base64, parted by commas; a value may be missing.

    Raises
    ------
    ServiceError
        400 where it cannot be read.

    Examples
    --------
    >>> parse_metadata("path ZnJvbnQvMC5wbmc=,archive")
    {'path': 'front/0.png', 'archive': ''}
    """
    if len(given) > MAX_METADATA:
        raise malformed(f"Upload-Metadata has {len(given)} characters", f"Send at most {MAX_METADATA}.")
    found: dict[str, str] = {}
    for pair in filter(None, (part.strip() for part in given.split(","))):
        key, _, value = pair.partition(" ")
        if key in found or not key.isascii() or not key.isprintable():
            raise malformed(f"Upload-Metadata has the key {key[:40]!r} twice, or it is not ASCII", "Correct the key.")
        try:
            found[key] = _decoded("Upload-Metadata", value).decode("utf-8")
        except UnicodeDecodeError:
            raise malformed(f"the value of {key!r} in Upload-Metadata is not UTF-8", "Encode it as UTF-8.") from None
    return found


def http_date(time_us: int) -> str:
    """A time as Upload-Expires has it."""
    return format_datetime(datetime.fromtimestamp(time_us // 1_000_000, UTC), usegmt=True)


def malformed(what: str, remedy: str) -> ServiceError:
    """400: a header does not follow the protocol."""
    return MalformedUpload(what, remedy=remedy)


def _decoded(name: str, value: str) -> bytes:
    try:
        return base64.b64decode(value.strip(), validate=True)
    except (binascii.Error, ValueError):
        raise malformed(f"{name} holds {value[:40]!r}, which is not base64", "Encode values in base64.") from None
