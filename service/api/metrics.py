"""Prometheus metrics of the API process, and of the system of record as it is when they are read."""

from __future__ import annotations

import os
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.multiprocess import MultiProcessCollector
from prometheus_client.registry import Collector
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import InstrumentedAttribute, Session

from schemas.api.webhooks import DeliveryState
from service.database.connections import Database, clock_us
from service.database.tables import Job, JobState, Project, WebhookDelivery, WorkerSeen
from service.domain.workers import ONLINE_US

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class Metrics:
    """Counts requests, and reads the rest from the database."""

    def __init__(self, database: Database) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "mrasfm_http_requests", "HTTP requests", ["method", "route", "status"], registry=self.registry
        )
        self.seconds = Histogram(
            "mrasfm_http_request_seconds",
            "Time to answer",
            ["method", "route"],
            buckets=(0.005, 0.02, 0.1, 0.5, 2, 10, 60, 600),
            registry=self.registry,
        )
        self.received_bytes = Counter("mrasfm_received_bytes", "Bytes of request bodies", registry=self.registry)
        self._told = self.registry
        if os.environ.get("PROMETHEUS_MULTIPROC_DIR"):  # what prometheus_client itself goes by
            self._told = CollectorRegistry()
            MultiProcessCollector(self._told)  # type: ignore[no-untyped-call]
        self._told.register(_Records(database))

    def text(self) -> bytes:
        """All metrics in Prometheus' text format, of all processes of this API."""
        return generate_latest(self._told)


class _Records(Collector):
    def __init__(self, database: Database) -> None:
        self._database = database

    def describe(self) -> Iterator[Metric]:
        """Nothing: else registering would ask the database."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Counts of what is recorded; without a database, only that it does not answer."""
        try:
            states, messages, workers, used = self._counts()
        except SQLAlchemyError:
            yield GaugeMetricFamily("mrasfm_database_up", "Whether the database answers", value=0)
            return
        yield GaugeMetricFamily("mrasfm_database_up", "Whether the database answers", value=1)
        jobs = GaugeMetricFamily("mrasfm_jobs", "Jobs by state", labels=["state"])
        for state in JobState:
            jobs.add_metric([state], states.get(state, 0))
        yield jobs
        webhooks = GaugeMetricFamily(
            "mrasfm_webhook_messages", "Messages of webhooks by state, of the last month", labels=["state"]
        )
        for message_state in DeliveryState:
            webhooks.add_metric([message_state], messages.get(message_state, 0))
        yield webhooks
        yield GaugeMetricFamily("mrasfm_workers_online", "Workers that reported lately", value=workers)
        yield GaugeMetricFamily("mrasfm_stored_bytes", "Bytes in the artifact store", value=used)

    def _counts(self) -> tuple[dict[str, int], dict[str, int], int, int]:
        with self._database.read() as session:
            states, messages = _by_state(session, Job.state), _by_state(session, WebhookDelivery.state)
            seen = WorkerSeen.seen_us > clock_us(session) - ONLINE_US
            workers = session.scalar(select(func.count()).select_from(WorkerSeen).where(seen)) or 0
            used = session.scalar(select(func.coalesce(func.sum(Project.used_bytes), 0))) or 0
        return states, messages, workers, int(used)


def _by_state(session: Session, state: InstrumentedAttribute[str]) -> dict[str, int]:
    return {row[0]: row[1] for row in session.execute(select(state, func.count()).group_by(state))}
