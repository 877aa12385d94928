"""The database: SQLite (embedded) or PostgreSQL, through one small interface."""

from __future__ import annotations

import random
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from sqlalchemy import (
    BigInteger,
    ColumnElement,
    Engine,
    ExceptionContext,
    create_engine,
    event,
    inspect,
    literal,
    literal_column,
    select,
    text,
)
from sqlalchemy.engine import make_url
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session, sessionmaker

from service.database.tables import now_us
from service.settings import Settings

if TYPE_CHECKING:
    from alembic.config import Config

Result = TypeVar("Result")

MIGRATIONS = Path(__file__).parent / "migrations"
# PostgreSQL ended this transaction for another one's sake: a serialization failure, a deadlock.
_TRY_AGAIN = frozenset({"40001", "40P01"})
_READ_ONLY = "25006"
_CLOCK_US = literal_column("CAST(extract(epoch FROM clock_timestamp()) * 1000000 AS bigint)", BigInteger)
LOCK_TIMEOUT = "55P03"
MAX_ATTEMPTS = 5  # of one transaction
WAIT_S = 0.05  # at most, before the second; twice as long before each later one
# A migration waits that long for a table: whoever wants it meanwhile waits behind the migration.
TABLE_LOCK_S = 5.0
PAUSE_S = 10.0  # of a migration that got no table
MAX_MIGRATION_ATTEMPTS = 40
# An error tells its statement, and not what was given to it: that is the users', and may be a hundred thousand names.
_ENGINE: dict[str, Any] = {"pool_size": 10, "max_overflow": 30, "hide_parameters": True}


class Transactions(Protocol):
    """Whole transactions on records, for code that leaves open whether one is tried again where the database is away.

    What is given must take being called again.
    """

    def query(self, work: Callable[[Session], Result]) -> Result:
        """The result of `work`, which reads one state of the database."""

    def transact(self, work: Callable[[Session], Result]) -> Result:
        """The result of `work`, whose changes are made."""


