"""Sends the messages of webhooks. Redirects are answers like others; proxies of the environment are not used.

One message at a time goes to each webhook, and some to each project: an address that takes long, or does not answer,
holds up its own messages alone.
"""

from __future__ import annotations

import logging
import ssl
import threading
import time
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from importlib.metadata import version

import httpcore

from service.database.connections import Database
from service.domain import webhooks
from service.domain.webhook_addresses import require_url
from service.domain.webhooks import Message, Outcome
from service.errors import AddressRefused
from service.settings import Settings
from worker.checked_connections import AddressRefusedError, CheckedBackend

log = logging.getLogger("mrasfm.webhooks")

THREADS = 8
OF_PROJECT = 2  # messages of one project that are sent at one time
_CONNECT_S = 5.0
_WITHIN_S = 15.0  # of a whole try; well below `webhooks.TAKEN_US`
_NEVER = threading.Event()


class WebhookSender:
    """Sender of messages that are due; any number may run at the same time."""

    def __init__(self, settings: Settings, database: Database) -> None:
        self._database = database
        self._allow_private = settings.webhook_private_addresses
        self._look_every_s = settings.webhook_seconds
        self._tls = ssl.create_default_context()

    def send_due(self, ended: threading.Event = _NEVER) -> int:
        """Send what is due until nothing is; how many messages were tried.

        Parameters
        ----------
        ended
            Once it is set no more are begun. What is under way ends within seconds.
        """
        total, under_way = 0, dict[Future[None], Message]()
        with ThreadPoolExecutor(THREADS, thread_name_prefix="webhook") as pool:
            while True:
                if not ended.is_set():
                    under_way |= {pool.submit(self._send, each): each for each in self._take(list(under_way.values()))}
                if not under_way:
                    return total
                # Others may become due while a slow one is under way.
                done, _ = wait(under_way, timeout=self._look_every_s, return_when=FIRST_COMPLETED)
                for sent in done:
                    del under_way[sent]
                    sent.result()
                    total += 1

    def _take(self, under_way: list[Message]) -> list[Message]:
        free = THREADS - len(under_way)
        with self._database.read() as session:
            if not free or not webhooks.is_any_due(session):
                return []
        with self._database.write() as session:
            return webhooks.take(session, limit=free, of_project=OF_PROJECT, under_way=under_way)

    def _send(self, message: Message) -> None:
        outcome = self._try(message)
        self._database.transact(lambda session: webhooks.note(session, message, outcome))
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
        backend = CheckedBackend(allow_private=self._allow_private, deadline_s=time.monotonic() + _WITHIN_S)
        timeouts = {"connect": _CONNECT_S, "read": _WITHIN_S, "write": _WITHIN_S, "pool": _CONNECT_S}
        try:
            require_url(message.url, allow_private=self._allow_private)  # the operator may have changed what is allowed
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
            log.warning("webhook refused", extra={"fields": {"delivery": message.id, "addresses": error.addresses}})
            return Outcome(error=str(error))
        except AddressRefused as error:
            return Outcome(error=error.problem.detail)
        except Exception as error:  # httpcore lets errors of sockets, of TLS and of h11 through
            return Outcome(error=f"{type(error).__name__}: {error}".rstrip(": "))
        if 300 <= status < 400:
            return Outcome(status=status, error="a redirect is not followed")
        return Outcome(status=status, error=None if 200 <= status < 300 else f"answered {status}")
