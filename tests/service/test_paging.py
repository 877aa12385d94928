"""Cursors hold whatever a list may end with."""

from __future__ import annotations

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from schemas.drive import MAX_PATH_CHARACTERS, RelativePath
from service.api.http.paging import MAX_CURSOR_CHARACTERS, cursor_of, position_of
from tests.helpers.live_api import Client
from tests.helpers.tiny_drive import manifest

_path = TypeAdapter(RelativePath)


def long_path(letter: str) -> str:
    """The longest path of a letter, of parts that a file system can hold."""
    part = letter * (200 // len(letter.encode()))
    return (f"{part}/" * MAX_PATH_CHARACTERS)[: MAX_PATH_CHARACTERS - 4].removesuffix("/") + ".png"


def is_legal(path: str) -> bool:
    try:
        return _path.validate_python(path) == path
    except ValidationError:
        return False


LETTERS = ("a", '"', "ß", "Ж", "影", "𠀋", "🚗")
long_paths = st.lists(st.text(min_size=1, max_size=80), min_size=1, max_size=12).map("/".join).filter(is_legal)


@given(path=long_paths)
@settings(deadline=None)
@example(path=long_path("𠀋"))
@example(path=long_path('"'))
@example(path=long_path("影"))
def test_a_cursor_holds_every_path_that_a_manifest_may(path: str) -> None:
    cursor = cursor_of(path)
    assert len(cursor) <= MAX_CURSOR_CHARACTERS
    assert position_of(cursor, str) == (path,)


@pytest.mark.parametrize("letter", LETTERS)
def test_the_list_of_files_goes_on_after_a_long_name(client: Client, letter: str) -> None:
    document = manifest()
    image = document["frames"][0]["images"]["front"]
    image["file"] = long_path(letter)
    assert len(image["file"]) > MAX_PATH_CHARACTERS - 6
    created = client.post("/v1/drives", json=document)
    assert created.status_code == 201, created.text
    url = f"/v1/drives/{created.json()['id']}/files"
    paths, cursor = [], None
    for _ in range(7):
        page = client.get(url, params={"limit": "1", **({"cursor": cursor} if cursor else {})})
        assert page.status_code == 200, page.text
        paths += [file["path"] for file in page.json()["items"]]
        cursor = page.json()["next"]
    assert image["file"] in paths
    assert len(set(paths)) == 6
    assert cursor is None
