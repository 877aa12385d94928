"""`mrasfm projects` and `mrasfm keys`: records of a service, as its operator changes them."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import pytest
from sqlalchemy import text

from service.commands import keys, projects
from service.database.connections import Database, found_schema, migrate
from service.settings import Settings
from tests.helpers.live_api import Api, problem_of
from tests.helpers.tiny_drive import tiny_drive


def run(api: Api, *arguments: str) -> int:
    parser = argparse.ArgumentParser()
    projects.register(parser.add_subparsers())
    parsed = parser.parse_args(["projects", "--data", str(api.settings.data_dir), *arguments])
    return int(parsed.run(parsed))


def test_a_quota_that_is_full_is_made_larger(api: Api, capsys: pytest.CaptureFixture[str]) -> None:
    client = api.client(max_drives=1)
    project = api.project(client.project_id)
    client.create()
    problem = problem_of(client.post("/v1/drives", content=tiny_drive("b").raw), 429, "too-many-drives")
    assert "mrasfm projects set" in problem["remedy"]
    assert run(api, "set", project.name, "--max-drives", "2") == 0
    client.create(tiny_drive("b"))
    changed = api.project(client.project_id)
    assert (changed.max_drives, changed.max_bytes) == (2, project.max_bytes), "the others stay"
    assert run(api, "set", project.name, "--max-bytes", "1000", "--max-active-jobs", "3") == 0
    problem_of(client.post("/v1/drives", content=tiny_drive("c").raw), 429, "too-many-drives")
    capsys.readouterr()
    assert run(api, "list") == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith(project.name)]
    assert f"{changed.used_bytes} of 1000 bytes" in line
    assert "3 active jobs, 2 drives" in line


def test_what_cannot_be_set_is_said(api: Api, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(api, "set", "nobody", "--max-drives", "2") == 2
    assert "no project 'nobody'" in capsys.readouterr().err
    assert run(api, "set", "nobody") == 2
    assert "--max-bytes, --max-active-jobs, --max-drives" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["0", "-1", "many", "1e9", "10" * 40])
def test_quotas_are_whole_numbers_that_the_database_holds(
    api: Api, capsys: pytest.CaptureFixture[str], value: str
) -> None:
    for option in ("--max-bytes", "--max-active-jobs", "--max-drives"):
        with pytest.raises(SystemExit):
            run(api, "set", "nobody", f"{option}={value}")
        assert f"{value!r}" in capsys.readouterr().err


def mrasfm(*arguments: str) -> int:
    parser = argparse.ArgumentParser(prog="mrasfm")
    subparsers = parser.add_subparsers()
    for command in (keys, projects):
        command.register(subparsers)
    parsed = parser.parse_args(arguments)
    return int(parsed.run(parsed))


@pytest.mark.parametrize(
    "asked", [("keys", "list"), ("keys", "revoke", "key_1"), ("projects", "list"), ("projects", "set", "a")]
)
def test_a_folder_without_a_service_is_refused_and_not_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], asked: tuple[str, ...]
) -> None:
    command, *rest = asked
    assert mrasfm(command, "--data", str(tmp_path / "typo"), *rest) == 2
    told = capsys.readouterr().err
    assert f"{tmp_path / 'typo'} holds no state of a service" in told
    assert "Give --data" in told
    assert not (tmp_path / "typo").exists()


def test_no_key_is_created_among_other_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "drive.json").touch()
    assert mrasfm("keys", "--data", str(tmp_path), "create") == 2
    assert f"{tmp_path} holds no state of a service, but other files, such as drive.json" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["drive.json"]


def test_a_new_key_says_which_service_it_is_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(tmp_path / "state")
    assert mrasfm("keys", "--data", folder, "create") == 0, "also before the service has started"
    first = capsys.readouterr()
    assert first.out.startswith("mrasfm_")
    assert f"{folder} held no state" in first.err
    assert f"mrasfm standalone --data {folder}" in first.err
    assert mrasfm("keys", "--data", folder, "create") == 0
    assert capsys.readouterr().err == f"mrasfm: the key is for the service with its state in {folder}.\n"


def test_options_may_come_after_the_action(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(tmp_path / "state")
    assert mrasfm("keys", "create", "--data", folder, "--json") == 0
    assert json.loads(capsys.readouterr().out)["project"] == "default"
    assert mrasfm("keys", "--json", "list", "--data", folder) == 0
    assert [key["name"] for key in json.loads(capsys.readouterr().out)] == ["unnamed"]
    assert mrasfm("projects", "--data", folder, "list", "--json") == 0
    assert [project["name"] for project in json.loads(capsys.readouterr().out)] == ["default"]


ACTIONS = [("keys", "list"), ("keys", "create"), ("projects", "list"), ("projects", "set", "a", "--max-drives", "2")]


def _set_schema(settings: Settings, revision: str) -> None:
    database = Database.from_settings(settings)
    with database.write() as session:
        session.execute(text("UPDATE alembic_version SET version_num = :revision"), {"revision": revision})
    database.close()


def _schema(settings: Settings) -> str | None:
    database = Database.from_settings(settings)
    try:
        return found_schema(database)
    finally:
        database.close()


@pytest.mark.parametrize("asked", ACTIONS)
def test_a_database_that_older_processes_use_is_refused_and_left_as_it_is(
    database_settings: Settings, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, asked: list[str]
) -> None:
    given = _environment(database_settings, monkeypatch)
    migrate(database_settings)
    _set_schema(database_settings, "0013")
    assert mrasfm(*asked, *given) == 2
    told = capsys.readouterr().err
    assert "is of an older MRASfM" in told
    assert ("run mrasfm migrate" if not given else "mrasfm standalone migrates") in told
    assert _schema(database_settings) == "0013"
    _set_schema(database_settings, "9999")
    assert mrasfm(*asked, *given) == 2
    assert "is of a newer MRASfM" in capsys.readouterr().err


def test_an_empty_database_gets_its_schema_with_the_first_key_alone(
    postgres_database: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(database_url=postgres_database)
    _environment(settings, monkeypatch)
    assert mrasfm("keys", "list") == 2
    assert "has no records of a service. Run mrasfm migrate" in capsys.readouterr().err
    assert _schema(settings) is None
    assert mrasfm("keys", "create") == 0
    assert mrasfm("keys", "list") == 0


@pytest.mark.parametrize("asked", [("keys", "list"), ("projects", "list")])
def test_lists_do_not_wait_for_who_writes(tmp_path: Path, asked: tuple[str, str]) -> None:
    settings = Settings(data_dir=tmp_path / "state", database_url=None)
    migrate(settings)
    database = Database.from_settings(settings)
    with database.write():
        begun_s = time.monotonic()
        assert mrasfm(*asked, "--data", str(settings.data_dir)) == 0
        assert time.monotonic() - begun_s < 10.0, "a writer waits for 30 s"
    database.close()


def _environment(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Arguments of commands for this database; those of a server's come with the environment."""
    if settings.database_url is None:
        return ["--data", str(settings.data_dir)]
    monkeypatch.setenv("MRASFM_DATABASE_URL", settings.resolved_database_url)
    return []
