"""Messages for the start of a part of the service where the database cannot be used."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version

from alembic.util.exc import CommandError
from sqlalchemy.engine import make_url
from sqlalchemy.exc import SQLAlchemyError

from service.database.connections import LOCK_TIMEOUT
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
    database = make_url(settings.resolved_database_url).render_as_string(hide_password=True)
    try:
        yield
    except CommandError as error:  # the database names a step of the schema that is not among ours
        raise UnusableDatabaseError(
            f"the database {database} is of a newer MRASfM than this one, {version('mrasfm')}: {error}. Install that "
            "version again, or give another database or another folder with --data."
        ) from error
    except SQLAlchemyError as error:
        reason = str(getattr(error, "orig", None) or error).strip()
        remedy = "Check MRASFM_DATABASE_URL, and that its server runs."
        if settings.database_url is None:
            remedy = "Check that its disk has room and that the file belongs to you."
        elif getattr(getattr(error, "orig", None), "sqlstate", None) == LOCK_TIMEOUT:
            remedy = "Another transaction has used a table for minutes: end it (pg_stat_activity), and migrate again."
        raise UnusableDatabaseError(f"the database {database} cannot be used: {reason}. {remedy}") from error
