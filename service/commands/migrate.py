"""`mrasfm migrate`: bring the database to this version's schema."""

from __future__ import annotations

import argparse
import sys

from service.commands.administration import EXIT_CANNOT_RUN
from service.settings import Settings


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser("migrate", help="bring the service's database to this version")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Migrate; safe to repeat."""
    from service.persistence.database import migrate
    from service.unusable_database import UnusableDatabaseError, unusable_is_told

    settings = Settings()
    try:
        with unusable_is_told(settings):
            migrate(settings)
    except UnusableDatabaseError as error:
        print(f"mrasfm: error: {error}", file=sys.stderr)
        return EXIT_CANNOT_RUN
    print("the database has this version's schema")
    return 0
