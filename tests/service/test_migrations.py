"""The migrations make what the models say, on both databases."""

from __future__ import annotations

import threading

from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from sqlalchemy import inspect

from service.persistence.database import MIGRATIONS, Database, is_current, migrate
from service.persistence.tables import Base
from service.settings import Settings


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
    database = Database.of(database_settings)
    assert differences(database) == []
    database.close()


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
