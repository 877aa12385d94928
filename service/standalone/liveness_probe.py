"""Probe whether a process still answers HTTP requests, without waiting for it."""

from __future__ import annotations

import socket
from contextlib import suppress


class Pulse:
    """One question to a process of this machine, and whether its answer has come.

    Nothing here waits: the kernel takes the connection and the question in the process's place, and keeps its answer.
    """

    def __init__(self, host: str, port: int, path: str) -> None:
        self._connection: socket.socket | None = None
        request = f"GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"
        with suppress(OSError):  # not ours to tell: the answer is missing then, or the question
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            self._connection = socket.socket(family, socket.SOCK_STREAM)
            self._connection.setblocking(False)
            self._connection.connect_ex(address)
            self._connection.send(request.encode())

    def end(self) -> bool:
        """Return whether it has answered by now, or could not be asked for want of something here."""
        if self._connection is None:
            return True
        with self._connection:
            try:
                return self._connection.recv(16).startswith(b"HTTP/1.1 200 ")
            except OSError:
                return False
