"""`mrasfm preflight`: the check of a drive, in seconds."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from mrasfm_engine.errors import InputError
from mrasfm_engine.preflight.drive_check import check_manifest_here, is_sound
from mrasfm_engine.preflight.drive_reader import MANIFEST_NAME, read_drive, read_manifest
from schemas import DriveManifest
from schemas.findings import Finding, as_json, error

EXIT_UNSOUND = 2
_DESCRIPTION = "Check a drive without reconstructing it. The exit code is 2 where a finding is an error."


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "preflight", help="check a drive without reconstructing it", description=_DESCRIPTION
    )
    parser.add_argument("drive", type=Path, metavar="DRIVE", help=f"folder with {MANIFEST_NAME}")
    parser.add_argument(
        "--manifest-only", action="store_true", help=f"open no image; DRIVE may be a {MANIFEST_NAME} itself"
    )
    parser.add_argument("--no-gnss", action="store_true", help="check for a reconstruction that ignores GNSS")
    parser.add_argument("--json", action="store_true", help="print one JSON object: findings, sound")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print what is found; 0 for a drive that can be reconstructed, 2 for one that cannot."""
    findings = _check(arguments.drive, manifest_only=arguments.manifest_only, use_gnss=not arguments.no_gnss)
    sound = is_sound(findings)
    if arguments.json:
        print(json.dumps({"findings": [as_json(finding) for finding in findings], "sound": sound}, allow_nan=False))
    else:
        for finding in findings:
            print(finding)
        print(f"{arguments.drive} {'can' if sound else 'cannot'} be reconstructed")
    return 0 if sound else EXIT_UNSOUND


def _check(path: Path, *, manifest_only: bool, use_gnss: bool) -> list[Finding]:
    """The findings; a drive or manifest that cannot be read is one too."""
    try:
        if not manifest_only:
            # Loads the image libraries, which the check of a manifest does without.
            from mrasfm_engine.preflight.image_content import inspect_drive

            return inspect_drive(read_drive(path, is_new=True), use_gnss=use_gnss)
        return check_manifest_here(_read_manifest(path), use_gnss=use_gnss)
    except InputError as problem:
        return [error(problem.code, _by_name(problem.what, path), problem.remedy)]


def _read_manifest(path: Path) -> DriveManifest:
    return read_drive(path, is_new=True).manifest if path.is_dir() else read_manifest(path, is_new=True)


def _by_name(what: str, path: Path) -> str:
    # Where the manifest lies on this machine is of no interest to who sent it, and its file may be a temporary one.
    file = path / MANIFEST_NAME if path.is_dir() else path
    return what.replace(str(file), MANIFEST_NAME)
