"""Hostile and broken input over HTTP: refused with words that help, and nothing of it stays."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import json
import os
import shutil
import socket
import stat
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from schemas.api.resource import Finding
from tests.helpers.live_api import Api, Client, api_in_thread, api_process, problem_of, settings_of, wait_until
from tests.helpers.tiny_drive import TinyDrive, manifest, png, png_of, tiny_drive, zip_of
from tests.service.conftest import StartApi

NAME = "front/000000.png"


def tar_of(*members: tuple[tarfile.TarInfo, bytes]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for member, data in members:
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return buffer.getvalue()


def member(name: str, kind: bytes = tarfile.REGTYPE, target: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


def zip_link(name: str) -> bytes:
    info = zipfile.ZipInfo(name)
    info.create_system, info.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(info, "/etc/passwd")
    return buffer.getvalue()


def zip_twice(name: str) -> bytes:
    """Written under another name of the same length, which is renamed: the writer would warn."""
    other = name[:-1] + "_"
    return zip_of({name: png(), other: png(seed="b")}).replace(other.encode(), name.encode())


def zip_bomb(name: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        archive.writestr(name, png_of(64, 48, bytes(50_000_000)))
    return buffer.getvalue()


HOSTILE: dict[str, tuple[Callable[[], bytes], str, str]] = {
    "leaves the folder": (lambda: zip_of({"../evil.png": png()}), "unsafe-archive", "../evil.png"),
    "absolute": (lambda: zip_of({"/etc/evil.png": png()}), "unsafe-archive", "/etc/evil.png"),
    "backslash": (lambda: zip_of({"front\\000000.png": png()}), "unsafe-archive", "000000.png"),
    "drive letter": (lambda: zip_of({"C:evil.png": png()}), "unsafe-archive", "C:evil.png"),
    "link in a zip": (lambda: zip_link(NAME), "unsafe-archive", NAME),
    "differ in case": (lambda: zip_of({NAME: png(), NAME.upper(): png()}), "unsafe-archive", NAME.upper()),
    "twice": (lambda: zip_twice(NAME), "unsafe-archive", NAME),
    "control characters": (lambda: zip_of({"front/\x1b[31m.png": png()}), "unsafe-archive", "\\x1b"),
    "link in a tar": (lambda: tar_of((member(NAME, tarfile.SYMTYPE, "/etc/passwd"), b"")), "unsafe-archive", NAME),
    "hard link": (lambda: tar_of((member(NAME, tarfile.LNKTYPE, "/etc/passwd"), b"")), "unsafe-archive", NAME),
    "device": (lambda: tar_of((member(NAME, tarfile.CHRTYPE), b"")), "unsafe-archive", NAME),
    "pipe": (lambda: tar_of((member(NAME, tarfile.FIFOTYPE), b"")), "unsafe-archive", NAME),
    "tar leaves": (lambda: tar_of((member("../evil.png"), png())), "unsafe-archive", "../evil.png"),
    "bomb": (lambda: zip_bomb(NAME), "archive-too-large", NAME),
    "bomb in gzip": (lambda: gzip.compress(tar_of((member(NAME), bytes(50_000_000)))), "archive-too-large", "ratio"),
    "bomb in bzip2": (lambda: bz2.compress(tar_of((member(NAME), bytes(50_000_000)))), "archive-too-large", "ratio"),
    "20,000 files": (lambda: zip_of({f"{i}.png": b"" for i in range(20_000)}), "unexpected-file", "0.png"),
    "20,000 folders": (lambda: zip_of({f"{i}/": b"" for i in range(20_000)}), "archive-too-large", "20000"),
    "not in the manifest": (lambda: zip_of({NAME: png(), "other.png": png()}), "unexpected-file", "other.png"),
    "huge image": (lambda: zip_of({NAME: png_of(60_000, 60_000, b"")}), "image-too-large", NAME),
    "no image": (lambda: zip_of({NAME: b"GIF89a"}), "not-an-image", NAME),
    "empty image": (lambda: zip_of({NAME: b""}), "empty-file", NAME),
    "other manifest": (lambda: zip_of({NAME: png(), "drive.json": b"{}"}), "other-manifest", "drive.json"),
    "truncated": (lambda: zip_of({NAME: png()})[:-30], "damaged-archive", "truncated"),
    "no file": (lambda: zip_of({}), "empty-archive", "no file"),
}


@pytest.fixture(scope="module")
def owner(api: Api) -> Client:
    return api.client()


@pytest.fixture(scope="module")
def drive_id(owner: Client) -> str:
    return owner.create()


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_archive(owner: Client, drive_id: str, what: str) -> None:
    content, code, named = HOSTILE[what]
    problem = problem_of(owner.put(f"/v1/drives/{drive_id}/archive", content=content()), 422, code)
    assert named in problem["detail"]
    assert owner.api.spooled() == []
    assert len(owner.api.objects(owner.project_id)) == 1, "only the manifest"
    assert owner.get(f"/v1/drives/{drive_id}").json()["files_stored"] == 0


def test_what_operating_systems_add_is_no_harm(client: Client) -> None:
    drive = tiny_drive()
    extra = {"__MACOSX/front/._000000.png": b"x", ".DS_Store": b"x", "front/Thumbs.db": b"x"}
    content = zip_of({f"my drive/{name}": data for name, data in {**drive.files, **extra}.items()})
    answer = client.put(f"/v1/drives/{client.create(drive)}/archive", content=content)
    assert answer.json() == {"stored": 6, "files_stored": 6, "files_expected": 6}


def test_what_is_no_archive(owner: Client, drive_id: str) -> None:
    for content in (b"", b"hello", png()):
        problem_of(owner.put(f"/v1/drives/{drive_id}/archive", content=content), 415, "not-an-archive")


def with_manifest(change: Callable[[dict[str, Any]], object]) -> bytes:
    document = manifest()
    change(document)
    return json.dumps(document).encode()


def set_in(*keys: Any) -> Callable[[dict[str, Any]], None]:
    *path, last, value = keys

    def change(document: Any) -> None:
        for key in path:
            document = document[key]
        document[last] = value

    return change


MANIFESTS: dict[str, tuple[bytes, str]] = {
    "NaN": (with_manifest(set_in("rig", "cameras", 0, "params", 0, float("nan"))), "NaN"),
    "infinity": (with_manifest(set_in("rig", "cameras", 0, "params", 0, float("inf"))), "Infinity"),
    "1e999": (tiny_drive().raw.replace(b"50.0", b"1e999", 1), "finite"),
    "key twice": (tiny_drive().raw.replace(b'"version": 1', b'"version": 1, "version": 1'), "appears twice"),
    "deep": (b'{"a":' * 100_000 + b"1" + b"}" * 100_000, "nested too deeply"),
    "no JSON": (b"{", "not valid JSON"),
    "nothing": (b"", "not valid JSON"),
    "no UTF-8": (b'{"name": "\xff"}', "not UTF-8"),
    "half a character": (tiny_drive().raw.replace(b'"tiny"', b'"\\ud800"'), "Invalid JSON"),
    "NUL in the name": (tiny_drive().raw.replace(b'"tiny"', b'"a\\u0000b"'), "name"),
    "unknown field": (with_manifest(set_in("extra", 1)), "extra"),
    "huge number": (tiny_drive().raw.replace(b"1000000", b"1" * 5000, 1), "integer of over 4300 digits"),
    "quaternion": (with_manifest(set_in("rig", "cameras", 0, "rig_from_cam", "rotation_xyzw", 0, 2.0)), "norm 1"),
    "no frames": (with_manifest(set_in("frames", [])), "frames"),
    "time goes back": (with_manifest(set_in("frames", 1, "timestamp_us", 5)), "goes back"),
    "leaves the drive": (with_manifest(set_in("frames", 0, "images", "front", "file", "../x.png")), "relative path"),
    "absolute": (with_manifest(set_in("frames", 0, "images", "front", "file", "/x.png")), "relative path"),
    "foreign camera": (with_manifest(set_in("frames", 0, "images", "left", {"file": "x.png"})), "left"),
    "version": (with_manifest(set_in("version", 3)), "version"),
    "version true": (with_manifest(set_in("version", True)), "version: must be the integer 1 or 2, is true"),
    "version 1.0": (with_manifest(set_in("version", 1.0)), "version: must be the integer 1 or 2, is 1.0"),
    "version 2.0": (with_manifest(set_in("version", 2.0)), "version: must be the integer 1 or 2, is 2.0"),
    "names differ in case": (
        with_manifest(set_in("frames", 0, "images", "rear", "file", NAME.upper())),
        "one file with",
    ),
    "own name": (with_manifest(set_in("frames", 0, "images", "rear", "file", "Drive.json")), "manifest's own name"),
    "number as text": (with_manifest(set_in("frames", 0, "timestamp_us", "5")), "timestamp_us"),
    "a list": (b"[]", "object"),
}


@pytest.mark.parametrize("what", MANIFESTS)
def test_a_manifest_that_is_refused(owner: Client, drive_id: str, what: str) -> None:
    raw, named = MANIFESTS[what]
    problem = problem_of(owner.post("/v1/drives", content=raw), 422, "invalid-document")
    assert named in problem["detail"]
    assert problem["errors"]
    assert [drive["id"] for drive in owner.get("/v1/drives").json()["items"]] == [drive_id]


def unsynchronised(document: dict[str, Any]) -> None:
    for frame in document["frames"]:
        frame["images"]["rear"]["timestamp_us"] = frame["timestamp_us"] + 90_000


def one_camera_never_there(document: dict[str, Any]) -> None:
    for frame in document["frames"]:
        del frame["images"]["rear"]


@pytest.mark.parametrize("change", [unsynchronised, one_camera_never_there])
def test_what_the_engine_finds_in_the_manifest_is_said_in_its_words(
    client: Client, tmp_path: Path, change: Callable[[dict[str, Any]], None]
) -> None:
    document = manifest()
    change(document)
    path = tmp_path / "drive.json"
    path.write_text(json.dumps(document))
    drive = tiny_drive()
    named = {image["file"] for frame in document["frames"] for image in frame["images"].values()}
    drive_id = client.filled(TinyDrive(document, {name: drive.files[name] for name in named}))
    told = engine_findings(path)
    answer = client.post(f"/v1/drives/{drive_id}:commit")
    if any(finding.severity == "error" for finding in told):
        found = problem_of(answer, 422, "drive-rejected")["findings"]
        assert client.get(f"/v1/drives/{drive_id}").json()["state"] == "OPEN"
    else:
        assert answer.status_code == 200
        found = client.get(f"/v1/drives/{drive_id}/preflight").json()["findings"]
    assert [Finding.model_validate(finding) for finding in found] == told
    assert told, "the engine finds something"


def engine_findings(path: Path) -> list[Finding]:
    command = [str(Path(sys.executable).with_name("mrasfm")), "preflight", "--manifest-only", "--json", str(path)]
    done = subprocess.run(command, capture_output=True, check=False)
    return [Finding.model_validate(finding) for finding in json.loads(done.stdout)["findings"]]


def endless(size_bytes: int) -> Iterator[bytes]:
    piece = b" " * 1_000_000
    for _ in range(size_bytes // len(piece)):
        yield piece


def test_a_manifest_of_200_mb_costs_no_memory(tmp_path: Path) -> None:
    with api_process(settings_of(tmp_path / "data"), tmp_path) as api:
        client = api.client()
        assert api.process is not None
        process = psutil.Process(api.process.pid)
        before = process.memory_info().rss
        announced = client.post("/v1/drives", content=endless(200_000_000), headers={"Content-Length": "200000000"})
        problem_of(announced, 413, "too-large")
        assert process.memory_info().rss - before < 30_000_000, "refused before it is read"
        chunked = client.post("/v1/drives", content=endless(200_000_000))
        problem_of(chunked, 413, "too-large")
        assert process.memory_info().rss < 400_000_000
        large = client.post("/v1/reconstructions", content=endless(20_000_000))
        problem_of(large, 413, "too-large")


def test_more_or_fewer_bytes_than_announced(owner: Client, drive_id: str) -> None:
    """Fewer, and then silence, is a client that went away; nothing stays of it."""
    path = f"/v1/drives/{drive_id}/files/{NAME}"
    host, port = owner.base_url.host, owner.base_url.port
    head = f"PUT {path} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {owner.key}\r\nContent-Length: 100000\r\n\r\n"
    with socket.create_connection((host, port)) as connection:
        connection.sendall(head.encode() + png())
        wait_until(lambda: owner.api.spooled() != [], "the upload's beginning")
    wait_until(lambda: owner.api.spooled() == [], "the upload's end")
    assert owner.get(f"/v1/drives/{drive_id}").json()["files_stored"] == 0
    assert owner.put(path, content=png()).status_code == 201
    owner.delete(path)


def test_a_file_over_the_bound(start_api: StartApi) -> None:
    client = start_api(max_file_bytes=1000, max_archive_bytes=5000, max_json_bytes=2000).client()
    drive_id = client.create()
    url = f"/v1/drives/{drive_id}"
    large = png_of(64, 48, os.urandom(2000))
    problem_of(client.put(f"{url}/files/{NAME}", content=large), 413, "too-large")
    problem_of(client.put(f"{url}/files/{NAME}", content=iter([large[:900], large[900:]])), 413, "too-large")
    problem_of(client.put(f"{url}/archive", content=bytes(5001)), 413, "too-large")
    problem = problem_of(client.put(f"{url}/archive", content=zip_of({NAME: large})), 422, "archive-too-large")
    assert NAME in problem["detail"]
    declared = {"files": [{"path": NAME, "size_bytes": 1, "sha256": "0" * 64}] * 30}
    problem_of(client.post(f"{url}/files:declare", json=declared), 413, "too-large")


def test_a_disk_without_the_space_that_must_stay(start_api: StartApi, tmp_path: Path) -> None:
    total = shutil.disk_usage(tmp_path).total
    api = start_api(min_free_disk_bytes=2 * total)
    client = api.client()
    problem_of(client.post("/v1/drives", content=tiny_drive().raw), 507, "disk-full")
    assert client.get("/v1/status").json()["disk"]["accepts_uploads"] is False
    assert api.spooled() == []


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 3 MB."""
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = shutil.which("mount") and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", folder], capture_output=True, check=False
    )
    if not mounted or mounted.returncode:
        pytest.skip("no right to mount a small file system")
    yield folder
    subprocess.run(["umount", folder], check=True)


