"""The console's session: a cookie in place of a key, for as long as the key, and for this host's pages only."""

from __future__ import annotations

from http.cookies import SimpleCookie

import httpx
import pytest

from service.database.tables import ApiKey, ConsoleSession, now_us
from service.domain.keys import KeyRing, revoke_key
from service.domain.sessions import KEPT_S
from tests.helpers.live_api import Api, Client, problem_of, wait_until
from tests.helpers.tiny_drive import tiny_drive

COOKIE = "mrasfm_session"


def login(api: Api, client: Client) -> httpx.Client:
    """A browser's client: no key, only the cookie."""
    answer = client.post("/v1/session")
    assert answer.status_code == 201, answer.text
    client.cookies.clear()
    browser = api.anonymous()
    browser.cookies.set(COOKIE, answer.cookies[COOKIE])
    return browser


def origin_of(api: Api) -> dict[str, str]:
    return {"Origin": api.url}


def key_id(client: Client) -> str:
    return str(client.get("/v1/session").json()["key_id"])


def test_a_key_becomes_a_cookie_that_scripts_and_other_sites_cannot_use(api: Api, client: Client) -> None:
    answer = client.post("/v1/session")
    client.cookies.clear()
    morsel = SimpleCookie(answer.headers["set-cookie"])[COOKIE]
    assert morsel["httponly"] is True
    assert morsel["samesite"] == "strict"
    assert morsel["max-age"] == str(KEPT_S)
    assert (morsel["path"], morsel["domain"]) == ("/", "")
    assert client.key not in answer.text + str(answer.headers)
    with api.database.read() as session:
        stored = session.query(ConsoleSession).filter_by(key_id=answer.json()["key_id"]).one()
        assert morsel.value not in (stored.secret_sha256, stored.id)


@pytest.mark.parametrize("protocols", ["https", "https, http", "HTTPS,http"])
def test_behind_tls_the_cookie_is_secure(client: Client, protocols: str) -> None:
    """Each proxy adds what it was asked by: the first is the client's own."""
    answer = client.post("/v1/session", headers={"X-Forwarded-Proto": protocols})
    assert SimpleCookie(answer.headers["set-cookie"])[COOKIE]["secure"] is True


def test_without_tls_the_cookie_is_not_secure(client: Client) -> None:
    answer = client.post("/v1/session", headers={"X-Forwarded-Proto": "http, https"})
    assert SimpleCookie(answer.headers["set-cookie"])[COOKIE]["secure"] == ""


def test_the_cookie_reads_and_writes_what_the_key_does(api: Api, client: Client) -> None:
    browser = login(api, client)
    assert browser.get("/v1/session").json()["session_expires_at"] is not None
    created = browser.post("/v1/drives", content=tiny_drive().raw, headers=origin_of(api))
    assert created.status_code == 201
    assert [d["id"] for d in client.get("/v1/drives").json()["items"]] == [created.json()["id"]]


@pytest.mark.parametrize("origin", [None, "null", "http://evil.example", "http://127.0.0.1:1", "http://127.0.0.1"])
def test_a_write_from_elsewhere_changes_nothing(api: Api, client: Client, origin: str | None) -> None:
    browser = login(api, client)
    headers = {} if origin is None else {"Origin": origin}
    problem_of(browser.post("/v1/drives", content=tiny_drive().raw, headers=headers), 403, "foreign-origin")
    problem_of(browser.delete("/v1/session", headers=headers), 403, "foreign-origin")
    assert client.get("/v1/drives").json()["items"] == []
    assert browser.get("/v1/drives").status_code == 200


@pytest.mark.parametrize("site", ["cross-site", "same-site", "none"])
def test_a_browser_that_says_where_a_write_comes_from_is_believed(api: Api, client: Client, site: str) -> None:
    """Also behind a proxy that changes Host, and where Origin has another scheme, which Host does not tell."""
    browser = login(api, client)
    told = {**origin_of(api), "Sec-Fetch-Site": site}
    problem_of(browser.post("/v1/drives", content=tiny_drive().raw, headers=told), 403, "foreign-origin")
    told = {"Origin": "https://maps.example.org", "Sec-Fetch-Site": "same-origin"}
    assert browser.post("/v1/drives", content=tiny_drive().raw, headers=told).status_code == 201


def test_a_bearer_key_needs_no_origin_and_no_cookie_helps_a_wrong_one(api: Api, client: Client) -> None:
    browser = login(api, client)
    problem_of(browser.get("/v1/drives", headers={"Authorization": "Bearer mrasfm_wrong"}), 401, "unauthorized")
    cookie = browser.cookies[COOKIE]
    bearer = api.anonymous(Authorization=f"Bearer {cookie}")
    problem_of(bearer.get("/v1/drives"), 401, "unauthorized")
    as_cookie = api.anonymous()
    as_cookie.cookies.set(COOKIE, client.key)
    problem_of(as_cookie.get("/v1/drives"), 401, "unauthorized")


def test_a_session_does_not_renew_itself(api: Api, client: Client) -> None:
    browser = login(api, client)
    problem_of(browser.post("/v1/session", headers=origin_of(api)), 401, "unauthorized")


def test_logging_out_ends_the_session_and_no_other(api: Api, client: Client) -> None:
    first, second = login(api, client), login(api, client)
    assert first.get("/v1/drives").status_code == 200
    answer = first.delete("/v1/session", headers=origin_of(api))
    assert answer.status_code == 204
    assert SimpleCookie(answer.headers["set-cookie"])[COOKIE]["max-age"] == "0"
    first.cookies.set(COOKIE, second.cookies[COOKIE] + "x")
    assert first.get("/v1/drives").status_code == 401
    assert second.get("/v1/drives").status_code == 200


def test_a_session_ends_with_its_key_and_with_its_time(api: Api, client: Client) -> None:
    of_time = login(api, client)
    with api.database.write() as session:
        session.query(ConsoleSession).filter_by(key_id=key_id(client)).update({"expires_us": now_us() - 1})
    assert of_time.get("/v1/drives").status_code == 401
    browser, mine = login(api, client), key_id(client)
    assert browser.get("/v1/drives").status_code == 200
    with api.database.write() as session:
        revoke_key(session, mine)
    wait_until(lambda: browser.get("/v1/drives").status_code == 401, "the session's end")


def test_sessions_of_a_key_are_bounded(api: Api, client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.domain.sessions._MAX_OF_A_KEY", 3)
    browsers = [login(api, client) for _ in range(5)]
    with api.database.read() as session:
        assert session.query(ConsoleSession).filter_by(key_id=key_id(client)).count() == 3
    assert browsers[0].get("/v1/session").status_code == 401
    assert browsers[-1].get("/v1/session").status_code == 200


def test_the_key_ring_forgets(api: Api, client: Client) -> None:
    ring = KeyRing(api.database)
    assert ring.find(client.key) == client.project_id
    ring.forget(client.key)
    assert ring.remembered(client.key) is None
    with api.database.read() as session:
        assert session.query(ApiKey).count() > 0
