"""Manifests are read the same way here and by the program that reads large ones."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from schemas.api.drives import FileRole
from schemas.parsing import parse_manifest
from service.api.context import Context
from service.api.manifests import reading
from service.api.manifests.bounded_process import LARGE_BYTES
from service.api.manifests.reading import read_manifest
from service.domain import drives
from service.domain.manifest_facts import ManifestFacts, facts_of
from service.errors import ServiceError
from service.storage.blob_writer import store_file
from tests.helpers.live_api import Client, api_process, problem_of, settings_of, sha256_of
from tests.helpers.tiny_drive import manifest, png, tiny_drive

Read = Callable[[bytes], ManifestFacts]


@pytest.fixture(params=["small", "large"])
def read(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Read]:
    """Spaces after a manifest make it a large one."""
    context = Context.open(settings_of(tmp_path))
    more = b" " * (LARGE_BYTES if request.param == "large" else 0)
    yield lambda raw: read_manifest(context, raw + more, what="it")
    context.database.close()


def with_masks() -> dict[str, Any]:
    document = manifest("with masks äé")
    for frame in document["frames"]:
        frame["images"]["front"]["mask"] = "mäsks/one.png"
    return document


def test_the_facts(read: Read) -> None:
    facts = read(json.dumps(with_masks()).encode())
    shown = (facts.name, facts.cameras, facts.frames, facts.has_gnss, facts.files_expected)
    assert shown == ("with masks äé", 2, 3, False, 7)
    expected = sorted([("mäsks/one.png", FileRole.MASK), *((path, FileRole.IMAGE) for path in tiny_drive().files)])
    assert [list(facts.files) for _ in range(2)] == [expected] * 2, "it can be gone through again"


def test_all_defects_are_told(read: Read) -> None:
    document = manifest()
    document["name"], document["rig"]["cameras"][0]["model"], document["extra"] = "", "NONE", 1
    with pytest.raises(ServiceError) as refused:
        read(json.dumps(document).encode())
    problem = refused.value.problem
    assert (refused.value.status, refused.value.code) == (422, "invalid-document")
    assert {item.field for item in problem.errors} == {"name", "rig.cameras.0.model", "extra"}
    assert problem.detail.startswith("it: name: ")
    assert "extra: is not a field of this document" in problem.detail
    assert problem.remedy.startswith("Correct the fields")


def test_what_is_no_json(read: Read) -> None:
    with pytest.raises(ServiceError, match="it: is not valid JSON"):
        read(b"{")


def test_names_that_no_folder_can_hold(read: Read) -> None:
    document = manifest()
    document["frames"][0]["images"]["front"] = {"file": "rear/000000.png/x.png"}
    with pytest.raises(ServiceError, match=r"folder that has the name of the file 'rear/000000\.png'") as refused:
        read(json.dumps(document).encode())
    assert [item.field for item in refused.value.problem.errors] == ["rear/000000.png/x.png"]


def test_a_drive_that_was_accepted_before_stricter_rules(client: Client) -> None:
    """It is shown, filled, committed and reconstructed; a new one like it is refused."""
    document = manifest("old")
    document["version"] = True
    images = document["frames"][0]["images"]
    images["front"]["file"], images["rear"]["file"] = "front/A.png", "front/a.png"
    raw = json.dumps(document).encode()
    problem = problem_of(client.post("/v1/drives", content=raw), 422, "invalid-document")
    assert "version" in {item["field"] for item in problem["errors"]}
    drive_id = stored_before(client, raw)
    assert client.get(f"/v1/drives/{drive_id}").json()["files_expected"] == 6
    assert client.get(f"/v1/drives/{drive_id}/manifest").content == raw
    files = [image["file"] for frame in document["frames"] for image in frame["images"].values()]
    for path in files:
        assert client.put(f"/v1/drives/{drive_id}/files/{path}", content=png(seed=path)).status_code == 201
    assert client.post(f"/v1/drives/{drive_id}:commit").status_code == 200
    assert client.reconstruct(drive_id)["state"] == "QUEUED"


def stored_before(client: Client, raw: bytes) -> str:
    """A drive as an earlier version made it; its id."""
    api, facts = client.api, facts_of(parse_manifest(raw))
    path = api.settings.spool_dir / "manifest"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(raw)
    stored = store_file(
        api.database,
        api.context.artifacts,
        project_id=client.project_id,
        path=path,
        sha256=sha256_of(raw),
        size_bytes=len(raw),
    )
    with api.database.write() as session:
        drive = drives.create(
            session,
            project_id=client.project_id,
            manifest=facts,
            rows=drives.rows_of(facts),
            stored=stored,
            expires_us=None,
        )
        return drive.id


LARGE = tiny_drive().raw + b" " * LARGE_BYTES


@pytest.mark.parametrize(("bound", "value"), [("_MEMORY_MB", 1), ("_TIMEOUT_S", 0.05)])
def test_a_manifest_that_costs_too_much_has_to_be_split(
    client: Client, monkeypatch: pytest.MonkeyPatch, bound: str, value: float
) -> None:
    monkeypatch.setattr(reading, bound, value)
    problem = problem_of(client.post("/v1/drives", content=LARGE), 422, "manifest-too-large")
    assert "Split the drive" in problem["remedy"]
    assert client.api.objects(client.project_id) == []


@pytest.mark.parametrize("command", [("/no/such/python",), (sys.executable, "-c", "raise SystemExit(1)")])
def test_a_reader_that_cannot_run_is_the_services_fault(
    client: Client, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    monkeypatch.setattr(reading, "_COMMAND", command)
    problem_of(client.post("/v1/drives", content=LARGE), 503, "check-failed")


@pytest.mark.slow
def test_a_large_manifest_leaves_the_memory_to_others(tmp_path: Path) -> None:
    """To parse it takes twenty times its size."""
    raw = tiny_drive(frames=20_000).raw
    with api_process(settings_of(tmp_path / "data"), tmp_path) as api:
        client = api.client()
        client.create()
        assert api.process is not None
        status = Path(f"/proc/{api.process.pid}/status")
        before_bytes = psutil.Process(api.process.pid).memory_info().rss
        drive_id = client.post("/v1/drives", content=raw).json()["id"]
        peak_kb = next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        assert client.get(f"/v1/drives/{drive_id}").json()["files_expected"] == 40_000
    assert peak_kb * 1024 - before_bytes < 8 * len(raw)
