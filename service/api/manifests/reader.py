"""Reads a manifest from outside, as a program: `python -m service.api.manifests.reader MEGABYTES WHAT`.

The manifest comes through standard input. The first line of the output is JSON: the facts, or the problem; a line for
each file follows.
"""

from __future__ import annotations

import io
import json
import resource
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from schemas.api.drives import FileRole
from schemas.api.problems import Problem
from schemas.parsing import DocumentError, parse_new_manifest
from service.domain.manifest_facts import ManifestFacts, facts_of
from service.errors import OtherError, ServiceError, invalid_document

_LETTERS = {FileRole.IMAGE: "i", FileRole.MASK: "m"}
_ROLES = {letter: role for role, letter in _LETTERS.items()}


def read(raw: bytes, *, what: str) -> ManifestFacts:
    """The facts of the manifest in these bytes.

    Parameters
    ----------
    what
        The bytes are, for the error.

    Raises
    ------
    ServiceError
        422 with all defects.
    """
    try:
        manifest = parse_new_manifest(raw)
    except DocumentError as error:
        raise invalid_document(error, what=what) from None
    return facts_of(manifest)


def main() -> None:
    """Read within so many megabytes of memory."""
    megabytes, what = sys.argv[1:]
    bound = int(megabytes) * 1_000_000
    resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        facts = read(sys.stdin.buffer.read(), what=what)
    except ServiceError as error:
        write({"problem": error.problem.model_dump(mode="json")})
        return
    shown = {
        name: getattr(facts, name) for name in ("name", "vehicle", "cameras", "frames", "has_gnss", "files_expected")
    }
    write({"facts": shown})
    # Their names are printable: none holds an end of line.
    lines = (f"{_LETTERS[role]}{path}\n".encode() for path, role in facts.files)
    sys.stdout.buffer.writelines(lines)


def write(header: dict[str, Any]) -> None:
    """The output's first line."""
    sys.stdout.buffer.write(json.dumps(header).encode() + b"\n")


def result_in(output: bytes) -> ManifestFacts:
    """Read the facts from the program's output.

    The files stay as they are there, and take no more memory: as texts they would take ten times as much.

    Raises
    ------
    ServiceError
        As `read`.
    ValueError, LookupError
        Where the program came to no end.
    """
    end = output.index(b"\n")
    header = json.loads(output[:end])
    if "problem" in header:
        raise OtherError(Problem.model_validate(header["problem"]))
    return ManifestFacts(**header["facts"], files=_Files(output, end + 1))


@dataclass(frozen=True)
class _Files:
    output: bytes
    start: int

    def __iter__(self) -> Iterator[tuple[str, FileRole]]:
        lines = io.BytesIO(self.output)
        lines.seek(self.start)
        for line in lines:
            text = line.decode()
            yield text[1:-1], _ROLES[text[0]]


if __name__ == "__main__":
    main()
