"""Commands of `mrasfm-client` for what a service holds: list, show, delete, jobs, download, export, webhooks."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import islice
from typing import TYPE_CHECKING, Any

from schemas.command_line import output_folder
from schemas.exports import EXPORT_FORMATS
from service.commands.client_common import CommandSummary, Conversation, add_command, run_command

if TYPE_CHECKING:
    from pydantic import BaseModel

    from schemas.api.exports import ExportRequest, ExportResource
    from schemas.api.jobs import JobResource
    from service.client import Client, Result

Converse = Callable[[Conversation, "Summary"], int]
LISTS = ("drives", "jobs", "scenes", "maps", "exports", "webhooks")
MOST_LISTED = 10**9
_KINDS = {"drv": "drive", "job": "job", "scn": "scene", "map": "map", "exp": "export", "whk": "webhook"}
_SHOWN = ("name", "kind", "state", "formats", "url", "event", "created_at")


@dataclass(kw_only=True)
class Summary(CommandSummary):
    """The object that `--json` prints."""

    items: list[dict[str, Any]] = field(default_factory=list)


def register_resources(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommands."""
    parser = _command(subparsers, "list", "list what the project has", _list)
    parser.add_argument("what", choices=LISTS, help="kind of what is listed, newest first")
    _add_limit(parser)
    parser.add_argument("--state", action="append", dest="states", metavar="STATE", help="only jobs in this state, "
                        "such as FAILED; may be repeated")  # fmt: skip
    parser.add_argument("--kind", action="append", dest="kinds", metavar="KIND", help="only jobs of this kind, such as "
                        "RECONSTRUCTION; may be repeated")  # fmt: skip
    parser.add_argument("--preflight", action="append", metavar="STATE", help="only drives whose check has this state, "
                        "such as REJECTED; may be repeated")  # fmt: skip
    parser = _command(subparsers, "show", "show a drive, job, scene, map, export or webhook", _show)
    parser.add_argument("id", metavar="ID", help="id as `list` prints it; of a map also MAP/VERSION")
    parser = _command(subparsers, "delete", "delete a drive, scene, map, export or webhook", _delete)
    parser.add_argument("id", metavar="ID", help="id as `list` prints it; of a map's version MAP/VERSION")
    parser = _command(subparsers, "cancel", "cancel jobs", _cancel)
    parser.add_argument("ids", nargs="+", metavar="JOB", help="id of a job")
    parser = _command(subparsers, "retry", "do jobs again that failed or were cancelled", _retry)
    parser.add_argument("ids", nargs="+", metavar="JOB", help="id of a job")
    parser.add_argument("--wait", action="store_true", help="wait for the end of the new jobs")
    parser = _command(subparsers, "wait", "wait for the end of a job", _wait)
    parser.add_argument("id", metavar="JOB", help="id of the job")
    parser = _command(subparsers, "download", "download a scene, a map or an export", _download, has_out=True)
    parser.add_argument("id", metavar="ID", help="id of a scene or export; of a map MAP or MAP/VERSION")
    parser.add_argument("--out", type=output_folder, required=True, metavar="OUT", help="folder for its files")
    parser = _command(subparsers, "export", "get a scene or map in formats of other programs", _export, has_out=True)
    parser.add_argument("id", metavar="ID", help="id of a scene; of a map MAP or MAP/VERSION")
    parser.add_argument(
        "--format",
        action="append",
        required=True,
        dest="formats",
        metavar="FORMAT",
        choices=list(EXPORT_FORMATS),
        help=f"format, may be repeated: {', '.join(EXPORT_FORMATS)}",
    )
    parser.add_argument("--image-size", type=int, metavar="PX", help="scale images down to this longest side")
    parser.add_argument("--crs", metavar="EPSG:CODE", help="coordinate reference system, for formats that take one")
    parser.add_argument("--component", type=int, metavar="N", help="of a scene: export its components/N in its place")
    parser.add_argument("--out", type=output_folder, metavar="OUT", help="folder for its files; waits for them")
    parser = _command(subparsers, "webhook", "register an address that is told when jobs end", _webhook)
    parser.add_argument("address", metavar="ADDRESS", help="https address that takes POST requests")
    parser.add_argument("--event", action="append", dest="events", metavar="EVENT", help="job.succeeded, job.failed or "
                        "job.cancelled, may be repeated (default: all)")  # fmt: skip
    parser = _command(subparsers, "rotate", "give a webhook another secret", _rotate)
    parser.add_argument("id", metavar="WEBHOOK", help="id of the webhook")
    parser = _command(subparsers, "deliveries", "list the messages to a webhook", _deliveries)
    parser.add_argument("id", metavar="WEBHOOK", help="id of the webhook")
    _add_limit(parser)


