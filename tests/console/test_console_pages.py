"""All pages, as somebody without the internet, a mouse or much width sees them."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path
from typing import Any

import axe_playwright_python
import pytest
from playwright.sync_api import Page, ViewportSize, expect

from schemas.api.problems import Problem
from service.database.tables import Drive
from service.domain import jobs
from service.domain.keys import revoke_key
from tests.console.conftest import MAP_FINDING, Open, World, go, log_in, wait_for
from tests.helpers.live_api import ONE_ATTEMPT
from tests.helpers.slow import slow
from tests.helpers.tiny_drive import tiny_drive

WIDE: ViewportSize = {"width": 1280, "height": 800}
NARROW: ViewportSize = {"width": 400, "height": 800}
OF_LOOKS = ("color-contrast", "scrollable-region-focusable", "target-size")  # what width and colours change
AXE = next(Path(axe_playwright_python.__file__).parent.rglob("axe.min.js"))


@pytest.mark.parametrize("pages", [5, *slow(None)])
def test_pages_are_whole(open_console: Open, world: World, pages: int | None) -> None:
    """No request to another host, no error, nothing beyond the width, no serious finding of axe: wide, and narrow."""
    shown = dict(list(world.pages.items())[:pages])
    page = open_console(world.api.url, viewport=WIDE).new_page()
    page.goto(world.api.url)
    page.get_by_label("API key").wait_for()
    findings = {"login": serious(page)}
    log_in(page, world.api.url, world.client.key)
    for name, address in shown.items():
        go(page, world.api.url, address)
        expect(page.locator("main h1")).not_to_be_empty()
        alerts = {"failed job": 1, "calibration": 1, "map's calibration": 1}.get(name, 0)
        assert page.locator(".box.bad[role=alert]").count() == alerts, name
        assert page.evaluate("document.documentElement.scrollWidth") <= WIDE["width"], name
        findings[name] = serious(page)
        page.set_viewport_size(NARROW)
        page.emulate_media(color_scheme="dark")
        assert page.evaluate("document.documentElement.scrollWidth") <= NARROW["width"], name
        findings[f"{name}, dark and narrow"] = serious(page, *OF_LOOKS)
        page.set_viewport_size(WIDE)
        page.emulate_media(color_scheme="light")
    assert {name: found for name, found in findings.items() if found} == {}
    assert len(findings) == 1 + 2 * len(shown) > (40 if pages is None else 10)


def serious(page: Page, *rules: str) -> list[str]:
    """Findings of axe, of some rules or of all."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(AXE.read_text(encoding="utf-8"))
    options = {"resultTypes": ["violations"], **({"runOnly": list(rules)} if rules else {})}
    found = page.evaluate("options => axe.run(options)", options)["violations"]
    return [
        f"{one['id']}: {one['nodes'][0]['html'][:120]}" for one in found if one["impact"] in ("serious", "critical")
    ]


def test_the_key_is_kept_nowhere(open_console: Open, world: World) -> None:
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, world.client.key)
    kept = page.evaluate(
        "JSON.stringify([document.cookie, {...localStorage}, {...sessionStorage}, location.href,"
        " document.documentElement.outerHTML])"
    )
    assert world.client.key not in kept
    assert json.loads(kept)[0] == ""
    assert world.client.key[:20] not in page.evaluate(
        "Array.from(document.querySelectorAll('input'), i => i.value).join()"
    )
    (cookie,) = page.context.cookies()
    assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")


def test_a_form_of_another_host_changes_nothing(open_console: Open, world: World) -> None:
    watched = open_console(world.api.url)
    watched.expected = ("Failed to load resource",)
    page = watched.new_page()
    log_in(page, world.api.url, world.client.key)
    before = len(world.client.get("/v1/jobs?limit=200").json()["items"])
    other = world.api.url.replace("127.0.0.1", "localhost")
    watched.url = "http://"  # this test's other site is another name of this machine
    page.goto(f"{other}/livez")
    target = f"{world.api.url}/v1/jobs/{world.failed_job}:retry"
    page.set_content(f'<form method="post" action="{target}"><button>Win</button></form>')
    with page.expect_navigation():
        page.get_by_role("button").click()
    assert "unauthorized" in page.content()
    assert len(world.client.get("/v1/jobs?limit=200").json()["items"]) == before