class Database:
    """Sessions for reading and for writing.

    Sessions block: call them from threads, never from an event loop.

    Parameters
    ----------
    url
        SQLAlchemy's.
    timeout_s
        How long to wait for a lock of SQLite's, or for a server to answer; a statement gets four times as long.
    """

    def __init__(self, url: str, *, timeout_s: float = 30.0) -> None:
        embedded = make_url(url).get_backend_name() == "sqlite"
        self.engine = _sqlite(url, timeout_s) if embedded else _server(url, timeout_s)
        self._sessions = sessionmaker(self.engine, expire_on_commit=False)

    @classmethod
    def from_settings(cls, settings: Settings) -> Database:
        """The database that the settings name."""
        return cls(settings.resolved_database_url)

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A session that sees one state of the database and writes nothing."""
        with self._sessions() as session:
            if self.engine.dialect.name == "postgresql":
                # Else each statement sees a state of its own. The pool gives connections out without it.
                session.connection(execution_options={"isolation_level": "REPEATABLE READ"})
            yield session

    @contextmanager
    def write(self, *, durable: bool = True) -> Iterator[Session]:
        """One transaction: committed where the block ends, rolled back where it raises.

        In SQLite writers take turns from the start: a transaction that reads first and wants to write later would
        otherwise fail, at once, when another has written in between.

        Parameters
        ----------
        durable
            Whether SQLite waits for the disk. If not, the transaction survives a crash of any process, but a power
            cut only once the next durable one has been committed. PostgreSQL always waits: when its server crashes,
            it loses what it did not wait for.
        """
        with self._sessions.begin() as session:
            if self.engine.dialect.name == "sqlite":
                session.connection(execution_options={"mrasfm_begin": "IMMEDIATE", "mrasfm_durable": durable})
            yield session

    def query(self, work: Callable[[Session], Result]) -> Result:
        """The result of `work` in a session of its own: see `read`."""
        with self.read() as session:
            return work(session)

    def transact(self, work: Callable[[Session], Result], *, durable: bool = True) -> Result:
        """The result of `work` in a transaction of its own: see `write`.

        Where the database ends the transaction for another one's sake, it is done again: nothing of it was kept. Two
        that ended each other would do so again if both began at once, so each waits for a moment of its own.
        """
        for attempt in range(MAX_ATTEMPTS):
            try:
                with self.write(durable=durable) as session:
                    return work(session)
            except OperationalError as error:
                if getattr(error.orig, "sqlstate", None) not in _TRY_AGAIN or attempt == MAX_ATTEMPTS - 1:
                    raise
            time.sleep(random.uniform(0.0, WAIT_S * 2**attempt))
        raise AssertionError("the last attempt returns or raises")

    def close(self) -> None:
        """Give all connections back."""
        self.engine.dispose()


def clock_us(session: Session) -> int:
    """Microseconds since 1970, on the one clock that all users of a database share.

    What one machine notes and another compares, as the end of a lease, is taken from here: their own clocks differ.
    SQLite's users share a machine.
    """
    if _is_embedded(session):
        return now_us()
    return session.scalars(select(_CLOCK_US)).one()


def clock_expression(session: Session) -> ColumnElement[int]:
    """The same as a part of a statement that writes, which asks nothing of its own."""
    return literal(now_us(), BigInteger) if _is_embedded(session) else _CLOCK_US


def _is_embedded(session: Session) -> bool:
    return session.get_bind().dialect.name == "sqlite"


def _server(url: str, timeout_s: float) -> Engine:
    chosen = make_url(url).query.get("options", "")  # the operator's come last: they win
    options = {
        "connect_timeout": max(2, min(10, round(timeout_s))),
        # A server that has vanished without a word is noticed within half a minute; else a thread waits for ever.
        "keepalives": 1,
        "keepalives_idle": 10,
        "keepalives_interval": 5,
        "keepalives_count": 3,
        "tcp_user_timeout": 20_000,
        "options": f"-c statement_timeout={round(4000 * timeout_s)} {chosen}".rstrip(),
    }
    engine = create_engine(url, pool_pre_ping=True, connect_args=options, **_ENGINE)

    @event.listens_for(engine, "handle_error")
    def _leave(context: ExceptionContext) -> None:
        # A server that became a standby, or that a name led to for a moment after another took over, answers and takes
        # nothing: connections to it would stay in the pool for as long as this process lives.
        if getattr(context.original_exception, "sqlstate", None) == _READ_ONLY:
            context.is_disconnect = True

    return engine


def _sqlite(url: str, timeout_s: float) -> Engine:
    path = make_url(url).database
    if path:
        Path(path).parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    engine = create_engine(url, **_ENGINE)

    @event.listens_for(engine, "connect")
    def _prepare(connection: sqlite3.Connection, record: Any) -> None:
        connection.isolation_level = None  # transactions begin where we say, not where the driver guesses
        connection.execute(f"PRAGMA busy_timeout={round(1000 * timeout_s)}")
        _write_ahead(connection, timeout_s)
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


def _write_ahead(connection: sqlite3.Connection, timeout_s: float) -> None:
    """Make readers not wait for the writer.

    While one process changes a new database to this mode, SQLite refuses the others at once, whatever its timeout is.
    """
    end_s = time.monotonic() + timeout_s
    while True:
        try:
            connection.execute("PRAGMA journal_mode=WAL")
            return
        except sqlite3.OperationalError:
            if time.monotonic() > end_s:
                raise
            time.sleep(0.02)


def migrate(settings: Settings) -> None:
    """Bring the database to the newest schema; safe to run by several processes at once and again.

    A table that another transaction uses for long is asked for again, for ten minutes.
    """
    from alembic.config import Config

    database = Database.from_settings(settings)
    if database.engine.dialect.name == "sqlite":
        event.listen(database.engine, "connect", _ignore_references)
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    try:
        for attempts_left in reversed(range(MAX_MIGRATION_ATTEMPTS)):
            try:
                _upgrade(database, config)
                break
            except OperationalError as error:
                if getattr(error.orig, "sqlstate", None) != LOCK_TIMEOUT or not attempts_left:
                    raise
            time.sleep(PAUSE_S)
    finally:
        database.close()


def _upgrade(database: Database, config: Config) -> None:
    """Bring the database to the newest schema in one transaction."""
    from alembic import command

    options = {"mrasfm_begin": "IMMEDIATE"}  # the second process waits here until the first is done
    with database.engine.connect().execution_options(**options) as connection, connection.begin():
        if connection.dialect.name == "postgresql":
            connection.execute(text("SET LOCAL statement_timeout TO 0"))  # large tables take their time
            connection.execute(text("SELECT pg_advisory_xact_lock(5240017)"))
            connection.execute(text(f"SET LOCAL lock_timeout TO {round(1000 * TABLE_LOCK_S)}"))
        config.attributes["connection"] = connection
        command.upgrade(config, "head")


def _ignore_references(connection: sqlite3.Connection, record: Any) -> None:
    """SQLite changes a table by copying it; dropping the old one would else delete all that refers to it."""
    connection.execute("PRAGMA foreign_keys=OFF")


@cache
def newest_schema() -> str:
    """The revision that this code expects: migrations are named after theirs."""
    return max(path.name.partition("_")[0] for path in (MIGRATIONS / "versions").glob("[0-9]*.py"))


def is_current(database: Database) -> bool:
    """Return whether the schema is the one that this code expects."""
    return found_schema(database) == newest_schema()


def has_schema(database: Database) -> bool:
    """Return whether the database was migrated before, to whichever revision."""
    return found_schema(database) is not None


def found_schema(database: Database) -> str | None:
    """The revision that the database has; None where it was never migrated.

    Asked without Alembic, which takes 10 MB that a process that does not migrate can do without.
    """
    with database.engine.connect() as connection:
        if not inspect(connection).has_table("alembic_version"):
            return None
        return connection.scalars(text("SELECT version_num FROM alembic_version")).one_or_none() or ""
