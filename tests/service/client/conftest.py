"""Drives in folders, and the library's client of a project."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from service.client import Client
from tests.helpers.live_api import Client as TestClient
from tests.helpers.tiny_drive import TinyDrive, tiny_drive

WriteTiny = Callable[..., Path]
Connect = Callable[..., Client]


def written(drive: TinyDrive, folder: Path) -> Path:
    """A drive as a folder."""
    for path, data in drive.files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    (folder / "drive.json").write_bytes(drive.raw)
    return folder


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A sound drive of six small images, whose contents no other test has."""
    return written(tiny_drive(seed=tmp_path.name), tmp_path / "drive")


@pytest.fixture
def connect() -> Iterator[Connect]:
    """A function that makes a library client of a test client's project."""
    with ExitStack() as opened:

        def make(of: TestClient, *, url: str | None = None, retry_s: float = 30.0) -> Client:
            return opened.enter_context(Client(url or of.api.url, of.key, retry_s=retry_s))

        yield make