def test_by_keyboard_alone_from_login_to_download(open_console: Open, world: World) -> None:
    page = open_console(world.api.url).new_page()
    page.goto(world.api.url)
    page.get_by_label("API key").wait_for()
    page.keyboard.type(world.client.key)  # the field has the focus
    page.keyboard.press("Enter")
    page.get_by_role("heading", name="Drives").wait_for()
    tab_to(page, "Scenes")
    page.keyboard.press("Enter")
    page.get_by_role("heading", name="Scenes").wait_for()
    tab_to(page, "example")
    page.keyboard.press("Enter")
    page.get_by_role("heading", name="example", exact=True).wait_for()
    tab_to(page, "Files")
    page.keyboard.press("Enter")
    page.get_by_role("heading", name="Files").wait_for()
    tab_to(page, "points.ply")
    with page.expect_download() as download:
        page.keyboard.press("Enter")
    assert Path(download.value.path()).read_bytes() == (world.folder / "points.ply").read_bytes()


def tab_to(page: Page, text: str) -> None:
    for _ in range(60):
        page.keyboard.press("Tab")
        focus = page.evaluate(
            "[document.activeElement.textContent, getComputedStyle(document.activeElement).outlineStyle]"
        )
        if focus[0] == text:
            assert focus[1] != "none", "the focus is seen"
            return
    raise AssertionError(f"{text} is not reached")


def test_a_revoked_key_ends_the_page_in_time(open_console: Open, world: World) -> None:
    watched = open_console(world.api.url)
    watched.expected = ("401",)
    page = watched.new_page()
    project_id, key = world.api.new_key()
    log_in(page, world.api.url, key)
    page.locator("[data-connection=live]").wait_for()
    key_id = world.api.client_of(project_id, key).get("/v1/session").json()["key_id"]
    with world.api.database.write() as session:
        revoke_key(session, key_id)
    revoked_s = time.monotonic()
    page.get_by_label("API key").wait_for()
    assert time.monotonic() - revoked_s < 5.0


def corrections_agree(page: Page, document: dict[str, Any]) -> None:
    """Each correction and its sigma is the file's, exact in an attribute and rounded to the digits that are shown."""
    for name, camera in document["cameras"].items():
        for kind, field, of_sigma in (
            ("rotation", "rotation_vector_deg", "rotation_deg"),
            ("translation", "translation_m", "translation_m"),
        ):
            row = page.locator(f"[data-corrections={kind}] tr[data-camera={name}]")
            assert row.get_attribute("data-wrong") == str(camera["wrong"]).lower()
            for axis, value, sigma in zip(
                "xyz", camera["difference"][field], camera["sigma"].get(of_sigma, [None] * 3), strict=True
            ):
                shown = row.locator(f"[data-axis={axis}]")
                assert float(shown.get_attribute("data-value") or "nan") == value
                first, *more = shown.inner_text().split(" ± ")
                if sigma is not None:
                    assert float(shown.get_attribute("data-sigma") or "nan") == sigma
                    decimals = len(more[0].partition(".")[2])
                    assert len(re.sub(r"^[0.]+", "", more[0].replace(".", ""))) >= 3
                    assert (first, more[0]) == (f"{value:.{decimals}f}", f"{sigma:.{decimals}f}")
                else:
                    assert float(first) == pytest.approx(value, rel=6e-3)


