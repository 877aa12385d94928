"""`mrasfm map`: several drives go in, a map comes out."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from service.client import SceneFolderError, download
from service.commands import map as map_command
from tests.helpers.live_api import Client
from tests.helpers.tiny_drive import tiny_drive
from tests.service.client.conftest import MAP_FILES, Connect, written


@pytest.fixture
def drives(tmp_path: Path) -> list[Path]:
    return [written(tiny_drive(f"d{i}", seed=f"{tmp_path}{i}"), tmp_path / f"d{i}") for i in range(3)]


def run(client: Client, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object) -> Any:
    monkeypatch.setenv("MRASFM_API_KEY", client.key)
    parser = argparse.ArgumentParser()
    map_command.register(parser.add_subparsers())
    arguments = parser.parse_args(["map", *map(str, words), "--url", client.api.url, "--json"])
    code = arguments.run(arguments)
    printed = capsys.readouterr()
    return code, json.loads(printed.out), printed.err


def test_a_map_and_its_next_version(
    client: Client,
    drives: list[Path],
    worker: Callable[[set[str]], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    worker({"d1"})
    out = tmp_path / "map"
    code, summary, said = run(client, monkeypatch, capsys, *drives, "--out", out, "--name", "Kreuzung")
    assert code == 0, said
    assert {path: (out / path).read_bytes() for path in MAP_FILES} == MAP_FILES
    assert summary["version"] == 1
    assert summary["failed"] == [summary["drive_ids"][1]]
    assert summary["unconnected"] == ["d2"]
    assert "d1" in said
    assert "it broke" in said
    # The same command again asks for nothing new.
    _, again, _ = run(client, monkeypatch, capsys, *drives, "--out", out, "--name", "Kreuzung")
    assert (again["job_id"], again["version"]) == (summary["job_id"], 1)
    # Another map does not go into its folder, and nothing is sent for it.
    counts = [len(client.get(f"/v1/{what}").json()["items"]) for what in ("drives", "jobs")]
    for words in ((*drives, "--name", "other"), (drives[0], drives[1]), ("--into", summary["map_id"], drives[1])):
        code, _, said = run(client, monkeypatch, capsys, *words, "--out", out)
        assert (code, f"{out} holds the map {summary['map_id']}/1, and this gives another one" in said) == (2, True)
    assert [len(client.get(f"/v1/{what}").json()["items"]) for what in ("drives", "jobs")] == counts
    # A version without the last drive, which has no third scene to keep: refused in the service's words.
    refused = run(client, monkeypatch, capsys, "--into", summary["map_id"], "--remove", summary["drive_ids"][2])
    assert refused[0] == 2
    assert refused[1]["problem"]["type"].endswith("too-few-scenes")
    failing = run(client, monkeypatch, capsys, drives[0], drives[1], "--require-all")
    assert failing[0] == 3
    assert "it broke" in failing[2]


@pytest.mark.parametrize("option", ["--name", "--into", "--remove"])
def test_what_cannot_be_asked_for_is_said_before_anything_is_sent(
    option: str, client: Client, drives: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, summary, said = run(client, monkeypatch, capsys, drives[0], drives[1], option, "a\nb")
    assert (code, summary["drive_ids"]) == (2, [])
    assert option in said
    assert client.get("/v1/drives").json()["items"] == []


def test_a_folder_of_another_version(client: Client, connect: Connect, tmp_path: Path) -> None:
    ids = [client.frozen(tiny_drive(f"v{i}", seed=f"{tmp_path}v{i}")) for i in range(2)]
    job = client.aggregate(drives=ids)
    for member in job["members"]:
        client.publish(client.claim(member["job_id"]), {"a": b"a"})
    client.publish_map(client.claim(job["id"]), MAP_FILES)
    library = connect(client)
    version = library.map_version(job["map_id"], 1)
    done = download(library, version, tmp_path / "out")
    assert (done.files_received, done.files_skipped) == (len(MAP_FILES), 0)
    other = version.model_copy(update={"number": 2})
    with pytest.raises(SceneFolderError, match="holds the map"):
        download(library, other, tmp_path / "out")
