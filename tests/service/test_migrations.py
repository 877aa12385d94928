"""The migrations make what the models say, on both databases."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from sqlalchemy import inspect, text

from service.database import connections
from service.database.connections import MIGRATIONS, Database, is_current, migrate
from service.database.startup_errors import UnusableDatabaseError, unusable_is_told
from service.database.tables import (
    Base,
    ConsoleSession,
    Drive,
    Export,
    Job,
    JobAttempt,
    JobEvent,
    Scene,
    WebhookDelivery,
)
from service.domain import webhooks
from service.domain.drives import Stored, stored_of
from service.settings import Settings
from tests.helpers.live_api import REPOSITORY, free_port, wait_until


def differences(database: Database) -> list[object]:
    with database.engine.connect() as connection:
        options = {"compare_type": True, "compare_server_default": True, "render_as_batch": True}
        context = MigrationContext.configure(connection, opts=options)
        return list(compare_metadata(context, Base.metadata))


def test_the_migrations_make_the_models(database: Database) -> None:
    assert differences(database) == []
    assert is_current(database)


def test_migrating_again_and_at_once_changes_nothing(database_settings: Settings) -> None:
    errors: list[BaseException] = []

    def run() -> None:
        try:
            migrate(database_settings)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    database = Database.from_settings(database_settings)
    assert differences(database) == []
    database.close()


def test_a_migration_that_waits_for_a_table_lets_others_have_it(
    postgres_database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind a migration that waits for a long transaction, every later reader of the table would wait as well."""
    monkeypatch.setattr(connections, "TABLE_LOCK_S", 0.3)
    monkeypatch.setattr(connections, "PAUSE_S", 0.2)
    settings = Settings(database_url=postgres_database)
    waiting = threading.Thread(target=migrate, args=(settings,))
    with _jobs_in_use(settings) as database:
        waiting.start()
        wait_until(lambda: _waits_for_a_lock(database), "the migration waits for the table")
        with database.engine.connect() as reader, reader.begin():
            reader.execute(text("SET LOCAL statement_timeout TO 5000"))
            reader.execute(text("SELECT count(*) FROM jobs"))
        assert not is_current(database)
    waiting.join(60.0)
    database = Database.from_settings(settings)
    assert is_current(database)
    assert differences(database) == []
    database.close()


def test_a_migration_that_gets_no_table_says_what_to_do(
    postgres_database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "TABLE_LOCK_S", 0.1)
    monkeypatch.setattr(connections, "PAUSE_S", 0.0)
    monkeypatch.setattr(connections, "MAX_MIGRATION_ATTEMPTS", 2)
    settings = Settings(database_url=postgres_database)
    with (
        _jobs_in_use(settings),
        pytest.raises(UnusableDatabaseError, match="pg_stat_activity"),
        unusable_is_told(settings),
    ):
        migrate(settings)


@contextmanager
def _jobs_in_use(settings: Settings) -> Iterator[Database]:
    """A database of an older version, one of whose tables a transaction has read that goes on."""
    database = Database.from_settings(settings)
    _upgrade(database, "0013")
    with database.engine.connect() as user, user.begin():
        user.execute(text("SELECT count(*) FROM jobs"))
        yield database
    database.close()


def _waits_for_a_lock(database: Database) -> bool:
    with database.engine.connect() as connection:
        return bool(connection.scalar(text("SELECT count(*) FROM pg_locks WHERE NOT granted AND relation IS NOT NULL")))


def _migrated_with(settings: Settings, version: str, records: Sequence[str]) -> Database:
    """A database of an older version with records, upgraded to the newest."""
    database = Database.from_settings(settings)
    _upgrade(database, version)
    with database.engine.connect().execution_options(mrasfm_begin="IMMEDIATE") as connection, connection.begin():
        for statement in records:
            connection.execute(text(statement))
    migrate(settings)
    assert differences(database) == []
    return database


