"""Messages to the workers, over the broker.

A message only says that a job is waiting. It may be lost, and it may arrive twice: what counts is the job's row.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

from schemas.api.jobs import JobKind
from service.database.tables import Job
from service.settings import Settings

if TYPE_CHECKING:
    import redis
    from celery import Celery

TASK = "mrasfm.run_job"
QUEUES = {
    JobKind.PREFLIGHT: "checks",
    JobKind.RECONSTRUCTION: "reconstructions",
    JobKind.AGGREGATION: "reconstructions",
    JobKind.SUBMAP: "reconstructions",
    JobKind.EXPORT: "checks",  # of minutes: it does not wait behind reconstructions of hours
}
_ANSWER_WITHIN_S = 2
_NOTICE_WITHIN_S = 10  # that the broker has vanished: a worker's main process waits for its answers
_SILENT_FOR_S = 3.0  # a broker that did not answer is not asked again for so long: it would hold up every request


def celery_options(settings: Settings) -> dict[str, Any]:
    """Celery's configuration, of senders and workers alike."""
    url = None if settings.redis_url is None else settings.redis_url.get_secret_value()
    return {
        "broker_url": url,
        "result_backend": None,
        "task_ignore_result": True,
        "task_default_queue": QUEUES[JobKind.RECONSTRUCTION],
        "task_acks_late": True,
        "task_reject_on_worker_lost": True,
        "worker_prefetch_multiplier": 1,
        "broker_connection_retry_on_startup": True,
        "broker_connection_max_retries": None,
        # The stage goes on while the broker is away: the job's lease is in the database.
        "worker_cancel_long_running_tasks_on_connection_loss": False,
        "broker_transport_options": {
            "visibility_timeout": settings.visibility_timeout_seconds,
            # Messages of a worker that died are looked for this often, not every 100 s as by default; and a sweeper
            # that was killed holds the others up for no longer than that.
            "unacked_restore_interval": min(5.0, settings.visibility_timeout_seconds / 3),
            "unacked_restore_throttle": 1,
            "unacked_mutex_expire": 10,
            "socket_connect_timeout": _ANSWER_WITHIN_S,
            # Without it a broker that goes without a word (a lost node, a cut network) stops the worker for ever.
            "socket_timeout": _NOTICE_WITHIN_S,
            "socket_keepalive": True,
            "health_check_interval": 10,
        },
    }


class JobQueue:
    """Sends messages, and sees which are waiting.

    Every method raises `BrokerError` within seconds where the broker does not answer. What speaks to the broker takes
    17 MB, and is loaded with the first message: processes that only take uploads send none.
    """

    def __init__(self, settings: Settings) -> None:
        self._options = celery_options(settings)
        self._url = self._options["broker_url"]
        self._silent_until_s = -math.inf

    @cached_property
    def _celery(self) -> Celery:
        from celery import Celery

        app = Celery("mrasfm", set_as_current=False)
        app.conf.update(self._options)
        app.conf.broker_transport_options |= {
            "socket_timeout": _ANSWER_WITHIN_S,
            "retry_on_timeout": False,
            "max_retries": 0,
        }
        return app

    def send(self, jobs: list[Job]) -> None:
        """Wake a worker up for each of the jobs."""
        if time.monotonic() < self._silent_until_s:
            raise BrokerError("the broker did not answer a moment ago")
        try:
            with self._celery.connection_for_write() as connection:
                connection.ensure_connection(max_retries=1, timeout=_ANSWER_WITHIN_S, interval_start=0)
                with self._celery.amqp.Producer(connection) as producer:
                    for job in jobs:
                        self._celery.send_task(
                            TASK,
                            args=[job.id],
                            task_id=task_id(job),
                            queue=QUEUES[JobKind(job.kind)],
                            producer=producer,
                            retry=False,
                        )
        except Exception as error:  # kombu lets errors of redis, sockets and its own through
            self._silent_until_s = time.monotonic() + _SILENT_FOR_S
            raise BrokerError(str(error)) from error

    def waiting(self) -> set[str]:
        """Task ids of all messages that are queued, or delivered and not acknowledged.

        Reads kombu's keys: lists named as the queues, and the hash `unacked`.
        """
        from redis import RedisError

        try:
            with self._client() as client:
                queued = [item for queue in set(QUEUES.values()) for item in client.lrange(queue, 0, -1)]
                delivered = client.hvals("unacked")
        except RedisError as error:
            raise BrokerError(str(error)) from error
        return set(_ids(queued, delivered))

    def require_broker(self) -> None:
        """Ask whether the broker answers."""
        from redis import RedisError

        try:
            with self._client() as client:
                client.ping()
        except RedisError as error:
            raise BrokerError(str(error)) from error

    def _client(self) -> redis.Redis:
        import redis
        from redis.backoff import NoBackoff
        from redis.retry import Retry

        if not self._url:
            raise BrokerError("no broker is configured")
        url = self._url.replace("redis+socket://", "unix://").replace("virtual_host=", "db=")
        return redis.Redis.from_url(
            url,
            socket_timeout=_ANSWER_WITHIN_S,
            socket_connect_timeout=_ANSWER_WITHIN_S,
            retry=Retry(NoBackoff(), 0),
        )


class BrokerError(Exception):
    """The broker does not answer."""


def task_id(job: Job) -> str:
    """Names the message for a job's next attempt; the same message sent twice has one name."""
    return f"{job.id}.{job.fence + 1}"


def _ids(queued: list[bytes], delivered: list[bytes]) -> Iterator[str]:
    for raw in queued:
        yield from _id(raw)
    for raw in delivered:
        try:
            message = json.loads(raw)[0]
        except (ValueError, LookupError, TypeError):
            continue
        yield from _id(message)


def _id(message: Any) -> Iterator[str]:
    """The message's task id; nothing where it is not one of ours."""
    try:
        content = json.loads(message) if isinstance(message, bytes | str) else message
        yield str(content["headers"]["id"])
    except (ValueError, LookupError, TypeError):
        return
