"""`mrasfm map`: send several drives to a service, and get one map of them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.command_line import output_folder
from service.commands.client_common import CommandSummary, Conversation, add_command, run_command

if TYPE_CHECKING:
    from schemas.api.aggregations import AggregationRequest
    from schemas.api.jobs import JobResource
    from schemas.api.maps import MapVersionResource
    from service.client import UploadState


@dataclass(kw_only=True)
class Summary(CommandSummary):
    """The object that `--json` prints."""

    drive_ids: list[str] = field(default_factory=list)
    map_id: str | None = None
    version: int | None = None
    failed: list[str] = field(default_factory=list)
    unconnected: list[str] = field(default_factory=list)


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = add_command(
        subparsers,
        "map",
        meaning="send drives to a service and get one map of them",
        description="Send drives to a service, reconstruct those without a scene there, and download one map of all.",
    )
    parser.add_argument("drives", type=Path, nargs="*", metavar="DRIVE", help="folders with drive.json")
    parser.add_argument("--out", type=output_folder, metavar="OUT", help="folder for the map")
    parser.add_argument("--into", metavar="MAP_ID", help="make a new version of this map instead of a new map")
    parser.add_argument(
        "--remove", action="append", default=[], metavar="ID", help="drive or scene that the new version leaves out"
    )
    parser.add_argument("--name", help="name of a new map")
    parser.add_argument(
        "--require-all", action="store_true", help="fail where a drive cannot be reconstructed, or placed in the map"
    )
    parser.add_argument("--no-gnss", action="store_true", help="ignore GNSS in the reconstructions")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Upload, wait and download, and say what there is."""
    summary = Summary()
    return run_command(arguments, summary, lambda conversation: _converse(conversation, summary))


def _converse(conversation: Conversation, summary: Summary) -> int:
    from service.client import DriveFolder, UploadState, start_aggregation

    client, arguments = conversation.client, conversation.arguments
    folders = [DriveFolder.read(path) for path in arguments.drives]
    _asked(arguments, [])  # what cannot be asked for is said before the drives are sent
    states = [UploadState(folder, client.url) for folder in folders]
    conversation.require_free_out(lambda: _known_job(conversation, states))
    with summary.timed("upload"):
        for folder, state in zip(folders, states, strict=True):
            summary.drive_ids.append(conversation.send(folder, state).drive_id)
    asked = _asked(arguments, summary.drive_ids)
    job = start_aggregation(client, asked, state=states[0] if states else None)
    summary.map_id = job.map_id
    conversation.note_job(job)
    job = conversation.wait(job)
    summary.version = job.map_version
    if job.map_id is None or job.map_version is None:
        return conversation.job_failed(job)
    version = client.map_version(job.map_id, job.map_version)
    _say(version, conversation)
    summary.unconnected, summary.failed = list(version.unconnected), [drive.drive_id for drive in version.failed]
    conversation.download(version)
    return 0


def _known_job(conversation: Conversation, states: Sequence[UploadState]) -> JobResource | None:
    """Job of the same command before, where it may be used again."""
    from service.client.upload import known_job

    drive_ids = [state.record.drive_id for state in states if state.record.drive_id is not None]
    if not states or len(drive_ids) < len(states):
        return None
    return known_job(conversation.client, _asked(conversation.arguments, drive_ids), state=states[0])


def _asked(arguments: argparse.Namespace, drive_ids: list[str]) -> AggregationRequest:
    from pydantic import ValidationError

    from schemas.api.aggregations import AggregationRequest
    from schemas.api.jobs import ReconstructionSettings
    from service.client import ClientError

    try:
        return AggregationRequest(
            drives=drive_ids,
            map_id=arguments.into,
            remove=arguments.remove,
            name=arguments.name,
            settings=ReconstructionSettings(use_gnss=not arguments.no_gnss),
            require_all=arguments.require_all,
        )
    except ValidationError as error:
        first = error.errors()[0]
        option = {"map_id": "into"}.get(str(first["loc"][0]), first["loc"][0])
        raise ClientError(f"--{option} is {first['input']!r}: {first['msg']}. Correct it.") from None


def _say(version: MapVersionResource, conversation: Conversation) -> None:
    url = f"{conversation.client.url}/v1/maps/{version.map_id}"
    conversation.say(f"map {version.map_id}, version {version.number}: {url}")
    conversation.say(f"  {version.summary.connected} of {version.summary.scenes} scenes are connected")
    for name in version.unconnected:
        conversation.say(f"  warning: no seam joins {name} to another scene; it lies where its GNSS puts it")
    for drive in version.failed:
        conversation.say(f"  warning: {drive.name} ({drive.drive_id}) is not in it: {drive.problem.detail}")
