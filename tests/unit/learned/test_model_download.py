from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from mrasfm_engine.errors import InputError, StorageError
from mrasfm_engine.learned import catalogue
from mrasfm_engine.learned.catalogue import KnownModel, known_model
from mrasfm_engine.learned.download import pull
from mrasfm_engine.learned.model_folder import ModelFolder
from mrasfm_engine.learned.onnx_file import sha256_of
from tests.helpers import learned_graphs

DATA = learned_graphs.aliked()


class Server:
    """Answers with what it is told and counts the requests."""

    def __init__(self) -> None:
        self.content, self.status, self.announced, self.requests = DATA, 200, len(DATA), 0
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                outer.requests += 1
                self.send_response(outer.status)
                self.send_header("Content-Length", str(outer.announced))
                self.end_headers()
                self.wfile.write(outer.content)

            def log_message(self, *arguments: Any) -> None:
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_address[1]}/aliked-n16rot.onnx"


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    thread = threading.Thread(target=server.http.serve_forever)
    thread.start()
    yield server
    server.http.shutdown()
    thread.join()
    server.http.server_close()


@pytest.fixture
def aliked(server: Server, monkeypatch: pytest.MonkeyPatch) -> KnownModel:
    """A small graph in the place of the published ALIKED."""
    model = replace(known_model("aliked-n16rot"), url=server.url, sha256=sha256_of(DATA))
    known = tuple(model if m.name == model.name else m for m in catalogue.known_models())
    monkeypatch.setattr(catalogue, "known_models", lambda: known)
    return model


@pytest.fixture
def folder(tmp_path: Path) -> ModelFolder:
    return ModelFolder(tmp_path / "models")


def test_a_model_is_pulled_once(aliked: KnownModel, server: Server, folder: ModelFolder) -> None:
    steps: list[tuple[int, int]] = []
    model = pull(aliked, folder, progress=lambda done, total: steps.append((done, total)))
    assert steps[-1] == (len(DATA), len(DATA))
    assert folder.load("aliked-n16rot") == (model, DATA)
    assert pull(aliked, folder) == model
    assert server.requests == 1


def test_a_damaged_copy_is_pulled_again(aliked: KnownModel, server: Server, folder: ModelFolder) -> None:
    model = pull(aliked, folder)
    model.file.write_bytes(DATA[:-1])
    assert pull(aliked, folder) == model
    assert folder.load("aliked-n16rot")[1] == DATA
    assert server.requests == 2


def left(folder: ModelFolder) -> list[str]:
    return sorted(p.name for p in folder.path.rglob("*")) if folder.path.exists() else []


def test_what_is_not_the_model_is_not_kept(aliked: KnownModel, server: Server, folder: ModelFolder) -> None:
    server.content = b"<html>sign in first</html>"
    server.announced = len(server.content)
    with pytest.raises(InputError) as error:
        pull(aliked, folder)
    assert sha256_of(DATA) in error.value.what
    assert sha256_of(server.content) in error.value.what
    assert left(folder) == []


def test_half_a_file_is_not_kept(aliked: KnownModel, server: Server, folder: ModelFolder) -> None:
    server.content = DATA[: len(DATA) // 2]
    with pytest.raises(InputError, match=r"cannot be pulled|is not aliked-n16rot"):
        pull(aliked, folder)
    assert left(folder) == []


def test_a_servers_refusal_is_told(aliked: KnownModel, server: Server, folder: ModelFolder) -> None:
    server.status = 404
    with pytest.raises(InputError, match="the server answers 404") as error:
        pull(aliked, folder)
    assert error.value.code == "pull-failed"
    assert left(folder) == []


def test_offline_is_told_with_what_to_do(aliked: KnownModel, server: Server, folder: ModelFolder) -> None:
    model = replace(aliked, url="http://127.0.0.1:9/aliked-n16rot.onnx")
    with pytest.raises(InputError, match="cannot be pulled") as error:
        pull(model, folder)
    assert error.value.code == "offline"
    assert "offline" in error.value.remedy
    assert "mrasfm models add FILE --name aliked-n16rot" in error.value.remedy
    assert left(folder) == []


def test_what_is_not_published_cannot_be_pulled(folder: ModelFolder) -> None:
    with pytest.raises(InputError, match="superpoint cannot be pulled") as error:
        pull(known_model("superpoint"), folder)
    assert "mrasfm models add FILE --name superpoint" in error.value.remedy
    assert not folder.path.exists()


def test_a_folder_that_cannot_be_written_is_a_storage_error(aliked: KnownModel, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError):
        pull(aliked, ModelFolder(tmp_path / "file" / "models"))


def test_the_published_urls_and_hashes_are_colmaps() -> None:
    for name, sha256 in (
        ("aliked-n16rot", "39c423d0a6f03d39ec89d3d1d61853765c2fb6a8b8381376c703e5758778a547"),
        ("aliked-lightglue", "b9a5de7204648b18a8cf5dcac819f9d30de1a5961ef03756803c8b86c2dceb8d"),
    ):
        model = known_model(name)
        assert model.url == f"https://github.com/colmap/colmap/releases/download/3.13.0/{name}.onnx"
        assert model.sha256 == sha256
