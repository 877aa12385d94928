"""Jobs of a project that have ended, without a worker."""

from __future__ import annotations

from sqlalchemy import insert

from schemas.api.jobs import JobKind
from service.database.tables import Job, JobMember, new_id
from tests.helpers.live_api import Client


def job_history(client: Client, *members: int) -> list[str]:
    """Jobs that have ended, of the newest first: an aggregation of as many members each, a reconstruction for 0."""
    common = {"project_id": client.project_id, "state": "SUCCEEDED", "settings": {}}
    kinds = [JobKind.AGGREGATION if count else JobKind.RECONSTRUCTION for count in members]
    trees = [{**common, "id": new_id("job"), "kind": kind, "created_us": 1000 - i} for i, kind in enumerate(kinds)]
    children = [
        {**common, "id": new_id("job"), "kind": JobKind.RECONSTRUCTION, "created_us": 1} for _ in range(max(members))
    ]
    rows = [
        {"job_id": tree["id"], "drive_id": f"drv_{i}", "name": f"d{i}", "child_id": children[i]["id"]}
        for tree, count in zip(trees, members, strict=True)
        for i in range(count)
    ]
    with client.api.database.write() as session:
        session.execute(insert(Job), [*trees, *children])
        session.flush()
        session.execute(insert(JobMember), rows)
    return [str(tree["id"]) for tree in trees]
