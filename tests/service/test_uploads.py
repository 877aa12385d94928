"""Resumable uploads, as tus clients make them."""

from __future__ import annotations

import asyncio
import hashlib
import os
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from sqlalchemy import update
from sqlalchemy.exc import OperationalError

from service.api.app import sweep_uploads
from service.api.routes import file_ingest, upload_writing
from service.database.tables import Drive, Upload, now_us
from service.domain import uploads as upload_records
from service.storage import durability
from service.storage.spool import BATCH_BYTES
from service.storage.uploads.resumable import Appender, PartialFile, append, sweep
from tests.helpers.live_api import Api, Client, problem_of, wait_until
from tests.helpers.tiny_drive import TinyDrive, png_of, tiny_drive, zip_of
from tests.helpers.tus_client import OFFSET_TYPE, VERSION, begin, checksum, create, head, offset_of, patch
from tests.service.conftest import StartApi

PATH = "front/000000.png"


def image(size_bytes: int, seed: int = 0) -> bytes:
    """Bytes that pass for an image."""
    noise = hashlib.shake_128(str(seed).encode()).digest(size_bytes)
    return png_of(64, 48, noise)


def stored(client: httpx.Client, drive_id: str, path: str = PATH) -> str | None:
    files = client.get(f"/v1/drives/{drive_id}/files").json()["items"]
    return next(file["sha256"] for file in files if file["path"] == path)


def sha256_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


@pytest.fixture
def drive() -> TinyDrive:
    return tiny_drive(seed=str(time.monotonic_ns()))


def bytes_left(api: Api) -> list[str]:
    folder = api.settings.uploads_dir
    return sorted(os.listdir(folder)) if folder.is_dir() else []


def test_a_file_in_pieces(api: Api, client: Client) -> None:
    drive_id, data = client.create(), image(300_000)
    url = begin(client, drive_id, PATH, data, sha256=sha256_of(data))
    assert offset_of(client, url) == 0
    for start in range(0, len(data), 100_000):
        assert stored(client, drive_id) is None
        answer = patch(client, url, start, data[start : start + 100_000])
        assert (answer.status_code, answer.content) == (204, b"")
        assert int(answer.headers["upload-offset"]) == min(start + 100_000, len(data))
        assert answer.headers["tus-resumable"] == "1.0.0"
        assert answer.headers["upload-expires"].endswith("GMT")
    assert stored(client, drive_id) == sha256_of(data)
    done = head(client, url)
    assert (done.headers["upload-offset"], done.headers["upload-length"]) == (str(len(data)),) * 2
    assert done.headers["cache-control"] == "no-store"
    assert done.headers["upload-metadata"].startswith("path ")
    assert not [name for name in bytes_left(api) if name.startswith(url.rsplit("/", 1)[1])]
    assert patch(client, url, len(data), b"").status_code == 204
    problem_of(patch(client, url, 0, data), 409, "wrong-offset")


def test_what_the_service_speaks(client: Client) -> None:
    answer = client.options(f"/v1/drives/{client.create()}/uploads")
    assert answer.status_code == 204
    assert answer.headers["tus-version"] == "1.0.0"
    assert set(answer.headers["tus-extension"].split(",")) == {"creation", "checksum", "expiration", "termination"}
    assert "sha1" in answer.headers["tus-checksum-algorithm"].split(",")
    assert int(answer.headers["tus-max-size"]) > 0


def test_a_wrong_offset(client: Client) -> None:
    data = image(1000)
    url = begin(client, client.create(), PATH, data)
    assert patch(client, url, 0, data[:500]).status_code == 204
    for offset in (0, 499, 501, 10**17):
        refused = patch(client, url, offset, data[500:])
        problem_of(refused, 409, "wrong-offset")
        assert refused.headers["upload-offset"] == "500"
        assert refused.headers["tus-resumable"] == "1.0.0"
    assert offset_of(client, url) == 500
    assert patch(client, url, 500, data[500:]).status_code == 204


@pytest.mark.parametrize("algorithm", ["sha1", "sha256"])
def test_checksums(client: Client, algorithm: str) -> None:
    drive_id, data = client.create(), image(5000)
    url = begin(client, drive_id, PATH, data)
    assert patch(client, url, 0, data[:2000], Upload_Checksum=checksum(data[:2000], algorithm)).status_code == 204
    wrong = patch(client, url, 2000, data[2000:], Upload_Checksum=checksum(data[2001:], algorithm))
    problem_of(wrong, 460, "checksum-mismatch")
    assert offset_of(client, url) == 2000, "the bytes were dropped"
    assert patch(client, url, 2000, data[2000:], Upload_Checksum=checksum(data[2000:], algorithm)).status_code == 204
    assert stored(client, drive_id) == sha256_of(data)