def test_records_of_the_first_schema_stay(database_settings: Settings) -> None:
    """SQLite copies a table to change it: what refers to the old one must not go with it."""
    database = _migrated_with(database_settings, "0001", _FIRST_RECORDS)
    with database.read() as session:
        job = session.get_one(Job, "job_1")
        assert (job.drive_id, job.map_id, job.is_child, job.waiting_for, job.children_percent) == (
            "drv_1", None, False, 0, 0.0,
        )  # fmt: skip
        assert (job.attempt, job.blame, job.losses, job.engine_ran) == (1, 0.0, 0, False)
        assert session.get_one(Job, "job_2").blame == 2, "attempts that failed before it was queued again"
        assert session.query(JobAttempt).count() == 1
        assert session.query(JobEvent).count() == 1
        assert session.query(Scene).count() == 0
        assert session.get_one(Drive, "drv_1").vehicle is None
    database.close()


_FIRST_RECORDS = (
    "INSERT INTO projects (id, name, used_bytes, max_bytes, max_active_jobs, max_drives, created_us) "
    "VALUES ('prj_1', 'p', 0, 1, 1, 1, 1)",
    "INSERT INTO blobs (id, project_id, key, sha256, size_bytes, touched_us) VALUES ('blb_1', 'prj_1', 'k', 's', 1, 1)",
    "INSERT INTO drives (id, project_id, name, state, manifest_blob_id, cameras, frames, files_expected, has_gnss, "
    "preflight_state, findings, created_us) VALUES "
    "('drv_1', 'prj_1', 'd', 'OPEN', 'blb_1', 1, 2, 2, false, 'NONE', '[]', 1)",
    "INSERT INTO jobs (id, project_id, kind, drive_id, settings, state, revision, attempt, fence, not_before_us, "
    "percent, reused, created_us) VALUES "
    "('job_1', 'prj_1', 'RECONSTRUCTION', 'drv_1', '{}', 'SUCCEEDED', 1, 1, 1, 0, 100, '[]', 1)",
    "INSERT INTO jobs (id, project_id, kind, drive_id, settings, state, revision, attempt, fence, not_before_us, "
    "percent, reused, created_us) VALUES "
    "('job_2', 'prj_1', 'RECONSTRUCTION', 'drv_1', '{}', 'QUEUED', 1, 2, 3, 0, 0, '[]', 1)",
    "INSERT INTO job_attempts (job_id, fence, attempt, owner, started_us) VALUES ('job_1', 1, 1, 'w', 1)",
    "INSERT INTO job_events (job_id, kind, data, created_us) VALUES ('job_1', 'state', '{}', 1)",
)


def test_records_of_sessions_exports_and_webhooks_stay(database_settings: Settings) -> None:
    database = _migrated_with(database_settings, "0009", _LATER_RECORDS)
    with database.write() as session:
        assert session.query(ConsoleSession).one().expires_us == 2**53
        export = session.query(Export).one()
        assert (export.formats, export.options, export.results) == (["kitti"], {"crs": None}, None)
        (message,) = webhooks.take(session, limit=8)
        assert (message.id, message.secrets) == ("msg_1", ["whsec_AA==", "whsec_BB=="])
        webhooks.note(session, message, webhooks.Outcome(status=204))
        assert session.query(WebhookDelivery).one().state == "DELIVERED"
    database.close()


def test_files_of_committed_drives_are_counted(database_settings: Settings) -> None:
    database = _migrated_with(database_settings, "0010", _DRIVES_WITH_FILES)
    with database.read() as session:
        found = {drive.id: (drive.files_stored, drive.bytes_stored) for drive in session.query(Drive)}
        assert found == {"drv_1": (2, 30), "drv_2": (None, None), "drv_3": (0, 0)}
        drives = session.query(Drive).order_by(Drive.id).all()
        stored = stored_of(session, drives)
        assert [stored[drive.id] for drive in drives] == [Stored(2, 30), Stored(1, 10), Stored(0, 0)]
    database.close()


