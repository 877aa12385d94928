"""Lines 5 and 17: the service gives what the command gives, bears load and kills, and answers what it says."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.io.trajectory_file import read_tum
from tests.benchmarks.chaos.report import MOST_HELD_S
from tests.benchmarks.commands import CommandFailed, mrasfm, read_report
from tests.benchmarks.real_drives import imported, reconstructed
from tests.benchmarks.service_load import FUZZED_REQUESTS, MAX_RSS_BYTES, MIN_RATE_RATIO
from tests.benchmarks.service_under_load import MAX_POLL_P99_S, MAX_SLOWDOWN
from tests.benchmarks.slow_tests import OF_MAPS, passed
from tests.benchmarks.standalone import standalone
from tests.benchmarks.table import Figure, exactly

REPOSITORY = Path(__file__).resolve().parents[2]
DRIVE = "kitti06"
DIFFERENCE_M = 0.02
KILLS = 10
OF_KILLS = {
    "lost": "after them, lost: drives, files, jobs, scenes, maps",
    "twice": "there twice",
    "stuck": "stuck ten minutes after the last kill",
    "wrong_bytes": "files with wrong bytes",
    "failed": "jobs failed for kills alone",
    "damaged": "defects of the database",
    "left": "processes and files left",
    "broken_promises": "answers that must not be",
    "ended_by_itself": "ends of the service by itself",
    "kills_missing": "kinds of kills of which there were too few",
}


def service(data: Path, work: Path) -> Iterator[Figure]:
    """Line 5."""
    yield from _same_scene(data, work)
    load = _figures_of("tests.benchmarks.service_load")
    yield Figure(
        line="5",
        what="500 files, 1 GB: rate against one process that hashes and writes",
        value=load["rate_ratio"],
        above=MIN_RATE_RATIO,
        most=10.0,
        remark=f"{load['upload_mb_per_s']} against {load['hash_and_write_mb_per_s']} MB/s; with fsync "
        f"{load['hash_write_and_sync_mb_per_s']} MB/s",
    )
    yield Figure(
        line="5",
        what="the same: peak memory of the API",
        value=load["api_peak_rss_mb"],
        unit="MB",
        most=MAX_RSS_BYTES / 1e6,
    )
    yield exactly("5", "50 clients at once: failures + 1", len(load["clients_failures"]) + 1, 1)
    yield from _under_load()
    fuzzed = _figures_of("tests.benchmarks.service_load", "--fuzz")
    yield Figure(
        line="5",
        what="requests made by schemathesis, all answered as documented",
        value=fuzzed["fuzzed_requests"] if fuzzed["passed"] else 0,
        above=FUZZED_REQUESTS - 1,
        most=1e6,
    )


def _under_load() -> Iterator[Figure]:
    load = _figures_of("tests.benchmarks.service_under_load")
    kinds = ", ".join(f"{count} {kind}" for kind, count in load["clients"].items())
    yield Figure(
        line="5",
        what=f"a reconstruction and 100 clients ({kinds}): 99 % of polls are answered within",
        value=load["polling"]["p99_s"],
        unit="s",
        most=MAX_POLL_P99_S,
        remark=f"median {load['polling']['p50_s']} s of {load['polling']['requests']}",
    )
    yield Figure(
        line="5",
        what="the same: the reconstruction's time, as a multiple of that without clients",
        value=load["slowdown"],
        most=MAX_SLOWDOWN,
        remark=f"{load['reconstruction_under_load_s']} s against {load['reconstruction_alone_s']} s",
    )
    failures = sum(len(load[kind]["failures"]) for kind in load["clients"])
    yield exactly("5", "the same: requests without an answer + 1", failures + 1, 1)


def maps_over_http(data: Path, work: Path) -> Iterator[Figure]:
    """Line 20f: the service's part of aggregation."""
    for test, what in OF_MAPS:
        yield passed("20f", what, test)


def kills(data: Path, work: Path) -> Iterator[Figure]:
    """Line 17: the whole service while its processes are killed."""
    figures = _figures_of("tests.benchmarks.chaos", "--kills", str(KILLS))
    yield Figure(
        line="17",
        what="kills of processes of the service while clients use it",
        value=figures["kills"],
        above=KILLS - 1,
        most=2 * KILLS,
        remark=f"seed {figures['seed']}; " + ", ".join(f"{n} {what}" for what, n in figures["kills_in_fact"].items()),
    )
    for name, what in OF_KILLS.items():
        found = figures[name] if isinstance(figures[name], int) else len(figures[name])
        said = figures["findings"].get(name, figures[name])
        remark = "; ".join(said[:3]) if found and isinstance(said, list) else ""
        yield replace(exactly("17", f"{what} + 1", found + 1, 1), remark=remark)
    yield Figure(
        line="17",
        what="longest time for which a client is told that its request is in flight, which a kill has ended",
        value=figures["longest_held_s"],
        unit="s",
        above=-1.0,
        most=MOST_HELD_S,
    )


def _same_scene(data: Path, work: Path) -> Iterator[Figure]:
    drive = imported(data, DRIVE, work)
    by_command = reconstructed(drive, work / f"{DRIVE}-no-gnss", "--no-gnss")
    by_service = work / f"{DRIVE}-service"
    with standalone(work / "service") as (url, key_file):
        mrasfm("upload", drive, "--url", url, "--key-file", key_file, "--out", by_service, "--no-gnss")
    images = [read_report(scene)["summary"]["registered_images"] for scene in (by_command, by_service)]
    yield exactly("5", f"{DRIVE} over HTTP: images registered, as by the command", images[1], images[0])
    a, b = (read_tum(scene / "poses.tum") for scene in (by_command, by_service))
    farthest_m = float(np.linalg.norm((a.world_from_rig - b.world_from_rig)[:, :3, 3], axis=1).max())
    yield Figure(
        line="5",
        what=f"{DRIVE} over HTTP: farthest pose from the command's",
        value=farthest_m,
        unit="m",
        above=-1.0,  # exactly the same poses are what to hope for
        most=DIFFERENCE_M,
    )


def _figures_of(module: str, *arguments: str) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    try:
        figures: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        raise CommandFailed(f"{module} {' '.join(arguments)}: {done.stderr.strip()[-300:]}") from None
    return figures
