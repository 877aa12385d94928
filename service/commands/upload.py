"""`mrasfm upload`: send a drive to a service, and get its scene."""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.commands.client_common import EPILOG, add_connection, connect, job_failed, lines_of, talk

if TYPE_CHECKING:
    from schemas.api.jobs import JobResource
    from service.client import Client, DriveFolder
    from service.client.display import Display


@dataclass
class Summary:
    """Document of `--json`, filled as it becomes known."""

    drive_id: str | None = None
    job_id: str | None = None
    job_state: str | None = None
    scene_id: str | None = None
    out: str | None = None
    bytes_sent: int = 0
    files_sent: int = 0
    files_skipped: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    error: str | None = None
    problem: dict[str, Any] | None = None
    findings: list[dict[str, Any]] = field(default_factory=list)  # of the scene's report


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "upload",
        help="send a drive to a service and get its scene",
        description="Send a drive to a service and reconstruct it; --wait waits for the scene, --out downloads it.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # --key SECRET must not pass for --key-file
    )
    parser.add_argument("drive", type=Path, metavar="DRIVE", help="folder with drive.json")
    add_connection(parser)
    parser.add_argument("--wait", action="store_true", help="wait until the scene is there")
    parser.add_argument("--out", type=Path, metavar="OUT", help="folder for the scene; waits for it")
    parser.add_argument("--no-gnss", action="store_true", help="ignore GNSS everywhere")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Upload, wait and download as asked, and say what there is."""
    summary = Summary()
    code = talk(lambda display: _converse(arguments, summary, display), summary, job_of=lambda: summary.job_id)
    if arguments.json:
        print(json.dumps(asdict(summary)))
    return code


def _converse(arguments: argparse.Namespace, summary: Summary, display: Display) -> int:
    from service.client import DriveFolder
    from service.client.download import require_free

    folder = DriveFolder.read(arguments.drive)
    if arguments.out is not None:
        require_free(arguments.out, None)  # now, not after an hour of waiting
    with connect(arguments, display) as client:
        job = _send(client, folder, arguments, summary, display)
        _say_where(client, summary, display)
        if not arguments.wait and arguments.out is None:
            return 0
        return _receive(client, job, arguments, summary, display)


def _send(
    client: Client, folder: DriveFolder, arguments: argparse.Namespace, summary: Summary, display: Display
) -> JobResource:
    from schemas.api.jobs import ReconstructionSettings
    from service.client import UploadState, start_reconstruction, upload_drive

    state = UploadState(folder, client.url)
    sent = upload_drive(client, folder, state=state, parallel=arguments.parallel, report=display.report)
    summary.drive_id, summary.seconds = sent.drive_id, dict(sent.seconds)
    summary.bytes_sent, summary.files_sent, summary.files_skipped = sent.bytes_sent, sent.files_sent, sent.files_skipped
    settings = ReconstructionSettings(use_gnss=not arguments.no_gnss)
    job = start_reconstruction(client, sent.drive_id, settings, state=state)
    summary.job_id, summary.job_state, summary.scene_id = job.id, job.state, job.scene_id
    return job


def _say_where(client: Client, summary: Summary, display: Display) -> None:
    display.say(
        f"drive {summary.drive_id}: {summary.files_sent} files sent ({summary.bytes_sent / 1e6:.1f} MB), "
        f"{summary.files_skipped} were there"
    )
    display.say(f"job {summary.job_id}: {client.url}/v1/jobs/{summary.job_id}")


def _receive(
    client: Client, job: JobResource, arguments: argparse.Namespace, summary: Summary, display: Display
) -> int:
    from schemas.api.jobs import JobState
    from service.client import download_scene, scene_findings, watch_job

    began_s = time.monotonic()
    job = watch_job(client, job.id, tell=display.tell)
    summary.job_state, summary.scene_id = job.state, job.scene_id
    summary.seconds["wait"] = round(time.monotonic() - began_s, 3)
    if job.state != JobState.SUCCEEDED or job.scene_id is None:
        return job_failed(job, summary, display)
    display.say(f"scene {job.scene_id}: {client.url}/v1/scenes/{job.scene_id}")
    findings = scene_findings(client, job.scene_id)
    summary.findings = [finding.model_dump(mode="json") for finding in findings]
    for line in lines_of(findings):
        display.say(line)
    if arguments.out is not None:
        began_s = time.monotonic()
        done = download_scene(client, job.scene_id, arguments.out, parallel=arguments.parallel, report=display.report)
        summary.seconds["download"] = round(time.monotonic() - began_s, 3)
        summary.out = str(arguments.out)
        display.say(f"{arguments.out}: {done.files_received} files received, {done.files_skipped} were there")
    return 0
