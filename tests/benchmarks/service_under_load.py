"""How the service answers while it works: `python -m tests.benchmarks.service_under_load`.

A hundred clients poll, follow event streams, list and upload for two minutes while one drive is reconstructed, all on
one machine with the clients. Then the same drive is reconstructed alone. Each client pauses for a second between
requests, half of what `Retry-After` asks of those who poll; `--pause-s 0` lets all of them go on at once. Prints its
figures as JSON, and exits with 1 where one is out of bounds.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx

from tests.benchmarks.commands import mrasfm
from tests.benchmarks.service_load import Payload
from tests.benchmarks.standalone import standalone
from tests.helpers.tiny_drive import CAMERAS, manifest

POLLING, STREAMING, LISTING, PUTTING = 50, 20, 10, 20
DURATION_S = 120.0
PAUSE_S = 1.0
FILE_BYTES = 500_000
FRAMES_OF_PUTTING = 200
MAX_POLL_P99_S = 1.0
MAX_SLOWDOWN = 2.0
_TIMEOUT_S = 120.0
_DRIVE = ("--cameras", 6, "--units", 30, "--width", 640, "--height", 360)


@dataclass
class Answers:
    """What one kind of client got."""

    seconds: list[float] = field(default_factory=list)
    statuses: Counter[int] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        ordered = sorted(self.seconds)
        return {
            "requests": len(ordered),
            "p50_s": round(statistics.median(ordered), 3) if ordered else None,
            "p99_s": round(ordered[int(0.99 * (len(ordered) - 1))], 3) if ordered else None,
            "slowest_s": round(ordered[-1], 3) if ordered else None,
            "statuses": dict(self.statuses),
            "failures": self.failures[:5],
        }

    @property
    def all_good(self) -> bool:
        return not self.failures and bool(self.seconds) and all(status < 400 for status in self.statuses)


def main(argv: list[str] | None = None) -> int:
    """Measure, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration-s", type=float, default=DURATION_S, help="at least; until the job has ended")
    parser.add_argument("--pause-s", type=float, default=PAUSE_S, help="of a client between two requests")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="load") as folder:
        figures = under_load(Path(folder), duration_s=arguments.duration_s, pause_s=arguments.pause_s)
    print(json.dumps(figures, indent=1))
    return 0 if figures["passed"] else 1


def under_load(folder: Path, *, duration_s: float, pause_s: float) -> dict[str, Any]:
    """The figures of polls and of the reconstruction."""
    drive = folder / "drive"
    mrasfm("synth", "--out", drive, *_DRIVE)
    with standalone(folder / "service") as (url, key_file):
        mrasfm("upload", drive, "--url", url, "--key-file", key_file, "--out", folder / "warm")  # compiles the engine
        answers, loaded_s = asyncio.run(_measure(url, key_file.read_text().strip(), duration_s, pause_s))
        with _client(url, key_file.read_text().strip()) as client:
            alone_s = _reconstruct_alone(client)
    polls = answers["polling"].figures()
    slowdown = loaded_s / alone_s
    passed = all(kind.all_good for kind in answers.values())
    return {
        "clients": {"polling": POLLING, "streaming": STREAMING, "listing": LISTING, "putting": PUTTING},
        "pause_s": pause_s,
        **{name: kind.figures() for name, kind in answers.items()},
        "reconstruction_under_load_s": round(loaded_s, 1),
        "reconstruction_alone_s": round(alone_s, 1),
        "slowdown": round(slowdown, 2),
        "passed": passed and polls["p99_s"] <= MAX_POLL_P99_S and slowdown <= MAX_SLOWDOWN,
    }


async def _measure(url: str, key: str, duration_s: float, pause_s: float) -> tuple[dict[str, Answers], float]:
    limits = httpx.Limits(max_connections=None, max_keepalive_connections=None)
    headers = {"Authorization": f"Bearer {key}"}
    async with httpx.AsyncClient(base_url=url, headers=headers, timeout=_TIMEOUT_S, limits=limits) as client:
        load = _Load(client, pause_s)
        await load.prepare()
        tasks = load.start()
        await asyncio.sleep(5.0)  # until all of them are at it
        job_id = await load.reconstruct()
        load.polled_id = job_id
        begin_s = time.monotonic()
        job = await load.ended(job_id)
        await asyncio.sleep(max(0.0, duration_s - (time.monotonic() - begin_s)))
        load.over.set()
        await asyncio.gather(*tasks)
    return load.answers, _took_s(job)


