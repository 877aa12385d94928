"""Writes the data folder of an installed MRASfM over its API, and what the API says of it: see README.md."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sqlite3
import subprocess
import tarfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from sqlalchemy import MetaData, create_engine, text

from tests.helpers.service_world import TERMINAL, wait_until
from tests.helpers.standalone import Standalone, command_of

SYNTH = (
    "--drives 3 --cameras 2 --units 5 --width 200 --height 112 --texture-px 128 --seed 3 --jpeg-quality 75 "
    "--noise 0 --shadows 0 --no-masks --parked-cars 2 --moving-cars 0"
)
SETTINGS = {"max_keypoints": 200}
DATABASE = "mrasfm.sqlite3"
# Logs, and what names the machine or is made anew at every start.
NOT_KEPT = ("broker/broker.conf", "broker/password", "broker/port", "logs", "scratch", "spool", "standalone.lock")
KEPT_WITHIN_S = 5.0  # a finished stage, by the worker


def write(older: Standalone, drives: list[Path]) -> dict[str, Any]:
    """Make two scenes, a map of two versions, a job that is interrupted and one that waits; what the API says."""
    ids = [older.add_drive(drive) for drive in drives]
    for drive_id in ids:
        path = f"/v1/drives/{drive_id}"
        wait_until(lambda path=path: older.request("GET", path)["preflight"] == "PASSED", "the check")
    scene = ended(older, reconstruct(older, ids[0]))["scene_id"]
    map_id = aggregate(older, drives=ids[:2], name="older")
    aggregate(older, map_id=map_id, remove=[scene], scenes=[scene])
    versions = [f"/v1/maps/{map_id}/versions/{number}" for number in (1, 2)]
    paths = ["/v1/drives", "/v1/scenes", "/v1/maps", *versions]
    paths += [f"/v1/drives/{drive_id}/{part}" for drive_id in ids for part in ("files", "preflight")]
    paths += [f"/v1/scenes/{member['scene_id']}" for member in older.request("GET", versions[1])["scenes"]]
    paths += [f"/v1/jobs/{job['id']}" for job in older.request("GET", "/v1/jobs")["items"]]
    answers = {path: older.request("GET", path) for path in paths}
    interrupted, waiting = reconstruct(older, ids[1], seed=5), reconstruct(older, ids[2])
    wait_until(lambda: list(older.data.rglob("scene/.stages/features.npz")) != [], "a finished stage")
    for process in older.processes():
        if "worker.child" in command_of(process):
            process.suspend()
    time.sleep(KEPT_WITHIN_S)
    assert [older.job(job)["state"] for job in (interrupted, waiting)] == ["RUNNING", "QUEUED"]
    return {"key": older.key, "answers": answers, "map": map_id, "interrupted": interrupted, "waiting": waiting}


def reconstruct(older: Standalone, drive_id: str, **settings: int) -> str:
    asked = {"drive_id": drive_id, "settings": {**SETTINGS, **settings}}
    return str(older.request("POST", "/v1/reconstructions", json=asked)["id"])


def aggregate(older: Standalone, **asked: Any) -> str:
    job = older.request("POST", "/v1/aggregations", json={**asked, "settings": SETTINGS})
    return str(ended(older, job["id"])["map_id"])


def ended(older: Standalone, job_id: str) -> dict[str, Any]:
    wait_until(lambda: older.job(job_id)["state"] in TERMINAL, "the job's end")
    job = older.job(job_id)
    assert job["state"] == "SUCCEEDED", job
    return job


def clean(data: Path) -> None:
    """Leave what is told from one machine to another, in few files."""
    for name in NOT_KEPT:
        if (data / name).is_dir():
            shutil.rmtree(data / name)
        else:
            (data / name).unlink(missing_ok=True)
    with closing(sqlite3.connect(data / DATABASE)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        connection.execute("VACUUM")


def dump(database: Path, url: str) -> str:
    """The rows of a SQLite database as those of a PostgreSQL one with the same schema: its SQL."""
    engine, tables = create_engine(url), MetaData()
    tables.reflect(engine)
    with closing(sqlite3.connect(database)) as source, engine.begin() as target:
        for table in tables.sorted_tables:
            if table.name == "alembic_version":
                continue
            names = ", ".join(column.name for column in table.columns)
            values = ", ".join("%s" for _ in table.columns)
            is_bool = [column.type.python_type is bool for column in table.columns]
            for row in source.execute(f"SELECT {names} FROM {table.name}"):
                # JSON stays the text that it is: NULL and JSON's null are not the same.
                given = tuple(bool(value) if to else value for value, to in zip(row, is_bool, strict=True))
                target.exec_driver_sql(f"INSERT INTO {table.name} ({names}) VALUES ({values})", given)
        target.execute(text("SELECT setval(pg_get_serial_sequence('job_events', 'id'), max(id)) FROM job_events"))
    engine.dispose()
    command = ["pg_dump", "--inserts", "--no-owner", "--no-privileges", url.replace("+psycopg", "")]
    dumped = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    # Without comments, commands of psql, and settings that another server may not know.
    lines = [line for line in dumped.splitlines() if line and not line.startswith(("--", "\\", "SET "))]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("python", type=Path, help="of the environment of the version that writes")
    parser.add_argument("database", help="URL of an empty PostgreSQL database, as in MRASFM_DATABASE_URL")
    parser.add_argument("out", type=Path, help="an empty folder; the archive is written there")
    arguments = parser.parse_args()
    out = arguments.out.resolve()
    # Its path is not resolved: it would be that of an interpreter without the environment.
    older = Standalone(out, python=arguments.python)
    mrasfm = arguments.python.parent / "mrasfm"
    subprocess.run([mrasfm, "synth", *SYNTH.split(), "--out", out / "drives"], check=True)
    older.start()
    try:
        written = write(older, sorted((out / "drives").glob("drive_*")))
        older.kill_everything(supervisor_last=False)
    finally:
        older.close()
    clean(older.data)
    environment = {"MRASFM_DATABASE_URL": arguments.database, "MRASFM_DATA_DIR": str(out / "empty")}
    subprocess.run([mrasfm, "migrate"], check=True, env={**os.environ, **environment})
    (out / "written.json").write_text(json.dumps(written, indent=1))
    (out / "postgresql.sql").write_text(dump(older.data / DATABASE, arguments.database))
    with tarfile.open(out / "older_data_folder.tar.xz", "w:xz", preset=9) as archive:
        for name in ("data", "written.json", "postgresql.sql"):
            archive.add(out / name, name, filter=nobodys)


def nobodys(member: tarfile.TarInfo) -> tarfile.TarInfo:
    return member.replace(uid=0, gid=0, uname="", gname="", deep=False)


if __name__ == "__main__":
    main()
