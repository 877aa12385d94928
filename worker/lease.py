"""Keeps messages of long jobs from being delivered a second time while their worker lives.

Redis has no acknowledgements of its own. Kombu keeps what was delivered in the hash `unacked`, with the time of
delivery in the sorted set `unacked_index`, and any worker puts back what is older than the visibility timeout. Without
renewal a job that is longer than the timeout would be started again and again; with a timeout as long as the longest
job a killed worker's message would come back as late. So the timeout is short, and the main process renews it.

The fields of kombu that are used here are private: its version is pinned and a test holds the behaviour.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from celery import bootsteps
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service.database.connections import Database
from service.domain import workers
from service.settings import Settings

log = logging.getLogger("mrasfm.worker")

_DATABASE_TIMEOUT_S = 2.0  # the main process must not wait long for the database: it renews leases


class _Repeated(bootsteps.StartStopStep):
    """A step of the main process that is done with every connection to the broker, and again and again with it."""

    requires = ("celery.worker.consumer.tasks:Tasks",)
    _timer: Any = None

    def do(self, consumer: Any) -> None:
        """The step."""
        raise NotImplementedError

    def start(self, consumer: Any) -> None:
        """Start repeating, with every connection to the broker."""
        self.do(consumer)
        every_s = consumer.app.mrasfm_settings.visibility_renew_seconds
        self._timer = consumer.timer.call_repeatedly(every_s, self.do, (consumer,))

    def stop(self, consumer: Any) -> None:
        """Stop repeating, when the connection is lost or the worker stops."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


class RenewLeases(_Repeated):
    """Renews the delivery time of every message that this worker holds."""

    def do(self, consumer: Any) -> None:
        """Set it to now."""
        channel = consumer.task_consumer.channel
        tags = list(channel.qos._delivered)
        if not tags:
            return
        with channel.conn_or_acquire() as client:
            client.zadd(channel.unacked_index_key, dict.fromkeys(tags, time.time()), xx=True)


class ReportPresence(_Repeated):
    """Reports to the system of record that this worker is there."""

    def do(self, consumer: Any) -> None:
        """Report it once."""
        queues = sorted(consumer.app.amqp.queues.consume_from)
        with _records(consumer.app.mrasfm_settings) as session:
            workers.report(session, name=consumer.hostname, queues=queues, concurrency=consumer.controller.concurrency)


def report_leaving(settings: Settings, name: str) -> None:
    """Report that a worker was told to stop and has stopped."""
    with _records(settings) as session:
        workers.leave(session, name)


@contextmanager
def _records(settings: Settings) -> Iterator[Session]:
    """A transaction; a database that does not take it is logged, and the worker goes on."""
    # Opened for each report: pool processes are forked from this one and must not share a connection with it.
    database = Database(settings.resolved_database_url, timeout_s=_DATABASE_TIMEOUT_S)
    try:
        with database.write() as session:
            yield session
    except SQLAlchemyError:
        log.warning("the database did not take this worker's report", exc_info=True)
    finally:
        database.close()
