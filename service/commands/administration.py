"""Common part of the commands that change a service's records: the project, and a transaction on the records."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from service.settings import Settings

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

EXIT_CANNOT_RUN = 2

Action = Callable[["Session", Settings, argparse.Namespace], int]


def add_data(parser: argparse.ArgumentParser) -> None:
    """Add the argument that says which service."""
    parser.add_argument("--data", type=Path, metavar="DIR", help="state of a standalone service (MRASFM_DATA_DIR)")


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add the argument that asks for a form that programs read."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def administer(action: Action, arguments: argparse.Namespace) -> int:
    """Run an action in one transaction on the service's records; its exit code."""
    from service.database.startup_errors import UnusableDatabaseError, unusable_is_told

    settings = Settings() if arguments.data is None else Settings(data_dir=arguments.data)
    try:
        with unusable_is_told(settings):
            return _in_transaction(action, settings, arguments)
    except UnusableDatabaseError as error:
        print(f"mrasfm: error: {error}", file=sys.stderr)
        return EXIT_CANNOT_RUN


def _in_transaction(action: Action, settings: Settings, arguments: argparse.Namespace) -> int:
    from service.database.connections import Database, migrate

    migrate(settings)
    database = Database.from_settings(settings)
    try:
        with database.write() as session:
            return action(session, settings, arguments)
    finally:
        database.close()
