"""What `mrasfm standalone` makes of its settings, and what it says where it cannot run."""

from __future__ import annotations

import argparse
import errno
import os
import socket
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from service.commands import standalone as command
from service.database.connections import migrate
from service.settings import Settings
from service.standalone import broker
from service.standalone.program import child_specs
from service.storage.data_folder import DATABASE_FILE, FOLDERS, LOCK_FILE, DataFolderError, require_data_folder


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    command.register(parser.add_subparsers())
    parsed = parser.parse_args(["standalone", *arguments])
    return int(parsed.run(parsed))


def test_everything_starts_after_the_broker_and_no_command_line_has_its_password(tmp_path: Path) -> None:
    embedded = broker.prepare(tmp_path / "broker")
    specs = child_specs(Settings(data_dir=tmp_path), embedded, workers=1, log_level="info")
    assert [spec.name for spec in specs] == ["broker", "api", "checker", "worker", "reconciler"]
    assert all(list(spec.depends_on) == ["broker"] for spec in specs[1:])
    assert all(spec.environment["MRASFM_REDIS_URL"] == embedded.url for spec in specs[1:])
    password = (tmp_path / "broker" / "password").read_text(encoding="ascii")
    assert password not in repr(specs)
    assert not any(password in argument for spec in specs for argument in spec.argv)


def test_with_a_broker_outside_none_is_started(tmp_path: Path) -> None:
    specs = child_specs(Settings(data_dir=tmp_path), None, workers=1, log_level="info")
    assert [spec.name for spec in specs] == ["api", "checker", "worker", "reconciler"]
    assert not any(spec.depends_on or "MRASFM_REDIS_URL" in spec.environment for spec in specs)


@pytest.mark.parametrize(("set_threads", "workers", "shared"), [(0, 1, False), (0, 2, True), (3, 2, False)])
def test_several_workers_share_the_cores(tmp_path: Path, set_threads: int, workers: int, shared: bool) -> None:
    settings = Settings(data_dir=tmp_path, engine_threads=set_threads)
    *_, worker, _ = child_specs(settings, None, workers=workers, log_level="info")
    assert ("MRASFM_ENGINE_THREADS" in worker.environment) == shared


@pytest.mark.parametrize(
    ("variable", "value", "named"),
    [("MRASFM_PORT", "70000", "port is not valid"), ("MRASFM_LEASE_SECONDS", "soon", "MRASFM_LEASE_SECONDS")],
)
def test_a_wrong_setting_is_named(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    variable: str,
    value: str,
    named: str,
) -> None:
    monkeypatch.setenv(variable, value)
    monkeypatch.setenv("MRASFM_UPLOAD_HOUR", "1")
    assert run("--data", str(tmp_path / "state")) == 2
    said = capsys.readouterr().err
    assert named in said
    assert (
        "mrasfm: warning: MRASFM_UPLOAD_HOUR is no setting and has no effect; did you mean MRASFM_UPLOAD_HOURS?" in said
    )
    assert not (tmp_path / "state").exists()


