"""Following a job to its end: by its events, and where these do not get through, by asking."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from schemas.api.jobs import JobResource, JobState
from service.client.api import Client, JobEvent

ENDED = frozenset({JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED})
# Some proxies hold an event stream back until it ends. After so many connections that said nothing, we only ask.
_SILENT_CONNECTIONS = 2


@dataclass(frozen=True)
class JobNews:
    """State of a job."""

    state: str
    attempt: int = 0
    percent: float = 0.0
    stage: str | None = None
    done: int | None = None
    total: int | None = None
    unit: str | None = None
    eta_low_s: float | None = None
    eta_high_s: float | None = None


Tell = Callable[[JobNews], None]


def watch_job(client: Client, job_id: str, *, tell: Tell = lambda news: None) -> JobResource:
    """Wait for a job's end.

    Connections may break and the service may be restarted meanwhile.

    Parameters
    ----------
    tell
        Told every change.

    Returns
    -------
    JobResource
        As it ended: `state` says how.
    """
    job = client.job(job_id)
    etag: str | None = None
    retry_after_s = 0.0
    listener = _Listener(client, _news(job), tell)
    while job.state not in ENDED:
        if listener.silent_connections < _SILENT_CONNECTIONS:
            listener.listen(job_id)
        else:
            client.pause(retry_after_s)
        changed, etag, retry_after_s = client.poll_job(job_id, etag)
        if changed is not None:
            job = changed
            tell(_news(job))
    return job


class _Listener:
    """Reads a job's events, connection after connection."""

    def __init__(self, client: Client, known: JobNews, tell: Tell) -> None:
        self._client = client
        self._tell = tell
        self._news = known
        # The stream begins with the job's past; what is older than what is known is not told again.
        self._past_until: tuple[int, float] | None = (known.attempt, known.percent)
        self._last_id: int | None = None
        self.silent_connections = 0
        tell(known)

    def listen(self, job_id: str) -> None:
        """Listen until the job, or the connection, ends."""
        heard = False
        for event in self._client.events(job_id, after=self._last_id):
            heard = True
            if event.id is not None:
                self._last_id = event.id
                self._take(event)
            if event.kind == "state" and self._news.state in ENDED:
                break
        if heard:
            self.silent_connections = 0
        else:
            self.silent_connections += 1
            self._client.pause(1.0)

    def _take(self, event: JobEvent) -> None:
        self._news = _updated(self._news, event.data)
        if self._past_until is not None and (self._news.attempt, self._news.percent) >= self._past_until:
            self._past_until = None
        if self._past_until is None:
            self._tell(self._news)


def _updated(news: JobNews, data: Mapping[str, Any]) -> JobNews:
    if "state" not in data:
        data = {"state": JobState.RUNNING, **data}  # only what runs makes progress
    known = {field.name for field in fields(JobNews)}
    return JobNews(**{"attempt": news.attempt, **{name: value for name, value in data.items() if name in known}})


def _news(job: JobResource) -> JobNews:
    progress = job.progress
    return JobNews(
        state=job.state,
        attempt=job.attempts[-1].attempt if job.attempts else 0,
        percent=progress.percent,
        stage=progress.stage,
        done=progress.done,
        total=progress.total,
        unit=progress.unit,
        eta_low_s=progress.eta_low_s,
        eta_high_s=progress.eta_high_s,
    )
