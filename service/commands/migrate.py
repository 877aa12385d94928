"""`mrasfm migrate`: bring the database to this version's schema."""

from __future__ import annotations

import argparse
import sys

from service.commands.administration import EXIT_CANNOT_RUN
from service.settings import settings_of_command


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "migrate",
        help="migrate the service's database to this version",
        description="Migrate the service's database to this version. Settings are environment variables, see "
        "mrasfm describe service.",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Migrate; safe to repeat."""
    from service.database.connections import migrate
    from service.database.startup_errors import UnusableDatabaseError, unusable_is_told

    settings = settings_of_command()
    try:
        with unusable_is_told(settings):
            migrate(settings)
    except UnusableDatabaseError as error:
        print(f"mrasfm: error: {error}", file=sys.stderr)
        return EXIT_CANNOT_RUN
    print("the database has this version's schema")
    return 0
