"""Query parameters that a request does not have are refused by name, and nothing else is."""

from __future__ import annotations

import re
from typing import Any

import pytest

from tests.helpers.live_api import Api, Client, problem_of
from tests.helpers.tiny_drive import png, tiny_drive


@pytest.mark.parametrize(
    ("path", "named", "says"),
    [
        ("/v1/jobs?limits=5", "limits", "did you mean 'limit'?"),
        ("/v1/scenes?driveid=drv_1&limit=5", "driveid", "did you mean 'drive_id'?"),
        ("/v1/jobs?sate=failed", "sate", "did you mean 'state'?"),
        ("/v1/jobs?xyz=1", "xyz", "which takes cursor, drive_id, kind, limit, state"),
        ("/v1/status?verbose", "verbose", "which takes none"),
        ("/v1/jobs?%1b[31m=1", "\x1b[31m", "'query.\\x1b[31m' is no parameter"),
    ],
)
def test_an_unknown_parameter_is_named_with_a_known_one(client: Client, path: str, named: str, says: str) -> None:
    problem = problem_of(client.get(path), 422, "invalid-request")
    assert [error["field"] for error in problem["errors"]] == [f"query.{named}"]
    assert says in problem["detail"]
    assert "leave them out" in problem["remedy"]
    assert client.head(path).status_code == 422


def test_an_event_stream_with_an_unknown_parameter_does_not_begin(client: Client) -> None:
    with client.stream("GET", "/v1/events?kind=EXPORT") as answer:
        assert answer.status_code == 422


def test_many_unknown_parameters_are_not_listed_whole(client: Client) -> None:
    query = "&".join(f"x{n}=1" for n in range(200))
    problem = problem_of(client.get(f"/v1/jobs?{query}"), 422, "invalid-request")
    assert len(problem["errors"]) == 10
    assert "197 more" in problem["detail"]


def test_a_misspelt_option_of_a_writing_request_has_no_effect(client: Client) -> None:
    drive = tiny_drive()
    drive_id = client.create(drive)
    url = f"/v1/drives/{drive_id}/files/front/000000.png"
    assert client.put(url, content=drive.files["front/000000.png"]).status_code in (200, 201)
    problem = problem_of(client.put(f"{url}?replce=true", content=png(seed="other")), 422, "invalid-request")
    assert "did you mean 'replace'?" in problem["detail"]
    assert client.get(url).content == drive.files["front/000000.png"]
    assert client.put(f"{url}?replace=true", content=png(seed="other")).status_code == 201
    problem_of(client.post("/v1/drives?dry_run=1", content=tiny_drive("second").raw), 422, "invalid-request")
    assert len(client.get("/v1/drives").json()["items"]) == 1


@pytest.mark.parametrize("path", ["/", "/docs", "/openapi.json", "/livez", "/readyz"])
def test_what_is_no_part_of_the_api_takes_anything(api: Api, path: str) -> None:
    """Probes and browsers add parameters of their own."""
    with api.anonymous() as anyone:
        assert anyone.get(f"{path}?verbose=1").status_code == 200


def test_every_documented_parameter_is_taken(client: Client, page: dict[str, Any]) -> None:
    """No route reads a parameter that it does not declare, and the page says that 422 may come."""
    documented = 0
    for path, methods in page["paths"].items():
        if not path.startswith("/v1/"):
            continue
        for method, operation in methods.items():
            assert "422" in operation["responses"], f"{method} {path}"
            names = [given["name"] for given in operation.get("parameters", ()) if given["in"] == "query"]
            documented += len(names)
            if method != "get" or not names:
                continue
            answer = client.get(re.sub(r"{\w+}", "none", path), params=dict.fromkeys(names, "1"))
            assert "is no parameter" not in answer.text, f"{method} {path}"
    assert documented > 15
