"""`mrasfm view`: the web console over the folder of a scene or map, without a service."""

from __future__ import annotations

import argparse
import sys
import webbrowser
from contextlib import suppress
from pathlib import Path

EXIT_REFUSED = 2
HOST = "127.0.0.1"


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "view",
        help="look at a scene or map in the browser",
        description="Serve the web console over the folder of a scene or map, for this machine only, until Ctrl-C.",
    )
    parser.add_argument("folder", type=Path, metavar="SCENE|MAP", help="folder with report.json")
    parser.add_argument(
        "--drive",
        type=Path,
        action="append",
        default=[],
        metavar="DRIVE",
        help="folder with drive.json, whose images are shown; may be repeated",
    )
    parser.add_argument("--port", type=int, default=0, help="port to listen on (default: a free one)")
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Serve until told to stop."""
    import socket

    from service.api.folder_view import DriveFolder, FolderViewError, create_view
    from service.api.server import server_of

    try:
        drives = [DriveFolder.read(folder) for folder in arguments.drive]
        app, page = create_view(arguments.folder, drives)
    except FolderViewError as error:
        print(f"mrasfm: error: {error}", file=sys.stderr)
        return EXIT_REFUSED
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((HOST, arguments.port))
            listener.listen()  # a browser that comes before the server is ready waits for it
        except (OSError, OverflowError) as error:
            print(f"mrasfm: error: port {arguments.port} cannot be used: {error}. Give another one.", file=sys.stderr)
            return EXIT_REFUSED
        address = f"http://{HOST}:{listener.getsockname()[1]}/{page}"
        print(f"mrasfm: {arguments.folder} is at {address}; Ctrl-C ends this", flush=True)
        if not arguments.no_browser:
            webbrowser.open(address)
        with suppress(KeyboardInterrupt):  # uvicorn raises it anew once it has stopped
            server_of(app, host=HOST, port=arguments.port, timeout_graceful_shutdown=1).run(sockets=[listener])
    return 0