class _Load:
    """The clients, all of one project."""

    def __init__(self, client: httpx.AsyncClient, pause_s: float) -> None:
        self.answers = {name: Answers() for name in ("polling", "streaming", "listing", "putting")}
        self.over = asyncio.Event()
        self.polled_id = ""
        self._client = client
        self._pause_s = pause_s
        self._drive_id = ""
        self._payload = Payload(os.urandom(FILE_BYTES))
        self._random = random.Random(1)

    async def prepare(self) -> None:
        (drive,) = [d for d in (await self._client.get("/v1/drives")).json()["items"] if d["state"] == "COMMITTED"]
        self._drive_id = drive["id"]
        (job, *_) = (await self._client.get("/v1/jobs")).json()["items"]
        self.polled_id = job["id"]

    async def reconstruct(self) -> str:
        return await _asked(self._client, self._drive_id, seed=11)

    async def ended(self, job_id: str) -> dict[str, Any]:
        while True:
            job: dict[str, Any] = (await self._client.get(f"/v1/jobs/{job_id}")).json()
            if job["state"] in ("SUCCEEDED", "FAILED", "CANCELLED"):
                return job
            await asyncio.sleep(1.0)

    def start(self) -> list[asyncio.Task[None]]:
        kinds = ((POLLING, self._poll), (STREAMING, self._stream), (LISTING, self._list), (PUTTING, self._put))
        return [asyncio.create_task(kind(number)) for count, kind in kinds for number in range(count)]

    async def _poll(self, number: int) -> None:
        etag = ""

        async def step() -> httpx.Response:
            nonlocal etag
            answer = await self._client.get(f"/v1/jobs/{self.polled_id}", headers={"If-None-Match": etag})
            etag = answer.headers.get("etag", "")
            return answer

        await self._repeat("polling", step)

    async def _list(self, number: int) -> None:
        await self._repeat("listing", lambda: self._client.get("/v1/jobs" if number % 2 else "/v1/drives"))

    async def _put(self, number: int) -> None:
        document = manifest(f"put {number}", frames=FRAMES_OF_PUTTING)
        created = await self._client.post("/v1/drives", json=document)
        drive_id = created.raise_for_status().json()["id"]
        paths = [f"{frame['images'][camera]['file']}" for frame in document["frames"] for camera in CAMERAS]
        sent = 0

        async def step() -> httpx.Response:
            nonlocal sent
            path, body = paths[sent % len(paths)], b"".join(self._payload.parts(number * 1000 + sent % len(paths)))
            sent += 1
            return await self._client.put(f"/v1/drives/{drive_id}/files/{path}", content=body)

        await self._repeat("putting", step)

    async def _repeat(self, kind: str, step: Callable[[], Awaitable[httpx.Response]]) -> None:
        answers = self.answers[kind]
        await asyncio.sleep(self._random.random() * max(self._pause_s, 0.1))
        while not self.over.is_set():
            begin_s = time.perf_counter()
            try:
                answers.statuses[(await step()).status_code] += 1
            except httpx.HTTPError as error:
                answers.failures.append(repr(error))
            answers.seconds.append(time.perf_counter() - begin_s)
            await asyncio.sleep(self._pause_s)

    async def _stream(self, number: int) -> None:
        """Follows the job's events; the time counts that the first of them took."""
        answers = self.answers["streaming"]
        while not self.over.is_set():
            begin_s = time.perf_counter()
            try:
                async with self._client.stream("GET", f"/v1/jobs/{self.polled_id}/events") as answer:
                    answers.statuses[answer.status_code] += 1
                    lines = answer.aiter_lines()
                    await anext(lines)
                    answers.seconds.append(time.perf_counter() - begin_s)
                    async for _ in lines:
                        if self.over.is_set():
                            break
            except httpx.HTTPError as error:
                answers.failures.append(repr(error))
            await asyncio.sleep(max(self._pause_s, 0.1))


async def _asked(client: httpx.AsyncClient, drive_id: str, *, seed: int) -> str:
    """The id of a new job; another seed, so that no finished stage is there already."""
    answer = await client.post("/v1/reconstructions", json={"drive_id": drive_id, "settings": {"seed": seed}})
    return str(answer.raise_for_status().json()["id"])


def _client(url: str, key: str) -> httpx.Client:
    return httpx.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=_TIMEOUT_S)


def _reconstruct_alone(client: httpx.Client) -> float:
    drives = client.get("/v1/drives").json()["items"]
    (drive_id,) = [drive["id"] for drive in drives if drive["state"] == "COMMITTED"]
    asked = client.post("/v1/reconstructions", json={"drive_id": drive_id, "settings": {"seed": 12}})
    job_id = asked.raise_for_status().json()["id"]
    while True:
        job: dict[str, Any] = client.get(f"/v1/jobs/{job_id}").json()
        if job["state"] in ("SUCCEEDED", "FAILED", "CANCELLED"):
            return _took_s(job)
        time.sleep(2.0)


def _took_s(job: dict[str, Any]) -> float:
    assert job["state"] == "SUCCEEDED", job["problem"]
    begin, end = (datetime.fromisoformat(job[name]) for name in ("started_at", "finished_at"))
    return (end - begin).total_seconds()


if __name__ == "__main__":
    sys.exit(main())
