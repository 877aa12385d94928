"""Common part of the commands that talk to a service: the key, the errors, and their messages."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from schemas.api.jobs import JobResource
    from schemas.api.problems import Problem
    from schemas.api.resource import Finding
    from service.client import Client
    from service.client.display import Display

KEY_VARIABLE = "MRASFM_API_KEY"
EXIT_REFUSED, EXIT_JOB_FAILED, EXIT_UNREACHABLE, EXIT_INTERRUPTED = 2, 3, 4, 130
_SHOWN_ITEMS = 20

EPILOG = f"""\
The API key is read from {KEY_VARIABLE} or --key-file. An interrupted upload goes on with the same command.

exit codes: 0 done; 2 the input is at fault or the service refuses it; 3 the job failed or was cancelled; 4 the service
cannot be reached; 130 interrupted"""


class CommandSummary(Protocol):
    """The part of a command's summary that says what went wrong."""

    error: str | None
    problem: dict[str, Any] | None


def add_connection(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that say which service, and how to talk to it."""
    parser.add_argument("--url", required=True, help="URL of the service, for example http://127.0.0.1:8000")
    parser.add_argument("--key-file", type=Path, metavar="FILE", help="file that holds the API key and nothing else")
    parser.add_argument("--parallel", type=_count, default=4, metavar="N", help="files at one time (default: 4)")
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end")


def connect(arguments: argparse.Namespace, display: Display) -> Client:
    """The service, with a warning where anybody can listen."""
    from service.client import Client

    client = Client(arguments.url, _key(arguments.key_file), connections=arguments.parallel + 1)
    _warn_of_plain_http(client.url, display)
    return client


def talk(converse: Callable[[Display], int], summary: CommandSummary, *, job_of: Callable[[], str | None]) -> int:
    """Run a conversation, and say what went wrong in it; the exit code."""
    from service.client import ApiError, ClientError, UnreachableError
    from service.client.display import Display

    with Display() as display:
        try:
            return converse(display)
        except UnreachableError as error:
            return failed(summary, display, str(error), EXIT_UNREACHABLE)
        except ApiError as error:
            summary.problem = error.problem.model_dump(mode="json", exclude_defaults=True)
            lines = "\n".join([str(error), *items_of(error.problem)])
            return failed(summary, display, lines, EXIT_UNREACHABLE if _is_trouble(error.status) else EXIT_REFUSED)
        except (ClientError, OSError) as error:
            return failed(summary, display, str(error), EXIT_REFUSED)
        except KeyboardInterrupt:
            more = f" Job {job_of()} goes on." if job_of() else ""
            return failed(summary, display, f"interrupted.{more} The same command goes on from here.", EXIT_INTERRUPTED)


def job_failed(job: JobResource, summary: CommandSummary, display: Display) -> int:
    """Say how a job ended that has no result, and give the exit code back."""
    if job.problem is None:
        text = f"job {job.id} was {job.state}. Give the same command again for another job."
        return failed(summary, display, text, EXIT_JOB_FAILED)
    summary.problem = job.problem.model_dump(mode="json", exclude_defaults=True)
    lines = [f"job {job.id} {job.state}: {job.problem.detail.rstrip('.')}. {job.problem.remedy}"]
    return failed(summary, display, "\n".join([*lines, *items_of(job.problem)]), EXIT_JOB_FAILED)


def items_of(problem: Problem) -> list[str]:
    """The particulars of a problem, a line each."""
    lines = [f"  {item.field}: {item.detail}" if item.field else f"  {item.detail}" for item in problem.errors]
    lines = _shortened([*lines, *_lines_of_findings(problem.findings)])
    if problem.log_tail:
        lines += ["  the last lines of its log:", *(f"    {line}" for line in problem.log_tail.splitlines())]
    return lines


def lines_of(findings: Sequence[Finding]) -> list[str]:
    """Findings, a line each; of many, the first and how many more there are."""
    return _shortened(_lines_of_findings(findings))


def _lines_of_findings(findings: Sequence[Finding]) -> list[str]:
    return [f"  {finding.severity}: {finding.what}. {finding.remedy}" for finding in findings]


def _shortened(lines: list[str]) -> list[str]:
    if len(lines) <= _SHOWN_ITEMS:
        return lines
    return [*lines[:_SHOWN_ITEMS], f"  and {len(lines) - _SHOWN_ITEMS} more"]


def failed(summary: CommandSummary, display: Display, text: str, code: int) -> int:
    """Say why, and give the exit code back."""
    summary.error = text.splitlines()[0]
    display.say(f"mrasfm: error: {text}" if code != EXIT_INTERRUPTED else f"mrasfm: {text}")
    return code


def _is_trouble(status: int) -> bool:
    """Return whether the service could not answer, rather than refused. A full disk (507) is its answer.

    After many tries, requests that arrive too slowly (408) are a network that does not carry them.
    """
    return status == 408 or (status >= 500 and status != 507)


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
