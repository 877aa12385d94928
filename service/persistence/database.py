"""The database: SQLite (embedded) or PostgreSQL, through one small interface."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from alembic import command
from alembic.config import Config
from sqlalchemy import Engine, create_engine, event, text
from sqlalchemy.engine import make_url
from sqlalchemy.orm import Session, sessionmaker

from service.settings import Settings

MIGRATIONS = Path(__file__).parent / "migrations"


class Database:
    """Sessions for reading and for writing.

    Sessions block: call them from threads, never from an event loop.

    Parameters
    ----------
    url
        SQLAlchemy's.
    patience_s
        How long to wait for a lock of SQLite's, or for a server to answer.
    """

    def __init__(self, url: str, *, patience_s: float = 30.0) -> None:
        embedded = make_url(url).get_backend_name() == "sqlite"
        self.engine = _sqlite(url, patience_s) if embedded else _server(url, patience_s)
        self._sessions = sessionmaker(self.engine, expire_on_commit=False)

    @classmethod
    def of(cls, settings: Settings) -> Database:
        """The database that the settings name."""
        return cls(settings.resolved_database_url)

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A session that sees one state of the database and writes nothing."""
        with self._sessions() as session:
            yield session

    @contextmanager
    def write(self, *, durable: bool = True) -> Iterator[Session]:
        """One transaction: committed where the block ends, rolled back where it raises.

        Parameters
        ----------
        durable
            Whether it survives a power cut as soon as it is committed. If not, it does when the next durable one has
            been committed; a crash of any process it survives in any case.

        In SQLite writers take turns from the start: a transaction that reads first and wants to write later would
        otherwise fail, at once, when another has written in between.
        """
        with self._sessions.begin() as session:
            if self.engine.dialect.name == "sqlite":
                session.connection(execution_options={"mrasfm_begin": "IMMEDIATE", "mrasfm_durable": durable})
            elif not durable:
                session.execute(text("SET LOCAL synchronous_commit TO OFF"))
            yield session

    def close(self) -> None:
        """Give all connections back."""
        self.engine.dispose()


def _server(url: str, patience_s: float) -> Engine:
    options = {"connect_timeout": max(2, min(10, round(patience_s)))}
    return create_engine(url, pool_size=10, max_overflow=30, pool_pre_ping=True, connect_args=options)


def _sqlite(url: str, patience_s: float) -> Engine:
    path = make_url(url).database
    if path:
        Path(path).parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    engine = create_engine(url, pool_size=10, max_overflow=30)

    @event.listens_for(engine, "connect")
    def _prepare(connection: sqlite3.Connection, record: Any) -> None:
        connection.isolation_level = None  # transactions begin where we say, not where the driver guesses
        connection.execute(f"PRAGMA busy_timeout={round(1000 * patience_s)}")
        _write_ahead(connection, patience_s)
        connection.execute("PRAGMA foreign_keys=ON")

    @event.listens_for(engine, "begin")
    def _begin(connection: Any) -> None:
        options = connection.get_execution_options()
        # FULL waits for the disk at every commit, NORMAL leaves that to the next FULL one.
        level = "FULL" if options.get("mrasfm_durable", True) else "NORMAL"
        if connection.info.get("synchronous") != level:
            connection.exec_driver_sql(f"PRAGMA synchronous={level}")
            connection.info["synchronous"] = level
        connection.exec_driver_sql(f"BEGIN {options.get('mrasfm_begin', 'DEFERRED')}")

    return engine


def _write_ahead(connection: sqlite3.Connection, patience_s: float) -> None:
    """Make readers not wait for the writer.

    While one process changes a new database to this mode, SQLite refuses the others at once, whatever its timeout is.
    """
    end_s = time.monotonic() + patience_s
    while True:
        try:
            connection.execute("PRAGMA journal_mode=WAL")
            return
        except sqlite3.OperationalError:
            if time.monotonic() > end_s:
                raise
            time.sleep(0.02)


def migrate(settings: Settings) -> None:
    """Bring the database to the newest schema; safe to run by several processes at once and again."""
    database = Database.of(settings)
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    options = {"mrasfm_begin": "IMMEDIATE"}  # the second process waits here until the first is done
    try:
        with database.engine.connect().execution_options(**options) as connection, connection.begin():
            if connection.dialect.name == "postgresql":
                connection.execute(text("SELECT pg_advisory_xact_lock(5240017)"))
            config.attributes["connection"] = connection
            command.upgrade(config, "head")
    finally:
        database.close()


def is_current(database: Database) -> bool:
    """Whether the schema is the one that this code expects."""
    from alembic.runtime.migration import MigrationContext
    from alembic.script import ScriptDirectory

    with database.engine.connect() as connection:
        found = MigrationContext.configure(connection).get_current_revision()
    return found == ScriptDirectory(str(MIGRATIONS)).get_current_head()
