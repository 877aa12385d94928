"""Sending drives with the library: resumed, repeated, over bad networks, and refused."""

from __future__ import annotations

import json
import shutil
import signal
import threading
import time
import uuid
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from schemas.api.jobs import ReconstructionSettings
from schemas.file_names import UPLOAD_RECORD_NAME
from service.client import (
    ApiError,
    ClientError,
    DriveFolder,
    DriveFolderError,
    UnreachableError,
    UploadState,
    resumable,
    start_reconstruction,
    upload_drive,
)
from service.client import Client as LibraryClient
from service.client.drive_folder import identify
from service.client.parallel import in_parallel
from service.client.transport import Transport
from tests.helpers.bad_network import Cut, Recorder, bad_network
from tests.helpers.live_api import DEADLINE_S, Client, free_port, wait_until
from tests.helpers.tiny_drive import png, tiny_drive
from tests.service.client.conftest import Connect, written


def drives_of(client: Client) -> list[dict[str, Any]]:
    return list(client.get("/v1/drives").json()["items"])


def test_a_drive_arrives_whole_and_is_committed(client: Client, connect: Connect, drive: Path) -> None:
    reported: list[tuple[str, int, int]] = []
    folder = DriveFolder.read(drive)
    sent = upload_drive(connect(client), folder, report=lambda *news: reported.append(news))
    (shown,) = drives_of(client)
    assert (shown["id"], shown["state"], shown["files_stored"]) == (sent.drive_id, "COMMITTED", 6)
    assert client.get(f"/v1/drives/{sent.drive_id}/manifest").content == (drive / "drive.json").read_bytes()
    size_bytes = sum(path.stat().st_size for path in drive.rglob("*.png"))
    assert (sent.files_sent, sent.files_skipped, sent.bytes_sent) == (6, 0, size_bytes)
    assert {stage: (done, total) for stage, done, total in reported} == {
        "hash": (size_bytes, size_bytes),
        "send": (size_bytes, size_bytes),
    }
    assert set(sent.seconds) == {"create", "hash", "declare", "send", "commit"}


def test_a_second_upload_is_the_same_drive_and_job(client: Client, connect: Connect, drive: Path) -> None:
    library, folder = connect(client), DriveFolder.read(drive)
    first = upload_drive(library, folder)
    job = start_reconstruction(library, first.drive_id, state=UploadState(folder, library.url))
    second = upload_drive(library, folder)
    again = start_reconstruction(library, second.drive_id, state=UploadState(folder, library.url))
    assert (second.drive_id, second.files_sent, second.files_skipped) == (first.drive_id, 0, 6)
    assert again.id == job.id
    other = ReconstructionSettings(use_gnss=False)
    assert start_reconstruction(library, first.drive_id, other, state=UploadState(folder, library.url)).id != job.id


def test_a_failed_or_cancelled_job_is_not_taken_for_an_answer(client: Client, connect: Connect, drive: Path) -> None:
    library, folder = connect(client), DriveFolder.read(drive)
    drive_id = upload_drive(library, folder).drive_id
    first = start_reconstruction(library, drive_id, state=UploadState(folder, library.url))
    library.cancel_job(first.id)
    second = start_reconstruction(library, drive_id, state=UploadState(folder, library.url))
    assert second.id != first.id
    scene_id = client.publish(client.claim(second.id), {"report.json": b"{}"})
    finished = start_reconstruction(library, drive_id, state=UploadState(folder, library.url))
    assert (finished.id, finished.scene_id) == (second.id, scene_id)
    assert client.delete(f"/v1/scenes/{scene_id}").status_code == 204
    assert start_reconstruction(library, drive_id, state=UploadState(folder, library.url)).id != second.id


def test_contents_that_the_project_has_are_not_sent(
    client: Client, connect: Connect, drive: Path, tmp_path: Path
) -> None:
    library = connect(client)
    first = upload_drive(library, DriveFolder.read(drive))
    copy = tmp_path / "copy"
    shutil.copytree(drive, copy, ignore=shutil.ignore_patterns(UPLOAD_RECORD_NAME))
    second = upload_drive(library, DriveFolder.read(copy))
    assert second.drive_id != first.drive_id
    assert (second.files_sent, second.bytes_sent, second.files_skipped) == (0, 0, 6)


