"""What a power cut can take: bytes of drives that are not committed yet, and then they are missed by name."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from sqlalchemy import select, update

from service.errors import ServiceError
from service.persistence import drives
from service.persistence.durability import boot_id
from service.persistence.tables import Blob, DriveFile
from tests.service.live_api import Api, Client, problem_of
from tests.service.tiny_drive import tiny_drive

pytestmark = pytest.mark.skipif(boot_id() is None, reason="this system does not name its starts")


def _blobs(api: Api, drive_id: str) -> dict[str, Blob]:
    with api.database.read() as session:
        rows = session.execute(
            select(DriveFile.path, Blob).join(Blob, DriveFile.blob_id == Blob.id).where(DriveFile.drive_id == drive_id)
        )
        return dict(iter(rows))


def _restart_machine(api: Api, drive_id: str) -> None:
    """As the database looks after another start of the machine."""
    keys = [blob.id for blob in _blobs(api, drive_id).values()]
    with api.database.write() as session:
        session.execute(update(Blob).where(Blob.id.in_(keys)).values(written_in_boot="an earlier start"))


def _object(api: Api, blob: Blob) -> Path:
    return api.settings.data_dir.resolve() / "artifacts" / blob.key


def test_a_commit_waits_for_the_disk(api: Api, client: Client) -> None:
    drive_id = client.filled(tiny_drive("wait", seed="wait"))
    assert {blob.written_in_boot for blob in _blobs(api, drive_id).values()} == {boot_id()}
    assert client.post(f"/v1/drives/{drive_id}:commit").status_code == 200
    assert {blob.written_in_boot for blob in _blobs(api, drive_id).values()} == {None}


@pytest.mark.parametrize("damage", ["shortened", "zeros", "gone"])
def test_bytes_that_did_not_survive_are_missing(api: Api, client: Client, damage: str) -> None:
    drive = tiny_drive(damage, seed=damage)
    drive_id = client.filled(drive)
    before_bytes = api.project(client.project_id).used_bytes
    _restart_machine(api, drive_id)
    path, blob = sorted(_blobs(api, drive_id).items())[0]
    stored = _object(api, blob)
    os.chmod(stored, 0o600)
    if damage == "gone":
        stored.unlink()
    else:
        stored.write_bytes(b"" if damage == "shortened" else bytes(blob.size_bytes))
    problem = problem_of(client.post(f"/v1/drives/{drive_id}:commit"), 409, "drive-incomplete")
    assert [item["field"] for item in problem["errors"]] == [path]
    assert api.project(client.project_id).used_bytes == before_bytes - blob.size_bytes
    assert client.put(f"/v1/drives/{drive_id}/files/{path}", content=drive.files[path]).status_code == 201
    assert client.post(f"/v1/drives/{drive_id}:commit").status_code == 200
    assert _object(api, _blobs(api, drive_id)[path]).read_bytes() == drive.files[path]


def test_bytes_that_survived_are_kept(api: Api, client: Client) -> None:
    drive_id = client.filled(tiny_drive("kept", seed="kept"))
    _restart_machine(api, drive_id)
    assert client.post(f"/v1/drives/{drive_id}:commit").status_code == 200
    assert {blob.written_in_boot for blob in _blobs(api, drive_id).values()} == {None}


def test_a_file_that_comes_during_the_commit_stops_it(api: Api, client: Client) -> None:
    drive_id = client.filled(tiny_drive("late", seed="late"))
    with pytest.raises(ServiceError, match="while it was being committed"), api.database.write() as session:
        drives.commit(session, drives.get(session, client.project_id, drive_id, lock=True), [])
    assert client.get(f"/v1/drives/{drive_id}").json()["state"] == "OPEN"