def test_bytes_that_were_not_compared_do_not_count(api: Api, client: Client) -> None:
    """Not where the connection breaks, and not where the process is killed: then the file is longer than the record."""
    data = image(3_000_000)
    url = begin(client, client.create(), PATH, data)
    assert patch(client, url, 0, data[:10]).status_code == 204

    def broken() -> Iterator[bytes]:
        yield data[10:2_500_000]
        raise ConnectionError

    def counts_at_once() -> bool:
        with api.database.read() as session:
            return session.get_one(Upload, url.rsplit("/", 1)[1]).tail_boot is not None

    with pytest.raises(ConnectionError):
        patch(client, url, 10, broken(), Upload_Checksum=checksum(data[10:]))
    wait_until(lambda: not counts_at_once(), "the begin of the request")
    wait_until(lambda: head(client, url).status_code == 200, "the end of the request")
    assert offset_of(client, url) == 10
    with pytest.raises(ConnectionError):
        patch(client, url, 10, broken())
    wait_until(counts_at_once, "the begin of the request")
    wait_until(lambda: head(client, url).status_code == 200, "the end of the request")
    kept = offset_of(client, url)
    assert 10 < kept <= 2_500_000, "what came without a checksum is kept"
    assert patch(client, url, kept, data[kept:]).status_code == 204