def test_a_drive_that_was_deleted_is_made_anew(client: Client, connect: Connect, drive: Path) -> None:
    library, folder = connect(client), DriveFolder.read(drive)
    first = upload_drive(library, folder)
    assert client.delete(f"/v1/drives/{first.drive_id}").status_code == 204
    second = upload_drive(library, folder)
    assert [shown["id"] for shown in drives_of(client)] == [second.drive_id]
    assert second.drive_id != first.drive_id


def test_an_image_changed_after_the_commit_makes_another_drive(client: Client, connect: Connect, drive: Path) -> None:
    library, folder = connect(client), DriveFolder.read(drive)
    first = upload_drive(library, folder)
    (drive / "front" / "000001.png").write_bytes(png(seed="changed"))
    second = upload_drive(library, folder)
    assert second.drive_id != first.drive_id
    assert (second.files_sent, second.files_skipped) == (1, 5)


def test_an_image_changed_before_the_commit_replaces_what_was_sent(
    client: Client, connect: Connect, drive: Path
) -> None:
    library = connect(client)
    path = drive / "front" / "000001.png"
    sound = path.read_bytes()
    path.write_bytes(b"no image")
    with pytest.raises(ApiError) as refused:
        upload_drive(library, DriveFolder.read(drive), parallel=1)
    assert refused.value.status == 422
    assert "front/000001.png" in str(refused.value)
    (drive / "front" / "000000.png").write_bytes(png(seed="also changed"))
    path.write_bytes(sound)
    sent = upload_drive(library, DriveFolder.read(drive))
    (shown,) = drives_of(client)
    assert (shown["id"], shown["state"]) == (sent.drive_id, "COMMITTED")
    stored = {file["path"]: file for file in client.get(f"/v1/drives/{sent.drive_id}/files").json()["items"]}
    assert stored["front/000000.png"]["size_bytes"] == (drive / "front" / "000000.png").stat().st_size


def test_lost_answers_have_their_effect_once(client: Client, connect: Connect, drive: Path) -> None:
    parts = (b"POST /v1/drives ", b":declare", b"PUT /v1/drives/", b":commit", b"POST /v1/reconstructions")
    cuts = [Cut(part, answer_bytes=20, times=2) for part in parts]
    with bad_network(client.api.url, *cuts) as network:
        library = connect(client, url=network.url)
        sent = upload_drive(library, DriveFolder.read(drive))
        start_reconstruction(library, sent.drive_id)
    assert [len(cut.seen) for cut in cuts] == [2, 2, 2, 2, 2]
    assert [(shown["state"], shown["files_stored"]) for shown in drives_of(client)] == [("COMMITTED", 6)]
    jobs = client.get("/v1/jobs").json()["items"]
    assert sorted(job["kind"] for job in jobs) == ["PREFLIGHT", "RECONSTRUCTION"]


def test_requests_that_came_too_slowly_are_sent_again(client: Client, connect: Connect, drive: Path) -> None:
    """As after a while in which this machine slept: 408 is no refusal."""
    answer = b"HTTP/1.1 408 Request Timeout\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
    parts = (b"POST /v1/drives ", b":declare", b"PUT /v1/drives/", b":commit")
    cuts = [Cut(part, answer_bytes=0, times=2, answer=answer) for part in parts]
    with bad_network(client.api.url, *cuts) as network:
        upload_drive(connect(client, url=network.url), DriveFolder.read(drive))
        cuts[0].times = 1000
        with pytest.raises(ApiError) as ended:
            connect(client, url=network.url, retry_s=0.5).create_drive(tiny_drive().raw)
    assert ended.value.status == 408, "retries end here too"
    assert [len(cut.seen) for cut in cuts[1:]] == [2, 2, 2]
    assert [(shown["state"], shown["files_stored"]) for shown in drives_of(client)] == [("COMMITTED", 6)]


def test_nothing_is_sent_where_files_are_missing(client: Client, drive: Path) -> None:
    (drive / "rear" / "000002.png").unlink()
    shutil.rmtree(drive / "front")
    with pytest.raises(DriveFolderError, match="4 of 6 files") as refused:
        DriveFolder.read(drive)
    for path in ("front/000000.png", "front/000001.png", "front/000002.png", "rear/000002.png"):
        assert f"\n  {path}" in str(refused.value)


