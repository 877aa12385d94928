"""How the API bears load: `python -m tests.benchmarks.service_load` sends a large drive and lets many clients in.

Starts an API of its own. Prints its figures as JSON, and exits with 1 where one is out of bounds.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import psutil

from tests.helpers.fuzzing import fuzz
from tests.helpers.live_api import ApiProcess, Client, api_process, settings_of
from tests.helpers.tiny_drive import CAMERAS, HEIGHT, WIDTH, manifest, png_of, tiny_drive

FILES = 500
FILE_BYTES = 2_000_000
CONNECTIONS = 4  # of the client that sends the large drive
CLIENTS = 50
ROUNDS = 4  # of each of the many clients
FUZZED_REQUESTS = 2000
MAX_RSS_BYTES = 300_000_000
MIN_RATE_RATIO = 1 / 3
_PNG = png_of(WIDTH, HEIGHT, b"")
_HEAD, _TAIL = _PNG[:41], _PNG[-12:]  # around the content of the only chunk of pixels


@dataclass(frozen=True)
class Payload:
    """Files that differ in a few bytes and share the rest: nothing has to be made, or held, for each."""

    shared: bytes

    def parts(self, i: int) -> Iterator[bytes]:
        yield _HEAD
        yield i.to_bytes(8, "big")
        yield self.shared
        yield _TAIL

    @property
    def size_bytes(self) -> int:
        return len(_HEAD) + 8 + len(self.shared) + len(_TAIL)


def main(argv: list[str] | None = None) -> int:
    """Measure, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=FILES)
    parser.add_argument(
        "--fuzz", action="store_true", help=f"send {FUZZED_REQUESTS} requests made by schemathesis instead"
    )
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="load") as folder, _api(Path(folder)) as api:
        if arguments.fuzz:
            figures = fuzzed(api, Path(folder))
        else:
            figures = large_upload(api, Path(folder), arguments.files) | many_clients(api)
            figures["passed"] = figures["upload_passed"] and figures["clients_passed"]
    print(json.dumps(figures, indent=1))
    return 0 if figures["passed"] else 1


def _api(folder: Path) -> Any:
    return api_process(settings_of(folder / "data"), folder, MRASFM_API_PROCESSES="0")  # as many as by default


