"""`mrasfm migrate`: bring the database to this version's schema."""

from __future__ import annotations

import argparse

from service.settings import Settings


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser("migrate", help="bring the service's database to this version")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Migrate; safe to repeat."""
    from service.persistence.database import migrate

    migrate(Settings())
    print("the database has this version's schema")
    return 0
