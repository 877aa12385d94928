"""Common part of the commands that change a service's records: the project, and a transaction on the records."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from service.settings import Settings, settings_of_command

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

EXIT_CANNOT_RUN = 2

Action = Callable[["Session", Settings, argparse.Namespace], int]


def add_options(parser: argparse.ArgumentParser, actions: Iterable[argparse.ArgumentParser]) -> None:
    """Add the arguments that say which service, and ask for a form that programs read: before and after an action."""
    _add(parser, data=None, json=False)
    for action in actions:
        # Without a default: it would overwrite what stands before the action.
        _add(action, data=argparse.SUPPRESS, json=argparse.SUPPRESS)


def _add(parser: argparse.ArgumentParser, *, data: str | None, json: str | bool) -> None:
    state = "state of a standalone service (MRASFM_DATA_DIR)"
    parser.add_argument("--data", type=Path, metavar="DIR", default=data, help=state)
    parser.add_argument("--json", action="store_true", default=json, help="print JSON")


def administer(
    action: Action, arguments: argparse.Namespace, *, may_begin: bool = False, only_reads: bool = False
) -> int:
    """Run an action in one transaction on the service's records; its exit code.

    Parameters
    ----------
    may_begin
        Whether the action makes sense before the service has started for the first time.
    only_reads
        Whether the action changes nothing, so that it takes no turn of the service's writers.
    """
    from service.database.startup_errors import UnusableDatabaseError, unusable_is_told
    from service.storage.data_folder import DataFolderError, require_data_folder

    settings = settings_of(arguments)
    if not may_begin and not holds_state(settings):
        print(
            f"mrasfm: error: {settings.data_dir.resolve()} holds no state of a service. Give --data and the folder "
            "that mrasfm standalone was started with.",
            file=sys.stderr,
        )
        return EXIT_CANNOT_RUN
    try:
        if settings.database_url is None:
            require_data_folder(settings.data_dir)
        with unusable_is_told(settings):
            return _in_transaction(action, settings, arguments, may_begin=may_begin, only_reads=only_reads)
    except (UnusableDatabaseError, DataFolderError) as error:
        print(f"mrasfm: error: {error}", file=sys.stderr)
        return EXIT_CANNOT_RUN


def settings_of(arguments: argparse.Namespace) -> Settings:
    """The settings of the service that the arguments name."""
    return settings_of_command(data_dir=arguments.data)


def holds_state(settings: Settings) -> bool:
    """Return whether a service's records are there; those of a database server are."""
    return settings.database_url is not None or settings.database_file.exists()


def _in_transaction(
    action: Action, settings: Settings, arguments: argparse.Namespace, *, may_begin: bool, only_reads: bool
) -> int:
    from service.database.connections import Database, has_schema, migrate
    from service.database.startup_errors import require_current

    database = Database.from_settings(settings)
    try:
        if may_begin and not has_schema(database):
            migrate(settings)
        # No other schema is changed here: processes of an older version may be at work on it.
        require_current(database, settings)
        with database.read() if only_reads else database.write() as session:
            return action(session, settings, arguments)
    finally:
        database.close()
