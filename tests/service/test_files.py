"""The files of a drive: sent once, whole, under the names of the manifest."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import io
import json
import os
import socket
import tarfile
import threading
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import httpx
import pytest
from sqlalchemy import event

from service.api.manifests.bounded_process import LARGE_BYTES
from service.storage.blob_writer import BlobWriter, StoredFile
from service.storage.blobs import Recorded
from tests.helpers.live_api import Api, Client, forget_all, problem_of
from tests.helpers.tiny_drive import TinyDrive, png, png_of, tiny_drive, zip_of
from tests.service.conftest import StartApi


def digest(data: bytes) -> str:
    return f"sha-256=:{base64.b64encode(hashlib.sha256(data).digest()).decode()}:"


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def api(request: pytest.FixtureRequest, api: Api) -> Api:
    """One over each database."""
    served: Api = api if request.param == "sqlite" else request.getfixturevalue("postgres_api")
    return served


@pytest.fixture
def drive() -> TinyDrive:
    return tiny_drive()


@pytest.fixture
def drive_id(client: Client, drive: TinyDrive) -> str:
    return client.create(drive)


def put(client: Client, drive_id: str, path: str, data: bytes, **options: str) -> httpx.Response:
    headers = {"Content-Digest": options.pop("digest")} if "digest" in options else {}
    return client.put(f"/v1/drives/{drive_id}/files/{quote(path)}", content=data, params=options, headers=headers)


def test_a_file_is_stored_once(client: Client, drive: TinyDrive, drive_id: str) -> None:
    path, data = next(iter(drive.files.items()))
    first = put(client, drive_id, path, data, digest=digest(data))
    assert first.status_code == 201
    assert first.json() == {
        "path": path,
        "role": "image",
        "stored": True,
        "size_bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    again = put(client, drive_id, path, data)
    assert (again.status_code, again.json()) == (200, first.json())
    shown = client.get(f"/v1/drives/{drive_id}").json()
    assert (shown["files_stored"], shown["bytes_stored"]) == (1, len(data))
    assert len(client.api.objects(client.project_id)) == 2, "the manifest and the file"


def test_files_are_listed_by_path_and_by_being_there(client: Client, drive: TinyDrive, drive_id: str) -> None:
    here = sorted(drive.files)[2]
    put(client, drive_id, here, drive.files[here])

    def listed(**params: str) -> list[str]:
        found, cursor = [], None
        while True:
            given = params | ({"cursor": cursor} if cursor else {}) | {"limit": "4"}
            page = client.get(f"/v1/drives/{drive_id}/files", params=given).json()
            found += [file["path"] for file in page["items"]]
            cursor = page["next"]
            if cursor is None:
                return found

    assert listed() == sorted(drive.files)
    assert listed(stored="true") == [here]
    assert listed(stored="false") == sorted(set(drive.files) - {here})


def test_other_bytes_replace_only_when_asked_to(client: Client, drive: TinyDrive, drive_id: str) -> None:
    path, data = next(iter(drive.files.items()))
    other = png(seed="other")
    put(client, drive_id, path, data)
    problem = problem_of(put(client, drive_id, path, other), 409, "file-exists")
    assert hashlib.sha256(data).hexdigest() in problem["detail"]
    assert len(client.api.objects(client.project_id)) == 2, "the refused bytes are not kept"
    answer = put(client, drive_id, path, other, replace="true")
    assert (answer.status_code, answer.json()["sha256"]) == (201, hashlib.sha256(other).hexdigest())


def test_a_file_that_was_deleted_can_be_sent_again(client: Client, drive: TinyDrive, drive_id: str) -> None:
    path, data = next(iter(drive.files.items()))
    put(client, drive_id, path, data)
    url = f"/v1/drives/{drive_id}/files/{path}"
    assert client.delete(url).status_code == 204
    assert client.delete(url).status_code == 204, "repeating it changes nothing"
    assert client.get(f"/v1/drives/{drive_id}").json()["files_stored"] == 0
    assert put(client, drive_id, path, png(seed="other")).status_code == 201


@pytest.mark.parametrize(
    "path", ["no.png", "front/000000.PNG", "../000000.png", "front//000000.png", "a\0b", "ÿ\u2028.png"]
)
def test_a_name_that_the_manifest_does_not_have(client: Client, drive_id: str, path: str) -> None:
    url = f"/v1/drives/{drive_id}/files/{quote(path).replace('..', '%2E%2E')}"
    problem = problem_of(client.put(url, content=png()), 422, "not-in-manifest")
    assert repr(path) in problem["detail"]
    problem_of(client.delete(url), 422, "not-in-manifest")
    assert client.api.spooled() == []


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"", "empty-file"),
        (b"GIF89a", "not-an-image"),
        (png()[:20], "damaged-image"),
        (png_of(60_000, 60_000, b""), "image-too-large"),
        (b"\x89PNG\r\n\x1a\n" + b"\xff" * 60, "damaged-image"),
    ],
)
def test_what_is_no_image_of_a_camera(client: Client, drive: TinyDrive, drive_id: str, data: bytes, code: str) -> None:
    path = next(iter(drive.files))
    problem = problem_of(put(client, drive_id, path, data), 422, code)
    assert path in problem["detail"]
    assert client.api.spooled() == []
    assert len(client.api.objects(client.project_id)) == 1, "only the manifest"


def test_a_form_is_named_as_what_is_wrong(client: Client, drive: TinyDrive, drive_id: str) -> None:
    """`curl -F file=@x.png` sends a good file as a part of something else."""
    path, data = next(iter(drive.files.items()))
    for where, part, status, code in (
        (f"files/{path}", data, 422, "not-an-image"),
        ("archive", drive.zipped(), 415, "not-an-archive"),
    ):
        url = f"/v1/drives/{drive_id}/{where}"
        problem = problem_of(client.put(url, files={"file": part}), status, code)
        assert "form (multipart/form-data)" in problem["detail"]
        assert "--data-binary" in problem["remedy"]
        headers = {"Content-Digest": digest(part)}
        problem = problem_of(client.put(url, files={"file": part}, headers=headers), 422, "wrong-digest")
        assert "form" in problem["detail"]
    raw = client.put(f"/v1/drives/{drive_id}/files/{path}", content=data, headers={"Content-Type": "multipart/x"})
    assert raw.status_code == 201, "the bytes count"


@pytest.mark.parametrize("size_bytes", [0, LARGE_BYTES])
def test_a_form_in_place_of_a_document_is_named(client: Client, drive: TinyDrive, size_bytes: int) -> None:
    manifest = drive.raw + b" " * size_bytes
    for path, document in (("/v1/drives", manifest), ("/v1/reconstructions", b'{"drive_id": "drv_0"}')):
        problem = problem_of(client.post(path, files={"file": document}), 422, "invalid-document")
        assert problem["detail"] == "the body is a form (multipart/form-data), in which the document is one part"
        assert "--data-binary" in problem["remedy"]
    assert client.post("/v1/drives", content=manifest, headers={"Content-Type": "multipart/x"}).status_code == 201


def test_a_file_that_is_not_here_yet(client: Client, drive: TinyDrive, drive_id: str) -> None:
    path, data = next(iter(drive.files.items()))
    problem = problem_of(client.get(f"/v1/drives/{drive_id}/files/{path}"), 404, "not-found")
    assert f"{path!r} of drive {drive_id} is not uploaded yet" in problem["detail"]
    assert f"PUT /v1/drives/{drive_id}/files/{path}" in problem["remedy"]
    put(client, drive_id, path, data)
    assert client.get(f"/v1/drives/{drive_id}/files/{path}").content == data
    for other in ("no.png", "drive.json", "a%00b"):
        problem = problem_of(client.get(f"/v1/drives/{drive_id}/files/{other}"), 404, "not-found")
        assert "names no file" in problem["detail"]


def test_bytes_that_are_not_those_announced(client: Client, drive: TinyDrive, drive_id: str) -> None:
    path, data = next(iter(drive.files.items()))
    problem_of(put(client, drive_id, path, data, digest=digest(b"other")), 422, "wrong-digest")
    for malformed in ("sha-256=x", "sha-256=:AAAA:", ":", "sha-256=:%%%:"):
        problem_of(put(client, drive_id, path, data, digest=malformed), 400, "malformed-digest")
    assert client.get(f"/v1/drives/{drive_id}").json()["files_stored"] == 0
    assert client.api.spooled() == []


def test_a_known_content_need_not_be_sent_again(client: Client, drive: TinyDrive, drive_id: str) -> None:
    client.send_files(drive_id, drive)
    again = client.create(tiny_drive("again"))
    answer = client.post(f"/v1/drives/{again}/files:declare", json=drive.declaration)
    assert answer.json() == {"stored": list(drive.files), "to_send": []}
    assert client.post(f"/v1/drives/{again}:commit").status_code == 200


def test_nothing_is_known_of_another_project(api: Api, client: Client, drive: TinyDrive, drive_id: str) -> None:
    client.send_files(drive_id, drive)
    other = api.client()
    own = other.create(drive)
    answer = other.post(f"/v1/drives/{own}/files:declare", json=drive.declaration)
    assert answer.json() == {"stored": [], "to_send": list(drive.files)}
    other.send_files(own, drive)
    assert not set(api.objects(client.project_id)) & set(api.objects(other.project_id))


def test_a_declaration_says_what_is_wrong_with_it(client: Client, drive: TinyDrive, drive_id: str) -> None:
    url = f"/v1/drives/{drive_id}/files:declare"
    wrong_size = drive.declaration
    client.send_files(drive_id, drive)
    other = client.create(drive)
    wrong_size["files"][0]["size_bytes"] += 1
    answer = client.post(f"/v1/drives/{other}/files:declare", json=wrong_size).json()
    assert answer["to_send"] == [wrong_size["files"][0]["path"]], "same digest, another size: not believed"
    unknown = {"files": [{"path": "no.png", "size_bytes": 1, "sha256": "0" * 64}]}
    problem_of(client.post(url, json=unknown), 422, "not-in-manifest")
    for wrong in ({"files": []}, {"files": [{**unknown["files"][0], "sha256": "A" * 64}]}, {}, {"files": "x"}):
        problem_of(client.post(url, json=wrong), 422, "invalid-document")
    too_many = {"files": unknown["files"] * 10_001}
    problem_of(client.post(url, json=too_many), 422, "invalid-document")


def test_an_archive_brings_all_files(client: Client, drive: TinyDrive, drive_id: str) -> None:
    content = zip_of({f"top/{path}": data for path, data in {**drive.files, "drive.json": drive.raw}.items()})
    answer = client.put(f"/v1/drives/{drive_id}/archive", content=content)
    assert answer.json() == {"stored": 6, "files_stored": 6, "files_expected": 6}
    again = client.put(f"/v1/drives/{drive_id}/archive", content=content, headers={"Content-Digest": digest(content)})
    assert again.status_code == 200
    assert client.api.spooled() == []


def test_an_archive_of_many_files_lets_others_write_in_between(api: Api, client: Client) -> None:
    drive = tiny_drive(seed="many", frames=800)
    drive_id = client.create(drive)
    statements = [0]

    def begun(connection: Any) -> None:
        statements.append(0)

    def executed(*given: Any) -> None:
        statements[-1] += 1

    engine = api.context.database.engine
    event.listen(engine, "begin", begun)
    event.listen(engine, "after_cursor_execute", executed)
    try:
        answer = client.put(f"/v1/drives/{drive_id}/archive", content=drive.zipped())
    finally:
        event.remove(engine, "begin", begun)
        event.remove(engine, "after_cursor_execute", executed)
    assert answer.json() == {"stored": 1600, "files_stored": 1600, "files_expected": 1600}
    assert max(statements) < 20, "of one transaction"


def test_what_an_archive_was_refused_for_stays_with_others(api: Api, client: Client) -> None:
    """What it recorded before is forgotten, but not what another drive has begun to use."""
    drive = tiny_drive(seed="shared")
    mine, others = client.create(drive), client.create(drive)
    used_bytes = api.project(client.project_id).used_bytes
    path, *_, last = sorted(drive.files)
    put(client, mine, last, png(seed="in the way"))
    way_bytes = len(png(seed="in the way"))
    record, found = BlobWriter.record, []

    def record_and_send(self: BlobWriter, files: Sequence[StoredFile]) -> dict[str, Recorded]:
        recorded = record(self, files)
        found.append(put(client, others, path, drive.files[path]).status_code)
        return recorded

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(BlobWriter, "record", record_and_send)
        problem_of(client.put(f"/v1/drives/{mine}/archive", content=drive.zipped()), 409, "file-exists")
    assert found == [201]
    assert api.project(client.project_id).used_bytes == used_bytes + way_bytes + len(drive.files[path])
    names = sorted(file.name[:64] for file in api.objects(client.project_id))
    kept = [drive.raw, png(seed="in the way"), drive.files[path]]
    assert names == sorted(hashlib.sha256(data).hexdigest() for data in kept)


def test_an_archive_with_one_conflict_changes_nothing(client: Client, drive: TinyDrive, drive_id: str) -> None:
    path = sorted(drive.files)[-1]
    put(client, drive_id, path, png(seed="other"))
    objects = client.api.objects(client.project_id)
    answer = client.put(f"/v1/drives/{drive_id}/archive", content=drive.zipped())
    assert path in problem_of(answer, 409, "file-exists")["detail"]
    assert client.get(f"/v1/drives/{drive_id}").json()["files_stored"] == 1
    assert client.api.objects(client.project_id) == objects
    assert client.api.spooled() == []
    replaced = client.put(f"/v1/drives/{drive_id}/archive", content=drive.zipped(), params={"replace": "true"})
    assert replaced.json()["files_stored"] == 6


def test_two_clients_write_one_file(api: Api, client: Client, drive: TinyDrive) -> None:
    """Exactly one wins, the other is told so, and the file is one of the two."""
    contents = [png(seed="a"), png(seed="b")]
    path = next(iter(drive.files))
    for _ in range(5):
        drive_id = client.create(drive)
        barrier = threading.Barrier(2)
        answers: list[httpx.Response] = []

        def write(data: bytes, drive_id: str = drive_id, barrier: threading.Barrier = barrier) -> None:
            own = api.client_of(client.project_id, client.key)
            barrier.wait()
            answers.append(put(own, drive_id, path, data))  # noqa: B023 (joined below)

        threads = [threading.Thread(target=write, args=(data,)) for data in contents]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(answer.status_code for answer in answers) == [201, 409]
        (won,) = (answer.json()["sha256"] for answer in answers if answer.status_code == 201)
        (shown,) = client.get(f"/v1/drives/{drive_id}/files", params={"stored": "true"}).json()["items"]
        assert shown["sha256"] == won
        (stored,) = (path for path in api.objects(client.project_id) if path.name.startswith(won))
        assert stored.read_bytes() in contents
        assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
        api.context.artifacts.delete(forget_all(api))


def test_many_clients_send_the_same_content_at_once(api: Api, client: Client, drive: TinyDrive) -> None:
    """It is stored once, counted once, and every drive has it."""
    path, data = next(iter(drive.files.items()))
    drive_ids = [client.create(drive) for _ in range(8)]
    used = api.project(client.project_id).used_bytes
    statuses: list[int] = []

    def write(drive_id: str) -> None:
        own = api.client_of(client.project_id, client.key)
        statuses.append(put(own, drive_id, path, data).status_code)

    threads = [threading.Thread(target=write, args=(drive_id,)) for drive_id in drive_ids]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert statuses == [201] * 8
    assert api.project(client.project_id).used_bytes == used + len(data)
    sha256 = hashlib.sha256(data).hexdigest()
    assert len([path for path in api.objects(client.project_id) if path.name.startswith(sha256)]) == 1


def test_a_full_quota_refuses_and_deleting_frees_it(api: Api, drive: TinyDrive) -> None:
    path, data = next(iter(drive.files.items()))
    client = api.client(max_bytes=len(drive.raw) + len(data) - 1)
    drive_id = client.create(drive)
    problem = problem_of(put(client, drive_id, path, data), 413, "quota-full")
    assert str(len(data)) in problem["detail"]
    problem_of(client.put(f"/v1/drives/{drive_id}/archive", content=drive.zipped()), 413, "quota-full")
    problem_of(client.post("/v1/drives", content=tiny_drive("second").raw * 1), 413, "quota-full")
    assert len(api.objects(client.project_id)) == 1, "nothing of what was refused stays"
    client.delete(f"/v1/drives/{drive_id}")
    api.context.artifacts.delete(forget_all(api))
    assert api.project(client.project_id).used_bytes == 0
    assert api.objects(client.project_id) == []
    client.create(drive)


def tar_of(files: dict[str, bytes]) -> bytes:
    """A tar archive, compressed with xz, in which equal files take space once."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:xz", preset=1) as archive:
        for path, data in files.items():
            member = tarfile.TarInfo(path)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return buffer.getvalue()


