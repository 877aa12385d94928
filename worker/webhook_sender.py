"""Sends the messages of webhooks, to addresses that were checked: the connection goes to what was looked up.

A name is resolved once for each connection. If one of its addresses is private, nothing is sent; else the connection is
made to one of these addresses, so that a name server that answers differently the next time changes nothing. Redirects
are answers like others, and none is followed; proxies of the environment are not used.
"""

from __future__ import annotations

import logging
import socket
import ssl
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from typing import Any

import httpcore

from service.database.connections import Database
from service.domain import webhooks
from service.domain.webhooks import Message, Outcome
from service.settings import Settings

log = logging.getLogger("mrasfm.webhooks")

THREADS = 8
_CONNECT_S = 5.0
_WITHIN_S = 15.0  # of a whole try: an address that answers a byte at a time holds nobody up


class AddressRefusedError(Exception):
    """The name leads to an address that is not told anything."""


class WebhookSender:
    """Sender of messages that are due; any number may run at the same time."""

    def __init__(self, settings: Settings, database: Database) -> None:
        self._database = database
        self._allow_private = settings.webhook_private_addresses
        self._tls = ssl.create_default_context()

    def send_due(self) -> int:
        """Send what is due, several at one time; how many messages were tried."""
        total = 0
        with ThreadPoolExecutor(THREADS, thread_name_prefix="webhook") as pool:
            while taken := self._take():
                list(pool.map(self._send, taken))
                total += len(taken)
        return total

    def _take(self) -> list[Message]:
        with self._database.read() as session:
            if not webhooks.is_any_due(session):
                return []
        with self._database.write() as session:
            return webhooks.take(session, limit=THREADS)

    def _send(self, message: Message) -> None:
        outcome = self._try(message)
        with self._database.write() as session:
            webhooks.note(session, message, outcome)
        fields = {"delivery": message.id, "attempt": message.attempts, "status": outcome.status, "why": outcome.error}
        if outcome.is_delivered:
            log.info("webhook delivered", extra={"fields": fields})
        else:
            log.warning("webhook not delivered", extra={"fields": fields})

    def _try(self, message: Message) -> Outcome:
        """One try; an answer's body is of no interest."""
        headers = {
            "content-type": "application/json",
            "user-agent": f"mrasfm/{version('mrasfm')}",
            "accept-encoding": "identity",
            **webhooks.signed_headers(message, timestamp_s=int(time.time())),
        }
        content = message.body.encode()
        headers["content-length"] = str(len(content))
        deadline_s = time.monotonic() + _WITHIN_S
        backend = _CheckedBackend(allow_private=self._allow_private, deadline_s=deadline_s)
        timeouts = {"connect": _CONNECT_S, "read": _WITHIN_S, "write": _WITHIN_S, "pool": _CONNECT_S}
        try:
            with (
                httpcore.ConnectionPool(ssl_context=self._tls, network_backend=backend, retries=0) as pool,
                pool.stream(
                    "POST",
                    message.url,
                    headers=[(name.encode(), value.encode("ascii")) for name, value in headers.items()],
                    content=content,
                    extensions={"timeout": timeouts},
                ) as answer,
            ):
                status = int(answer.status)
        except AddressRefusedError as error:
            return Outcome(error=str(error))
        except Exception as error:  # httpcore lets errors of sockets, of TLS and of h11 through
            return Outcome(error=f"{type(error).__name__}: {error}".rstrip(": "))
        if 300 <= status < 400:
            return Outcome(status=status, error="a redirect is not followed")
        return Outcome(status=status, error=None if 200 <= status < 300 else f"answered {status}")


class _CheckedBackend(httpcore.NetworkBackend):
    """Connections to addresses that were looked up and checked, up to a deadline."""

    def __init__(self, *, allow_private: bool, deadline_s: float) -> None:
        self._allow_private, self._deadline_s = allow_private, deadline_s
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
        addresses = resolved(host, port)
        refused = [] if self._allow_private else [a for a in addresses if not webhooks.is_public(a)]
        if refused or not addresses:
            what = f"leads to {refused[0]}, an address of a private network" if refused else "has no address"
            raise AddressRefusedError(f"{host} {what}")
        failed: Exception | None = None
        for address in addresses:
            try:
                stream = self._inner.connect_tcp(address, port, timeout=_left(self._deadline_s, timeout))
                return _BoundedStream(stream, self._deadline_s)
            except (httpcore.ConnectError, httpcore.ConnectTimeout) as error:
                failed = error
        assert failed is not None
        raise failed


def resolved(host: str, port: int) -> list[str]:
    """Addresses of a name, each once."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(str(address[0]) for *_, address in found))


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
        raise httpcore.ReadTimeout(f"no answer within {_WITHIN_S:g} s")
    return left_s if timeout_s is None else min(left_s, timeout_s)