@pytest.mark.parametrize(
    ("raw", "what"),
    [(None, "No such file"), (b"{", "not valid JSON"), (b'{"version": 1}', "name: is missing"), (b"[NaN]", "NaN")],
)
def test_a_manifest_that_breaks_its_contract_is_refused_here(drive: Path, raw: bytes | None, what: str) -> None:
    (drive / "drive.json").unlink()
    if raw is not None:
        (drive / "drive.json").write_bytes(raw)
    with pytest.raises(DriveFolderError, match=what):
        DriveFolder.read(drive)


def test_a_file_that_grows_or_shrinks_meanwhile_is_named(client: Client, connect: Connect, drive: Path) -> None:
    library = connect(client)
    path = "front/000000.png"
    drive_id = client.create(tiny_drive("another"))
    for change in (b"longer than it was" * 100, b"short", (drive / path).read_bytes()[:-1] + b"!"):
        file = identify(drive, path)
        before = (drive / path).read_bytes()
        (drive / path).write_bytes(change)
        with pytest.raises((DriveFolderError, ApiError), match=r"changed while|SHA-256"):
            library.put_file(drive_id, file)
        (drive / path).write_bytes(before)
    stored = client.get(f"/v1/drives/{drive_id}/files", params={"stored": "true"}).json()["items"]
    assert stored == []


def test_a_drive_that_the_check_rejects_is_refused_with_its_findings(
    client: Client, connect: Connect, tmp_path: Path
) -> None:
    tiny = tiny_drive(seed=tmp_path.name)
    for frame in tiny.manifest["frames"]:
        frame["timestamp_us"] //= 1000  # milliseconds, called microseconds
    with pytest.raises(ApiError) as refused:
        upload_drive(connect(client), DriveFolder.read(written(tiny, tmp_path / "drive")))
    assert (refused.value.status, refused.value.code) == (422, "drive-rejected")
    assert refused.value.problem.findings
    assert [shown["state"] for shown in drives_of(client)] == ["OPEN"]


def test_a_wrong_key_is_refused_at_once(client: Client, drive: Path) -> None:
    with LibraryClient(client.api.url, "mrasfm_wrong") as library, pytest.raises(ApiError) as refused:
        upload_drive(library, DriveFolder.read(drive))
    assert (refused.value.status, refused.value.code) == (401, "unauthorized")
    assert "mrasfm_wrong" not in str(refused.value)


@pytest.mark.parametrize("key", ["", " ", "two words", "schlüssel", "line\nbreak"])
def test_what_cannot_be_a_key_is_not_sent(key: str) -> None:
    with pytest.raises(ClientError, match="the API key is"):
        LibraryClient("http://127.0.0.1:1", key)


@pytest.mark.parametrize(
    "url",
    [
        "",
        "127.0.0.1:8000",
        "ftp://host",
        "http://",
        "http://user:secret@host",
        "http://host/?key=1",
        "http://host:port",
    ],
)
def test_what_cannot_be_a_url_is_refused(url: str) -> None:
    with pytest.raises(ClientError, match="URL") as refused:
        LibraryClient(url, "key")
    assert "secret" not in str(refused.value)


@pytest.mark.parametrize("url", ["https://host/maps/v1", "https://host/maps/v1/"])
def test_the_path_that_every_request_adds_is_refused_in_a_url(url: str) -> None:
    with pytest.raises(ClientError, match=r"^the URL '.+' ends with /v1, .* Give https://host/maps\.$"):
        LibraryClient(url, "key")


def test_a_client_that_is_stopped_waits_for_nothing(client: Client, connect: Connect) -> None:
    silent = [Cut(part, answer_bytes=0, times=9, silent=True) for part in (b"/status", b"/jobs/")]
    with bad_network(client.api.url, *silent) as network, ThreadPoolExecutor() as pool:
        library = connect(client, url=network.url)
        waiting: list[Future[Any]] = [pool.submit(library.status), pool.submit(lambda: list(library.events("job_0")))]
        wait_until(lambda: all(cut.seen for cut in silent), "the requests")
        began_s = time.monotonic()
        library.stop()
        for asked in waiting:
            with pytest.raises(UnreachableError, match="the client was stopped"):
                asked.result(DEADLINE_S)
        assert time.monotonic() - began_s < 5
        with pytest.raises(UnreachableError, match="the client was stopped"):
            library.create_drive(tiny_drive().raw)
    assert drives_of(client) == [], "nothing is begun after it"


