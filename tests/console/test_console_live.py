"""Jobs as they go on, in eight pages at one time, and over a restart of the service."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from playwright.sync_api import APIResponse, Locator, Page, Route, expect
from sqlalchemy import delete

from schemas.api.problems import Problem
from service.database.tables import Job
from service.domain import jobs
from service.domain.jobs import Claim, ProgressNote
from service.storage.artifacts import ArtifactStore
from tests.console.conftest import Open, World, go, log_in, wait_for
from tests.helpers.live_api import Api, Client, api_process, settings_of
from tests.helpers.tiny_drive import tiny_drive

TABS = 8


def progress(api: Api, held: Claim, percent: float) -> None:
    note = ProgressNote(stage="features", done=int(percent), total=100, unit="images", percent=percent)
    with api.database.write() as session:
        jobs.heartbeat(session, held, lease_us=600_000_000, note=note)


def shown_percent(page: Page) -> float:
    return float(page.locator(".row .progress .number").inner_text().removesuffix(" %"))


@pytest.mark.slow
def test_eight_pages_live_with_one_stream(open_console: Open, world: World) -> None:
    """A browser opens six connections to a host: a stream for each page would leave none for requests."""
    client = world.api.client()
    job = client.reconstruct(client.frozen(tiny_drive("tabs", seed="tabs")))
    held = client.claim(job["id"])
    watched = open_console(world.api.url)
    first = watched.new_page()
    log_in(first, world.api.url, client.key)
    pages = [first, *(watched.new_page() for _ in range(TABS - 1))]
    for page in pages:
        go(page, world.api.url, f"jobs/{job['id']}")
        page.locator("[data-connection=live]").wait_for()
    asked_s = time.monotonic()
    assert pages[-1].evaluate("fetch('v1/drives').then(a => a.status)") == 200
    assert time.monotonic() - asked_s < 1.0
    seen = []
    for percent in (10.0, 20.0, 30.5, 44.0, 60.0, 75.0):
        progress(world.api, held, percent)
        for page in (pages[0], pages[-1]):
            expect(page.locator(".row .progress .number")).to_have_text(f"{percent:.1f} %", timeout=3000)
        seen.append(shown_percent(pages[-1]))
    assert seen == sorted(set(seen))
    assert len(seen) >= 5
    assert pages[-1].get_by_text("features · 75 of 100 images").is_visible()
    client.publish(held, {"points.ply": b"ply"})
    for page in (pages[0], pages[-1]):
        page.get_by_role("link", name="Open the scene").wait_for()


def test_cancel_and_retry(open_console: Open, world: World) -> None:
    client = world.api.client()
    job = client.reconstruct(client.frozen(tiny_drive("cancel", seed="cancel")))
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, client.key)
    go(page, world.api.url, f"jobs/{job['id']}")
    page.get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Yes").click()
    page.locator(".badge", has_text="cancelled").wait_for()
    assert client.get(f"/v1/jobs/{job['id']}").json()["state"] == "CANCELLED"
    page.get_by_role("button", name="Retry").click()
    page.get_by_role("button", name="Yes").click()
    wait_for(page, f"!location.hash.includes('{job['id']}')")
    page.locator(".badge", has_text="queued").wait_for()
    page.get_by_role("link", name=job["id"]).wait_for()


def test_a_failed_job_shows_its_problem_and_the_end_of_its_log(open_console: Open, world: World) -> None:
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, world.pages["failed job"])
    box = page.get_by_role("alert")
    expect(box).to_contain_text("the process ended with signal 6")
    expect(box).to_contain_text("Report it with the end of the log.")
    expect(box.locator("pre")).to_have_text("line one\nline two")


def test_a_list_that_was_read_earlier_hides_no_news(open_console: Open, world: World) -> None:
    """Neither what the stream said since, nor what a later list says."""
    client = world.api.client()
    ended, deleted = (client.reconstruct(client.frozen(tiny_drive(name, seed=name)))["id"] for name in ("a", "b"))
    held = client.claim(ended)
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, client.key)
    go(page, world.api.url, "jobs")
    page.locator("[data-connection=live]").wait_for()
    read: list[tuple[Route, APIResponse]] = []
    page.route("**/v1/jobs?*", lambda route: read.append((route, route.fetch())))

    def row(job_id: str) -> Locator:
        return page.locator("tbody tr", has=page.locator(f"a[href$='{job_id}']"))

    def read_list() -> None:
        before = len(read)
        page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
        while len(read) == before:
            page.wait_for_timeout(20)

    def arrive(i: int) -> None:
        route, answer = read[i]
        route.fulfill(response=answer)
        page.wait_for_timeout(200)  # for what must not come

    read_list()
    client.publish(held, {"points.ply": b"ply"})
    expect(row(ended).locator(".badge")).to_have_text("succeeded")
    arrive(0)
    expect(row(ended).locator(".badge")).to_have_text("succeeded")
    read_list()
    with world.api.database.write() as session:
        session.execute(delete(Job).where(Job.id == deleted))
    read_list()
    arrive(2)
    expect(row(deleted)).to_have_count(0)
    arrive(1)
    expect(row(deleted)).to_have_count(0)
    expect(row(ended).locator(".badge")).to_have_text("succeeded")


@pytest.mark.slow
def test_a_page_outlives_the_service(open_console: Open, tmp_path: Path) -> None:
    """The service is killed and started again: the page reaches the job's end by itself."""
    settings = settings_of(tmp_path / "data")
    with api_process(settings, tmp_path) as api:
        api.context = SimpleNamespace(artifacts=ArtifactStore.open(settings, api.database))
        client: Client = api.client()
        job = client.reconstruct(client.frozen(tiny_drive("restart", seed="restart")))
        held = client.claim(job["id"])
        watched = open_console(api.url)
        watched.expected = (
            "ERR_CONNECTION_REFUSED",
            "ERR_INCOMPLETE_CHUNKED_ENCODING",
            "ERR_CONTENT_LENGTH_MISMATCH",
            "ERR_CONNECTION_RESET",
            "ERR_EMPTY",
        )
        page = watched.new_page()
        log_in(page, api.url, client.key)
        go(page, api.url, f"jobs/{job['id']}")
        page.locator("[data-connection=live]").wait_for()
        page.evaluate("window.isSamePage = true")
        api.kill()
        wait_for(page, "document.querySelector('[data-connection]').dataset.connection !== 'live'")
        with api.database.write() as session:
            jobs.fail(session, held, problem(), limits=jobs.RetryLimits(max_attempts=1), retry_delay_us=0, blame=9.0)
        api.start()
        page.locator(".badge", has_text="failed").wait_for(timeout=30_000)
        page.locator("[data-connection=live]").wait_for()
        assert page.evaluate("window.isSamePage") is True


def problem() -> Problem:
    return Problem(
        type="urn:mrasfm:problem:engine-abort",
        title="The engine ended",
        status=None,
        detail="it ended",
        remedy="Retry it.",
    )
