"""The common part of commands that talk to a service: key, waiting, download, and messages about what went wrong."""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from schemas.api.jobs import JobResource
    from schemas.api.problems import Problem
    from schemas.api.resource import Finding
    from service.client import Client, DriveFolder, Result, Sent, UploadState
    from service.client.display import Display

KEY_VARIABLE, URL_VARIABLE = "MRASFM_API_KEY", "MRASFM_URL"
EXIT_REFUSED, EXIT_JOB_FAILED, EXIT_UNREACHABLE, EXIT_INTERRUPTED = 2, 3, 4, 130
_SHOWN_ITEMS = 20
_EPILOG = f"""\
The API key is read from {KEY_VARIABLE} or --key-file. An interrupted upload goes on with the same command.

exit codes: 0 done; 2 the input is at fault or the service refuses it; 3 the job failed or was cancelled; 4 the service
cannot be reached; 130 interrupted"""


@dataclass(kw_only=True)
class CommandSummary:
    """The object that `--json` prints, filled as it becomes known."""

    job_id: str | None = None
    job_state: str | None = None
    out: str | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    error: str | None = None
    problem: dict[str, Any] | None = None

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Note the duration of the block."""
        began_s = time.monotonic()
        yield
        self.seconds[part] = round(time.monotonic() - began_s, 3)


@dataclass(frozen=True)
class Conversation:
    """One command's use of a service."""

    client: Client
    arguments: argparse.Namespace
    summary: CommandSummary
    display: Display

    def say(self, line: str) -> None:
        """Show a line that stays."""
        self.display.say(line)

    def send(self, folder: DriveFolder, state: UploadState) -> Sent:
        """Bring a drive to the service."""
        from service.client import upload_drive

        parallel = self.arguments.parallel
        sent = upload_drive(self.client, folder, state=state, parallel=parallel, report=self.display.report)
        megabytes = f"{sent.bytes_sent / 1e6:.1f} MB"
        self.say(f"drive {sent.drive_id}: {sent.files_sent} files sent ({megabytes}), {sent.files_skipped} were there")
        return sent

    def note_job(self, job: JobResource) -> None:
        """Say where the job is that was asked for."""
        self.summary.job_id, self.summary.job_state = job.id, job.state
        self.say(f"job {job.id}: {self.client.url}/v1/jobs/{job.id}")

    def require_free_out(self, known_job: Callable[[], JobResource | None]) -> None:
        """Refuse a folder of `--out` that holds another result than the one to come, as `require_free_for_job`.

        Raises
        ------
        SceneFolderError
        """
        from service.client.download import require_free_for_job

        if self.arguments.out is not None:
            require_free_for_job(self.arguments.out, known_job)

    def wait(self, job: JobResource) -> JobResource:
        """Wait for the job's end."""
        from service.client import watch_job

        with self.summary.timed("wait"):
            job = watch_job(self.client, job.id, tell=self.display.tell)
        self.summary.job_state = job.state
        return job

    def download(self, result: Result) -> None:
        """Bring a result into the folder that `--out` names, if it names one."""
        from service.client import download

        out: Path | None = self.arguments.out
        if out is None:
            return
        with self.summary.timed("download"):
            done = download(self.client, result, out, parallel=self.arguments.parallel, report=self.display.report)
        self.summary.out = str(out)
        self.say(f"{out}: {done.files_received} files received, {done.files_skipped} were there")

    def job_failed(self, job: JobResource) -> int:
        """Say how a job ended that has no result; the exit code."""
        if job.problem is None:
            text = f"job {job.id} was {job.state}. Give the same command again for another job."
        else:
            self.summary.problem = job.problem.model_dump(mode="json", exclude_defaults=True)
            first = f"job {job.id} {job.state}: {job.problem.detail.rstrip('.')}. {job.problem.remedy}"
            text = "\n".join([first, *_items_of(job.problem)])
        return _failed(self.summary, self.display, text, EXIT_JOB_FAILED)


def add_command(
    subparsers: argparse._SubParsersAction[argparse.ArgumentParser], name: str, *, meaning: str, description: str
) -> argparse.ArgumentParser:
    """Add a subcommand, with the arguments that say which service, and how to talk to it."""
    parser = subparsers.add_parser(
        name,
        help=meaning,
        description=description,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # --key SECRET must not pass for --key-file
    )
    parser.add_argument(
        "--url", help=f"URL of the service, for example http://127.0.0.1:8000; default: that of {URL_VARIABLE}"
    )
    parser.add_argument("--key-file", type=Path, metavar="FILE", help="file that holds the API key and nothing else")
    parser.add_argument("--parallel", type=_count, default=4, metavar="N", help="files at one time (default: 4)")
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end")
    return parser