def test_a_database_that_is_away_is_named_without_its_password(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(socket.socket()) as nobody:  # bound but not listening: connections are refused
        nobody.bind(("127.0.0.1", 0))
        port = nobody.getsockname()[1]
        monkeypatch.setenv("MRASFM_DATABASE_URL", f"postgresql+psycopg://mrasfm:topsecret@127.0.0.1:{port}/mrasfm")
        assert run("--data", str(tmp_path), "--port", "0") == 2
    said = capsys.readouterr().err
    assert f"the database postgresql+psycopg://mrasfm:***@127.0.0.1:{port}/mrasfm cannot be used" in said
    assert "Check MRASFM_DATABASE_URL" in said
    assert "topsecret" not in said


def test_a_schema_of_a_newer_version_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    migrate(Settings(data_dir=tmp_path))
    with closing(sqlite3.connect(tmp_path / "mrasfm.sqlite3")) as connection, connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    assert run("--data", str(tmp_path), "--port", "0") == 2
    said = capsys.readouterr().err
    assert f"{tmp_path}/mrasfm.sqlite3 is of a newer MRASfM than this one" in said
    assert "Install that version again" in said


@pytest.mark.parametrize("function", ["truncate", "fsync"])  # as the lock is written, and as the broker is prepared
def test_a_full_disk_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], function: str
) -> None:
    def no_room(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(f"service.storage.data_folder.os.{function}", no_room)
    assert run("--data", str(tmp_path), "--port", "0") == 2
    said = capsys.readouterr().err
    assert "cannot be used: No space left on device. Make room on its disk" in said


def test_a_reader_that_has_ended_ends_nothing() -> None:
    """As `mrasfm standalone 2>&1 | head -3` does."""
    speaker = "from service.commands.standalone import _say; input(); _say('one'); _say('two')"
    with subprocess.Popen(
        [sys.executable, "-c", speaker], stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        process.stderr.close()
        process.communicate("\n", timeout=60)
    assert process.returncode == 0


def test_a_full_disk_below_the_terminals_words_ends_nothing(tmp_path: Path) -> None:
    speaker = "from service.commands.standalone import _say; _say('one'); _say('two')"
    with Path("/dev/full").open("w") as full:
        subprocess.run([sys.executable, "-c", speaker], stderr=full, check=True, timeout=60)


def test_a_file_in_the_data_folder_s_place_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "state").write_text("", encoding="ascii")
    assert run("--data", str(tmp_path / "state")) == 2
    assert f"the data folder {tmp_path / 'state'} cannot be used" in capsys.readouterr().err


def test_an_address_of_another_machine_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--data", str(tmp_path), "--host", "192.0.2.1", "--port", "0") == 2
    assert "cannot listen on 192.0.2.1" in capsys.readouterr().err


@pytest.mark.parametrize("workers", ["0", "-1", "two"])
def test_a_number_of_workers_is_a_number(workers: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run("--workers", workers)
    assert "not a whole number above 0" in capsys.readouterr().err


@pytest.mark.parametrize("names", [["drive.json", "images/"], ["pictures/", "report.json"], ["map.json"], [".stages/"]])
def test_a_folder_of_other_files_is_refused_and_not_touched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], names: list[str]
) -> None:
    """Of a drive, a scene, a map, or a run that was interrupted."""
    for name in names:
        (tmp_path / name).mkdir() if name.endswith("/") else (tmp_path / name).touch()
    tmp_path.chmod(0o755)
    before = sorted(tmp_path.rglob("*"))
    # The address is not ours: where the folder were taken, the service would not start all the same.
    assert run("--data", str(tmp_path), "--host", "192.0.2.1", "--port", "1") == 2
    told = capsys.readouterr().err
    assert f"{tmp_path} holds no state of a service, but other files, such as {names[0].rstrip('/')}" in told
    assert sorted(tmp_path.rglob("*")) == before
    assert tmp_path.stat().st_mode & 0o777 == 0o755


def test_a_folder_of_its_own_and_an_empty_one_are_taken(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    folders = ("spool_dir", "uploads_dir", "metrics_dir", "temporary_dir", "scratch_dir")
    assert {getattr(settings, name).name for name in folders} < FOLDERS
    assert settings.database_file.name == DATABASE_FILE
    require_data_folder(tmp_path / "new")
    require_data_folder(tmp_path)
    for name in (*FOLDERS, ".hidden", ".DS_Store", "Thumbs.db"):
        (tmp_path / name).mkdir()
        require_data_folder(tmp_path)
    (tmp_path / "notes.txt").touch()
    with pytest.raises(DataFolderError, match=r"notes\.txt"):
        require_data_folder(tmp_path)
    for name in (LOCK_FILE, DATABASE_FILE):
        (tmp_path / name).touch()
        require_data_folder(tmp_path)
        (tmp_path / name).unlink()
