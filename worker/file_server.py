"""Brings files of a drive for the child of an attempt, which asks for them on the loopback interface.

The child has no key to the artifact store: it decodes images from outside.
"""

from __future__ import annotations

import hmac
import json
import logging
import secrets
import socketserver
import threading
from typing import Self

from service.storage.on_demand import OnDemandFolder
from worker.child_protocol import FileAddress

log = logging.getLogger("mrasfm.worker")

_LONGEST_REQUEST = 16_384
_REQUEST_SECONDS = 30.0


class _Server(socketserver.ThreadingTCPServer):
    daemon_threads, block_on_close = True, False
    request_queue_size = 128  # threads of the engine ask at the same time


class FileServer:
    """Answers requests for a folder's files, each `{"token": ..., "file": ...}` in a line, by `{"error": ...}`.

    The error is null when the file is there.
    """

    def __init__(self, folder: OnDemandFolder) -> None:
        token = secrets.token_hex(32)

        class Handler(socketserver.StreamRequestHandler):
            timeout = _REQUEST_SECONDS

            def handle(self) -> None:
                try:
                    request = json.loads(self.rfile.readline(_LONGEST_REQUEST))
                    if not hmac.compare_digest(str(request["token"]), token):
                        return
                    file = str(request["file"])
                except (OSError, ValueError, TypeError, KeyError):
                    return  # of somebody else
                self.wfile.write(json.dumps({"error": _brought(folder, file)}).encode() + b"\n")

        self._server = _Server(("127.0.0.1", 0), Handler)
        self.address = FileAddress(port=self._server.server_address[1], token=token)
        self._thread = threading.Thread(target=self._server.serve_forever, name="files", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()


def _brought(folder: OnDemandFolder, file: str) -> str | None:
    """Bring a file; the error's kind where that fails, whose text may name the store's keys."""
    try:
        folder.bring(file)
    except Exception as error:  # whoever asks must hear of it; the attempt ends with the error itself
        log.warning("a file of the drive does not come", exc_info=True, extra={"fields": {"file": file}})
        return type(error).__name__
    return None
