"""`mrasfm open`: a scene or map, as the browser shows it."""

from __future__ import annotations

import argparse
import json
import os
import sys
import webbrowser
from pathlib import Path

from mrasfm_engine.errors import InputError
from schemas.artifacts import MAP_FILE, REPORT_FILE

# The first that is there is opened: the report in one file, the road from above, what was exported.
PAGES = ("report.html", "pictures/road.png")
_NO_BROWSER = 1


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "open",
        help="show a scene or map in the browser",
        description="Show a scene or map in the browser: its report, where there is none the road from above, else the "
        "folder. Where no browser can be started, what would be shown is printed, and the exit code is 1.",
    )
    parser.add_argument("folder", type=Path, metavar="SCENE|MAP", help="folder of a scene or map")
    parser.add_argument("--json", action="store_true", help="print what would be shown as JSON, and open nothing")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Open the page, or say what it is."""
    page = page_of(arguments.folder)
    if arguments.json:
        print(json.dumps({"page": str(page), "url": page.as_uri()}))
        return 0
    print(page)
    if can_show() and webbrowser.open(page.as_uri()):
        return 0
    print("mrasfm: no browser can be started here: open this file yourself", file=sys.stderr)
    return _NO_BROWSER


def page_of(folder: Path) -> Path:
    """Page of a scene or map.

    Raises
    ------
    InputError
        Where the folder is neither.
    """
    if not any((folder / name).is_file() for name in (REPORT_FILE, MAP_FILE)):
        raise InputError(
            f"{folder} is no scene or map: it has no {REPORT_FILE}",
            remedy="Give a folder that `mrasfm reconstruct --out` or `mrasfm aggregate --out` wrote.",
            code="not-a-scene",
        )
    found = next((folder / name for name in PAGES if (folder / name).is_file()), folder)
    return found.resolve()


def can_show() -> bool:
    """Return whether there is a screen: browsers in a terminal would take it over."""
    return sys.platform in ("darwin", "win32") or any(
        os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    )
