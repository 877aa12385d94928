"""`mrasfm models`: trained models, which are there, and getting them."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn
from rich.table import Table

from mrasfm_engine.learned.catalogue import KnownModel, known_model, known_models
from mrasfm_engine.learned.download import pull
from mrasfm_engine.learned.model_folder import InstalledModel, ModelFolder, default_folder

HASH_SHOWN = 12
_USE = {True: "yes", False: "NO", None: "not known"}


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "models", help="list, download and add trained models", description="List, download and add trained models."
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    listing = actions.add_parser("list", help="list known models, their licences and the installed ones")
    listing.add_argument("--json", action="store_true", help="one JSON object, with signatures and sources")
    listing.set_defaults(run=run_list)
    pulling = actions.add_parser("pull", help="download a published model")
    pulling.add_argument("name", metavar="NAME", help="name of the model, as mrasfm models list prints it")
    pulling.set_defaults(run=run_pull)
    adding = actions.add_parser("add", help="add a model file")
    adding.add_argument("file", type=Path, metavar="FILE", help="ONNX model, in one file")
    adding.add_argument(
        "--name", metavar="NAME", help="name of the model (default: the name that its signature implies)"
    )
    adding.set_defaults(run=run_add)
    for action in (listing, pulling, adding):
        action.add_argument(
            "--folder",
            type=Path,
            metavar="DIR",
            help="folder of the models (default: MRASFM_MODELS or the user's data folder)",
        )


def run_list(arguments: argparse.Namespace) -> int:
    """Print every known model and every one of the user's own."""
    folder = _folder(arguments)
    installed = {model.name: model for model in folder.installed()}
    names = [model.name for model in known_models()]
    names += [name for name in installed if name not in names]
    rows = [_row(name, installed.get(name)) for name in names]
    if arguments.json:
        print(json.dumps({"folder": str(folder.path), "models": rows}, indent=1))
        return 0
    table = Table("name", "for", "licence", "commercial use", "here", box=None, pad_edge=False)
    for row in rows:
        here = f"yes, {row['sha256'][:HASH_SHOWN]}" if row["here"] else f"no ({row['get']})"
        table.add_row(row["name"], row["for"], row["licence"], _USE[row["commercial_use"]], here)
    console = Console(width=None if Console().is_terminal else 160)
    console.print(table)
    console.print(f"Folder: {folder.path}", soft_wrap=True, highlight=False)
    return 0


def run_pull(arguments: argparse.Namespace) -> int:
    """Download one model and say where it is."""
    model = known_model(arguments.name)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(model.name, total=None)
        got = pull(
            model,
            _folder(arguments),
            progress=lambda done, total: bars.update(task, completed=done, total=total or None),
        )
    _say(got)
    return 0


def run_add(arguments: argparse.Namespace) -> int:
    """Take in one file and say what it was found to be."""
    _say(_folder(arguments).add(arguments.file, arguments.name))
    return 0


def _folder(arguments: argparse.Namespace) -> ModelFolder:
    return ModelFolder(arguments.folder or default_folder())


def _say(model: InstalledModel) -> None:
    print(f"{model.name}: {model.file}")
    print(f"  used as:  {model.known.name} ({_purpose(model.known)})")
    print(f"  SHA-256:  {model.sha256}{'' if model.is_published else ' (recorded: no published hash is known)'}")
    print(f"  licence:  {model.licence}")
    if model.commercial_use is not True:
        allowed = "is not allowed" if model.commercial_use is False else "may not be allowed"
        print(f"  WARNING: commercial use {allowed} by this licence. Whether your use is, you must know.")


def _row(name: str, installed: InstalledModel | None) -> dict[str, Any]:
    known = installed.known if installed is not None else known_model(name)
    return {
        "name": name,
        "for": _purpose(known),
        "licence": known.licence if installed is None else installed.licence,
        "commercial_use": known.commercial_use if installed is None else installed.commercial_use,
        "here": installed is not None,
        "sha256": known.sha256 if installed is None else installed.sha256,
        "get": "pull" if known.url else "add a file",
        "source": known.source,
        "signature": str(known.signature),
    }


def _purpose(known: KnownModel) -> str:
    if known.descriptors is None or known.descriptors == known.method:
        return f"{known.kind} {known.method}" if known.method != known.kind else str(known.kind)
    return f"{known.kind} {known.method} after {known.descriptors}"
