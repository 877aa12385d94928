"""A session in the browser: several pages and keys, and a service that is away for a while."""

from __future__ import annotations

import json

from playwright.sync_api import Page, Route, expect

from tests.console.conftest import Open, World, go, log_in
from tests.helpers.live_api import Client

AWAY = {
    "type": "urn:mrasfm:problem:unavailable",
    "title": "Not available at the moment",
    "status": 503,
    "detail": "the database does not answer",
    "remedy": "Try again in some seconds.",
}


def named(world: World, project: str) -> tuple[Client, str]:
    """A client of a project of its own; the project's name as pages show it."""
    client = world.api.client()
    return client, str(client.get("/v1/session").json()["project"])


def log_out(page: Page) -> None:
    page.get_by_role("button", name="Log out").click()
    page.get_by_label("API key").wait_for()


def log_in_here(page: Page, key: str) -> None:
    """Without loading the page anew."""
    page.get_by_label("API key").fill(key)
    page.get_by_role("button", name="Log in").click()
    page.locator("header .project").wait_for()


def test_all_pages_of_a_browser_are_of_one_project(open_console: Open, world: World) -> None:
    """The cookie is one: a page that was open before shows the project of the key that another page logged in with."""
    (first, one), (second, two) = named(world, "one"), named(world, "two")
    assert one != two
    second.create()
    watched = open_console(world.api.url)
    watched.expected = ("401",)
    pages = [watched.new_page(), watched.new_page()]
    log_in(pages[0], world.api.url, first.key)
    go(pages[1], world.api.url, "drives")
    for page in pages:
        expect(page.locator("header .project")).to_have_text(one)
        page.locator("[data-connection=live]").wait_for()
    log_out(pages[0])
    pages[1].get_by_label("API key").wait_for()
    log_in_here(pages[0], second.key)
    for page in pages:
        expect(page.locator("header .project")).to_have_text(two)
        page.locator("tbody a").wait_for()
    pages[0].wait_for_timeout(6000)  # for the end of the first key's event stream
    for page in pages:
        expect(page.locator("header .project")).to_have_text(two)
        expect(page.locator("[data-connection]")).to_have_attribute("data-connection", "live")


def test_a_service_that_is_away_for_a_while_ends_no_session(open_console: Open, world: World) -> None:
    watched = open_console(world.api.url)
    watched.expected = ("503",)
    page = watched.new_page()
    log_in(page, world.api.url, world.client.key)
    away = [True]

    def answer(route: Route) -> None:
        if away[0]:
            route.fulfill(status=503, body=json.dumps(AWAY), content_type="application/problem+json")
        else:
            route.fallback()

    page.route("**/v1/session", answer)
    page.goto(f"{world.api.url}/#/scenes")
    page.reload()
    expect(page.get_by_role("alert")).to_contain_text(AWAY["detail"])
    assert page.get_by_label("API key").count() == 0
    away[0] = False
    page.get_by_role("heading", name="Scenes").wait_for()
    expect(page.locator("header .project")).not_to_be_empty()


def test_a_page_that_was_opened_while_the_service_was_away_goes_on(open_console: Open, world: World) -> None:
    """Also one that is not read anew when a job ends."""
    watched = open_console(world.api.url)
    watched.expected = ("ERR_CONNECTION_REFUSED",)
    page = watched.new_page()
    log_in(page, world.api.url, world.client.key)
    page.locator("[data-connection=live]").wait_for()
    page.route(f"**/v1/scenes/{world.scene_id}", lambda route: route.abort("connectionrefused"))
    page.evaluate(f"location.hash = '#/scenes/{world.scene_id}'")
    expect(page.get_by_role("alert")).to_contain_text("this page goes on by itself when the service is back")
    page.unroute(f"**/v1/scenes/{world.scene_id}")
    page.get_by_text("Units registered").wait_for()
    expect(page.get_by_role("alert")).to_have_count(0)


def test_logging_out_says_where_it_did_not(open_console: Open, world: World) -> None:
    watched = open_console(world.api.url)
    # The last: the stream of events ends with the session, and its page asks whose session there is.
    watched.expected = ("ERR_CONNECTION_REFUSED", "503", "401")
    page = watched.new_page()
    log_in(page, world.api.url, world.client.key)
    page.route("**/v1/session", lambda route: route.abort("connectionrefused"))
    page.get_by_role("button", name="Log out").click()
    expect(page.get_by_role("alert")).to_contain_text("The session goes on")
    assert page.get_by_label("API key").count() == 0
    page.unroute("**/v1/session")
    page.route("**/v1/session", lambda route: route.fulfill(status=503, json=AWAY))
    page.get_by_role("button", name="Log out").click()
    page.wait_for_timeout(300)
    assert page.get_by_label("API key").count() == 0
    page.unroute("**/v1/session")
    log_out(page)


def test_an_address_that_was_cut_or_is_none_is_said_to_be(open_console: Open, world: World) -> None:
    watched = open_console(world.api.url)
    watched.expected = ("404",)
    page = watched.new_page()
    log_in(page, world.api.url, world.client.key)
    for address in ("drives/%", "drives/%E6%9D", "nothing", "drives/..%2Fscenes"):
        page.goto("about:blank")
        page.goto(f"{world.api.url}/#/{address}")
        expect(page.get_by_role("alert")).to_be_visible()


def test_a_service_that_answers_with_errors_is_asked_in_peace(open_console: Open, world: World) -> None:
    """As while its database is away: each page asked a hundred times a second, and said that it polls."""
    watched = open_console(world.api.url)
    watched.expected = ("503",)
    page = watched.new_page()
    page.add_init_script("delete window.SharedWorker")  # its requests cannot be answered here
    log_in(page, world.api.url, world.client.key)
    page.locator("[data-connection=live]").wait_for()
    asked: list[str] = []

    def refuse(route: Route) -> None:
        asked.append(route.request.url)
        route.fulfill(status=503, body=json.dumps(AWAY), content_type="application/problem+json")

    for address in ("**/v1/events", "**/v1/jobs?*"):
        page.route(address, refuse)
    page.reload()
    page.locator("[data-connection=offline]").wait_for()
    page.wait_for_timeout(4000)
    assert 3 <= len(asked) < 10
    expect(page.locator("[data-connection]")).to_have_attribute("data-connection", "offline")
    for address in ("**/v1/events", "**/v1/jobs?*"):
        page.unroute(address)
    page.locator("[data-connection=live]").wait_for()