def test_calibration_shows_what_the_file_says(open_console: Open, world: World) -> None:
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, world.pages["calibration"])
    page.locator("[data-corrections=rotation]").wait_for()
    document = json.loads((world.folder / "calibration.json").read_text())
    corrections_agree(page, document)
    for name, camera in document["cameras"].items():
        for param, given in zip(camera["param_names"], camera["refined"]["params"], strict=True):
            cell = page.locator(f"[data-intrinsics] tr[data-camera={name}][data-param={param}] td[data-value]").last
            assert float(cell.get_attribute("data-value") or "nan") == given
    # Three drives of the vehicle have a scene: two of one calibration from the fixture's file, and the map's third.
    charts = page.locator(".chart")
    expect(charts).to_have_count(3)
    for index in range(3):
        drawn = charts.nth(index).locator("[data-value]").evaluate_all("all => all.map(one => +one.dataset.value)")
        values = [camera["difference"]["rotation_vector_deg"][index] for camera in document["cameras"].values()]
        assert drawn == [value for value in values for _ in range(3)]


def test_versions_are_compared_and_rolled_back(open_console: Open, world: World) -> None:
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, world.pages["versions"])
    expect(page.get_by_text("Scenes added: third")).to_be_visible()
    page.get_by_role("button", name="Make it current").click()
    page.get_by_role("button", name="Yes").click()
    page.locator("tbody tr:nth-child(2) .badge", has_text="current").wait_for()
    assert world.client.get(f"/v1/maps/{world.map_id}").json()["current_version"] == 1
    world.client.put(f"/v1/maps/{world.map_id}/current-version", json={"version": 2})


def test_the_list_of_drives_counts_findings_of_the_check(open_console: Open, world: World) -> None:
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, world.pages["drives"])
    expect(page.get_by_role("row", name="example").get_by_text("1 warning")).to_have_count(1)
    expect(page.locator("table").get_by_text("warning")).to_have_count(1)


def test_a_map_lists_its_findings(open_console: Open, world: World) -> None:
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, world.pages["map"])
    listed = page.locator("ul.findings li")
    expect(listed).to_have_count(1)
    expect(listed).to_contain_text(f"Warning: {MAP_FINDING['what']}")
    expect(listed).to_contain_text(MAP_FINDING["remedy"])


def test_a_seam_shows_its_pictures_and_a_missing_one_its_reason(open_console: Open, world: World) -> None:
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, world.pages["seams"])
    pictures = page.locator(".slider img")
    assert pictures.count() == 2
    for index in range(2):
        pictures.nth(index).scroll_into_view_if_needed()
    wait_for(page, "Array.from(document.querySelectorAll('.slider img')).every(i => i.naturalWidth === 300)")
    expect(page.get_by_text("two hypotheses have a similar number of inliers")).to_be_visible()
    expect(page.locator("[data-exact='0.7316933881054083']")).to_have_text("0.732 px")
    slider = page.get_by_role("slider")
    slider.focus()
    page.keyboard.press("End")
    assert "100%" in page.locator(".stack img + img").evaluate("e => e.style.clipPath")


def test_first_page_is_small(world: World) -> None:
    import gzip

    page = world.client.get("/")
    names = set(re.findall(r'(?:src|href)="(console/files/[^"]+)"', page.text))
    script = world.client.get("/console/files/console.js").text
    names |= {f"console/files/{name}" for name in re.findall(r'from"\./([^"]+)"', script)} | {"console/files/events.js"}
    assert len(names) >= 5
    sizes = [len(gzip.compress(world.client.get(f"/{name}").content)) for name in names]
    assert 10_000 < sum(sizes) + len(gzip.compress(page.content)) <= 80_000


def test_a_tile_url_adds_its_origin_and_no_other(tmp_path: Path) -> None:
    from service.api.routes.console import console_policy
    from tests.helpers.live_api import settings_of

    settings = settings_of(tmp_path, console_tiles="https://tiles.example:8443/a/{z}/{x}/{y}.png")
    assert settings.tile_origin == "https://tiles.example:8443"
    own, more = (set(console_policy(origin).replace(";", " ").split()) for origin in (None, settings.tile_origin))
    assert more - own == {"https://tiles.example:8443"}
    for wrong in (
        "ftp://a/{z}/{x}/{y}",
        "https://a/{z}/{x}",
        "https://a b/{z}/{x}/{y}",
        "https://a;script-src/{z}/{x}/{y}",
    ):
        with pytest.raises(ValueError, match="console_tiles"):
            settings_of(tmp_path, console_tiles=wrong)


