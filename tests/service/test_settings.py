"""Settings that do not fit together are refused by their names."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import ValidationError

from service.database.connections import migrate
from service.settings import Settings, misspelt_variables, settings_of_command
from tests.helpers.live_api import REPOSITORY
from tests.helpers.tiny_drive import tiny_drive
from tests.service.conftest import StartApi

FIELDS = Settings.model_json_schema()["properties"]
NUMBERS = {
    name: form.get("maximum")
    for name, field in FIELDS.items()
    for form in (field, *field.get("anyOf", ()))
    if form.get("type") in ("number", "integer")
}


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", ["inf", "nan", "1e300", "10" * 40, "-1"])
def test_every_number_has_bounds(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    assert NUMBERS[name] is not None
    monkeypatch.setenv(f"MRASFM_{name.upper()}", value)
    with pytest.raises(ValidationError) as caught:
        Settings()
    assert name in [problem["loc"][0] for problem in caught.value.errors()]


def test_the_largest_numbers_can_be_worked_with(start_api: StartApi) -> None:
    of_api = [name for name in NUMBERS if name.endswith(("_hours", "_days")) or name.startswith(("max_", "project_"))]
    assert len(of_api) >= 14
    api = start_api(**{name: NUMBERS[name] for name in of_api})
    client = api.client()
    created = client.post("/v1/drives", content=tiny_drive().raw, headers={"Idempotency-Key": "largest"})
    assert created.status_code == 201, created.text
    assert created.json()["expires_at"] > "2100"
    job = client.reconstruct(client.committed(tiny_drive("b")), **{"Idempotency-Key": "job"})
    assert client.publish(client.claim(job["id"]), {"report.json": b"{}"})


@pytest.mark.parametrize("token", ["short", "sixteen letters and spaces", "quoted'quoted'quoted'", "ü" * 20])
def test_a_token_that_cannot_be_sent_or_can_be_guessed(monkeypatch: pytest.MonkeyPatch, token: str) -> None:
    monkeypatch.setenv("MRASFM_METRICS_TOKEN", token)
    with pytest.raises(ValidationError, match="openssl rand") as caught:
        Settings()
    assert token not in str(caught.value), "errors end in logs"


def test_no_token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MRASFM_METRICS_TOKEN", "")
    assert Settings().metrics_token is None


@pytest.mark.parametrize(
    ("name", "url"),
    [
        ("database_url", ""),
        ("database_url", "mysql://mrasfm:hush@db/mrasfm"),
        ("database_url", "postgres://mrasfm:hush@db/mrasfm"),
        ("database_url", "postgresql+psycopg://mrasfm:hush@db:port/mrasfm"),
        ("database_url", "mrasfm.sqlite3"),
        ("redis_url", "http://:hush@broker:6379"),
        ("redis_url", "redis://:hush@broker:port/0"),
        ("redis_url", "broker:6379"),
        ("artifacts_url", "ftp://store/hush"),
        ("artifacts_url", "/srv/mrasfm"),
    ],
)
def test_a_url_of_another_kind_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str, url: str
) -> None:
    monkeypatch.setenv(f"MRASFM_{name.upper()}", url)
    with pytest.raises(SystemExit) as ended:
        settings_of_command()
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert re.fullmatch(rf"mrasfm: error: {name} is not valid: must be .+\. Correct MRASFM_{name.upper()}\.\n", said)
    assert "hush" not in said


@pytest.mark.parametrize(
    ("name", "url"),
    [
        ("database_url", "sqlite:////srv/state.sqlite3"),
        ("database_url", "postgresql://mrasfm@db/mrasfm"),
        ("database_url", "postgresql+psycopg://mrasfm@/mrasfm?host=/run/postgresql"),
        ("redis_url", "redis+socket:///run/valkey.sock?virtual_host=1"),
        ("redis_url", "rediss://:hush@[::1]:6379/0"),
        ("artifacts_url", "file:///srv/my%20state"),
        ("artifacts_url", "s3://bucket"),
        ("artifacts_url", "gs://bucket/prefix"),
        ("artifacts_url", "az://container"),
    ],
)
def test_a_url_of_a_kind_that_is_spoken(monkeypatch: pytest.MonkeyPatch, name: str, url: str) -> None:
    monkeypatch.setenv(f"MRASFM_{name.upper()}", url)
    given = getattr(Settings(), name)
    assert url == (given if isinstance(given, str) else given.get_secret_value())


@pytest.mark.parametrize("name", ["redis_url", "artifacts_url"])
def test_an_empty_url_is_none(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """`mrasfm standalone` waited for a broker at no address."""
    monkeypatch.setenv(f"MRASFM_{name.upper()}", "")
    assert getattr(Settings(), name) is None


@pytest.mark.parametrize(
    "command",
    [
        "service api",
        "service migrate",
        "service keys list",
        "service projects list",
        "worker worker",
        "worker reconciler",
    ],
)
def test_every_command_names_a_wrong_setting(command: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", *command.split()],
        cwd=REPOSITORY,
        env={**os.environ, "MRASFM_UPLOAD_HOURS": "a day"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("mrasfm: error: upload_hours is not valid: ")
    assert done.stderr.endswith("Correct MRASFM_UPLOAD_HOURS.\n")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("variable", "meant"),
    [
        ("MRASFM_DRIVE_RETENTION_DAY", "MRASFM_DRIVE_RETENTION_DAYS"),
        ("mrasfm_max_file_size", "MRASFM_MAX_FILE_BYTES"),
        ("MRASFM_ENGINE_THREADS", None),
        ("mrasfm_port", None),
        ("MRASFM_API_KEY", None),
        ("MRASFM_URL", None),
        ("MRASFM_MODELS", None),
        ("MRASFM_CHECKER_MEMORY", None),
        ("DRIVE_RETENTION_DAY", None),
    ],
)
def test_a_misspelt_variable_is_named(variable: str, meant: str | None) -> None:
    said = [] if meant is None else [f"{variable} is no setting and has no effect; did you mean {meant}?"]
    assert list(misspelt_variables({variable: "1"})) == said


def test_commands_warn_of_misspelt_variables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MRASFM_UPLOAD_HOUR", "1")
    assert settings_of_command(data_dir=tmp_path).upload_hours == 24.0
    assert "mrasfm: warning: MRASFM_UPLOAD_HOUR is no setting and has no effect" in capsys.readouterr().err


def test_the_defaults_fit_together() -> None:
    assert Settings().heartbeat_seconds < Settings().lease_seconds


@pytest.mark.parametrize(
    ("variables", "words"),
    [
        (
            {"MRASFM_HEARTBEAT_SECONDS": "30", "MRASFM_STALLED_SECONDS": "40"},
            r"MRASFM_HEARTBEAT_SECONDS \(30\) must be at most half of MRASFM_LEASE_SECONDS \(45\)",
        ),
        (
            {"MRASFM_STALLED_SECONDS": "5"},
            r"MRASFM_HEARTBEAT_SECONDS \(5\) must be less than MRASFM_STALLED_SECONDS \(5\)",
        ),
        (
            {"MRASFM_VISIBILITY_TIMEOUT_SECONDS": "29"},
            r"MRASFM_VISIBILITY_RENEW_SECONDS \(15\) must be at most half of MRASFM_VISIBILITY_TIMEOUT_SECONDS \(29\)",
        ),
        (
            {"MRASFM_TERMINATE_AFTER_SECONDS": "31"},
            r"MRASFM_TERMINATE_AFTER_SECONDS \(31\) must be at most MRASFM_KILL_AFTER_SECONDS \(30\)",
        ),
    ],
)
def test_times_that_contradict_each_other(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], words: str
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValidationError, match=words) as caught:
        Settings()
    assert all(problem["loc"] for problem in caught.value.errors()), "the error names a field"


def test_a_time_that_is_no_number_is_the_only_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MRASFM_HEARTBEAT_SECONDS", "soon")
    with pytest.raises(ValidationError) as caught:
        Settings()
    assert [problem["loc"] for problem in caught.value.errors()] == [("heartbeat_seconds",)]


@pytest.mark.parametrize("name", ["a?b", "50% off", "a#b", "a%20b", "Straße", "with ' and \" quotes"])
def test_the_embedded_database_is_in_its_folder_whatever_that_is_called(tmp_path: Path, name: str) -> None:
    migrate(Settings(data_dir=tmp_path / name))
    assert (tmp_path / name / "mrasfm.sqlite3").stat().st_size > 0
    assert [path.name for path in tmp_path.iterdir()] == [name]
