"""`mrasfm upload`: send a drive to a service, and get its scene."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from schemas.command_line import output_folder
from service.commands.client_common import CommandSummary, Conversation, add_command, lines_of, run_command


@dataclass(kw_only=True)
class Summary(CommandSummary):
    """The object that `--json` prints."""

    drive_id: str | None = None
    scene_id: str | None = None
    bytes_sent: int = 0
    files_sent: int = 0
    files_skipped: int = 0
    findings: list[dict[str, Any]] = field(default_factory=list)  # of the scene's report


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = add_command(
        subparsers,
        "upload",
        meaning="send a drive to a service and get its scene",
        description="Send a drive to a service and reconstruct it; --wait waits for the scene, --out downloads it.",
    )
    parser.add_argument("drive", type=Path, metavar="DRIVE", help="folder with drive.json")
    parser.add_argument("--wait", action="store_true", help="wait until the scene is there")
    parser.add_argument("--out", type=output_folder, metavar="OUT", help="folder for the scene; waits for it")
    parser.add_argument("--no-gnss", action="store_true", help="ignore GNSS everywhere")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Upload, wait and download as asked, and say what there is."""
    summary = Summary()
    return run_command(arguments, summary, lambda conversation: _converse(conversation, summary))


def _converse(conversation: Conversation, summary: Summary) -> int:
    from schemas.api.jobs import JobState, ReconstructionSettings
    from service.client import DriveFolder, UploadState, scene_findings, start_reconstruction
    from service.client.upload import known_job

    client, arguments = conversation.client, conversation.arguments
    folder = DriveFolder.read(arguments.drive)
    state = UploadState(folder, client.url)
    settings = ReconstructionSettings(use_gnss=not arguments.no_gnss)
    conversation.require_free_out(lambda: known_job(client, settings, state=state))
    sent = conversation.send(folder, state)
    summary.drive_id, summary.bytes_sent = sent.drive_id, sent.bytes_sent
    summary.files_sent, summary.files_skipped = sent.files_sent, sent.files_skipped
    summary.seconds.update(sent.seconds)
    job = start_reconstruction(client, sent.drive_id, settings, state=state)
    summary.scene_id = job.scene_id
    conversation.note_job(job)
    if not arguments.wait and arguments.out is None:
        return 0
    job = conversation.wait(job)
    summary.scene_id = job.scene_id
    if job.state != JobState.SUCCEEDED or job.scene_id is None:
        return conversation.job_failed(job)
    conversation.say(f"scene {job.scene_id}: {client.url}/v1/scenes/{job.scene_id}")
    scene = client.scene(job.scene_id)
    findings = scene_findings(client, scene)
    summary.findings = [finding.model_dump(mode="json") for finding in findings]
    for line in lines_of(findings):
        conversation.say(line)
    conversation.download(scene)
    return 0
