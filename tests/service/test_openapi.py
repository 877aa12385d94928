"""The OpenAPI page says all that the API does, and the API does what the page says."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from pydantic import BaseModel

from schemas.api.drives import DriveResource
from schemas.api.jobs import JobResource
from schemas.api.resource import Resource, example_of
from schemas.api.uploads import UploadResource
from tests.helpers.fuzzing import fuzz
from tests.helpers.live_api import Api, Client, problem_of


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


def json_contents(page: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """What is asked and what is answered in JSON."""
    for name, operation in operations(page):
        told = [("body", operation.get("requestBody", {})), *operation["responses"].items()]
        for where, each in told:
            if "application/json" in each.get("content", {}):
                yield f"{name} {where}", each["content"]["application/json"]


def test_every_body_and_every_answer_has_an_example(page: dict[str, Any]) -> None:
    found = 0
    for name, content in json_contents(page):
        model = page["components"]["schemas"][content["schema"]["$ref"].rpartition("/")[2]]
        assert content.get("example") or model.get("examples"), name
        found += 1
    assert found > 25
    assert page["components"]["schemas"]["Finding"]["examples"]


def test_every_example_is_valid(page: dict[str, Any]) -> None:
    shown = [(name, schema, schema.get("examples", ())) for name, schema in page["components"]["schemas"].items()]
    shown += [(name, of["schema"], [of["example"]]) for name, of in json_contents(page) if "example" in of]
    for name, schema, examples in shown:
        validator = jsonschema.Draft202012Validator({**schema, "components": page["components"]})
        for example in examples:
            assert [error.message for error in validator.iter_errors(example)] == [], name


def models(root: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for model in root.__subclasses__():
        yield model
        yield from models(model)


def test_examples_of_answers_show_every_field() -> None:
    shown = [model for model in models(Resource) if isinstance(model.model_config.get("json_schema_extra"), dict)]
    assert len(shown) > 20
    for model in shown:
        example = example_of(model)
        assert model.model_validate_json(json.dumps(example)).model_dump(mode="json") == example, model.__name__


def test_examples_of_lists_are_theirs(page: dict[str, Any]) -> None:
    pages = {name: schema for name, schema in page["components"]["schemas"].items() if name.startswith("Page_")}
    assert len(pages) == 10
    for name, schema in pages.items():
        (item,) = schema["examples"][0]["items"]
        assert item.get("files", []) == [], name
        assert schema["description"].startswith("Part of a list"), name


def test_the_page_shows_examples_as_they_are_written(page: dict[str, Any]) -> None:
    for model in (DriveResource, JobResource, UploadResource):
        shown = page["components"]["schemas"][model.__name__]["examples"][0]
        assert list(shown.items()) == list(example_of(model).items())
    (job,) = page["components"]["schemas"]["Page_JobResource_"]["examples"][0]["items"]
    assert list(job) == list(example_of(JobResource))


def test_the_example_of_a_manifest_is_accepted(client: Client, page: dict[str, Any]) -> None:
    example = page["components"]["schemas"]["DriveManifest"]["examples"][0]
    assert example["frames"]
    assert client.post("/v1/drives", json=example).status_code == 201


def test_what_is_given_is_described(page: dict[str, Any]) -> None:
    for name, operation in operations(page):
        for given in operation.get("parameters", ()):
            assert given["description"], (name, given["name"])
            assert given["in"] != "header" or given["name"][0].isupper(), (name, given["name"])
        for status, response in operation["responses"].items():
            assert response["description"] not in ("", "Successful Response"), (name, status)


# The name says all there is to say.
CLEAR = {"id", "items", "name", "size_bytes", "drive_id", "scene_id", "started_at", "created_at", "cameras"}
CLEAR |= {"summary", "progress", "settings", "status"}


def test_fields_are_described(page: dict[str, Any]) -> None:
    for name, schema in page["components"]["schemas"].items():
        bare = {field for field, of in schema.get("properties", {}).items() if "description" not in of}
        assert bare <= CLEAR, name


def test_the_page_is_in_the_order_of_the_conversation(page: dict[str, Any]) -> None:
    names = [tag["name"] for tag in page["tags"]]
    assert all(tag["description"] for tag in page["tags"])
    assert {tag for _, operation in operations(page) for tag in operation["tags"]} == set(names)
    assert names[0] == "drives"
    assert names.index("files") < names.index("reconstructions") < names.index("scenes") < names.index("maps")


def test_operations_have_short_names(page: dict[str, Any]) -> None:
    for _, operation in operations(page):
        assert re.fullmatch("[a-z]+(_[a-z]+){1,3}", operation["operationId"]), operation["operationId"]
        assert operation["summary"] != operation["operationId"].replace("_", " ").title()


@pytest.mark.parametrize(
    ("path", "allowed"),
    [
        ("/v1/drives", "GET, HEAD, POST"),
        ("/v1/drives/x", "GET, HEAD, DELETE"),
        ("/v1/drives/x:commit", "POST"),
        ("/v1/jobs/x:cancel", "POST"),
        ("/v1/drives/x/files/a/b", "GET, HEAD, PUT, DELETE"),
        ("/v1/scenes/x/files/a/b", "GET, HEAD"),
        ("/v1/maps/x/versions/1/files/a/b", "GET, HEAD"),
        ("/v1/maps/x/current-version", "PUT"),
        ("/v1/drives/x/uploads", "GET, HEAD, POST, OPTIONS"),
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
    result = fuzz(api.url, api.client().key, tmp_path, max_examples=4, phases="fuzzing,stateful")
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
