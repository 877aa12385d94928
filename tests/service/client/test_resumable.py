"""Large files go in pieces: what has arrived is not sent again."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from schemas.file_names import UPLOAD_RECORD_NAME
from service.client import ApiError, ClientError, DriveFolder, UploadState, resumable, upload_drive
from service.client.drive_folder import LocalFile, identify
from service.client.parallel import Meter, no_report
from service.client.resumable import ResumableUpload
from service.database.tables import Drive
from service.storage.uploads.resumable import PartialFile
from tests.helpers.bad_network import Cut, bad_network
from tests.helpers.live_api import Api, Client, wait_until
from tests.helpers.tiny_drive import TinyDrive, tiny_drive
from tests.service.client.conftest import Connect, written
from tests.service.conftest import StartApi
from tests.service.test_uploads import image

SIZE_BYTES = 6_000_000


@pytest.fixture(autouse=True)
def _small_is_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resumable, "FROM_BYTES", 100_000)


@pytest.fixture
def large_drive(tmp_path: Path) -> Path:
    """A drive with one large image among small ones."""
    tiny = tiny_drive(seed=tmp_path.name)
    files = {**tiny.files, "front/000001.png": image(SIZE_BYTES, seed=hash(tmp_path.name))}
    return written(TinyDrive(tiny.manifest, files), tmp_path / "drive")


def state_of(drive: Path) -> dict[str, Any]:
    (upload,) = json.loads((drive / UPLOAD_RECORD_NAME).read_text())["uploads"].values()
    return dict(upload)


def test_a_connection_that_breaks_again_and_again(client: Client, connect: Connect, large_drive: Path) -> None:
    cuts = [Cut(part, answer_bytes=20, times=2) for part in (b"/uploads HTTP", b"HEAD ", b"PATCH ")]
    with bad_network(client.api.url, *cuts) as network:
        sent = upload_drive(connect(client, url=network.url), DriveFolder.read(large_drive), parallel=1)
    assert [len(cut.seen) for cut in cuts[:2]] == [2, 2]
    assert cuts[2].seen
    assert client.get(f"/v1/drives/{sent.drive_id}").json()["state"] == "COMMITTED"
    assert sent.bytes_sent == sum(path.stat().st_size for path in large_drive.rglob("*.png"))
    assert state_of(large_drive)["resumable"] == {}


def test_another_run_goes_on_in_the_middle_of_a_file(
    api: Api, client: Client, connect: Connect, large_drive: Path
) -> None:
    library, folder = connect(client), DriveFolder.read(large_drive)

    def stop(stage: str, done_bytes: int, total_bytes: int) -> None:
        if stage == "send" and done_bytes > SIZE_BYTES // 2:
            library.stop()

    with pytest.raises(ClientError):
        upload_drive(library, folder, parallel=1, report=stop)
    drive_id, (upload_id,) = state_of(large_drive)["drive_id"], state_of(large_drive)["resumable"].values()
    url, tus = f"/v1/drives/{drive_id}/uploads/{upload_id}", {"Tus-Resumable": "1.0.0"}
    # The broken request holds the upload until its bytes are on the disk, and may take hold of it only now.
    offsets = [0]

    def has_kept_some() -> bool:
        answer = client.head(url, headers=tus)
        offsets.append(int(answer.headers["upload-offset"]) if answer.status_code == 200 else 0)
        return offsets[-1] > 0

    wait_until(has_kept_some, "the end of the broken request")
    kept = offsets[-1]
    assert 0 < kept < SIZE_BYTES
    again, done = connect(client), list[int]()
    upload_drive(again, folder, parallel=1, report=lambda stage, at, of: done.append(at) if stage == "send" else None)
    assert any(at >= kept for at in done[:3]), "the first that is counted is what was there"
    assert UploadState(folder, again.url).uploads == {}


def test_a_machine_that_slept_goes_on_in_the_middle_of_a_file(
    start_api: StartApi, connect: Connect, large_drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = start_api(upload_idle_seconds=0.3).client()
    file, drive_id, begun_at = identify(large_drive, "front/000001.png"), client.create(), list[int]()
    awake = LocalFile.pieces

    def pieces(self: LocalFile, offset: int = 0) -> Iterator[bytes]:
        begun_at.append(offset)
        for i, piece in enumerate(awake(self, offset)):
            if i == 2 and len(begun_at) == 1:
                time.sleep(1.0)
            yield piece

    monkeypatch.setattr(LocalFile, "pieces", pieces)
    ResumableUpload(connect(client), drive_id, file, Meter(no_report, "send", file.size_bytes)).send()
    assert len(begun_at) == 2
    assert begun_at[1] > 0, "what came before is not sent again"
    (sent,) = client.get(f"/v1/drives/{drive_id}/files", params={"stored": "true"}).json()["items"]
    assert sent["sha256"] == file.sha256


def test_an_upload_that_is_gone_begins_anew(client: Client, connect: Connect, large_drive: Path) -> None:
    library, folder = connect(client), DriveFolder.read(large_drive)
    state = UploadState(folder, library.url)
    (large,) = [path for path in folder.paths if (large_drive / path).stat().st_size > SIZE_BYTES]
    file = identify(folder.root, large)
    state.note_upload(f"{file.path} {file.sha256}", "upl_0")
    sent = upload_drive(library, folder, state=state)
    assert client.get(f"/v1/drives/{sent.drive_id}").json()["state"] == "COMMITTED"


def test_a_refusal_whose_answer_was_lost_is_told_in_the_services_words(
    client: Client, connect: Connect, large_drive: Path
) -> None:
    """The service drops what it refuses: the next question where to go on has 404 for an answer, and no words."""
    (large_drive / "front" / "000001.png").write_bytes(bytes(SIZE_BYTES + 1))
    cut = Cut(b"PATCH ", answer_bytes=20, times=1)
    with bad_network(client.api.url, cut) as network, pytest.raises(ApiError) as raised:
        upload_drive(connect(client, url=network.url), DriveFolder.read(large_drive), parallel=1)
    assert len(cut.seen) == 1
    assert raised.value.code == "not-an-image"
    assert "front/000001.png" in str(raised.value)


@pytest.mark.parametrize("is_known", [True, False])
def test_a_drive_that_is_committed_meanwhile(
    api: Api, client: Client, connect: Connect, large_drive: Path, is_known: bool
) -> None:
    """Said in the service's words, before the file is sent."""
    library, folder = connect(client), DriveFolder.read(large_drive)
    file, drive_id, counted = identify(folder.root, "front/000001.png"), client.filled(), list[int]()
    meter = Meter(lambda stage, done, total: counted.append(done), "send", file.size_bytes)
    upload_id = ResumableUpload(library, drive_id, file, meter).begin()
    with api.database.write() as session:
        session.get_one(Drive, drive_id).state = "COMMITTED"
    with pytest.raises(ApiError) as raised:
        ResumableUpload(library, drive_id, file, meter, upload_id=upload_id if is_known else None).send()
    assert raised.value.code == "drive-committed"
    assert max(counted) == 0


def test_another_request_still_holds_the_upload(api: Api, client: Client, connect: Connect, large_drive: Path) -> None:
    """As after a connection that broke, which the service has not seen yet."""
    library, folder = connect(client), DriveFolder.read(large_drive)
    file, drive_id = identify(folder.root, "front/000001.png"), client.create()
    upload = ResumableUpload(library, drive_id, file, Meter(no_report, "send", file.size_bytes))
    holding = PartialFile(api.settings.uploads_dir, upload.begin())
    letting_go = threading.Timer(0.5, holding.close)
    letting_go.start()
    upload.send()
    letting_go.join()
    (sent,) = client.get(f"/v1/drives/{drive_id}/files", params={"stored": "true"}).json()["items"]
    assert sent["sha256"] == file.sha256
