"""A data folder that an older version wrote is served, its work is finished, and its map goes on."""

from __future__ import annotations

import hashlib
import json
import shutil
import tarfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, text

from service.database.connections import Database, is_current
from service.settings import Settings
from tests.helpers.service_world import TERMINAL, wait_until
from tests.helpers.slow import slow
from tests.helpers.standalone import Standalone

ARCHIVE = Path(__file__).parents[1] / "data" / "older_data_folder.tar.xz"
OLD_SCHEMA = "0003"

pytestmark = pytest.mark.engine


@dataclass
class Older:
    """An unpacked data folder, and what the version that wrote it said of it; see tests/data/README.md."""

    settings: Settings
    written: dict[str, Any]
    standalone: Standalone


@pytest.fixture(params=["sqlite", *slow("postgresql")])
def older(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Older]:
    with tarfile.open(ARCHIVE) as archive:
        # Python before 3.11.4 has no filters, and those from 3.12 on want one.
        archive.extractall(tmp_path, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
    settings, environment = Settings(data_dir=tmp_path / "data"), {}
    if request.param == "postgresql":
        url = environment["MRASFM_DATABASE_URL"] = request.getfixturevalue("postgres_database")
        engine = create_engine(url)
        with engine.begin() as connection:
            connection.exec_driver_sql((tmp_path / "postgresql.sql").read_text())
        engine.dispose()
        (tmp_path / "data" / "mrasfm.sqlite3").unlink()
        settings = Settings(data_dir=tmp_path / "data", database_url=url)
    written = json.loads((tmp_path / "written.json").read_text())
    made = Standalone(tmp_path, key=written["key"], workers=2, **environment)
    yield Older(settings, written, made)
    made.close()
    shutil.rmtree(tmp_path / "data")


def test_an_older_data_folder_goes_on(older: Older) -> None:
    service, written = older.standalone, older.written
    database = Database.from_settings(older.settings)
    with database.engine.connect() as connection:
        assert connection.scalar(text("SELECT version_num FROM alembic_version")) == OLD_SCHEMA
    service.start()
    assert is_current(database)
    database.close()

    # All that the older version said of what was finished is still so, and every file is there.
    for path, said in written["answers"].items():
        assert_contains(service.request("GET", path), said, path)
    kept = [file for said in written["answers"].values() for file in said.get("files", ())]
    assert_download(service, kept)
    ended = next(said for said in written["answers"].values() if said.get("kind") == "RECONSTRUCTION")
    refused = service.answer("POST", f"/v1/jobs/{ended['id']}:retry")
    assert (refused.status_code, refused.json()["type"]) == (409, "urn:mrasfm:problem:job-not-failed")

    # The interrupted job is done again, from what is still valid of its stages, and the one that waited begins.
    interrupted = finished(service, written["interrupted"])
    assert [attempt["outcome"] for attempt in interrupted["attempts"]] == ["worker-lost", "succeeded"]
    new_scene = finished(service, written["waiting"])["scene_id"]
    assert_download(service, service.request("GET", f"/v1/scenes/{new_scene}")["files"])

    # One scene comes from the older map, one from its own older folder, and one is new.
    version = service.request("GET", f"/v1/maps/{written['map']}/versions/current")
    old_scene = version["scenes"][0]["scene_id"]
    asked = {"map_id": written["map"], "remove": [old_scene], "scenes": [old_scene, new_scene], "require_all": True}
    made = finished(service, service.request("POST", "/v1/aggregations", json=asked)["id"])
    assert made["map_version"] == version["number"] + 1
    version = service.request("GET", f"/v1/maps/{written['map']}/versions/current")
    assert (version["number"], version["summary"]["connected"]) == (made["map_version"], 3)
    assert (version["unconnected"], version["failed"]) == ([], [])
    assert_download(service, version["files"])


def finished(service: Standalone, job_id: str) -> dict[str, Any]:
    def has_ended() -> bool:
        time.sleep(0.2)  # the engine needs the time more
        return service.job(job_id)["state"] in TERMINAL

    wait_until(has_ended, lambda: f"{service.job(job_id)}\n{service.said()}")
    job = service.job(job_id)
    assert job["state"] == "SUCCEEDED", f"{job['problem']}"
    return job


def assert_contains(answer: Any, said: Any, where: str) -> None:
    """Newer versions may say more, and nothing else."""
    if isinstance(said, dict):
        for name, value in said.items():
            assert name in answer, f"{where}: {name}"
            assert_contains(answer[name], value, f"{where}: {name}")
    elif isinstance(said, list):
        assert len(answer) == len(said), where
        for i, value in enumerate(said):
            assert_contains(answer[i], value, f"{where}[{i}]")
    else:
        assert answer == said, where


def assert_download(service: Standalone, files: list[dict[str, Any]]) -> None:
    assert files
    for file in files:
        content = service.answer("GET", file["url"]).content
        assert (len(content), hashlib.sha256(content).hexdigest()) == (file["size_bytes"], file["sha256"]), file["url"]
