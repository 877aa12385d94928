"""Messages for the start of a part of the service where the database cannot be used."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version

from alembic.util.exc import CommandError
from sqlalchemy.engine import make_url
from sqlalchemy.exc import SQLAlchemyError

from service.database.connections import LOCK_TIMEOUT, Database, found_schema, newest_schema
from service.settings import Settings


class UnusableDatabaseError(Exception):
    """The database cannot be used; the message says why and what to do."""


@contextmanager
def unusable_is_told(settings: Settings) -> Iterator[None]:
    """Make errors of the database such that a person can act on.

    Raises
    ------
    UnusableDatabaseError
        Instead of SQLAlchemy's and Alembic's.
    """
    database = _name_of(settings)
    try:
        yield
    except CommandError as error:  # the database names a step of the schema that is not among ours
        raise _is_newer(settings, str(error)) from error
    except SQLAlchemyError as error:
        reason = str(getattr(error, "orig", None) or error).strip()
        remedy = "Check MRASFM_DATABASE_URL, and that its server runs."
        if settings.database_url is None:
            remedy = "Check that its disk has room and that the file belongs to you."
        elif getattr(getattr(error, "orig", None), "sqlstate", None) == LOCK_TIMEOUT:
            remedy = "Another transaction has used a table for minutes: end it (pg_stat_activity), and migrate again."
        raise UnusableDatabaseError(f"the database {database} cannot be used: {reason}. {remedy}") from error


def require_current(database: Database, settings: Settings) -> None:
    """Return where the schema is the one that this code expects.

    Raises
    ------
    UnusableDatabaseError
        Where it is another one, or there is none.
    """
    found, expected = found_schema(database), newest_schema()
    if found == expected:
        return
    if found and found > expected:
        raise _is_newer(settings, f"its schema is {found}, not {expected}")
    if settings.database_url is None:
        remedy = "Stop the service and start it with this version: mrasfm standalone migrates its database."
    elif found is None:
        remedy = "Run mrasfm migrate, then start the service."
    else:
        remedy = "Stop the service's processes, run mrasfm migrate, and start them with this version."
    what = "has no records of a service" if found is None else f"is of an older MRASfM than this one, {_installed()}"
    raise UnusableDatabaseError(f"the database {_name_of(settings)} {what}. {remedy}")


def _is_newer(settings: Settings, why: str) -> UnusableDatabaseError:
    return UnusableDatabaseError(
        f"the database {_name_of(settings)} is of a newer MRASfM than this one, {_installed()}: {why}. Install that "
        "version again, or give another database or another folder with --data."
    )


def _name_of(settings: Settings) -> str:
    return make_url(settings.resolved_database_url).render_as_string(hide_password=True)


def _installed() -> str:
    return version("mrasfm")
