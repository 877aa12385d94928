"""Following jobs: by events, without them, and across restarts of the service."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import pytest

from schemas.api.problems import PROBLEM_TYPE, Problem
from service.client import JobNews, watch_job
from service.client.api import _events, _lines
from service.client.display import described
from service.domain import jobs
from tests.helpers.bad_network import Cut, bad_network
from tests.helpers.live_api import ONE_ATTEMPT, Client
from tests.helpers.tiny_drive import tiny_drive
from tests.service.client.conftest import Connect


@pytest.fixture
def job_id(client: Client) -> str:
    """A job that waits."""
    return str(client.reconstruct(client.frozen(tiny_drive(seed="follow")))["id"])


@contextmanager
def meanwhile(work: Callable[[], object]) -> Iterator[None]:
    """Do something in another thread."""
    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        thread.join()


def note(percent: float, stage: str) -> jobs.ProgressNote:
    return jobs.ProgressNote(
        stage=stage, done=1, total=2, unit="images", percent=percent, eta_low_s=1.0, eta_high_s=2.0
    )


STEPS = ((10.0, "features"), (60.0, "mapping"))


def work_of(
    client: Client, job_id: str, told: list[JobNews], steps: Sequence[tuple[float, str]] = STEPS
) -> Callable[[], None]:
    """A worker's part: progress, each step once the one before was told, then a scene."""

    def work() -> None:
        held = client.claim(job_id)
        for percent, stage in steps:
            with client.api.database.write() as session:
                jobs.heartbeat(session, held, lease_us=60_000_000, note=note(percent, stage))
            end_s = time.monotonic() + 30
            while not any(news.percent >= percent for news in told) and time.monotonic() < end_s:
                time.sleep(0.02)
        client.publish(held, {"report.json": b"{}"})

    return work


def test_events_tell_every_step(client: Client, connect: Connect, job_id: str) -> None:
    told: list[JobNews] = []
    with meanwhile(work_of(client, job_id, told)):
        job = watch_job(connect(client), job_id, tell=told.append)
    assert job.state == "SUCCEEDED"
    assert job.scene_id is not None
    steps = [(news.state, news.stage, news.percent) for news in told]
    assert ("RUNNING", "features", 10.0) in steps
    assert ("RUNNING", "mapping", 60.0) in steps
    assert told[-1].state == "SUCCEEDED"
    percents = [news.percent for news in told]
    assert percents == sorted(percents)


def test_breaking_streams_go_on_after_the_last_event(client: Client, connect: Connect, job_id: str) -> None:
    cut = Cut(b"/events", answer_bytes=1000, times=3)  # the head, and some of the events
    told: list[JobNews] = []
    steps = [(10.0 * i, "features") for i in range(1, 9)]
    with bad_network(client.api.url, cut) as network, meanwhile(work_of(client, job_id, told, steps)):
        assert watch_job(connect(client, url=network.url), job_id, tell=told.append).state == "SUCCEEDED"
    assert b"last-event-id" not in cut.seen[0].lower()
    assert any(b"last-event-id" in head.lower() for head in cut.seen[1:])


def test_where_no_stream_gets_through_it_asks(client: Client, connect: Connect, job_id: str) -> None:
    cut = Cut(b"/events", answer_bytes=0, times=1000)
    told: list[JobNews] = []
    with bad_network(client.api.url, cut) as network, meanwhile(work_of(client, job_id, told)):
        assert watch_job(connect(client, url=network.url), job_id, tell=told.append).state == "SUCCEEDED"
    assert len(cut.seen) == 2
    assert {"features", "mapping"} <= {news.stage for news in told}


def test_the_past_of_a_job_is_not_told_again(client: Client, connect: Connect, job_id: str) -> None:
    held = client.claim(job_id)
    for percent in (10.0, 20.0, 30.0):
        with client.api.database.write() as session:
            jobs.heartbeat(session, held, lease_us=60_000_000, note=note(percent, "features"))
    told: list[JobNews] = []
    with meanwhile(work_of_held(client, held, told)):
        watch_job(connect(client), job_id, tell=told.append)
    assert min(news.percent for news in told) == 30.0
    assert "mapping" in {news.stage for news in told}


def work_of_held(client: Client, held: jobs.Claim, told: list[JobNews]) -> Callable[[], None]:
    def work() -> None:
        end_s = time.monotonic() + 30
        while not told and time.monotonic() < end_s:
            time.sleep(0.02)
        with client.api.database.write() as session:
            jobs.heartbeat(session, held, lease_us=60_000_000, note=note(60.0, "mapping"))
        while not any(news.stage == "mapping" for news in told) and time.monotonic() < end_s:
            time.sleep(0.02)
        client.publish(held, {"report.json": b"{}"})

    return work


def test_a_job_that_fails_ends_it_with_its_problem(client: Client, connect: Connect, job_id: str) -> None:
    held = client.claim(job_id)
    problem = Problem(type=PROBLEM_TYPE + "no-overlap", title="t", detail="what", remedy="remedy", retryable=False)
    with client.api.database.write() as session:
        jobs.fail(session, held, problem, limits=ONE_ATTEMPT, retry_delay_us=0)
    job = watch_job(connect(client), job_id)
    assert job.state == "FAILED"
    assert job.problem is not None
    assert job.problem.detail == "what"


STREAM = (
    b": ping\n\n"
    b'id: 7\r\nevent: progress\r\ndata: {"stage":\r\ndata:  "a\xe2\x80\xa8b"}\r\n\r\n'
    b"retry: 3\n\n"
    b"id: 8\nevent: state\ndata: no json\n\n"
    b"id: 9\nevent: state\ndata: {}\n"  # not ended: not an event
)


@pytest.mark.parametrize("size", [1, 2, 7, 1000])
def test_event_streams_are_read_however_they_are_cut(size: int) -> None:
    pieces = (STREAM[i : i + size] for i in range(0, len(STREAM), size))
    events = [(event.id, event.kind, event.data) for event in _events(_lines(pieces))]
    assert events == [
        (None, "keep-alive", {}),
        (7, "progress", {"stage": "a\u2028b"}),
        (8, "state", {}),
    ]


@pytest.mark.parametrize(
    ("news", "line"),
    [
        (JobNews("QUEUED"), "QUEUED"),
        (JobNews("QUEUED", attempt=1), "QUEUED again after attempt 1"),
        (JobNews("QUEUED", 1, 30.0, "submaps", 3, 8, "sub-maps"), "QUEUED, 30.0 %, submaps 3/8 sub-maps"),
        (
            JobNews("RUNNING", 1, 33.5, "matches", 4, 19, "pairs", 120, 260),
            "RUNNING, 33.5 %, matches 4/19 pairs, 2 to 5 min to go",
        ),
        (JobNews("RUNNING", 1, 3.0, "fetch", eta_low_s=2.5, eta_high_s=20.2), "RUNNING, 3.0 %, fetch, 2 to 21 s to go"),
        (JobNews("RUNNING", 1, 3.0, "x", eta_low_s=7200, eta_high_s=30000), "RUNNING, 3.0 %, x, 2 to 9 h to go"),
        (JobNews("STALLED", 1, 50.0, "mapping", 1, 2, "units", 1, 2), "STALLED, 50.0 %, mapping 1/2 units"),
        (JobNews("SUCCEEDED", 1, 100.0, "publish", 1, 2, "files"), "SUCCEEDED"),
    ],
)
def test_news_in_one_line(news: JobNews, line: str) -> None:
    assert described(news) == line
