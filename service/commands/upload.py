"""`mrasfm upload`: send a drive to a service, and get its scene."""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from schemas.api.jobs import JobResource
    from schemas.api.problems import Problem
    from service.client import Client, DriveFolder
    from service.client.display import Display

KEY_VARIABLE = "MRASFM_API_KEY"
EXIT_REFUSED, EXIT_JOB_FAILED, EXIT_UNREACHABLE, EXIT_INTERRUPTED = 2, 3, 4, 130
_SHOWN_ITEMS = 20

_EPILOG = f"""\
The API key is read from {KEY_VARIABLE} or --key-file. An interrupted upload goes on with the same command.

exit codes: 0 done; 2 the input is at fault or the service refuses it; 3 the job failed or was cancelled; 4 the service
cannot be reached; 130 interrupted"""


@dataclass
class Summary:
    """What `--json` prints, filled as it becomes known."""

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


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "upload",
        help="send a drive to a service and get its scene",
        description="Send a drive to a service, ask for its scene, and with --wait or --out get it.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # --key SECRET must not pass for --key-file
    )
    parser.add_argument("drive", type=Path, metavar="DRIVE", help="folder with drive.json")
    parser.add_argument("--url", required=True, help="of the service, for example http://127.0.0.1:8000")
    parser.add_argument("--key-file", type=Path, metavar="FILE", help="file that holds the API key and nothing else")
    parser.add_argument("--wait", action="store_true", help="wait until the scene is there")
    parser.add_argument("--out", type=Path, metavar="OUT", help="folder for the scene; waits for it")
    parser.add_argument("--no-gnss", action="store_true", help="ignore GNSS everywhere")
    parser.add_argument("--parallel", type=_count, default=4, metavar="N", help="files at one time (default: 4)")
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Upload, wait and download as asked, and say what there is."""
    from service.client import ApiError, ClientError, UnreachableError
    from service.client.display import Display

    summary = Summary()
    code = 0
    with Display() as display:
        try:
            code = _converse(arguments, summary, display)
        except UnreachableError as error:
            code = _failed(summary, display, str(error), EXIT_UNREACHABLE)
        except ApiError as error:
            summary.problem = error.problem.model_dump(mode="json", exclude_defaults=True)
            lines = "\n".join([str(error), *_items(error.problem)])
            code = _failed(summary, display, lines, EXIT_UNREACHABLE if _is_trouble(error.status) else EXIT_REFUSED)
        except (ClientError, OSError) as error:
            code = _failed(summary, display, str(error), EXIT_REFUSED)
        except KeyboardInterrupt:
            more = f" Job {summary.job_id} goes on." if summary.job_id else ""
            code = _failed(
                summary, display, f"interrupted.{more} The same command goes on from here.", EXIT_INTERRUPTED
            )
    if arguments.json:
        print(json.dumps(asdict(summary)))
    return code


def _converse(arguments: argparse.Namespace, summary: Summary, display: Display) -> int:
    from service.client import Client, DriveFolder
    from service.client.download import require_free

    key = _key(arguments.key_file)
    folder = DriveFolder.read(arguments.drive)
    if arguments.out is not None:
        require_free(arguments.out, None)  # now, not after an hour of waiting
    with Client(arguments.url, key, connections=arguments.parallel + 1) as client:
        _warn_of_plain_http(client.url, display)
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
    from service.client import download_scene, follow

    began_s = time.monotonic()
    job = follow(client, job.id, tell=display.tell)
    summary.job_state, summary.scene_id = job.state, job.scene_id
    summary.seconds["wait"] = round(time.monotonic() - began_s, 3)
    if job.state != JobState.SUCCEEDED or job.scene_id is None:
        return _job_failed(job, summary, display)
    display.say(f"scene {job.scene_id}: {client.url}/v1/scenes/{job.scene_id}")
    if arguments.out is not None:
        began_s = time.monotonic()
        done = download_scene(client, job.scene_id, arguments.out, parallel=arguments.parallel, report=display.report)
        summary.seconds["download"] = round(time.monotonic() - began_s, 3)
        summary.out = str(arguments.out)
        display.say(f"{arguments.out}: {done.files_received} files received, {done.files_skipped} were there")
    return 0


def _job_failed(job: JobResource, summary: Summary, display: Display) -> int:
    if job.problem is None:
        text = f"job {job.id} was {job.state}. Give the same command again for another job."
        return _failed(summary, display, text, EXIT_JOB_FAILED)
    summary.problem = job.problem.model_dump(mode="json", exclude_defaults=True)
    lines = [f"job {job.id} {job.state}: {job.problem.detail.rstrip('.')}. {job.problem.remedy}", *_items(job.problem)]
    return _failed(summary, display, "\n".join(lines), EXIT_JOB_FAILED)


def _items(problem: Problem) -> list[str]:
    """The particulars of a problem, a line each."""
    lines = [f"  {item.field}: {item.detail}" if item.field else f"  {item.detail}" for item in problem.errors]
    lines += [_finding(finding) for finding in problem.findings]
    if len(lines) > _SHOWN_ITEMS:
        lines[_SHOWN_ITEMS:] = [f"  and {len(lines) - _SHOWN_ITEMS} more"]
    if problem.log_tail:
        lines += ["  the last lines of its log:", *(f"    {line}" for line in problem.log_tail.splitlines())]
    return lines


def _finding(finding: Mapping[str, Any]) -> str:
    return f"  {finding.get('severity', 'finding')}: {finding.get('what', '')}. {finding.get('remedy', '')}".rstrip()


def _failed(summary: Summary, display: Display, text: str, code: int) -> int:
    summary.error = text.splitlines()[0]
    display.say(f"mrasfm: error: {text}" if code != EXIT_INTERRUPTED else f"mrasfm: {text}")
    return code


def _is_trouble(status: int) -> bool:
    """Whether the service could not answer, rather than did not want to. A full disk (507) is its answer."""
    return status >= 500 and status != 507


def _key(key_file: Path | None) -> str:
    from service.client import ClientError

    if key_file is None:
        key = os.environ.get(KEY_VARIABLE, "")
        if not key:
            raise ClientError(f"there is no API key. Set {KEY_VARIABLE}, or give --key-file.")
        return key
    try:
        return key_file.read_text("ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise ClientError(f"the key file {key_file} cannot be read: {error}. Give a file that holds the key.") from None


def _warn_of_plain_http(url: str, display: Display) -> None:
    from service.client.transport import is_loopback

    parts = urlsplit(url)
    if parts.scheme == "http" and not is_loopback(parts.hostname or ""):
        display.say(f"mrasfm: warning: {url} is not encrypted: key and drive can be read on the way. Use https.")


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 64:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to 64")
    return int(text)