class _SpoolPeak:
    """Most bytes that lie in the spool while a request is answered."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._ended = folder, threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.most_bytes = 0

    def __enter__(self) -> _SpoolPeak:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(0.002):
            with contextlib.suppress(FileNotFoundError):
                self.most_bytes = max(self.most_bytes, sum(e.stat().st_size for e in os.scandir(self._folder)))


def test_an_archive_unpacks_to_no_more_than_the_quota(start_api: StartApi, drive: TinyDrive) -> None:
    """Its ratio is below the bound, its own size within the quota: a small project must not fill the disk of all."""
    api = start_api()
    client = api.client(max_bytes=5_000_000)
    drive_id = client.create(drive)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packing:
        for path in drive.files:  # farther apart than deflate looks back
            packing.writestr(path, png_of(64, 48, (os.urandom(512) + bytes(1 << 16)) * 50))
        sizes = [entry.file_size for entry in packing.infolist()]
    assert max(sizes) < 5_000_000 < sum(sizes) / 3
    with _SpoolPeak(api.settings.spool_dir) as spool:
        answer = client.put(f"/v1/drives/{drive_id}/archive", content=archive.getvalue())
        problem = problem_of(answer, 413, "quota-full")
    assert "the project may store 5000000" in problem["detail"]
    assert spool.most_bytes < 10_000_000
    assert api.spooled() == []


def test_equal_files_of_an_archive_count_once(api: Api, drive: TinyDrive) -> None:
    mask = png_of(64, 48, os.urandom(300_000))
    client = api.client(max_bytes=len(drive.raw) + len(mask))
    drive_id = client.create(drive)
    answer = client.put(f"/v1/drives/{drive_id}/archive", content=tar_of(dict.fromkeys(drive.files, mask)))
    assert answer.status_code == 200, answer.text
    assert (answer.json()["stored"], answer.json()["files_stored"]) == (len(drive.files), len(drive.files))
    assert api.project(client.project_id).used_bytes == len(drive.raw) + len(mask)
    assert len(api.objects(client.project_id)) == 2
    for path in drive.files:
        assert client.get(f"/v1/drives/{drive_id}/files/{path}").content == mask


def test_the_manifest_in_an_archive_may_be_written_in_another_way(client: Client, drive: TinyDrive) -> None:
    indented = json.dumps(drive.manifest, indent=1).encode()
    for written in (indented, indented + b" " * 3_000_000):
        drive_id = client.create(drive)
        assert client.put(f"/v1/drives/{drive_id}/archive", content=drive.zipped(**{"drive.json": written})).is_success
    assert client.api.context.large_documents.held == 0


@pytest.mark.parametrize("what", ["key twice", "many keys", "deep", "too large"])
def test_the_manifest_in_an_archive_is_read_within_bounds(
    client: Client, drive: TinyDrive, drive_id: str, what: str
) -> None:
    same = drive.raw.decode()
    written = {
        "key twice": same.replace('"version": 1', '"version": 1, "version": 1'),
        "many keys": "{" + ",".join(f'"k{i}":1' for i in range(300_000)) + "}",
        "deep": '{"a":' * 100_000,
        "too large": same + " " * client.api.settings.max_json_bytes,
    }[what]
    answer = client.put(f"/v1/drives/{drive_id}/archive", content=drive.zipped(**{"drive.json": written.encode()}))
    assert "drive.json" in problem_of(answer, 422, "other-manifest")["detail"]
    assert client.api.spooled() == []


def test_the_very_bytes_of_a_large_manifest_are_the_manifest(client: Client, drive: TinyDrive) -> None:
    raw = drive.raw + b" " * client.api.settings.max_json_bytes
    drive_id = client.post("/v1/drives", content=raw).json()["id"]
    assert client.put(f"/v1/drives/{drive_id}/archive", content=drive.zipped(**{"drive.json": raw})).is_success


def test_an_archive_with_a_strange_file_is_refused_while_it_comes(api: Api, client: Client) -> None:
    drive = tiny_drive("watched", seed="watched")
    archive = zip_of({"../../etc/passwd": b"", **{path: data + bytes(5 << 20) for path, data in drive.files.items()}})
    drive_id = client.create(drive)
    with socket.create_connection((urlsplit(api.url).hostname, urlsplit(api.url).port), timeout=30) as connection:
        head = f"PUT /v1/drives/{drive_id}/archive HTTP/1.1\r\nHost: {urlsplit(api.url).netloc}\r\n"
        head += f"Authorization: Bearer {client.key}\r\nContent-Length: {len(archive)}\r\n\r\n"
        connection.sendall(head.encode() + archive[: 3 << 20])  # of thirty megabytes
        answer = connection.recv(1 << 16).decode()
    assert answer.startswith("HTTP/1.1 422")
    assert "leaves the drive's folder with '..'" in answer
    assert "passwd" in answer
    assert api.spooled() == []
