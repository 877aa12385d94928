"""The OpenAPI page says all that the API does, and the API does what the page says."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.service.fuzzing import fuzz
from tests.service.live_api import Api, Client, problem_of

RESOURCES = (
    "DriveResource",
    "JobResource",
    "SceneResource",
    "PreflightResource",
    "ServiceStatus",
    "Problem",
    "ReconstructionRequest",
    "DeclareFiles",
    "AggregationRequest",
    "MapResource",
    "MapVersionResource",
    "CurrentVersion",
    "UploadResource",
)


@pytest.fixture(scope="module")
def page(api: Api) -> dict[str, Any]:
    return dict(httpx.get(f"{api.url}/openapi.json").json())


def operations(page: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for path, methods in page["paths"].items():
        for method, operation in methods.items():
            yield f"{method.upper()} {path}", operation


def test_every_route_is_described(page: dict[str, Any]) -> None:
    names = [operation["operationId"] for _, operation in operations(page)]
    assert len(names) == len(set(names)) >= 40
    for name, operation in operations(page):
        assert operation["summary"], name
        assert operation["description"], name
        assert operation["tags"], name
        assert any(status.startswith("2") for status in operation["responses"]), name


def test_every_problem_is_documented_as_one(page: dict[str, Any]) -> None:
    for name, operation in operations(page):
        for status, response in operation["responses"].items():
            if int(status) >= 400:
                assert list(response["content"]) == ["application/problem+json"], (name, status)
        if "/v1/" in name:
            assert "401" in operation["responses"], name
        if "{" in name:
            assert "404" in operation["responses"], name


def test_every_reference_leads_somewhere(page: dict[str, Any]) -> None:
    def references(node: Any) -> Iterator[str]:
        if isinstance(node, dict):
            if isinstance(node.get("$ref"), str):
                yield node["$ref"]
            for value in node.values():
                yield from references(value)
        elif isinstance(node, list):
            for value in node:
                yield from references(value)

    found = set(references(page))
    assert len(found) > 20
    for reference in found:
        node: Any = page
        for part in reference.removeprefix("#/").split("/"):
            node = node[part]


def test_resources_have_examples(page: dict[str, Any]) -> None:
    for name in RESOURCES:
        assert page["components"]["schemas"][name]["examples"], name
    body = page["paths"]["/v1/drives"]["post"]["requestBody"]["content"]["application/json"]
    assert body["example"]["frames"]


def test_the_example_of_a_manifest_is_accepted(client: Client, page: dict[str, Any]) -> None:
    example = page["paths"]["/v1/drives"]["post"]["requestBody"]["content"]["application/json"]["example"]
    assert client.post("/v1/drives", json=example).status_code == 201


@pytest.mark.parametrize(
    ("path", "allowed"),
    [
        ("/v1/drives", "GET, HEAD, POST"),
        ("/v1/drives/x", "GET, HEAD, DELETE"),
        ("/v1/drives/x:commit", "POST"),
        ("/v1/jobs/x:cancel", "POST"),
        ("/v1/drives/x/files/a/b", "PUT, DELETE"),
        ("/v1/scenes/x/files/a/b", "GET, HEAD"),
        ("/v1/maps/x/versions/1/files/a/b", "GET, HEAD"),
        ("/v1/maps/x/current-version", "PUT"),
        ("/v1/drives/x/uploads", "POST, OPTIONS"),
        ("/livez", "GET, HEAD"),
        ("/v1/jobs/x/events", "GET"),
        ("/docs", "GET, HEAD"),
    ],
)
def test_other_methods_are_refused_with_those_there_are(client: Client, path: str, allowed: str) -> None:
    answer = client.patch(path)
    problem_of(answer, 405, "method-not-allowed")
    assert sorted(answer.headers["allow"].split(", ")) == sorted(allowed.split(", "))


def test_a_path_that_is_none(client: Client) -> None:
    problem_of(client.get("/v1/nothing"), 404, "not-found")


def test_made_up_requests_are_answered_as_documented(api: Api, tmp_path: Path) -> None:
    result = fuzz(api.url, api.client().key, tmp_path, max_examples=8, phases="fuzzing,stateful")
    assert result.passed, result.output
    assert result.requests > 100
    assert result.statuses.get("POST /v1/drives 201"), "the requests get somewhere"
    assert {case.split()[1] for case in result.statuses} >= {"/v1/aggregations", "/v1/maps/{map_id}"}


@pytest.mark.slow
def test_many_made_up_requests(api: Api, tmp_path: Path) -> None:
    result = fuzz(api.url, api.client().key, tmp_path, max_examples=40, phases="examples,coverage,fuzzing,stateful")
    assert result.passed, result.output
    assert result.requests >= 2000
    for case in ("POST /v1/drives 201", "PUT /v1/drives/{drive_id}/files/{path} 201"):
        assert result.statuses.get(case), (case, result.statuses)