def test_after_another_start_of_the_machine_only_what_was_synced_counts(
    api: Api, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = image(1000)
    url = begin(client, client.create(), PATH, data)
    upload_id = url.rsplit("/", 1)[1]
    assert patch(client, url, 0, data[:400]).status_code == 204
    file = PartialFile(api.settings.uploads_dir, upload_id)
    file.append_at(400, data[400:700], min_free_bytes=0)  # as a process that was killed leaves it
    file.close()
    with monkeypatch.context() as patched:
        patched.setattr("service.api.routes.upload_writing.boot_id", lambda: "another start")
        assert offset_of(client, url) == 400
    assert offset_of(client, url) == 700
    with api.database.read() as session:
        assert session.get_one(Upload, upload_id).kept_bytes == 700, "what is told was synced"
    assert durability.boot_id() is not None


def test_one_writer_at_a_time(client: Client, api: Api) -> None:
    data = image(100_000)
    drive_id = client.create()
    url = begin(client, drive_id, PATH, data)
    go_on = threading.Event()

    def slow() -> Iterator[bytes]:
        yield data[:50_000]
        assert go_on.wait(30)
        yield data[50_000:]

    answers: list[httpx.Response] = []
    other = api.client_of(client.project_id, client.key)
    first = threading.Thread(target=lambda: answers.append(patch(other, url, 0, slow())))
    first.start()
    wait_until(lambda: head(client, url).status_code == 423, "the first writer")
    problem_of(patch(client, url, 0, data), 423, "upload-locked")
    problem_of(client.delete(url, headers=VERSION), 423, "upload-locked")
    go_on.set()
    first.join()
    assert [answer.status_code for answer in answers] == [204]
    assert stored(client, drive_id) == sha256_of(data)


def test_a_look_at_an_upload_stops_no_writer(client: Client, api: Api) -> None:
    """Whoever looks holds the bytes, too; the writer waits for a moment."""
    data = image(1000)
    url = begin(client, client.create(), PATH, data)
    looking = PartialFile(api.settings.uploads_dir, url.rsplit("/", 1)[1])
    letting_go = threading.Timer(0.3, looking.close)
    letting_go.start()
    assert patch(client, url, 0, data).status_code == 204
    letting_go.join()


def test_a_writer_that_is_silent_makes_room(start_api: StartApi) -> None:
    api = start_api(upload_idle_seconds=0.3)
    client, data = api.client(), image(100_000)
    url = begin(client, client.create(), PATH, data)
    host = urlsplit(api.url)
    with socket.create_connection((host.hostname, host.port)) as connection:
        lines = [
            f"PATCH {url} HTTP/1.1", f"Host: {host.netloc}", f"Authorization: Bearer {client.key}",
            "Tus-Resumable: 1.0.0", "Upload-Offset: 0", "Content-Type: application/offset+octet-stream",
            f"Content-Length: {len(data)}", "", "",
        ]  # fmt: skip
        connection.sendall("\r\n".join(lines).encode() + data[:1000])
        assert b" 408 " in connection.recv(100)
    assert offset_of(client, url) == 1000


def test_expiry(api: Api, client: Client) -> None:
    data = image(1000)
    drive_id = client.create()
    url = begin(client, drive_id, PATH, data)
    upload_id = url.rsplit("/", 1)[1]
    assert patch(client, url, 0, data[:500]).status_code == 204
    with api.database.write() as session:
        session.execute(update(Upload).where(Upload.id == upload_id).values(expires_us=now_us() - 1))
    assert head(client, url).status_code == 410
    problem_of(patch(client, url, 500, data[500:]), 410, "upload-expired")
    assert any(name.startswith(upload_id) for name in bytes_left(api))
    sweep_uploads(api.context)
    assert not any(name.startswith(upload_id) for name in bytes_left(api))
    assert head(client, url).status_code == 410
    with api.database.write() as session:
        long_ago = now_us() - 8 * 86_400 * 1_000_000
        session.execute(update(Upload).where(Upload.id == upload_id).values(expires_us=long_ago))
    sweep_uploads(api.context)
    assert head(client, url).status_code == 404
    url = begin(client, drive_id, PATH, data)
    assert patch(client, url, 0, data).status_code == 204
    assert stored(client, drive_id) == sha256_of(data)


def test_every_request_renews_an_upload(api: Api, client: Client) -> None:
    """Of a client that looks again and again how far its upload is, the bytes stay."""
    data = image(1000)
    url = begin(client, client.create(), PATH, data)
    requests: list[Callable[[], httpx.Response]] = [
        lambda: head(client, url),
        lambda: patch(client, url, 0, data[:500]),
        lambda: head(client, url),
    ]
    for request in requests:
        with api.database.write() as session:
            mine = update(Upload).where(Upload.id == url.rsplit("/", 1)[1])
            session.execute(mine.values(expires_us=now_us() + 60_000_000))
        renewed = parsedate_to_datetime(request().headers["upload-expires"])
        assert renewed > datetime.now(UTC) + timedelta(hours=23)
        (listed,) = client.get(f"{url.rpartition('/')[0]}").json()["items"]
        assert datetime.fromisoformat(listed["expires_at"]) >= renewed


def test_termination(api: Api, client: Client) -> None:
    data = image(1000)
    url = begin(client, client.create(), PATH, data)
    assert patch(client, url, 0, data[:500]).status_code == 204
    ended = client.delete(url, headers=VERSION)
    assert (ended.status_code, ended.headers["tus-resumable"]) == (204, "1.0.0")
    assert head(client, url).status_code == 404
    problem_of(patch(client, url, 500, data[500:]), 404, "not-found")
    problem_of(client.delete(url, headers=VERSION), 404, "not-found")


def test_what_is_there_is_not_sent_again(client: Client, drive: TinyDrive) -> None:
    client.filled(drive)
    other_id, data = client.create(drive), drive.files[PATH]
    answer = create(client, other_id, len(data), path=PATH, sha256=sha256_of(data))
    assert (answer.status_code, answer.headers["upload-offset"], answer.json()["done"]) == (201, str(len(data)), True)
    assert stored(client, other_id) == sha256_of(data)
    assert offset_of(client, answer.headers["location"]) == len(data)
    # Of another project nothing is known.
    stranger = client.api.client()
    answer = create(stranger, stranger.create(drive), len(data), path=PATH, sha256=sha256_of(data))
    assert answer.headers["upload-offset"] == "0"


def test_what_is_there_and_is_no_file_of_a_drive_is_sent_and_checked(client: Client, drive: TinyDrive) -> None:
    """A manifest here; else any result of a job would pass for an image."""
    client.create(drive)
    drive_id, data = client.create(tiny_drive("other")), drive.raw
    answer = create(client, drive_id, len(data), path=PATH, sha256=sha256_of(data))
    assert (answer.headers["upload-offset"], answer.json()["done"]) == ("0", False)
    problem_of(patch(client, answer.headers["location"], 0, data), 422, "not-an-image")
    file = {"path": PATH, "size_bytes": len(data), "sha256": sha256_of(data)}
    declared = client.post(f"/v1/drives/{drive_id}/files:declare", json={"files": [file]})
    assert declared.json() == {"stored": [], "to_send": [PATH]}
    assert stored(client, drive_id) is None


def test_an_archive(client: Client, drive: TinyDrive) -> None:
    drive_id, zipped = client.create(drive), drive.zipped()
    answer = create(client, drive_id, len(zipped), archive="", sha256=sha256_of(zipped))
    url = answer.headers["location"]
    assert patch(client, url, 0, zipped[:100]).status_code == 204
    assert patch(client, url, 100, zipped[100:]).status_code == 204
    assert client.post(f"/v1/drives/{drive_id}:commit").status_code == 200


def test_only_what_unpacks_takes_a_place_of_those_that_unpack(
    client: Client, api: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    unpacking, go_on = api.context.unpacking.places, threading.Event()
    unpack_now = file_ingest.keep_archive

    def unpack_later(*given: Any) -> Any:
        assert go_on.wait(30)
        return unpack_now(*given)

    monkeypatch.setattr(upload_writing, "keep_archive", unpack_later)
    answers: list[int] = []

    def send(url: str, offset: int, data: bytes) -> threading.Thread:
        own = api.client_of(client.project_id, client.key)
        thread = threading.Thread(target=lambda: answers.append(patch(own, url, offset, data).status_code))
        thread.start()
        return thread

    zips = [tiny_drive(seed=f"turn{i}").zipped() for i in range(3)]
    *urls, last = [begin_archive(client, client.create(), zipped) for zipped in zips]
    try:
        sending = [send(url, 0, zipped) for url, zipped in zip(urls, zips[:-1], strict=True)]
        wait_until(lambda: unpacking.held == 2, "that all places are taken")
        client.timeout = 5
        assert patch(client, last, 0, zips[-1][:100]).status_code == 204
        sending.append(send(last, 100, zips[-1][100:]))
        wait_until(lambda: unpacking.waiting == 1, "that the last one waits")
        with api.database.read() as session:
            kept_bytes = session.get_one(Upload, last.rsplit("/", 1)[1]).kept_bytes
        assert kept_bytes == len(zips[-1]), "what came does not wait"
    finally:
        go_on.set()
    for thread in sending:
        thread.join()
    assert answers == [204] * len(zips)


def test_uploads_that_end_take_turns_on_the_disk(start_api: StartApi, monkeypatch: pytest.MonkeyPatch) -> None:
    """As files that are sent whole; each of them is hashed and, elsewhere than in a folder, in memory in parts."""
    api = start_api(max_concurrent_writes=2)
    client = api.client()
    go_on, lock, under_way = threading.Event(), threading.Lock(), list[int]()
    keep_now = file_ingest.keep_file

    def keep_later(*given: Any) -> Any:
        with lock:
            under_way.append(len(under_way) + 1)
        assert go_on.wait(30)
        return keep_now(*given)

    monkeypatch.setattr(upload_writing, "keep_file", keep_later)
    drive = tiny_drive()
    drive_id = client.create(drive)
    urls = [create(client, drive_id, len(data), path=path).headers["location"] for path, data in drive.files.items()]
    answers: list[int] = []

    def send(url: str, data: bytes) -> None:
        answers.append(patch(api.client_of(client.project_id, client.key), url, 0, data).status_code)

    sending = [threading.Thread(target=send, args=one) for one in zip(urls, drive.files.values(), strict=True)]
    try:
        for thread in sending:
            thread.start()
        wait_until(lambda: api.context.disk.statistics().tasks_waiting == len(urls) - 2, "that all others wait")
        assert under_way == [1, 2]
    finally:
        go_on.set()
    for thread in sending:
        thread.join(30)
    assert answers == [204] * len(urls)
    assert client.post(f"/v1/drives/{drive_id}:commit").status_code == 200


def begun(client: Client, method: str, url: str, **headers: str) -> tuple[int, bytes]:
    """The answer to a request whose body does not come."""
    connection = HTTPConnection(urlsplit(client.api.url).netloc, timeout=10)
    try:
        connection.putrequest(method, url)
        for name, value in {"Authorization": f"Bearer {client.key}", **headers}.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def test_the_quota_of_open_uploads(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(upload_records, "MAX_OPEN", 2)
    drive_id = client.create()
    urls = [create(client, drive_id, 100, path=PATH).headers["location"] for _ in range(2)]
    problem_of(create(client, drive_id, 100, path=PATH), 429, "too-many-uploads")
    assert client.delete(urls[0], headers=VERSION).status_code == 204
    assert create(client, drive_id, 100, path=PATH).status_code == 201


@pytest.mark.parametrize("method", ["PATCH", "HEAD"])
@pytest.mark.parametrize("what", ["file", "archive"])
def test_a_drive_that_was_committed_meanwhile_is_told_before_the_bytes_come(
    client: Client, api: Api, drive: TinyDrive, what: str, method: str
) -> None:
    drive_id, size_bytes = client.filled(drive), 10_000_000
    announced = {"archive": ""} if what == "archive" else {"path": PATH, "replace": "true"}
    url = create(client, drive_id, size_bytes, **announced).headers["location"]
    assert patch(client, url, 0, drive.zipped()[:1000]).status_code == 204
    commit(api, drive_id)
    headers = {} if method == "HEAD" else {"Upload_Offset": "1000", "Content_Length": str(size_bytes - 1000)}
    status, body = begun(client, method, url, Tus_Resumable="1.0.0", Content_Type=OFFSET_TYPE, **headers)
    assert status == 409
    assert method == "HEAD" or b"drive-committed" in body
    assert head(client, url).status_code == 404, "as at its end, there is nothing to go on with"
    assert not any(name.startswith(url.rsplit("/", 1)[1]) for name in bytes_left(api))


def commit(api: Api, drive_id: str) -> None:
    with api.database.write() as session:
        session.execute(update(Drive).where(Drive.id == drive_id).values(state="COMMITTED"))


def test_what_a_committed_drive_has_may_come_again(client: Client, api: Api, drive: TinyDrive) -> None:
    drive_id, data = client.create(drive), drive.files[PATH]
    urls = [begin(client, drive_id, PATH, data, **known) for known in ({"sha256": sha256_of(data)}, {})]
    client.send_files(drive_id, drive)
    commit(api, drive_id)
    for url in urls:
        assert patch(client, url, 0, data).status_code == 204
    other = png_of(64, 48, b"other")
    large = str(20_000_000)
    status, body = begun(client, "PUT", f"/v1/drives/{drive_id}/files/{PATH}?replace=true", Content_Length=large)
    assert (status, b"drive-committed" in body) == (409, True)
    problem_of(client.put(f"/v1/drives/{drive_id}/files/{PATH}", content=other), 409, "drive-committed")


def test_a_drive_that_was_deleted_meanwhile_is_told_before_the_bytes_come(client: Client) -> None:
    drive_id = client.create()
    url = create(client, drive_id, 10_000_000, archive="").headers["location"]
    assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
    headers = {"Tus_Resumable": "1.0.0", "Content_Type": OFFSET_TYPE, "Upload_Offset": "0"}
    assert begun(client, "PATCH", url, **headers, Content_Length="10000000")[0] == 404


def test_bytes_that_are_not_what_was_announced(api: Api, client: Client) -> None:
    drive_id, data = client.create(), image(1000)
    url = begin(client, drive_id, PATH, data, sha256=sha256_of(b"other"))
    problem_of(patch(client, url, 0, data), 422, "wrong-digest")
    assert head(client, url).status_code == 404, "there is nothing to go on with"
    text = b"no image" * 100
    url = begin(client, drive_id, PATH, text)
    answer = patch(client, url, 0, text)
    assert 415 <= answer.status_code <= 422, answer.text
    assert head(client, url).status_code == 404
    assert stored(client, drive_id) is None
    archive = begin_archive(client, drive_id, text)
    assert patch(client, archive, 0, text).status_code == 415


def begin_archive(client: Client, drive_id: str, data: bytes) -> str:
    answer = create(client, drive_id, len(data), archive="")
    assert answer.status_code == 201
    return answer.headers["location"]


def test_other_bytes_are_stored_under_the_name(client: Client) -> None:
    drive = tiny_drive()
    drive_id, data = client.filled(drive), image(1000)
    url = begin(client, drive_id, PATH, data)
    problem_of(patch(client, url, 0, data), 409, "file-exists")
    url = begin(client, drive_id, PATH, data, replace="true")
    assert patch(client, url, 0, data).status_code == 204
    assert stored(client, drive_id) == sha256_of(data)


def test_refused_creations(start_api: StartApi) -> None:
    api = start_api(max_file_bytes=10_000, max_archive_bytes=50_000)
    client = api.client(max_bytes=20_000)
    drive_id = client.create()
    too_large = create(client, drive_id, 10_001, path=PATH)
    problem_of(too_large, 413, "too-large")
    assert too_large.headers["tus-max-size"] == "10000"
    problem_of(create(client, drive_id, 50_001, archive=""), 413, "too-large")
    problem_of(create(client, drive_id, 5, path="no.png"), 422, "not-in-manifest")
    problem_of(create(client, drive_id, 5), 400, "malformed-upload")
    problem_of(create(client, "drv_0", 5, path=PATH), 404, "not-found")
    assert PATH in problem_of(create(client, drive_id, 0, path=PATH), 422, "empty-file")["detail"]
    problem_of(create(client, drive_id, 0, archive=""), 422, "empty-archive")
    assert client.get(f"/v1/drives/{drive_id}/uploads").json()["items"] == []
    assert create(client, drive_id, 9_000, path=PATH).status_code == 201
    assert create(client, drive_id, 9_000, path="rear/000000.png").status_code == 201
    problem_of(create(client, drive_id, 9_000, path="rear/000001.png"), 413, "quota-full")
    other = client.post(f"/v1/drives/{drive_id}/uploads", headers={"Tus-Resumable": "0.2.2", "Upload-Length": "5"})
    problem_of(other, 412, "tus-version")
    assert other.headers["tus-version"] == other.headers["tus-resumable"] == "1.0.0"


def test_uploads_into_a_committed_drive_count_nothing(start_api: StartApi) -> None:
    client = start_api().client(max_bytes=1_000_000)
    drive_id = client.filled()
    assert create(client, drive_id, 900_000, archive="").status_code == 201
    other_id = client.create()
    problem_of(create(client, other_id, 900_000, archive=""), 413, "quota-full")
    commit(client.api, drive_id)
    assert create(client, other_id, 900_000, archive="").status_code == 201


def test_an_upload_that_goes_on_while_it_is_swept(tmp_path: Path) -> None:
    upload_id = "upl_" + "0" * 30
    file = PartialFile(tmp_path, upload_id)
    file.append_at(0, b"bytes", min_free_bytes=0)
    file.close()
    answers = iter([set[str](), {upload_id}])  # a request has ended between the two, and put its time off
    assert sweep(tmp_path, lambda _: next(answers)) == 0
    assert file.path.read_bytes() == b"bytes"
    assert sweep(tmp_path, lambda _: set()) == 1
    assert not file.path.exists()


def test_a_committed_drive_takes_none(client: Client) -> None:
    problem_of(create(client, client.frozen(), 5, path=PATH), 409, "drive-committed")


def test_refused_requests(client: Client, api: Api) -> None:
    data = image(1000)
    url = begin(client, client.create(), PATH, data)
    wrong_type = client.patch(url, content=b"x", headers={**VERSION, "Upload-Offset": "0"})
    problem_of(wrong_type, 415, "wrong-media-type")
    problem_of(patch(client, url, 0, data + b"x"), 413, "too-large")
    problem_of(patch(client, url, 0, iter((data, b"x"))), 413, "too-large")
    assert offset_of(client, url) == 0
    problem_of(patch(client, url, 0, b"x", Upload_Checksum="md5 AAAA"), 400, "malformed-upload")
    problem_of(patch(client, url, 0, b"x", Upload_Offset="x"), 400, "malformed-upload")
    stranger = api.client()
    assert head(stranger, url).status_code == 404
    problem_of(patch(stranger, url, 0, data), 404, "not-found")
    problem_of(stranger.delete(url, headers=VERSION), 404, "not-found")
    assert api.anonymous().head(url, headers=VERSION).status_code == 401
    assert patch(client, url, 0, data, Content_Type="Application/Offset+Octet-Stream; x=1").status_code == 204


def test_a_full_disk(start_api: StartApi) -> None:
    client = start_api().client()
    drive_id = client.create()
    full = start_api(min_free_disk_bytes=2**60).client_of(client.project_id, client.key)  # of the same folder
    problem_of(create(full, drive_id, 10, path=PATH), 507, "disk-full")


def test_the_disk_fills_up(client: Client, api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    data = image(3_000_000)
    url = begin(client, client.create(), PATH, data)
    with monkeypatch.context() as full:
        asked: list[int] = []

        def require_space(folder: object, size_bytes: int, *, min_free_bytes: int) -> None:
            asked.append(size_bytes)
            if len(asked) > 2:
                raise OSError(28, "No space left on device")

        full.setattr("service.storage.uploads.resumable.require_space", require_space)
        problem_of(patch(client, url, 0, data), 507, "disk-full")
    kept = offset_of(client, url)
    assert 0 < kept < len(data)
    assert patch(client, url, kept, data[kept:]).status_code == 204


class _NoRoomOnce:
    """`os.statvfs` of a disk that has no room when the second batch of an upload is written, and has some again."""

    def __init__(self, folder: Path) -> None:
        self._statvfs, self._folder, self._asked = os.statvfs, folder, 0

    def __call__(self, path: Path) -> Any:
        self._asked += path == self._folder
        if path == self._folder and self._asked == 2:
            return SimpleNamespace(f_bavail=0, f_frsize=1)
        return self._statvfs(path)


@pytest.mark.parametrize("more", [300_000, 900_000, BATCH_BYTES + 500_000])
def test_nothing_is_written_in_the_place_of_what_had_no_room(
    client: Client, api: Api, monkeypatch: pytest.MonkeyPatch, more: int
) -> None:
    """The refusal of one batch is seen when the next one is there, and that one may fit."""
    data, drive_id = image(2 * BATCH_BYTES + 300_000 + more), client.create()
    url = begin(client, drive_id, PATH, data)
    with monkeypatch.context() as full:
        full.setattr(os, "statvfs", _NoRoomOnce(api.settings.uploads_dir))
        problem_of(patch(client, url, 0, data), 507, "disk-full")
    kept = offset_of(client, url)
    assert BATCH_BYTES <= kept < 2 * BATCH_BYTES
    assert (api.settings.uploads_dir / f"{url.rsplit('/', 1)[1]}.bytes").read_bytes() == data[:kept]
    assert patch(client, url, kept, data[kept:]).status_code == 204
    assert stored(client, drive_id) == sha256_of(data)


def test_a_database_that_is_away_writes_nothing_twice(
    client: Client, api: Api, monkeypatch: pytest.MonkeyPatch, drive: TinyDrive
) -> None:
    """The names of an archive are looked up once its bytes are written."""
    archive, drive_id = drive.zipped(), client.create(drive)
    url = create(client, drive_id, len(archive), archive="").headers["location"]
    with monkeypatch.context() as away:
        away.setattr("service.domain.drives.named_files", _away)
        problem_of(patch(client, url, 0, archive[:1000]), 503, "database-unavailable")
    assert offset_of(client, url) == 1000
    assert (api.settings.uploads_dir / f"{url.rsplit('/', 1)[1]}.bytes").read_bytes() == archive[:1000]
    assert patch(client, url, 1000, archive[1000:]).status_code == 204
    assert stored(client, drive_id) == sha256_of(drive.files[PATH])


def _away(*_: object) -> set[str]:
    raise OperationalError("SELECT", {}, Exception("database is locked"))


@pytest.mark.parametrize("waits_for", ["its turn", "the batch before"])
def test_a_cancelled_request_leaves_no_gap(tmp_path: Path, waits_for: str) -> None:
    """A service that is told to stop cancels its requests, also those that wait for their turn on the disk."""
    sent = [bytes([n]) * BATCH_BYTES for n in range(2)] + [b"rest"]
    file = PartialFile(tmp_path, "upl_" + "0" * 30)
    appender = Appender(file, offset=0, min_free_bytes=0, checksum=None, whole=None)

    async def body(waiting: asyncio.Event) -> AsyncIterator[bytes]:
        yield sent[0]
        if waits_for == "the batch before":
            waiting.set()
            yield sent[1]
        else:
            yield sent[2]
            waiting.set()

    async def run() -> None:
        on_disk, waiting = asyncio.Semaphore(1), asyncio.Event()
        async with on_disk:
            task = asyncio.create_task(append(body(waiting), appender, max_bytes=1 << 30, on_disk=on_disk))
            await waiting.wait()
            await asyncio.sleep(0.05)
            task.cancel()
            await asyncio.sleep(0.05)
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(run())
    written = file.path.read_bytes()
    file.close()
    assert len(written) == appender.offset >= BATCH_BYTES
    assert b"".join(sent if waits_for == "the batch before" else [sent[0], sent[2]]).startswith(written)


def test_killed_between_the_last_byte_and_the_end(client: Client, api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    """All bytes are there, and the drive does not have them yet: whoever asks for the offset brings it to its end."""
    data, drive_id = image(1000), client.create()
    url = begin(client, drive_id, PATH, data, sha256=sha256_of(data))
    with monkeypatch.context() as killed:
        killed.setattr("service.api.routes.upload_writing._Held._hand_over", _die)
        assert patch(client, url, 0, data).status_code == 500
    assert stored(client, drive_id) is None
    assert offset_of(client, url) == len(data)
    assert stored(client, drive_id) == sha256_of(data)
    # And where the record alone is missing.
    upload_id = url.rsplit("/", 1)[1]
    with api.database.write() as session:
        session.execute(update(Upload).where(Upload.id == upload_id).values(is_done=False))
    file = PartialFile(api.settings.uploads_dir, upload_id)
    file.append_at(0, data, min_free_bytes=0)
    file.close()
    assert offset_of(client, url) == len(data)
    assert stored(client, drive_id) == sha256_of(data)


def _die(*_: object) -> None:
    raise RuntimeError("killed")


def test_methods_in_a_header(client: Client) -> None:
    data, drive_id = image(1000), client.create()
    url = begin(client, drive_id, PATH, data)
    headers = {**VERSION, "Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
    answer = client.post(url, content=data, headers={**headers, "X-HTTP-Method-Override": "PATCH"})
    assert answer.status_code == 204
    assert client.post(url, headers={**VERSION, "X-HTTP-Method-Override": "DELETE"}).status_code == 204
    problem_of(client.post(url, headers=VERSION), 405, "method-not-allowed")


def test_repeated_creation(client: Client) -> None:
    drive_id, key = client.create(), {"Idempotency-Key": "tus-1"}
    headers = {**VERSION, "Upload-Length": "10", "Upload-Metadata": "path " + "ZnJvbnQvMDAwMDAwLnBuZw=="}
    first = client.post(f"/v1/drives/{drive_id}/uploads", headers={**headers, **key})
    again = client.post(f"/v1/drives/{drive_id}/uploads", headers={**headers, **key})
    assert (first.status_code, first.headers["location"]) == (again.status_code, again.headers["location"])
    other = client.post(f"/v1/drives/{drive_id}/uploads", headers={**headers, **key, "Upload-Length": "11"})
    problem_of(other, 422, "idempotency-key-reused")


def test_a_deleted_drive_takes_its_uploads_along(client: Client, api: Api) -> None:
    drive_id, data = client.create(), image(1000)
    url = begin(client, drive_id, PATH, data)
    assert patch(client, url, 0, data[:500]).status_code == 204
    assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
    assert head(client, url).status_code == 404
    sweep_uploads(api.context)
    assert not any(name.startswith(url.rsplit("/", 1)[1]) for name in bytes_left(api))


def test_an_archive_with_a_strange_file_is_refused_before_the_rest_comes(api: Api, client: Client) -> None:
    drive = tiny_drive("watched", seed="watched", frames=6)
    files = {path: data + os.urandom(100_000) for path, data in drive.files.items()}
    (first, content), *others = files.items()
    archive = zip_of({first: content, "notes/mine.txt": b"mine", **dict(others)})
    answer = create(client, client.create(drive), len(archive), archive="")
    url = answer.headers["location"]
    assert patch(client, url, 0, archive[:50_000]).status_code == 204
    problem = problem_of(patch(client, url, 50_000, archive[50_000:250_000]), 422, "unexpected-file")
    assert "'notes/mine.txt'" in problem["detail"]
    assert "Leave them out" in problem["remedy"]
    assert head(client, url).status_code == 404, "nothing more is waited for"
    assert not [name for name in bytes_left(api) if name.startswith(url.rsplit("/", 1)[1])]


def test_an_archive_goes_on_in_another_process(client: Client, api: Api) -> None:
    """What one request knew of the names is read again where it is gone."""
    drive = tiny_drive("watched on", seed="watched on")
    archive = drive.zipped()
    drive_id = client.create(drive)
    url = create(client, drive_id, len(archive), archive="").headers["location"]
    for start in range(0, len(archive), 700):
        assert patch(client, url, start, archive[start : start + 700]).status_code == 204
        api.context.archive_watches.take(url.rsplit("/", 1)[1])
    assert stored(client, drive_id) == sha256_of(drive.files[PATH])


def test_a_client_that_lost_an_uploads_url_finds_it_by_its_digest(client: Client) -> None:
    drive_id, data = client.create(), image(3000)
    url = begin(client, drive_id, PATH, data, sha256=sha256_of(data))
    begin(client, drive_id, "front/000001.png", data[:2000], sha256=sha256_of(data[:2000]))
    assert patch(client, url, 0, data[:1000]).status_code == 204
    listed = client.get(f"/v1/drives/{drive_id}/uploads", params={"sha256": sha256_of(data)}).json()["items"]
    assert [(one["id"], one["offset_bytes"]) for one in listed] == [(url.rsplit("/", 1)[1], 1000)]
    assert len(client.get(f"/v1/drives/{drive_id}/uploads").json()["items"]) == 2
    assert patch(client, url, 1000, data[1000:]).status_code == 204
    assert client.get(f"/v1/drives/{drive_id}/uploads", params={"sha256": sha256_of(data)}).json()["items"] == []
    problem_of(client.get(f"/v1/drives/{drive_id}/uploads", params={"sha256": "x"}), 422, "invalid-request")
    problem_of(client.get("/v1/drives/drv_none/uploads"), 404, "not-found")
