"""The page for people works on a machine without internet."""

from __future__ import annotations

import re

from tests.service.live_api import Api


def test_docs_come_from_the_service_alone(api: Api) -> None:
    with api.anonymous() as client:
        page = client.get("/docs")
        assert page.status_code == 200
        links = re.findall(r'(?:src|href)="([^"]+)"', page.text)
        assert len(links) >= 3
        assert all(link.startswith("/docs/files/") for link in links), links
        for link in links:
            answer = client.get(link)
            assert answer.status_code == 200
            assert len(answer.content) > 500
        assert client.get("/openapi.json").json()["openapi"].startswith("3.1")


def test_only_these_files_are_served(api: Api) -> None:
    with api.anonymous() as client:
        for path in ("../main.py", "%2e%2e/main.py", "__init__.pyc", "nothing.js"):
            assert client.get(f"/docs/files/{path}").status_code == 404
