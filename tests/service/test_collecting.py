"""Bytes that nothing needs are deleted, and leave the quota."""

from __future__ import annotations

from sqlalchemy import update

from service.persistence.tables import Blob, now_us
from tests.service.live_api import Api, Client, wait_until
from tests.service.tiny_drive import tiny_drive

_TWO_HOURS_US = 2 * 3600 * 1_000_000


def _age(api: Api, project_id: str) -> None:
    with api.database.write() as session:
        old = update(Blob).where(Blob.project_id == project_id).values(touched_us=now_us() - _TWO_HOURS_US)
        session.execute(old)


def test_a_deleted_drive_leaves_the_quota_at_once(api: Api, client: Client) -> None:
    drive_id = client.filled()
    assert api.project(client.project_id).used_bytes > 0
    assert api.objects(client.project_id)
    _age(api, client.project_id)
    assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
    wait_until(lambda: api.project(client.project_id).used_bytes == 0, "the quota")
    wait_until(lambda: not api.objects(client.project_id), "the objects' end")


def test_bytes_that_another_drive_needs_stay(api: Api, client: Client) -> None:
    drive = tiny_drive()
    first, second = client.filled(drive), client.filled(drive)
    _age(api, client.project_id)
    before_bytes = api.project(client.project_id).used_bytes
    assert client.delete(f"/v1/drives/{first}").status_code == 204
    other = client.filled(tiny_drive("other", seed="other"))
    _age(api, client.project_id)
    assert client.delete(f"/v1/drives/{other}").status_code == 204
    wait_until(lambda: api.project(client.project_id).used_bytes == before_bytes, "the quota")
    assert client.get(f"/v1/drives/{second}").json()["files_stored"] == len(drive.files)
    assert client.post(f"/v1/drives/{second}:commit").status_code == 200


def test_bytes_that_were_just_used_wait(api: Api, client: Client) -> None:
    drive = tiny_drive("again", seed="again")
    drive_id = client.filled(drive)
    assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
    # Sent a moment ago: another upload may be about to refer to them.
    assert len(api.objects(client.project_id)) >= len(drive.files)
