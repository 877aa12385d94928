"""Connections to addresses that were looked up and checked, within a deadline.

A name is resolved once for each connection. If one of its addresses is private, there is none; else the connection goes
to one of these addresses, so that a name server that answers differently the next time changes nothing.
"""

from __future__ import annotations

import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterable
from queue import Empty, SimpleQueue
from typing import Any

import httpcore

from service.domain.webhook_addresses import is_public

LOOK_UP_S = 5.0
# Resolvers cannot be interrupted: a look-up that is given up goes on, for half a minute with glibc's defaults.
_LOOK_UPS = threading.BoundedSemaphore(32)

Resolve = Callable[[str, int, float], list[str]]


class AddressRefusedError(Exception):
    """The name leads to an address that is not told anything.

    The message may be shown to whoever gave the name. `addresses` may not: they are those of the operator's network.
    """

    def __init__(self, host: str, addresses: list[str]) -> None:
        super().__init__(f"{host} has no address, or one of a private network")
        self.addresses = addresses


def resolved(host: str, port: int, within_s: float) -> list[str]:
    """Addresses of a name, each once.

    Raises
    ------
    OSError
        Where there are none.
    httpcore.ConnectTimeout
        Where no name server answers in time.
    """
    deadline_s = time.monotonic() + within_s
    answer: SimpleQueue[list[str] | Exception] = SimpleQueue()

    def look_up() -> None:
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            answer.put(list(dict.fromkeys(str(address[0]) for *_, address in found)))
        except Exception as error:
            answer.put(error)
        finally:
            _LOOK_UPS.release()

    too_late = httpcore.ConnectTimeout(f"{host} was not looked up within {within_s:g} s")
    if not _LOOK_UPS.acquire(timeout=within_s):
        raise too_late
    threading.Thread(target=look_up, name="look-up", daemon=True).start()
    try:
        addresses = answer.get(timeout=max(0.0, deadline_s - time.monotonic()))
    except Empty:
        raise too_late from None
    if isinstance(addresses, Exception):
        raise addresses
    return addresses


class CheckedBackend(httpcore.NetworkBackend):
    """Connections to public addresses alone, up to a deadline.

    Parameters
    ----------
    deadline_s
        On the monotonic clock: when every step has ended, so that a peer that answers a byte at a time holds nobody up.
    """

    def __init__(self, *, allow_private: bool, deadline_s: float, resolve: Resolve = resolved) -> None:
        self._allow_private, self._deadline_s, self._resolve = allow_private, deadline_s, resolve
        self._inner = httpcore.SyncBackend()

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        """Connect to the first of the name's addresses that answers, where all of them are public."""
        addresses = self._resolve(host, port, _left(self._deadline_s, LOOK_UP_S))
        if not addresses or not (self._allow_private or all(map(is_public, addresses))):
            raise AddressRefusedError(host, addresses)
        failed: Exception | None = None
        for address in addresses:
            try:
                stream = self._inner.connect_tcp(address, port, timeout=_left(self._deadline_s, timeout))
                return _BoundedStream(stream, self._deadline_s)
            except (httpcore.ConnectError, httpcore.ConnectTimeout) as error:
                failed = error
        assert failed is not None
        raise failed


class _BoundedStream(httpcore.NetworkStream):
    """A connection whose steps end by a deadline."""

    def __init__(self, inner: httpcore.NetworkStream, deadline_s: float) -> None:
        self._inner, self._deadline_s = inner, deadline_s

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        return self._inner.read(max_bytes, timeout=_left(self._deadline_s, timeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self._inner.write(buffer, timeout=_left(self._deadline_s, timeout))

    def close(self) -> None:
        self._inner.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        inner = self._inner.start_tls(ssl_context, server_hostname, timeout=_left(self._deadline_s, timeout))
        return _BoundedStream(inner, self._deadline_s)

    def get_extra_info(self, info: str) -> Any:
        return self._inner.get_extra_info(info)


def _left(deadline_s: float, timeout_s: float | None) -> float:
    """Seconds that a step has.

    Raises
    ------
    httpcore.ReadTimeout
        Where none is left.
    """
    left_s = deadline_s - time.monotonic()
    if left_s <= 0.0:
        raise httpcore.ReadTimeout("no answer in time")
    return left_s if timeout_s is None else min(left_s, timeout_s)
