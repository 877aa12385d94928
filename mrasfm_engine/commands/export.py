"""`mrasfm export`: a scene or map in formats of other programs."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from mrasfm_engine.commands.named_path import split_name
from mrasfm_engine.commands.reconstruct import cancel_on_interrupt
from mrasfm_engine.commands.stage_progress import stage_progress
from mrasfm_engine.errors import InputError
from schemas.command_line import output_folder
from schemas.exports import EXPORT_FORMATS

EXIT_WITHHELD = 1


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "export",
        help="write a scene or map in formats of other programs",
        description="Write a scene or map in formats of other programs. Every file is read back before it is put in "
        "place. Formats: " + "; ".join(f"{known.name}: {known.description}" for known in EXPORT_FORMATS.values()) + ".",
    )
    parser.add_argument("folder", type=Path, metavar="SCENE|MAP", help="folder of a scene or map")
    parser.add_argument(
        "--format",
        action="append",
        required=True,
        choices=list(EXPORT_FORMATS),
        metavar="FORMAT",
        dest="formats",
        help=f"format, may be repeated: {', '.join(EXPORT_FORMATS)}",
    )
    parser.add_argument("--out", type=output_folder, required=True, metavar="OUT", help="folder for the export")
    parser.add_argument(
        "--drive",
        action="append",
        default=[],
        metavar="DRIVE",
        help="folder of the drive, for formats with images; of a map NAME=DRIVE for each scene",
    )
    parser.add_argument(
        "--image-size", type=int, metavar="PX", help="scale images down to this longest side; by default they are not"
    )
    parser.add_argument(
        "--crs", metavar="EPSG:CODE", help="coordinate reference system, for formats that take one; by default UTM"
    )
    parser.add_argument("--json", action="store_true", help="print report.json instead of a summary")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Export, show progress, and say what was written and what was withheld."""
    drives = _drives(arguments.drive)
    # The engine takes a second to load; help and argument errors should not wait for it.
    from mrasfm_engine.export.contract import ExportOptions
    from mrasfm_engine.export.run_export import ExportRequest, run_export

    request = ExportRequest(
        folder=arguments.folder,
        out=arguments.out,
        formats=arguments.formats,
        options=ExportOptions(image_size_px=arguments.image_size, crs=arguments.crs),
        drives=drives,
        threads=len(os.sched_getaffinity(0)),
    )
    console = Console(stderr=True)
    with cancel_on_interrupt(console) as cancelled, stage_progress(console) as progress:
        report = run_export(request, progress=progress, cancel=cancelled)
    if arguments.json:
        print(json.dumps(report, allow_nan=False))
    else:
        _say(report, arguments.out)
    return EXIT_WITHHELD if any("withheld" in result for result in report["formats"].values()) else 0


def _drives(words: list[str]) -> dict[str, Path]:
    """Drives by the names of their scenes; the empty name where none is given."""
    result: dict[str, Path] = {}
    for word in words:
        name, path = split_name(word)
        if (name or "") in result:
            raise InputError(
                f"two drives are given{f' for scene {name}' if name else ''}: {result[name or '']} and {path}",
                remedy="Give one drive, or of a map NAME=DRIVE for each scene.",
                code="duplicate-drive",
            )
        result[name or ""] = path
    return result


def _say(report: dict[str, Any], out: Path) -> None:
    print(f"Export of {report['source']['kind']} {report['source']['name']}: {out}")
    for name, result in report["formats"].items():
        if "withheld" in result:
            print(f"mrasfm: {result['withheld']}", file=sys.stderr)
            continue
        size = sum(file["bytes"] for file in result["files"])
        print(f"  {name}: {len(result['files'])} files, {size / 1e6:.1f} MB in {out / name}")
        for note in result["notes"]:
            print(f"    {note}")
