"""What a power cut can take: bytes of drives that are not committed yet, and then they are missed by name."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from sqlalchemy import make_url, select, text, update

from service.database.connections import Database
from service.database.tables import Blob, DriveFile
from service.domain import drives
from service.errors import ServiceError
from service.storage.durability import boot_id
from tests.helpers.live_api import Api, Client, problem_of
from tests.helpers.tiny_drive import tiny_drive

pytestmark = pytest.mark.skipif(boot_id() is None, reason="this system does not name its starts")


@pytest.mark.parametrize("durable", [True, False])
def test_a_server_always_waits_for_its_disk(postgres_url: str, durable: bool) -> None:
    """It forgets what it did not wait for when it crashes, and not only when the power fails."""
    database = Database(postgres_url)
    with database.write(durable=durable) as session:
        assert session.scalar(text("SHOW synchronous_commit")) == "on"
    database.close()


@pytest.mark.parametrize(
    ("timeout_s", "chosen", "timeout"), [(30.0, "", "2min"), (2.0, "", "8s"), (30.0, "-c statement_timeout=5s", "5s")]
)
def test_a_server_that_hangs_is_given_up(postgres_url: str, timeout_s: float, chosen: str, timeout: str) -> None:
    url = make_url(postgres_url)
    if chosen:
        url = url.update_query_dict({"options": chosen})
    database = Database(url.render_as_string(hide_password=False), timeout_s=timeout_s)
    with database.read() as session:
        assert session.scalar(text("SHOW statement_timeout")) == timeout
        raw = session.connection().connection.driver_connection
        assert raw is not None
        given = raw.info.get_parameters()
    database.close()
    named = ("keepalives", "keepalives_idle", "keepalives_interval", "keepalives_count", "tcp_user_timeout")
    assert {name: given[name] for name in named} == {
        "keepalives": "1",
        "keepalives_idle": "10",
        "keepalives_interval": "5",
        "keepalives_count": "3",
        "tcp_user_timeout": "20000",
    }


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