def test_a_form_that_is_sent_twice_makes_one_map(open_console: Open, world: World) -> None:
    page, client = open_console(world.api.url).new_page(), world.api.client(max_active_jobs=20)
    for name in ("a", "b"):
        client.scene({"points.ply": b"ply"}, tiny_drive(name, seed=name))
    log_in(page, world.api.url, client.key)
    go(page, world.api.url, "drives")
    for box in page.locator("tbody input[type=checkbox]").all():
        box.check()
    page.get_by_role("button", name="Make a map of 2 drives").dblclick()
    wait_for(page, "location.hash.includes('jobs/')")
    page.wait_for_timeout(500)
    assert len(client.get("/v1/maps").json()["items"]) == 1


def test_a_question_has_the_focus(open_console: Open, world: World) -> None:
    """The button that was pressed is gone: somebody with a keyboard would begin at the top of the page."""
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, f"drives/{world.drive_id}")
    page.get_by_role("button", name="Delete").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="No")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="Delete")).to_be_focused()


def test_a_long_name_leaves_a_list_its_columns(open_console: Open, world: World) -> None:
    """One name without a space pushed all columns of a list out of sight."""
    page, client = open_console(world.api.url, viewport=WIDE).new_page(), world.api.client()
    long = "W" * 200
    client.scene({"points.ply": b"ply"}, tiny_drive(long, seed="long"))
    log_in(page, world.api.url, client.key)
    for address in ("drives", "scenes", "jobs"):
        go(page, world.api.url, address)
        page.get_by_text(long).first.wait_for()
        table = page.locator(".scroll")
        assert table.evaluate("one => one.scrollWidth - one.clientWidth") <= 0, address


def test_a_job_of_many_drives_names_some_of_them(open_console: Open, world: World) -> None:
    page, client = open_console(world.api.url).new_page(), world.api.client(max_active_jobs=50)
    drives = [client.frozen(tiny_drive(f"drive-{i}", seed=f"some {i}")) for i in range(7)]
    client.aggregate(drives=drives, name="many")
    log_in(page, world.api.url, client.key)
    go(page, world.api.url, "jobs")
    page.get_by_text("drive-0, drive-1, drive-2, drive-3, drive-4 and 2 more").wait_for()


def test_a_long_name_in_a_finding_or_problem_stays_on_the_page(open_console: Open, world: World) -> None:
    page, client = open_console(world.api.url, viewport=NARROW).new_page(), world.api.client()
    long = f"images/{'front_left_' * 12}.png"
    drive_id = client.frozen(tiny_drive("finding", seed="finding"))
    finding = {"severity": "warning", "code": "dark", "what": f"{long} is dark", "remedy": f"Look at {long}."}
    job = client.reconstruct(drive_id)
    problem = Problem(
        type="urn:mrasfm:problem:bad-input", title="It failed", status=None, detail=f"{long} is dark", remedy="Look."
    )
    with world.api.database.write() as session:
        session.get_one(Drive, drive_id).findings = [finding]
        held = jobs.claim(session, job["id"], owner="worker@test", lease_us=60_000_000)
        assert held is not None
        jobs.fail(session, held, problem, limits=ONE_ATTEMPT, retry_delay_us=0)
    log_in(page, world.api.url, client.key)
    for address in (f"drives/{drive_id}", f"jobs/{job['id']}"):
        go(page, world.api.url, address)
        page.get_by_text(f"{long} is dark").first.wait_for()
        assert page.evaluate("document.documentElement.scrollWidth") <= NARROW["width"], address
