"""Prometheus metrics of the API process, and of the system of record as it is when they are read."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.multiprocess import MultiProcessCollector
from prometheus_client.registry import Collector
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import InstrumentedAttribute, Session

from schemas.api.jobs import JobKind
from schemas.api.webhooks import DeliveryState
from service.database.connections import Database, clock_us
from service.database.tables import Job, JobState, Project, WebhookDelivery, WorkerSeen
from service.domain import jobs, passes
from service.domain.workers import ONLINE_US
from service.settings import Settings

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class Metrics:
    """Counts requests, and reads the rest from the database."""

    def __init__(self, database: Database, settings: Settings) -> None:
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
        self.sent_bytes = Counter("mrasfm_sent_bytes", "Bytes of bodies of answers", registry=self.registry)
        self._told = self.registry
        if os.environ.get("PROMETHEUS_MULTIPROC_DIR"):  # what prometheus_client itself goes by
            self._told = CollectorRegistry()
            MultiProcessCollector(self._told)  # type: ignore[no-untyped-call]
        self._told.register(_Records(database, settings))
        self._told.register(_Disk(settings))

    def text(self) -> bytes:
        """All metrics in Prometheus' text format, of all processes of this API."""
        return generate_latest(self._told)


class _Records(Collector):
    def __init__(self, database: Database, settings: Settings) -> None:
        self._database = database
        self._settings = settings

    def describe(self) -> Iterator[Metric]:
        """Nothing: else registering would ask the database."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Counts of what is recorded; without a database, only that it does not answer."""
        try:
            with self._database.read() as session:
                found = list(self._recorded(session))
        except SQLAlchemyError:
            yield GaugeMetricFamily("mrasfm_database_up", "Whether the database answers", value=0)
            return
        yield GaugeMetricFamily("mrasfm_database_up", "Whether the database answers", value=1)
        yield from found

    def _recorded(self, session: Session) -> Iterator[Metric]:
        yield _family("jobs", "Jobs by state", "state", _by_state(session, Job.state), names=JobState)
        stalled = jobs.count_stalled(session, stalled_s=self._settings.stalled_seconds)
        yield _gauge("jobs_stalled", "Running jobs without a recent heartbeat", stalled)
        backlogs = jobs.backlogs(session)
        due = {str(kind): backlog.jobs for kind, backlog in backlogs.items()}
        yield _family("jobs_due", "Jobs that wait for nothing but a worker, by kind", "kind", due, names=JobKind)
        waits_s = {str(kind): backlog.longest_wait_us / 1e6 for kind, backlog in backlogs.items()}
        about = "Time for which the oldest of them has waited"
        yield _family("jobs_due_longest_wait_seconds", about, "kind", waits_s, names=JobKind)
        messages = _by_state(session, WebhookDelivery.state)
        about = "Messages of webhooks by state, of the last month"
        yield _family("webhook_messages", about, "state", messages, names=DeliveryState)
        online = select(func.count()).select_from(WorkerSeen).where(WorkerSeen.seen_us > clock_us(session) - ONLINE_US)
        yield _gauge("workers_online", "Workers that reported lately", session.scalar(online) or 0)
        ages_s = {name: max(0, age_us) / 1e6 for name, age_us in passes.ages_us(session).items()}
        about = "Time since a reconciler last made each of its passes"
        yield _family("reconciler_pass_age_seconds", about, "pass", ages_s, names=ages_s)
        used = session.scalar(select(func.coalesce(func.sum(Project.used_bytes), 0))) or 0
        yield _gauge("stored_bytes", "Bytes in the artifact store", int(used))


class _Disk(Collector):
    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def collect(self) -> Iterator[Metric]:
        """Space where uploads are received; nothing of a disk that does not answer."""
        try:
            free_bytes, total_bytes = disk_of_uploads(self._settings)
        except OSError:
            return
        yield _gauge("disk_free_bytes", "Free space where uploads are received", free_bytes)
        yield _gauge("disk_total_bytes", "Size of the file system where uploads are received", total_bytes)


def disk_of_uploads(settings: Settings) -> tuple[int, int]:
    """Bytes that are free where uploads are received, and bytes of that file system."""
    settings.spool_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    usage = shutil.disk_usage(settings.spool_dir)
    return usage.free, usage.total


def _gauge(name: str, about: str, value: float) -> Metric:
    return GaugeMetricFamily(f"mrasfm_{name}", about, value=value)


def _family(name: str, about: str, label: str, values: Mapping[str, float], *, names: Iterable[str]) -> Metric:
    """A metric with a value for each of the names, and 0 where there is none."""
    result = GaugeMetricFamily(f"mrasfm_{name}", about, labels=[label])
    for key in names:
        result.add_metric([key], values.get(key, 0))
    return result


def _by_state(session: Session, state: InstrumentedAttribute[str]) -> dict[str, int]:
    return {row[0]: row[1] for row in session.execute(select(state, func.count()).group_by(state))}
