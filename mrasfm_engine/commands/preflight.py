"""`mrasfm preflight`: what is wrong with a drive, in seconds.

`python -m mrasfm_engine.commands.preflight` is the same without loading the other commands.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
from pathlib import Path

from mrasfm_engine.errors import InputError
from mrasfm_engine.findings import Finding, as_json, error
from mrasfm_engine.preflight.drive_check import check_manifest, is_sound
from mrasfm_engine.preflight.drive_reader import MANIFEST_NAME, read_drive, read_manifest
from schemas import DriveManifest

EXIT_UNSOUND = 2
_DESCRIPTION = "Check a drive without reconstructing it. The exit code is 2 where a finding is an error."


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    _add_arguments(
        subparsers.add_parser("preflight", help="check a drive without reconstructing it", description=_DESCRIPTION)
    )


def main(argv: list[str] | None = None) -> int:
    """Run the command alone."""
    parser = argparse.ArgumentParser(prog="mrasfm preflight", description=_DESCRIPTION)
    _add_arguments(parser)
    return run(parser.parse_args(argv))


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("drive", type=Path, metavar="DRIVE", help=f"folder with {MANIFEST_NAME}")
    parser.add_argument(
        "--manifest-only", action="store_true", help=f"open no image; DRIVE may be a {MANIFEST_NAME} itself"
    )
    parser.add_argument("--no-gnss", action="store_true", help="check for a reconstruction that ignores GNSS")
    parser.add_argument(
        "--accepted", action="store_true", help="leave out rules for new manifests: the service has accepted this one"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object: findings, sound")
    parser.add_argument(
        "--max-memory-mb", type=int, metavar="MB", help="refuse a manifest that needs more memory than this (Linux)"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print what is found; 0 for a drive that can be reconstructed, 2 for one that cannot."""
    if arguments.max_memory_mb is not None:
        _bound_memory(arguments.max_memory_mb)
    findings = _check(
        arguments.drive,
        manifest_only=arguments.manifest_only,
        use_gnss=not arguments.no_gnss,
        is_new=not arguments.accepted,
    )
    sound = is_sound(findings)
    if arguments.json:
        print(json.dumps({"findings": [as_json(finding) for finding in findings], "sound": sound}, allow_nan=False))
    else:
        for finding in findings:
            print(finding)
        print(f"{arguments.drive} {'can' if sound else 'cannot'} be reconstructed")
    return 0 if sound else EXIT_UNSOUND


def _check(path: Path, *, manifest_only: bool, use_gnss: bool, is_new: bool) -> list[Finding]:
    """The findings; a drive or manifest that cannot be read is one too."""
    try:
        if not manifest_only:
            # Loads the image libraries, which the check of a manifest does without.
            from mrasfm_engine.preflight.image_content import inspect_drive

            return inspect_drive(read_drive(path, is_new=is_new), use_gnss=use_gnss)
        return check_manifest(_read_manifest(path, is_new=is_new), use_gnss=use_gnss)
    except InputError as problem:
        return [error(problem.code, _by_name(problem.what, path), problem.remedy)]
    except MemoryError:
        return [error("bad-size", f"{MANIFEST_NAME} needs too much memory to be read", "Split the drive in several.")]


def _bound_memory(megabytes: int) -> None:
    """Let this process take so much more memory than it has now.

    Small JSON can unpack to a hundred times its bytes. Where memory is refused to Python it raises MemoryError; where
    to pydantic, that aborts the process.
    """
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    bound = pages * resource.getpagesize() + megabytes * 1_000_000
    resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _read_manifest(path: Path, *, is_new: bool) -> DriveManifest:
    if path.is_dir():
        return read_drive(path, is_new=is_new).manifest
    return read_manifest(path, is_new=is_new)


def _by_name(what: str, path: Path) -> str:
    # Where the manifest lies on this machine is of no interest to who sent it, and its file may be a temporary one.
    file = path / MANIFEST_NAME if path.is_dir() else path
    return what.replace(str(file), MANIFEST_NAME)


if __name__ == "__main__":
    sys.exit(main())