def large_upload(api: ApiProcess, folder: Path, files: int) -> dict[str, Any]:
    """Send a drive of many files, and compare with a process that only hashes and writes the same bytes."""
    payload = Payload(os.urandom(FILE_BYTES - len(_PNG)))
    plain_s = _timed(lambda: _hash_and_write(payload, folder / "plain", files, durable=False))
    _written_out(folder / "plain")
    durable_s = _timed(lambda: _hash_and_write(payload, folder / "durable", files, durable=True))
    _written_out(folder / "durable")
    client = api.client()
    document = manifest("long", frames=files // len(CAMERAS))
    drive_id = client.post("/v1/drives", json=document).raise_for_status().json()["id"]
    paths = [image["file"] for frame in document["frames"] for image in frame["images"].values()]
    with _Peak(api) as rss:
        sent_s = _timed(lambda: _send(client, drive_id, paths, payload))
    shown = client.get(f"/v1/drives/{drive_id}").json()
    total_bytes = files * payload.size_bytes
    ratio = plain_s / sent_s
    return {
        "upload_files": files,
        "upload_bytes": total_bytes,
        "upload_mb_per_s": round(total_bytes / sent_s / 1e6, 1),
        "hash_and_write_mb_per_s": round(total_bytes / plain_s / 1e6, 1),
        "hash_write_and_sync_mb_per_s": round(total_bytes / durable_s / 1e6, 1),
        "rate_ratio": round(ratio, 3),
        "rate_ratio_to_synced": round(durable_s / sent_s, 3),
        "api_peak_rss_mb": round(rss.peak_bytes / 1e6, 1),
        "upload_passed": shown["bytes_stored"] == total_bytes
        and ratio >= MIN_RATE_RATIO
        and rss.peak_bytes < MAX_RSS_BYTES,
    }


def _hash_and_write(payload: Payload, folder: Path, files: int, *, durable: bool) -> None:
    folder.mkdir()
    for i in range(files):
        digest = hashlib.sha256()
        with (folder / f"{i}.png").open("wb") as file:
            for part in payload.parts(i):
                digest.update(part)
                file.write(part)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        digest.hexdigest()


def _written_out(folder: Path) -> None:
    """Nothing of what was measured before is still being written while the next is measured."""
    shutil.rmtree(folder)
    os.sync()


def _send(client: Client, drive_id: str, paths: list[str], payload: Payload) -> None:
    def send(item: tuple[int, str]) -> None:
        i, path = item
        headers = {"Content-Length": str(payload.size_bytes)}
        url = f"/v1/drives/{drive_id}/files/{path}"
        client.put(url, content=payload.parts(i), headers=headers).raise_for_status()

    with ThreadPoolExecutor(CONNECTIONS) as pool:
        list(pool.map(send, enumerate(paths)))


def many_clients(api: ApiProcess) -> dict[str, Any]:
    """Many clients create, fill and poll drives at the same time; every answer must be a success."""
    answers: Counter[int] = Counter()
    slowest_s = 0.0
    lock = threading.Lock()

    def count(response: httpx.Response) -> None:
        nonlocal slowest_s
        with lock:
            answers[response.status_code] += 1
            slowest_s = max(slowest_s, response.elapsed.total_seconds())

    started_s = time.perf_counter()
    with ThreadPoolExecutor(CLIENTS) as pool:
        failures = [repr(error) for error in pool.map(lambda i: _converse(api, i, count), range(CLIENTS)) if error]
    elapsed_s = time.perf_counter() - started_s
    return {
        "clients": CLIENTS,
        "clients_requests": answers.total(),
        "clients_requests_per_s": round(answers.total() / elapsed_s, 1),
        "clients_slowest_s": round(slowest_s, 2),
        "clients_statuses": dict(answers),
        "clients_failures": failures[:5],
        "clients_passed": not failures and all(status < 400 for status in answers),
    }


def _converse(api: ApiProcess, number: int, count: Callable[[httpx.Response], None]) -> Exception | None:
    """One client's drives: created, sent file by file, looked at after each."""
    client = api.client()
    try:
        for turn in range(ROUNDS):
            drive = tiny_drive(f"{number}-{turn}", seed=f"{number}-{turn}")
            created = client.post("/v1/drives", content=drive.raw)
            count(created)
            drive_url = f"/v1/drives/{created.json()['id']}"
            for path, data in drive.files.items():
                count(client.put(f"{drive_url}/files/{path}", content=data))
                count(client.get(drive_url))
                count(client.get("/v1/jobs"))
    except (httpx.HTTPError, LookupError, ValueError) as error:
        return error
    return None


def fuzzed(api: ApiProcess, folder: Path) -> dict[str, Any]:
    """Send what schemathesis makes from the OpenAPI page, and check every answer against it."""
    reports = folder / "reports"
    reports.mkdir()
    result = fuzz(api.url, api.client().key, reports, max_examples=40, phases="examples,coverage,fuzzing,stateful")
    if not result.passed:
        print(result.output, file=sys.stderr)
    return {
        "fuzzed_requests": result.requests,
        "fuzzed_server_errors": sum(n for case, n in result.statuses.items() if case[-3:] >= "500"),
        "passed": result.passed and result.requests >= FUZZED_REQUESTS,
    }


class _Peak:
    """The highest resident memory of all of the API's processes together while it is entered.

    Pages that they share count in each.
    """

    def __init__(self, api: ApiProcess) -> None:
        assert api.process is not None
        parent = psutil.Process(api.process.pid)
        self._processes = [parent, *parent.children(recursive=True)]
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._sample)
        self.peak_bytes = 0

    def __enter__(self) -> _Peak:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()

    def _sample(self) -> None:
        while not self._over.wait(0.02):
            self.peak_bytes = max(self.peak_bytes, sum(process.memory_info().rss for process in self._processes))


def _timed(work: Callable[[], object]) -> float:
    started_s = time.perf_counter()
    work()
    return time.perf_counter() - started_s


if __name__ == "__main__":
    sys.exit(main())