def run_command(arguments: argparse.Namespace, summary: CommandSummary, converse: Callable[[Conversation], int]) -> int:
    """Run a conversation, say what went wrong in it, and print the summary where that is asked for; the exit code."""
    from service.client.display import Display

    with Display() as display:
        code = _conversed(arguments, summary, converse, display)
    if arguments.json:
        print(json.dumps(asdict(summary)))
    return code


def _conversed(
    arguments: argparse.Namespace, summary: CommandSummary, converse: Callable[[Conversation], int], display: Display
) -> int:
    from service.client import ApiError, Client, ClientError, UnreachableError
    from service.client.download import require_free
    from service.errors import Unauthorized

    try:
        if arguments.out is not None:
            require_free(arguments.out, None)  # now, not after an hour of waiting
        with Client(_url(arguments.url), _key(arguments.key_file), connections=arguments.parallel + 1) as client:
            _warn_of_plain_http(client.url, display)
            return converse(Conversation(client, arguments, summary, display))
    except UnreachableError as error:
        return _failed(summary, display, str(error), EXIT_UNREACHABLE)
    except ApiError as error:
        summary.problem = error.problem.model_dump(mode="json", exclude_defaults=True)
        if error.code == Unauthorized.code:
            told = f"{error.problem.detail.rstrip('.')}. {_remedy_of_key(arguments.key_file)}"
        else:
            told = str(error)
        lines = "\n".join([told, *_items_of(error.problem)])
        return _failed(summary, display, lines, EXIT_UNREACHABLE if _is_trouble(error.status) else EXIT_REFUSED)
    except BrokenPipeError:  # of what is printed: the program's
        raise
    except (ClientError, OSError) as error:
        return _failed(summary, display, str(error), EXIT_REFUSED)
    except KeyboardInterrupt:
        more = f" Job {summary.job_id} goes on." if summary.job_id else ""
        return _failed(summary, display, f"interrupted.{more} The same command goes on from here.", EXIT_INTERRUPTED)


def lines_of(findings: Sequence[Finding]) -> list[str]:
    """Findings, a line each; of many, the first and how many more there are."""
    return _shortened(_lines_of_findings(findings))


def _items_of(problem: Problem) -> list[str]:
    """Particulars of a problem, a line each."""
    lines = [f"  {item.field}: {item.detail}" if item.field else f"  {item.detail}" for item in problem.errors]
    lines = _shortened([*lines, *_lines_of_findings(problem.findings)])
    if problem.log_tail:
        lines += ["  the last lines of its log:", *(f"    {line}" for line in problem.log_tail.splitlines())]
    return lines


def _lines_of_findings(findings: Sequence[Finding]) -> list[str]:
    return [f"  {finding.severity}: {finding.what}. {finding.remedy}" for finding in findings]


def _shortened(lines: list[str]) -> list[str]:
    if len(lines) <= _SHOWN_ITEMS:
        return lines
    return [*lines[:_SHOWN_ITEMS], f"  and {len(lines) - _SHOWN_ITEMS} more"]


def _failed(summary: CommandSummary, display: Display, text: str, code: int) -> int:
    """Say why, and give the exit code back."""
    summary.error = text.splitlines()[0]
    display.say(f"mrasfm: error: {text}" if code != EXIT_INTERRUPTED else f"mrasfm: {text}")
    return code


def _is_trouble(status: int) -> bool:
    """Return whether the service could not answer, rather than refused. A full disk (507) is its answer.

    After many tries, requests that arrive too slowly (408) are a network that does not carry them.
    """
    return status == 408 or (status >= 500 and status != 507)


def _url(given: str | None) -> str:
    from service.client import ClientError

    url = given or os.environ.get(URL_VARIABLE, "")
    if not url:
        raise ClientError(f"there is no URL of a service. Give --url, or set {URL_VARIABLE}.")
    return url


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


def _remedy_of_key(key_file: Path | None) -> str:
    """Advice on a key that the service does not take: its own is for who writes requests."""
    if key_file is None:
        where = f"The key is that of {KEY_VARIABLE}: correct it, or give --key-file."
    else:
        where = f"The key is that of --key-file {key_file}: correct it, or set {KEY_VARIABLE} and leave --key-file out."
    return f"{where} The operator of the service makes keys with 'mrasfm keys create'."


def _warn_of_plain_http(url: str, display: Display) -> None:
    from service.client.transport import is_loopback

    parts = urlsplit(url)
    if parts.scheme == "http" and not is_loopback(parts.hostname or ""):
        display.say(f"mrasfm: warning: {url} is not encrypted: key and drive can be read on the way. Use https.")


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 64:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to 64")
    return int(text)
