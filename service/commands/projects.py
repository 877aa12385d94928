"""`mrasfm projects`: list projects, and change their quotas."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter, ValidationError

from service.commands.administration import add_options, administer
from service.settings import Bytes, Count, Settings

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

_QUOTAS = {
    "max_bytes": (Bytes, "bytes that the project stores"),
    "max_active_jobs": (Count, "jobs that are queued or running at one time"),
    "max_drives": (Count, "drives at one time"),
}


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "projects", help="list projects and change their quotas", description="List projects and change their quotas."
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    listing = actions.add_parser("list", help="list projects with what they use of their quotas")
    change = actions.add_parser("set", help="change quotas of a project; what it has already stays")
    change.add_argument("name", metavar="NAME", help="name of the project")
    for quota, (kind, what) in _QUOTAS.items():
        change.add_argument(_option(quota), type=_number(kind), metavar="N", help=what)
    add_options(parser, (listing, change))
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Do what is asked. A running service goes by it from its next request on."""
    return administer(_ACTIONS[arguments.action], arguments, only_reads=arguments.action == "list")


def _list(session: Session, settings: Settings, arguments: argparse.Namespace) -> int:
    from sqlalchemy import select

    from service.database.tables import Project

    projects = session.scalars(select(Project).order_by(Project.name)).all()
    if arguments.json:
        names = ("name", "used_bytes", *_QUOTAS)
        print(json.dumps([{name: getattr(project, name) for name in names} for project in projects]))
        return 0
    for project in projects:
        print(
            f"{project.name}  {project.used_bytes} of {project.max_bytes} bytes  "
            f"at most {project.max_active_jobs} active jobs, {project.max_drives} drives"
        )
    return 0


def _set(session: Session, settings: Settings, arguments: argparse.Namespace) -> int:
    from service.domain.keys import find_project

    quotas = {quota: value for quota in _QUOTAS if (value := getattr(arguments, quota)) is not None}
    if not quotas:
        options = ", ".join(_option(quota) for quota in _QUOTAS)
        print(f"mrasfm: error: there is nothing to set; give one of {options}", file=sys.stderr)
        return 2
    project = find_project(session, arguments.name)
    if project is None:
        print(
            f"mrasfm: error: there is no project {arguments.name!r}; 'mrasfm projects list' shows them",
            file=sys.stderr,
        )
        return 2
    for quota, value in quotas.items():
        setattr(project, quota, value)
    return 0


def _option(quota: str) -> str:
    return f"--{quota.replace('_', '-')}"


def _number(kind: Any) -> Callable[[str], int]:
    """Within the bounds of the setting that new projects begin with."""

    def parse(text: str) -> int:
        try:
            return int(TypeAdapter(kind).validate_strings(text))
        except ValidationError as error:
            raise argparse.ArgumentTypeError(f"{text!r}: {error.errors()[0]['msg']}") from None

    return parse


_ACTIONS = {"list": _list, "set": _set}
