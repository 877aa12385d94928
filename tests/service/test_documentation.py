"""The page for people works on a machine without internet."""

from __future__ import annotations

import base64
import hashlib
import re

from tests.helpers.live_api import Api


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


def test_the_page_may_run_its_own_scripts_and_no_others(api: Api) -> None:
    with api.anonymous() as client:
        page = client.get("/docs")
    policy = dict(directive.split(" ", 1) for directive in page.headers["content-security-policy"].split("; "))
    inline = re.findall(r"<script>(.*?)</script>", page.text, re.DOTALL)
    assert len(inline) == 1
    digests = {base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in inline}
    assert policy["script-src"].split() == ["'self'", *(f"'sha256-{digest}'" for digest in digests)]
    assert "unsafe" not in page.headers["content-security-policy"]
    assert (policy["default-src"], policy["frame-ancestors"]) == ("'none'", "'none'")
    assert policy["connect-src"] == "'self'", "it asks for /openapi.json"
    for pattern in (r"<style", r'style="', r'\son\w+="', r"javascript:"):
        assert not re.search(pattern, page.text), "what the policy would forbid"


def test_only_these_files_are_served(api: Api) -> None:
    with api.anonymous() as client:
        for path in ("../main.py", "%2e%2e/main.py", "__init__.pyc", "nothing.js"):
            assert client.get(f"/docs/files/{path}").status_code == 404
