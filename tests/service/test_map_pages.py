"""Pages of maps and of their versions, which may show thousands of scenes."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import insert

from service.database.tables import Map, MapScene, MapVersion, Scene, new_id
from tests.helpers.executed_statements import statements_of
from tests.helpers.live_api import MAP_SUMMARY, Api, Client

PROBLEM = {"type": "https://example.org/p", "title": "t", "detail": "d", "remedy": "r", "retryable": False}


@pytest.fixture(params=["api", "postgres_api"])
def owner(request: pytest.FixtureRequest) -> Client:
    """A client of a project of its own, with either database."""
    api: Api = request.getfixturevalue(request.param)
    return api.client()


def published(client: Client, *versions: tuple[str, int, int, int]) -> None:
    """Versions of maps without a job, of a map's id, a number, and as many scenes and failed drives each."""
    scene = {"id": new_id("scn"), "project_id": client.project_id, "job_id": new_id("job"), "drive_id": "drv_1"}
    failed = {"drive_id": "drv_2", "job_id": None, "problem": PROBLEM}
    rows: dict[type[Any], list[dict[str, Any]]] = {
        MapVersion: [
            {
                "map_id": map_id,
                "number": number,
                "job_id": new_id("job"),
                "fence": 1,
                "summary": MAP_SUMMARY.model_dump(mode="json"),
                "failed": [{**failed, "name": f"f{i}"} for i in range(missing)],
            }
            for map_id, number, _, missing in versions
        ],
        MapScene: [
            {
                "map_id": map_id,
                "number": number,
                "name": f"s{i:04d}",
                "drive_id": "drv_1",
                "scene_id": scene["id"],
                "connected": i % 2 == 0,
            }
            for map_id, number, scenes, _ in versions
            for i in range(scenes)
        ],
    }
    with client.api.database.write() as session:
        session.execute(insert(Scene), [{**scene, "name": "s", "fence": 1, "summary": {}}])
        for table, values in rows.items():
            session.execute(insert(table), values)


def made_maps(client: Client, *current: int | None) -> list[str]:
    """Maps with these current versions, the newest first."""
    rows = [
        {
            "id": new_id("map"),
            "project_id": client.project_id,
            "name": f"m{i}",
            "current_version": number,
            "newest_version": number or 0,
            "created_us": 1000 - i,
        }
        for i, number in enumerate(current)
    ]
    with client.api.database.write() as session:
        session.execute(insert(Map), rows)
    return [str(row["id"]) for row in rows]


def pages(client: Client, url: str, limit: int) -> list[list[dict[str, Any]]]:
    """All pages of a list."""
    found: list[list[dict[str, Any]]] = []
    cursor = None
    while not found or cursor is not None:
        page = client.get(url, params={"limit": limit, **({} if cursor is None else {"cursor": cursor})}).json()
        found.append(page["items"])
        cursor = page["next"]
    return found


def children(version: dict[str, Any] | None) -> int:
    return 0 if version is None else len(version["scenes"]) + len(version["failed"])


def test_a_page_of_maps_ends_where_their_scenes_are_many(owner: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.api.routes.map_views.CHILDREN_OF_PAGE", 10)
    made = made_maps(owner, None, 1, 3, 2, 1, 1)
    published(
        owner,
        (made[1], 1, 4, 0),
        (made[2], 2, 9, 9),  # not current
        (made[2], 3, 2, 2),
        (made[3], 2, 3, 0),
        (made[4], 1, 12, 1),
        (made[5], 1, 0, 0),
    )
    found = pages(owner, "/v1/maps", 4)
    assert [[shown["id"] for shown in page] for page in found if page] == [made[:3], [made[3]], [made[4]], [made[5]]]
    assert [children(shown["version"]) for page in found for shown in page] == [0, 4, 4, 3, 13, 0]


def test_a_page_of_versions_ends_where_their_scenes_are_many(owner: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.api.routes.map_views.CHILDREN_OF_PAGE", 10)
    first, other = made_maps(owner, 6, 1)
    sizes = [(2, 3), (5, 0), (1, 0), (11, 0), (0, 0), (10, 0)]
    published(owner, (other, 1, 7, 7), *((first, 6 - i, scenes, missing) for i, (scenes, missing) in enumerate(sizes)))
    found = pages(owner, f"/v1/maps/{first}/versions", 4)
    assert [[shown["number"] for shown in page] for page in found if page] == [[6, 5], [4], [3], [2, 1]]
    assert [(len(shown["scenes"]), len(shown["failed"])) for page in found for shown in page] == sizes
    assert [shown["is_current"] for page in found for shown in page] == [True, *[False] * 5]
    (named,) = [shown for page in found for shown in page if shown["number"] == 5]
    assert [scene["name"] for scene in named["scenes"]] == [f"s{i:04d}" for i in range(5)]
    assert named["unconnected"] == ["s0001", "s0003"]


def test_a_page_takes_as_few_queries_however_long_it_is(owner: Client) -> None:
    made = made_maps(owner, *[1] * 30)
    published(owner, *((map_id, 1, 3, 1) for map_id in made), *((made[0], number, 3, 1) for number in range(2, 32)))
    for url, count in (("/v1/maps", 30), (f"/v1/maps/{made[0]}/versions", 31)):
        with statements_of(owner.api.context.database) as statements:
            (shown,) = [page for page in pages(owner, url, 1000) if page]
        assert len(shown) == count
        assert 4 < len(statements) < 15, statements


def test_a_page_reads_no_scene_that_it_does_not_show(owner: Client) -> None:
    made = made_maps(owner, *[1] * 3)
    published(owner, *((map_id, 1, 1500, 0) for map_id in made))
    assert [len(page) for page in pages(owner, "/v1/maps", 1000) if page] == [1, 1, 1]
    single = owner.get(f"/v1/maps/{made[0]}").json()
    assert len(single["version"]["scenes"]) == 1500