def test_work_that_cannot_be_ended_is_not_waited_for() -> None:
    stopped, released, begun = threading.Event(), threading.Event(), list[int]()

    def work(item: int) -> None:
        begun.append(item)
        released.wait(DEADLINE_S)

    def interrupt() -> None:
        wait_until(lambda: begun, "the work")
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    interrupting = threading.Thread(target=interrupt)
    interrupting.start()
    began_s = time.monotonic()
    try:
        with pytest.raises(KeyboardInterrupt):
            in_parallel(work, [1, 2, 3], threads=1, stop=stopped.set)
    finally:
        released.set()
    interrupting.join()
    assert stopped.is_set()
    assert begun == [1]
    assert time.monotonic() - began_s < 10


def test_retries_end() -> None:
    url = f"http://127.0.0.1:{free_port()}"
    with (
        LibraryClient(url, "key", first_retry_s=0.5) as library,
        pytest.raises(UnreachableError, match=r"cannot be reached.*Check the URL"),
    ):
        library.status()


def test_what_is_kept_goes_elsewhere_where_the_folder_is_not_writable(
    client: Client, connect: Connect, drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (drive / UPLOAD_RECORD_NAME).mkdir()  # no file can be put in its place, also not by root
    library, folder = connect(client), DriveFolder.read(drive)
    first = upload_drive(library, folder)
    assert len(list((tmp_path / "cache" / "mrasfm" / "uploads").iterdir())) == 1
    assert upload_drive(library, folder).drive_id == first.drive_id


@pytest.fixture
def stranger() -> Iterator[Recorder]:
    """A server that is not the service, and notes what it is told."""
    with closing(Recorder()) as server:
        yield server


@pytest.mark.parametrize("form", ["{url}/steal", "//{host}/steal", "../../../steal", "upl_0/../../steal", "upl_0\n"])
def test_no_address_in_the_folder_is_given_the_key(
    client: Client, connect: Connect, tmp_path: Path, stranger: Recorder, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    """A drive's folder may come from anybody, with a record of an upload in it."""
    monkeypatch.setattr(resumable, "FROM_BYTES", 1)
    folder = DriveFolder.read(written(tiny_drive(seed=tmp_path.name), tmp_path / "drive"))
    library = connect(client)
    target = form.format(url=stranger.url, host=stranger.url.removeprefix("http://"))
    files = [identify(folder.root, path) for path in folder.paths]
    planted = {
        "upload": str(uuid.uuid4()),
        "drive_id": client.create(tiny_drive(seed=tmp_path.name)),
        "resumable": {f"{file.path} {file.sha256}": target for file in files},
    }
    record = {"version": 1, "uploads": {f"{library.url} {folder.manifest_sha256}": planted}}
    (folder.root / UPLOAD_RECORD_NAME).write_text(json.dumps(record))
    sent = upload_drive(library, folder)
    assert client.get(f"/v1/drives/{sent.drive_id}").json()["state"] == "COMMITTED"
    assert stranger.requests == []


@pytest.mark.parametrize("target", ["{url}/x", "//{host}/x", "v1/drives", "", "http:/x"])
def test_only_paths_of_the_service_are_asked_for(client: Client, stranger: Recorder, target: str) -> None:
    target = target.format(url=stranger.url, host=stranger.url.removeprefix("http://"))
    transport = Transport(client.api.url, client.key, connections=1, retry_s=0.0)
    with closing(transport), pytest.raises(ClientError, match="is not a path"):
        transport.request("GET", target)
    assert stranger.requests == []


def test_a_redirect_is_told_and_not_followed(stranger: Recorder) -> None:
    with (
        closing(Recorder(redirect_to=f"{stranger.url}/v1/status")) as first,
        LibraryClient(first.url, "key") as library,
        pytest.raises(ApiError, match=f"leads to: {stranger.url}/v1/status"),
    ):
        library.status()
    assert len(first.requests) == 1
    assert stranger.requests == []


@pytest.mark.parametrize("kept", [b"", b"{", b"[]", b'{"version": 1, "uploads": {"x": 3}}'])
def test_a_damaged_record_costs_nothing_but_a_new_drive(
    client: Client, connect: Connect, drive: Path, kept: bytes
) -> None:
    (drive / UPLOAD_RECORD_NAME).write_bytes(kept)
    sent = upload_drive(connect(client), DriveFolder.read(drive))
    record = json.loads((drive / UPLOAD_RECORD_NAME).read_bytes())["uploads"]
    assert [upload["drive_id"] for upload in record.values()] == [sent.drive_id]