def _add_limit(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--limit", type=_limit, default=50, metavar="N", help="how many (default: 50)")


def _limit(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= MOST_LISTED:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {MOST_LISTED}")
    return int(text)


def _command(
    subparsers: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    meaning: str,
    converse: Converse,
    *,
    has_out: bool = False,
) -> argparse.ArgumentParser:
    parser = add_command(subparsers, name, meaning=meaning, description=f"{meaning[:1].upper()}{meaning[1:]}.")

    def run(arguments: argparse.Namespace) -> int:
        summary = Summary()
        return run_command(arguments, summary, lambda conversation: converse(conversation, summary))

    parser.set_defaults(run=run, **({} if has_out else {"out": None}))
    return parser


def _list(conversation: Conversation, summary: Summary) -> int:
    arguments = conversation.arguments
    items: Iterable[BaseModel] = getattr(conversation.client, arguments.what)(**_only(arguments))
    return _print(conversation, summary, items, limit=arguments.limit)


def _only(arguments: argparse.Namespace) -> dict[str, Any]:
    """States and kinds of the jobs that are listed, states of the check of the drives."""
    from schemas.api.drives import PreflightState
    from schemas.api.jobs import JobKind, JobState
    from service.client import ClientError

    filters: tuple[tuple[str, str, str, type[StrEnum]], ...] = (
        ("states", "state", "jobs", JobState),
        ("kinds", "kind", "jobs", JobKind),
        ("preflight", "preflight", "drives", PreflightState),
    )
    only = {}
    for name, option, what, values in filters:
        words = getattr(arguments, name)
        if not words:
            continue
        if arguments.what != what:
            raise ClientError(f"{arguments.what} are not listed by --{option}. Give it with `list {what}`.")
        for word in words:
            if word.upper() not in list(values):
                raise ClientError(f"--{option} is {word!r}. Give one of {', '.join(values)}.")
        only[name] = [word.upper() for word in words]
    return only


def _deliveries(conversation: Conversation, summary: Summary) -> int:
    arguments = conversation.arguments
    return _print(conversation, summary, conversation.client.deliveries(arguments.id), limit=arguments.limit)


def _print(conversation: Conversation, summary: Summary, items: Iterable[BaseModel], *, limit: int) -> int:
    rest = iter(items)
    for item in islice(rest, limit):
        shown = item.model_dump(mode="json")
        summary.items.append(shown)
        if not conversation.arguments.json:
            words = [_word(shown[name]) for name in _SHOWN if shown.get(name) not in (None, "")]
            print("  ".join([shown["id"], *words, *_of_drive(shown), *_of_job(shown)]), flush=True)
    if next(rest, None) is not None:
        conversation.say(f"there are more than these {limit}: --limit lists them")
    return 0


def _word(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def _of_drive(shown: dict[str, Any]) -> list[str]:
    """Result of the check of a drive with the number of its findings; nothing of another resource."""
    from schemas.api.drives import PreflightState

    if "preflight_errors" not in shown or shown["preflight"] == PreflightState.NONE:
        return []
    found = [(shown["preflight_errors"], "error"), (shown["preflight_warnings"], "warning")]
    counts = ", ".join(f"{count} {what}{'' if count == 1 else 's'}" for count, what in found if count)
    match shown["preflight"]:
        case PreflightState.PENDING:
            return [f"check runs: {counts} so far" if counts else "check runs"]
        case PreflightState.UNKNOWN:
            return [f"check failed: {shown['preflight_job_id']}"]
        case state:
            return [f"check {state.lower()}: {counts or 'no finding'}"]


def _of_job(shown: dict[str, Any]) -> list[str]:
    """Stage, drives and problem of a job, what it repeats; nothing of another resource."""
    from schemas.api.problems import PROBLEM_TYPE

    if "progress" not in shown:
        return []
    progress, problem = shown["progress"], shown["problem"]
    words = [member["name"] for member in shown["members"]] or [shown["drive_id"] or shown["map_id"] or ""]
    if shown["state"] in ("RUNNING", "STALLED"):
        words.append(f"{progress['stage'] or ''} {progress['percent']:.0f} %".strip())
    if shown["retry_of"]:
        words.append(f"retry of {shown['retry_of']}")
    if problem:
        words.append(f"{problem['type'].removeprefix(PROBLEM_TYPE)}: {problem['detail']}")
    return [word for word in words if word]


def _show(conversation: Conversation, summary: Summary) -> int:
    return _tell(conversation, summary, _found(conversation.client, conversation.arguments.id))


def _found(client: Client, given: str) -> BaseModel:
    kind, first, version = _kind_of(given)
    if kind == "map" and version:
        return client.map_version(first, version)
    if kind == "webhook":
        found = next((webhook for webhook in client.webhooks() if webhook.id == given), None)
        if found is None:
            raise _unknown(f"there is no webhook {given}")
        return found
    shown: BaseModel = getattr(client, kind)(first)
    return shown


def _kind_of(given: str) -> tuple[str, str, str]:
    """Kind, id, and version of a map where one is given."""
    first, _, version = given.partition("/")
    kind = _KINDS.get(first.partition("_")[0])
    if kind is None or (version and kind != "map"):
        raise _unknown(f"{given!r} is no id")
    return kind, first, version


def _unknown(what: str) -> Exception:
    from service.client import ClientError

    return ClientError(f"{what}. Give one that `list` prints.")


def _tell(conversation: Conversation, summary: Summary, item: BaseModel) -> int:
    summary.items.append(item.model_dump(mode="json"))
    if not conversation.arguments.json:
        print(json.dumps(summary.items[-1], indent=1, ensure_ascii=False))
    return 0


def _delete(conversation: Conversation, summary: Summary) -> int:
    kind, first, version = _kind_of(conversation.arguments.id)
    if kind == "job":
        raise _unknown("jobs are not deleted, but cancelled")
    if version:
        conversation.client.delete_map_version(first, int(version) if version.isdecimal() else 0)
    else:
        getattr(conversation.client, f"delete_{kind}")(first)
    conversation.say(f"{conversation.arguments.id} is deleted")
    return 0


def _cancel(conversation: Conversation, summary: Summary) -> int:
    for job_id in conversation.arguments.ids:
        _note(conversation, summary, conversation.client.cancel_job(job_id))
    return 0


def _retry(conversation: Conversation, summary: Summary) -> int:
    made = []
    for job_id in conversation.arguments.ids:
        made.append(conversation.client.retry_job(job_id))
        _note(conversation, summary, made[-1])  # also where the next one is refused
    return max(_ended(conversation, job.id) for job in made) if conversation.arguments.wait else 0


def _note(conversation: Conversation, summary: Summary, job: JobResource) -> None:
    conversation.note_job(job)
    summary.items.append(job.model_dump(mode="json"))


def _wait(conversation: Conversation, summary: Summary) -> int:
    return _ended(conversation, conversation.arguments.id)


def _ended(conversation: Conversation, job_id: str) -> int:
    from schemas.api.jobs import JobState

    job = conversation.wait(conversation.client.job(job_id))
    return 0 if job.state == JobState.SUCCEEDED else conversation.job_failed(job)


def _download(conversation: Conversation, summary: Summary) -> int:
    conversation.download(_result(conversation.client, conversation.arguments.id))
    return 0


def _result(client: Client, given: str) -> Result:
    kind, first, version = _kind_of(given)
    match kind:
        case "scene":
            return client.scene(first)
        case "export":
            return client.export(first)
        case "map":
            return client.map_version(first, version or "current")
    raise _unknown(f"{given} has no files to download")


def _export(conversation: Conversation, summary: Summary) -> int:
    from schemas.api.jobs import JobState
    from service.client.download import require_free

    client, arguments = conversation.client, conversation.arguments
    kind, first, version = _kind_of(arguments.id)
    asked = _asked(arguments)
    if kind == "scene":
        export = client.export_scene(first, asked)
    elif kind == "map":
        export = client.export_map(first, version or "current", asked)
    else:
        raise _unknown(f"{arguments.id} is no scene or map")
    conversation.say(f"export {export.id}: {client.url}/v1/exports/{export.id}")
    if arguments.out is not None:
        require_free(arguments.out, export.id)  # before the wait
        if export.state != JobState.SUCCEEDED:  # the record of an older job may have expired
            job = conversation.wait(client.job(export.job_id))
            export = client.export(export.id)
            if export.state != JobState.SUCCEEDED:
                return conversation.job_failed(job)
        _say_withheld(conversation, export)
        conversation.download(export)
    summary.items.append(export.model_dump(mode="json"))
    return 0


def _say_withheld(conversation: Conversation, export: ExportResource) -> None:
    for result in export.results:
        if result.withheld is not None:
            conversation.say(f"  warning: {result.withheld}")
        for note in result.notes:
            conversation.say(f"  {result.format}: {note}")


def _asked(arguments: argparse.Namespace) -> ExportRequest:
    from pydantic import ValidationError

    from schemas.api.exports import ExportRequest
    from service.client import ClientError

    try:
        return ExportRequest(
            formats=arguments.formats,
            image_size_px=arguments.image_size,
            crs=arguments.crs,
            component=arguments.component,
        )
    except ValidationError as error:
        first = error.errors()[0]
        option = {"image_size_px": "image-size", "formats": "format"}.get(str(first["loc"][0]), first["loc"][0])
        raise ClientError(f"--{option} is {first['input']!r}: {first['msg']}. Correct it.") from None


def _webhook(conversation: Conversation, summary: Summary) -> int:
    from pydantic import ValidationError

    from schemas.api.webhooks import WebhookRequest
    from service.client import ClientError

    arguments = conversation.arguments
    events = {} if arguments.events is None else {"events": arguments.events}
    try:
        asked = WebhookRequest.model_validate({"url": arguments.address, **events})
    except ValidationError as error:
        raise ClientError(f"{error.errors()[0]['input']!r}: {error.errors()[0]['msg']}. Correct it.") from None
    return _tell(conversation, summary, conversation.client.create_webhook(asked))


def _rotate(conversation: Conversation, summary: Summary) -> int:
    return _tell(conversation, summary, conversation.client.rotate_webhook(conversation.arguments.id))
