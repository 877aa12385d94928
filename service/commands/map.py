"""`mrasfm map`: send several drives to a service, and get one map of them."""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.commands.client_common import EPILOG, add_connection, connect, job_failed, talk

if TYPE_CHECKING:
    from schemas.api.aggregations import AggregationRequest
    from schemas.api.jobs import JobResource
    from schemas.api.maps import MapVersionResource
    from service.client import Client, DriveFolder
    from service.client.display import Display


@dataclass
class Summary:
    """Document of `--json`, filled as it becomes known."""

    drive_ids: list[str] = field(default_factory=list)
    job_id: str | None = None
    job_state: str | None = None
    map_id: str | None = None
    version: int | None = None
    failed: list[str] = field(default_factory=list)
    unconnected: list[str] = field(default_factory=list)
    out: str | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    error: str | None = None
    problem: dict[str, Any] | None = None


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "map",
        help="send drives to a service and get one map of them",
        description="Send drives to a service, reconstruct those without a scene there, and download one map of all.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # --key SECRET must not pass for --key-file
    )
    parser.add_argument("drives", type=Path, nargs="*", metavar="DRIVE", help="folders with drive.json")
    add_connection(parser)
    parser.add_argument("--out", type=Path, metavar="OUT", help="folder for the map")
    parser.add_argument("--into", metavar="MAP_ID", help="make a new version of this map instead of a new map")
    parser.add_argument(
        "--remove", action="append", default=[], metavar="ID", help="drive or scene that the new version leaves out"
    )
    parser.add_argument("--name", help="name of a new map")
    parser.add_argument("--require-all", action="store_true", help="fail where a drive cannot be reconstructed")
    parser.add_argument("--no-gnss", action="store_true", help="ignore GNSS in the reconstructions")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Upload, wait and download, and say what there is."""
    summary = Summary()
    code = talk(lambda display: _converse(arguments, summary, display), summary, job_of=lambda: summary.job_id)
    if arguments.json:
        print(json.dumps(asdict(summary)))
    return code


def _converse(arguments: argparse.Namespace, summary: Summary, display: Display) -> int:
    from service.client import DriveFolder
    from service.client.download import require_free

    folders = [DriveFolder.read(path) for path in arguments.drives]
    _asked(arguments, [])  # what cannot be asked for is said before the drives are sent
    if arguments.out is not None:
        require_free(arguments.out, None)
    with connect(arguments, display) as client:
        job = _ask(client, folders, arguments, summary, display)
        return _receive(client, job, arguments, summary, display)


def _ask(
    client: Client, folders: list[DriveFolder], arguments: argparse.Namespace, summary: Summary, display: Display
) -> JobResource:
    from service.client import UploadState, start_aggregation, upload_drive

    began_s = time.monotonic()
    states = [UploadState(folder, client.url) for folder in folders]
    for folder, state in zip(folders, states, strict=True):
        sent = upload_drive(client, folder, state=state, parallel=arguments.parallel, report=display.report)
        summary.drive_ids.append(sent.drive_id)
        display.say(f"drive {sent.drive_id}: {sent.files_sent} files sent, {sent.files_skipped} were there")
    summary.seconds["upload"] = round(time.monotonic() - began_s, 3)
    asked = _asked(arguments, summary.drive_ids)
    job = start_aggregation(client, asked, state=states[0] if states else None)
    summary.job_id, summary.job_state, summary.map_id = job.id, job.state, job.map_id
    display.say(f"job {job.id}: {client.url}/v1/jobs/{job.id}")
    return job


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


def _receive(
    client: Client, job: JobResource, arguments: argparse.Namespace, summary: Summary, display: Display
) -> int:
    from service.client import download_map, watch_job

    began_s = time.monotonic()
    job = watch_job(client, job.id, tell=display.tell)
    summary.job_state, summary.version = job.state, job.map_version
    summary.seconds["wait"] = round(time.monotonic() - began_s, 3)
    if job.map_id is None or job.map_version is None:
        return job_failed(job, summary, display)
    version = client.map_version(job.map_id, job.map_version)
    _say(version, client, summary, display)
    if arguments.out is not None:
        done = download_map(client, version, arguments.out, parallel=arguments.parallel, report=display.report)
        summary.out = str(arguments.out)
        display.say(f"{arguments.out}: {done.files_received} files received, {done.files_skipped} were there")
    return 0


def _say(version: MapVersionResource, client: Client, summary: Summary, display: Display) -> None:
    display.say(f"map {version.map_id}, version {version.number}: {client.url}/v1/maps/{version.map_id}")
    display.say(f"  {version.summary.connected} of {version.summary.scenes} scenes are connected")
    for name in version.unconnected:
        display.say(f"  warning: {name} overlaps no other, and lies where its GNSS puts it")
    for drive in version.failed:
        display.say(f"  warning: {drive.name} ({drive.drive_id}) is not in it: {drive.problem.detail}")
    summary.unconnected, summary.failed = list(version.unconnected), [drive.drive_id for drive in version.failed]
