"""What tus' headers say."""

from __future__ import annotations

import base64
import hashlib

import pytest

from service.api.http.tus import (
    http_date,
    parse_announced,
    parse_checksum,
    parse_metadata,
    parse_number,
    require_version,
)
from service.errors import ServiceError


def metadata(**values: str) -> str:
    return ",".join(f"{key} {base64.b64encode(value.encode()).decode()}".strip() for key, value in values.items())


def test_metadata_round_trip() -> None:
    given = {"path": "front/Straße 0.png", "archive": "", "sha256": "ab" * 32}
    assert parse_metadata(metadata(**given)) == given
    assert parse_metadata("") == {}
    assert parse_metadata(" a , b YQ== ,") == {"a": "", "b": "a"}


@pytest.mark.parametrize("given", ["path ?", "path YQ", "path YQ==,path YQ==", "é YQ==", "path /w==", "a" * 8193])
def test_metadata_that_cannot_be_read(given: str) -> None:
    with pytest.raises(ServiceError) as caught:
        parse_metadata(given)
    assert (caught.value.status, caught.value.code) == (400, "malformed-upload")


def test_what_is_announced() -> None:
    file = parse_announced("12", metadata(path="a.png", sha256="0f" * 32, replace="true"))
    assert (file.path, file.size_bytes, file.sha256, file.replace) == ("a.png", 12, "0f" * 32, True)
    assert parse_announced("0", metadata(filename="b.png")).path == "b.png"
    archive = parse_announced("7", metadata(archive="", filename="drive.zip"))
    assert (archive.path, archive.replace) == (None, False)


@pytest.mark.parametrize(
    ("length", "given"),
    [
        (None, metadata(path="a")),
        ("-1", metadata(path="a")),
        ("1e3", metadata(path="a")),
        ("٣", metadata(path="a")),
        ("9" * 19, metadata(path="a")),
        ("1", ""),
        ("1", metadata(path="a", archive="")),
        ("1", metadata(path="a", sha256="AB" * 32)),
    ],
)
def test_announcements_that_are_none(length: str | None, given: str) -> None:
    with pytest.raises(ServiceError) as caught:
        parse_announced(length, given)
    assert caught.value.status == 400


def test_checksums() -> None:
    for algorithm in ("sha1", "sha256"):
        digest = hashlib.new(algorithm, b"bytes").digest()
        found = parse_checksum(f"{algorithm} {base64.b64encode(digest).decode()}")
        assert found is not None
        assert (found.algorithm, found.digest) == (algorithm, digest)
    assert parse_checksum(None) is None
    for given in ("md5 AAAA", "sha1", "sha1 AAAA", "sha256 ?", ""):
        with pytest.raises(ServiceError) as caught:
            parse_checksum(given)
        assert caught.value.status == 400


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (None, "the header Upload-Length is missing"),
        ("9" * 20, "Upload-Length has 20 digits, over the bound of 18"),
        ("-1", "Upload-Length is '-1', which is no number of bytes"),
    ],
)
def test_what_is_no_number_says_why(given: str | None, words: str) -> None:
    with pytest.raises(ServiceError) as caught:
        parse_number("Upload-Length", given)
    assert (caught.value.status, caught.value.problem.detail) == (400, words)


def test_a_missing_version_is_said_to_be_missing() -> None:
    with pytest.raises(ServiceError, match="the header Tus-Resumable is missing"):
        require_version(None)


def test_numbers_and_dates() -> None:
    assert parse_number("Upload-Offset", "007") == 7
    assert http_date(784_111_777_999_999) == "Sun, 06 Nov 1994 08:49:37 GMT"