def fill(path: Path) -> None:
    """Write until nothing fits any more."""
    with contextlib.suppress(OSError), path.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))


def test_a_disk_that_is_full(small_disk: Path) -> None:
    drive = tiny_drive()
    with api_in_thread(settings_of(small_disk / "data")) as api:
        client = api.client()
        drive_id = client.create(drive)
        large = png_of(64, 48, os.urandom(8_000_000))
        for content in (large, iter([large])):
            problem_of(client.put(f"/v1/drives/{drive_id}/files/{NAME}", content=content), 507, "disk-full")
            assert api.spooled() == []
        filler = small_disk / "filler"
        fill(filler)
        answer = client.put(f"/v1/drives/{drive_id}/files/{NAME}", content=drive.files[NAME])
        assert answer.status_code in (503, 507), answer.text
        assert client.get(f"/v1/drives/{drive_id}").json()["files_stored"] == 0
        filler.unlink()
        client.send_files(drive_id, drive)
        assert client.post(f"/v1/drives/{drive_id}:commit").status_code == 200


@pytest.mark.slow
def test_a_kill_in_the_middle_of_an_upload(tmp_path: Path) -> None:
    """What was accepted is there; what was not can be sent again; what was left is swept."""
    drive = tiny_drive()
    first, second, *_ = drive.files
    with api_process(settings_of(tmp_path / "data"), tmp_path) as api:
        client = api.client()
        drive_id = client.create(drive)
        assert client.put(f"/v1/drives/{drive_id}/files/{first}", content=drive.files[first]).status_code == 201

        def stuttering() -> Iterator[bytes]:
            yield png_of(64, 48, bytes(3_000_000))
            wait_until(lambda: any((api.settings.spool_dir / n).stat().st_size for n in api.spooled()), "bytes")
            api.kill()
            yield bytes(100)

        with pytest.raises(httpx.TransportError):
            client.put(f"/v1/drives/{drive_id}/files/{second}", content=stuttering())
        (left,) = api.spooled()
        os.utime(api.settings.spool_dir / left, (0, 0))  # as if a day had passed
        api.start()
        wait_until(lambda: api.spooled() == [], "the sweep")
        listed = client.get(f"/v1/drives/{drive_id}/files", params={"stored": "true"}).json()["items"]
        assert [file["path"] for file in listed] == [first]
        for path, data in drive.files.items():
            assert client.put(f"/v1/drives/{drive_id}/files/{path}", content=data).status_code in (200, 201)
        assert client.post(f"/v1/drives/{drive_id}:commit").status_code == 200
