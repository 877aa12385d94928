"""`mrasfm keys`: make, list and revoke API keys."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from typing import TYPE_CHECKING

from service.commands.administration import add_options, administer, holds_state, settings_of

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from service.settings import Settings


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "keys", help="create, list and revoke API keys", description="Create, list and revoke API keys."
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    create = actions.add_parser("create", help="create a key and print it")
    create.add_argument(
        "--project",
        default="default",
        help="project that the key opens; created if it does not exist (default: default)",
    )
    create.add_argument("--name", default="unnamed", help="label of the key in lists (default: unnamed)")
    listing = actions.add_parser("list", help="list keys, without their secrets")
    revoke = actions.add_parser("revoke", help="revoke a key")
    revoke.add_argument("key_id", metavar="ID", help="id of the key, as mrasfm keys list prints it")
    add_options(parser, (create, listing, revoke))
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Do what is asked; a key is printed once and not kept."""
    if arguments.action == "create":
        return _create_and_say_where(arguments)
    return administer(_ACTIONS[arguments.action], arguments, only_reads=arguments.action == "list")


def _create_and_say_where(arguments: argparse.Namespace) -> int:
    """Create a key, and say which service it is for: another folder's service would answer it with 401."""
    settings = settings_of(arguments)
    is_first = not holds_state(settings)
    code = administer(_create, arguments, may_begin=True)
    if code != 0:
        return code
    if settings.database_url is not None:
        told = "the key is for the service with the database of MRASFM_DATABASE_URL"
    elif is_first:
        folder = settings.data_dir.resolve()
        told = (
            f"warning: {folder} held no state of a service. The key is for one that is started with mrasfm standalone "
            f"--data {shlex.quote(str(folder))}; for one that runs already, give --data and its folder"
        )
    else:
        told = f"the key is for the service with its state in {settings.data_dir.resolve()}"
    print(f"mrasfm: {told}.", file=sys.stderr)
    return code


def _create(session: Session, settings: Settings, arguments: argparse.Namespace) -> int:
    from service.domain.keys import create_key, create_project, find_project

    for given in (arguments.project, arguments.name):
        if not 0 < len(given) <= 200 or not given.isprintable():
            print(f"mrasfm: error: {given!r} is not a name of 1 to 200 printable characters", file=sys.stderr)
            return 2
    project = find_project(session, arguments.project) or create_project(session, arguments.project, settings)
    key, secret = create_key(session, project, arguments.name)
    print(json.dumps({"id": key.id, "project": project.name, "key": secret}) if arguments.json else secret)
    return 0


def _list(session: Session, settings: Settings, arguments: argparse.Namespace) -> int:
    from sqlalchemy import select

    from service.database.tables import ApiKey, Project

    rows = session.execute(select(ApiKey, Project.name).join(Project, ApiKey.project_id == Project.id))
    if arguments.json:
        listed = [
            {"id": key.id, "project": project, "name": key.name, "revoked": key.revoked_us is not None}
            for key, project in rows
        ]
        print(json.dumps(listed))
        return 0
    for key, project in rows:
        print(f"{key.id}  {project}  {key.name}  {'revoked' if key.revoked_us else 'valid'}")
    return 0


def _revoke(session: Session, settings: Settings, arguments: argparse.Namespace) -> int:
    from service.domain.keys import revoke_key

    if revoke_key(session, arguments.key_id):
        return 0
    print(f"mrasfm: error: there is no key {arguments.key_id!r}; 'mrasfm keys list' shows them", file=sys.stderr)
    return 2


_ACTIONS = {"create": _create, "list": _list, "revoke": _revoke}