_DRIVES_WITH_FILES = (
    "INSERT INTO projects (id, name, used_bytes, max_bytes, max_active_jobs, max_drives, created_us) "
    "VALUES ('prj_1', 'p', 0, 1, 1, 1, 1)",
    "INSERT INTO blobs (id, project_id, key, sha256, size_bytes, touched_us) "
    "VALUES ('blb_1', 'prj_1', 'k', 's', 10, 1), ('blb_2', 'prj_1', 'l', 't', 20, 1)",
    *(
        "INSERT INTO drives (id, project_id, name, state, manifest_blob_id, cameras, frames, files_expected, has_gnss, "
        "preflight_state, findings, created_us) VALUES "
        f"('{drive_id}', 'prj_1', 'd', '{state}', 'blb_1', 1, 2, 2, false, 'NONE', '[]', 1)"
        for drive_id, state in (("drv_1", "COMMITTED"), ("drv_2", "OPEN"), ("drv_3", "COMMITTED"))
    ),
    "INSERT INTO drive_files (drive_id, path, role, blob_id, stored_us) VALUES "
    "('drv_1', 'a', 'image', 'blb_1', 1), ('drv_1', 'b', 'image', 'blb_2', 1), "
    "('drv_2', 'a', 'image', 'blb_1', 1), ('drv_2', 'b', 'image', NULL, NULL)",
)


_LATER_RECORDS = (
    "INSERT INTO projects (id, name, used_bytes, max_bytes, max_active_jobs, max_drives, created_us) "
    "VALUES ('prj_1', 'p', 0, 1, 1, 1, 1)",
    "INSERT INTO api_keys (id, project_id, name, secret_sha256, created_us) VALUES ('key_1', 'prj_1', 'k', 's', 1)",
    "INSERT INTO console_sessions (id, key_id, secret_sha256, created_us, expires_us) "
    "VALUES ('ses_1', 'key_1', 's', 1, 9007199254740992)",
    "INSERT INTO exports (id, project_id, job_id, inputs_sha256, formats, options, created_us) "
    "VALUES ('exp_1', 'prj_1', 'job_1', 's', '[\"kitti\"]', '{\"crs\": null}', 1)",
    "INSERT INTO webhooks (id, project_id, url, events, description, secret, previous_secret, previous_until_us, "
    "created_us) VALUES ('whk_1', 'prj_1', 'https://example.org/', '[\"job.failed\"]', '', 'whsec_AA==', 'whsec_BB==', "
    "9007199254740992, 1)",
    "INSERT INTO webhook_deliveries (id, webhook_id, job_id, event, body, state, attempts, next_us, created_us) "
    "VALUES ('msg_1', 'whk_1', 'job_1', 'job.failed', '{}', 'PENDING', 3, 1, 1)",
)


def _upgrade(database: Database, revision: str) -> None:
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    with database.engine.connect().execution_options(mrasfm_begin="IMMEDIATE") as connection, connection.begin():
        config.attributes["connection"] = connection
        command.upgrade(config, revision)


def test_down_and_up_again(database: Database, database_settings: Settings) -> None:
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    with database.engine.connect().execution_options(mrasfm_begin="IMMEDIATE") as connection, connection.begin():
        config.attributes["connection"] = connection
        command.downgrade(config, "base")
    assert set(inspect(database.engine).get_table_names()) <= {"alembic_version"}
    assert not is_current(database)
    migrate(database_settings)
    assert differences(database) == []


def test_the_command_says_what_is_wrong_with_the_database(tmp_path: Path) -> None:
    environment = {**os.environ, "MRASFM_DATABASE_URL": f"postgresql+psycopg://mrasfm:hush@127.0.0.1:{free_port()}/x"}
    command = [sys.executable, "-m", "service", "migrate"]
    done = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "cannot be used" in done.stderr
    assert "MRASFM_DATABASE_URL" in done.stderr
    assert "hush" not in done.stderr
    assert "Traceback" not in done.stderr
