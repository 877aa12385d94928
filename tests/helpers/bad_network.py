"""Who a client may meet: a TCP relay to an API that breaks connections where a test says so, and other servers."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

_PIECE_BYTES = 65536


@dataclass
class Cut:
    """Requests whose first line holds `part` get so many bytes of their answer, and then the end of the connection.

    With `answer` they get this, and the API does not see them; with `silent` nothing, and the connection stays.
    """

    part: bytes
    answer_bytes: int
    times: int
    answer: bytes = b""
    silent: bool = False
    seen: list[bytes] = field(default_factory=list)  # the heads of those that were cut


class BadNetwork:
    """The relay: clients connect to `url`."""

    def __init__(self, api_url: str, cuts: list[Cut]) -> None:
        parts = urlsplit(api_url)
        self._target = (str(parts.hostname), int(parts.port or 80))
        self._cuts = cuts
        self._lock = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open: list[socket.socket] = []
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self._acceptor = threading.Thread(target=self._accept, daemon=True)
        self._acceptor.start()

    def close(self) -> None:
        _end(self._listener)
        self._acceptor.join()  # a connection accepted meanwhile is closed with the others
        self._listener.close()
        for connection in self._open:
            _end(connection)
            connection.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(self._target)
                self._open += [near, far]
                threading.Thread(target=self._relay, args=(near, far), daemon=True).start()

    def _relay(self, near: socket.socket, far: socket.socket) -> None:
        left: list[int] = []  # bytes of the answer that may still pass; empty: all
        threading.Thread(target=self._answer, args=(near, far, left), daemon=True).start()
        with suppress(OSError):
            while piece := near.recv(_PIECE_BYTES):
                cut = self._cut_for(piece)
                if cut is not None and cut.answer:
                    near.sendall(cut.answer)
                    break
                if cut is not None and cut.silent:
                    while near.recv(_PIECE_BYTES):
                        continue
                    break
                if cut is not None:
                    left.append(cut.answer_bytes)
                far.sendall(piece)
        _end(far)

    def _cut_for(self, piece: bytes) -> Cut | None:
        line = piece.partition(b"\r\n")[0]
        is_head = line.endswith(b" HTTP/1.1")
        with self._lock:
            for cut in self._cuts:
                if is_head and cut.part in line and len(cut.seen) < cut.times:
                    cut.seen.append(piece)
                    return cut
        return None

    def _answer(self, near: socket.socket, far: socket.socket, left: list[int]) -> None:
        with suppress(OSError):
            while piece := far.recv(_PIECE_BYTES):
                if left:
                    near.sendall(piece[: left[0]])
                    left[0] -= len(piece)
                    if left[0] <= 0:
                        break
                else:
                    near.sendall(piece)
        _end(near)
        _end(far)


def _end(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class Recorder:
    """A server that is no API: it notes every request's method, path and key, and answers 404 or with a redirect."""

    def __init__(self, *, redirect_to: str | None = None) -> None:
        self.requests: list[tuple[str, str, str | None]] = []
        noted = self.requests

        class Handler(BaseHTTPRequestHandler):
            def handle_one_request(self) -> None:
                self.raw_requestline = self.rfile.readline(_PIECE_BYTES)
                self.close_connection = True
                if self.raw_requestline and self.parse_request():
                    noted.append((self.command, self.path, self.headers.get("Authorization")))
                    self.send_response(404 if redirect_to is None else 307)
                    if redirect_to is not None:
                        self.send_header("Location", redirect_to)
                    self.end_headers()

            def log_message(self, format: str, *arguments: object) -> None:
                pass

        # Another address than the API's, and loopback too.
        self._server = ThreadingHTTPServer(("127.0.0.2", 0), Handler)
        self.url = f"http://127.0.0.2:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@contextmanager
def bad_network(api_url: str, *cuts: Cut) -> Iterator[BadNetwork]:
    """A relay to an API for the time of a test."""
    relay = BadNetwork(api_url, list(cuts))
    try:
        yield relay
    finally:
        relay.close()
