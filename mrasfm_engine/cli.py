"""The `mrasfm` command: finds the subcommand, loads it alone, and turns errors into exit codes.

The list of subcommands that `mrasfm --help` shows, and the shell's completion, are files that `make docs` makes of the
parsers: showing them loads no subcommand.
"""

from __future__ import annotations

import argparse
import atexit
import errno
import gc
import json
import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import EntryPoint, entry_points, version
from pathlib import Path

from mrasfm_engine.errors import CancelledError, MrasfmError, TerminatedError
from mrasfm_engine.freed_memory import loading

EXIT_OUT_OF_MEMORY = 1  # as of any program that fails
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
EXIT_UNREAD = 141  # as of a program that a broken pipe ends
EXIT_TERMINATED = 143  # as of a program that SIGTERM ends
# Of the system's errors, those of the paths that a user gives or of what lies there.
PATH_ERRORS = frozenset({errno.EACCES, errno.EPERM, errno.ELOOP, errno.ENAMETOOLONG})
GROUP = "mrasfm.commands"
INDEX = Path(__file__).with_name("command_index.json")  # what each subcommand does, by its name
DESCRIPTION = "Multi-camera drives to metric maps."
# A subcommand that is in none of these is listed under the last heading.
HEADINGS: Mapping[str, Sequence[str]] = {
    "From a recording to a map": ("import", "preflight", "reconstruct", "aggregate", "export", "open"),
    "Judge the result": ("evaluate", "bench", "ablate"),
    "Use a service": ("upload", "map"),
    "Run a service": ("demo", "standalone", "api", "worker", "reconciler", "migrate", "keys", "projects"),
    "More": ("synth", "models", "describe", "completion"),
}


def build_parser() -> argparse.ArgumentParser:
    """The parser of `mrasfm` with all subcommands.

    Subcommands are modules of the entry-point group `mrasfm.commands` with a function
    `register(subparsers)` that adds a parser whose default `run` takes the parsed arguments.
    """
    return _parser_of(_commands().values())


def _commands() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name)}


def _parser_of(entries: Iterable[EntryPoint]) -> argparse.ArgumentParser:
    from schemas.command_line import CommandParser  # not for --help, which loads nothing

    parser: argparse.ArgumentParser = CommandParser(prog="mrasfm", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=version("mrasfm"), help="print the version and exit")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for entry in entries:
        entry.load().register(subparsers)
    return parser


def overview() -> str:
    """The text of `mrasfm --help`: subcommands in groups."""
    known: dict[str, str] = json.loads(INDEX.read_text(encoding="utf-8"))
    names = _commands().keys()
    listed = {name for group in HEADINGS.values() for name in group}
    lines = ["usage: mrasfm COMMAND ...", "", DESCRIPTION]
    for heading, group in HEADINGS.items():
        rest = sorted(names - listed) if heading == list(HEADINGS)[-1] else []
        lines += ["", f"{heading}:", *(f"  {n:<12} {known.get(n, '')}".rstrip() for n in [*group, *rest] if n in names)]
    lines += [
        "",
        "mrasfm COMMAND --help describes a command, mrasfm --version prints the version.",
        'Completion: eval "$(mrasfm completion bash)"',
    ]
    return "\n".join(lines) + "\n"


def _without_control(text: str) -> str:
    """Lines whose other control characters are escaped: a message may name any file, and terminals obey them."""
    return re.sub(r"[^\t\n\x20-\x7e\xa0-\U0010ffff]", lambda found: ascii(found[0])[1:-1], text)


def main(argv: list[str] | None = None) -> int:
    """Run one subcommand."""
    words = sys.argv[1:] if argv is None else argv
    if argv is None:
        # The interpreter looks for garbage once more as it ends: half a second after the engine, for nothing.
        atexit.register(gc.freeze)
    if not words or words[0] in ("-h", "--help"):
        print(overview(), end="", file=sys.stdout if words else sys.stderr)
        return 0 if words else EXIT_BAD_INPUT
    commands = _commands()
    # Only what is asked for is loaded; what is none, or comes after an option, gets the words of the whole parser.
    entries = [commands[words[0]]] if words[0] in commands else list(commands.values())
    with loading():
        parser = _parser_of([] if words[0] == "--version" else entries)
    arguments = parser.parse_args(words)
    try:
        code = int(arguments.run(arguments) or 0)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # who reads has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_UNREAD
    except CancelledError as error:
        print(f"mrasfm: {error}", file=sys.stderr)
        return EXIT_TERMINATED if isinstance(error, TerminatedError) else EXIT_INTERRUPTED
    except MrasfmError as error:
        print(f"mrasfm: error: {_without_control(str(error))}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except OSError as error:
        if error.errno not in PATH_ERRORS or error.filename is None:
            raise
        print(f"mrasfm: error: {_without_control(f'{error.filename}: {error.strerror}')}", file=sys.stderr)
        print("  Check the path and its permissions.", file=sys.stderr)
        return EXIT_BAD_INPUT
    except MemoryError as error:
        print(f"mrasfm: error: memory ran out{f': {error}' if str(error) else ''}", file=sys.stderr)
        print(
            "  Lower features.max_side_px, features.max_keypoints or threads in the settings, or free memory.",
            file=sys.stderr,
        )
        return EXIT_OUT_OF_MEMORY
    except KeyboardInterrupt:
        print("mrasfm: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
