"""Lines 41 and 42: a rendered drive of 3,600 images, by the command and by the service's workers.

Line 41: memory and time of the command on its first quarter and on all of it. Line 42: two workers beside one, and two
of which one is killed again and again. What two processes can gain on the machine at all, a plain extraction of
keypoints tells.
"""

from __future__ import annotations

import json
import random
import subprocess
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.features.sift import SiftExtractor
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.trajectory_file import read_tum
from schemas.api.jobs import JobKind, JobState
from schemas.artifacts import SUBMAP_STAGES, Stage, checkpoint_file, submap_checkpoint
from service.storage.data_folder import write_private_file
from tests.benchmarks.chaos.installation import Installation
from tests.benchmarks.chaos.processes import Role, kill, tree_of
from tests.benchmarks.chaos.records import Records
from tests.benchmarks.commands import MRASFM, CommandFailed, evaluate, mrasfm, read_report
from tests.benchmarks.edited_drives import edited_drive
from tests.benchmarks.table import Figure, exactly, failed
from tests.helpers.submap_stages import stages_run_in_join

CAMERAS, UNITS, FIRST_UNITS, SEED, SIZE = 6, 600, 150, 1, ("--width", 640, "--height", 360)
THREADS, TIMEOUT_S = 2, 3600.0
SAMPLED_EVERY_S = 0.5
MOST_MEMORY_GB, MOST_TIMES_MEMORY, MOST_TIMES_A_UNIT = 3.0, 1.4, 1.15
MOST_TIME_OF_TWO = 0.6
KILLED_EVERY_S, KILLS = 120.0, 5
SAME_M, SAME_DEG = 0.001, 0.005
EXTRACTED, EXTRACTIONS = 10, 3  # pictures by each of two processes, and how often


def memory_of_long_drives(data: Path, work: Path) -> Iterator[Figure]:
    """Line 41."""
    del data
    whole = _rendered(work)
    settings = work / "two threads.toml"
    settings.write_text(f"threads = {THREADS}\n")
    _warm_up(work)
    peak_gb, seconds = {}, {}
    for units, drive in ((FIRST_UNITS, _beginning(whole, FIRST_UNITS)), (UNITS, whole)):
        scene, title = work / f"scene of {units} units", f"{CAMERAS} cameras, {units} units"
        started_s = time.perf_counter()
        peak_gb[units] = _peak_gb("reconstruct", drive, "--config", settings, "--out", scene)
        seconds[units] = time.perf_counter() - started_s
        yield from _of_scene("41", title, scene, drive, units)
        most, what = MOST_MEMORY_GB if units == UNITS else None, "peak memory of all processes"
        yield Figure(line="41", what=f"{title}: {what}", value=peak_gb[units], unit="GB", most=most)
        yield Figure(line="41", what=f"{title}: time of a unit", value=seconds[units] / units, unit="s")
    per_unit_s = {units: seconds[units] / units for units in seconds}
    ratios = ((peak_gb, "memory", MOST_TIMES_MEMORY), (per_unit_s, "time of a unit", MOST_TIMES_A_UNIT))
    for values, what, most in ratios:
        title = f"{what}, {UNITS} units beside {FIRST_UNITS}"
        yield Figure(line="41", what=title, value=values[UNITS] / values[FIRST_UNITS], most=most)
    further_s = (seconds[UNITS] - seconds[FIRST_UNITS]) / (UNITS - FIRST_UNITS)
    title = f"time of a further unit beside one of {FIRST_UNITS}"
    ratio = further_s / per_unit_s[FIRST_UNITS]
    yield Figure(line="41", what=title, value=ratio, most=MOST_TIMES_A_UNIT)


def on_several_workers(data: Path, work: Path) -> Iterator[Figure]:
    """Line 42."""
    del data
    drive, seconds, scenes = _rendered(work), {}, {}
    _warm_up(work)
    for workers in (1, 2):
        run = _Service(work / f"{workers} workers", workers)
        scenes[workers], seconds[workers] = run.reconstruct(drive)
        title = f"{UNITS} units, {workers} {'workers' if workers > 1 else 'worker'} of one thread"
        yield Figure(line="42", what=title, value=seconds[workers], unit="s")
        yield from _of_scene("42", title, scenes[workers], drive, UNITS)
    title = f"{UNITS} units, time of two workers beside one"
    yield Figure(line="42", what=title, value=seconds[2] / seconds[1], most=MOST_TIME_OF_TWO)
    yield Figure(line="42", what="of keypoints, two processes beside one: what the machine has", value=_time_of_two())
    run = _Service(work / "killed workers", 2)
    scene, killed_s = run.reconstruct(drive, kills=KILLS)
    title = f"{UNITS} units, a worker killed every {KILLED_EVERY_S:.0f} s"
    yield Figure(line="42", what=title, value=killed_s, unit="s")
    yield from _of_scene("42", title, scene, drive, UNITS)
    yield from _of_kills(title, run, scene, scenes[2])


def _time_of_two() -> float:
    """Time of two processes at once that extract keypoints, beside that of one that does the work of both.

    Half is what cores of their own with memory of their own would give.
    """
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(_extract, [1, 1]))  # both have begun
        of_one, of_two = [], []
        for _ in range(EXTRACTIONS):
            of_one.append(_seconds_of(pool, [2 * EXTRACTED]))
            of_two.append(_seconds_of(pool, [EXTRACTED, EXTRACTED]))
    return float(np.median(of_two) / np.median(of_one))


def _seconds_of(pool: Executor, images: list[int]) -> float:
    begin_s = time.perf_counter()
    list(pool.map(_extract, images))
    return time.perf_counter() - begin_s


def _extract(images: int) -> None:
    """Extract the keypoints of a picture of noise so often, in one thread."""
    cv2.setNumThreads(1)
    noise = np.random.default_rng(SEED).integers(0, 256, (720, 1280, 3), dtype=np.uint8)
    picture, extractor = np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0), np.uint8), SiftExtractor(FeatureConfig())
    for _ in range(images):
        extractor.extract(picture, None)


def _of_scene(line: str, title: str, scene: Path, drive: Path, units: int) -> Iterator[Figure]:
    yield exactly(line, f"{title}: units with a pose", read_report(scene)["summary"]["registered_units"], units)
    rmse_m = evaluate(scene, drive)["metric"]["rmse_m"]
    yield Figure(line=line, what=f"{title}: metric RMSE", value=rmse_m, unit="m")


def _of_kills(title: str, run: _Service, scene: Path, undisturbed: Path) -> Iterator[Figure]:
    """Figures of the scene that two workers made of which one was killed again and again."""
    kills, scenes = run.kills_that_counted(), run.records.rows("SELECT id FROM scenes")
    remark = ", ".join(sorted(one.stage for one in kills))
    yield replace(exactly("42", f"{title}: kills within sub-maps", len(kills), KILLS), remark=remark)
    yield exactly("42", f"{title}: scenes", len(scenes), 1)
    a, b = (read_tum(one / "poses.tum") for one in (scene, undisturbed))
    if not np.array_equal(a.timestamps_us, b.timestamps_us):
        yield failed("42", f"{title}: poses as without", "they are of other units")
        return
    a_from_b = se3.inverse(a.world_from_rig) @ b.world_from_rig
    off_m, off_deg = np.linalg.norm(a_from_b[:, :3, 3], axis=1), se3.rotation_angle_deg(a_from_b[:, :3, :3])
    what = f"{title}: farthest pose from the undisturbed one"
    # Exactly the same poses are what to hope for.
    yield Figure(line="42", what=f"{what}, position", value=float(off_m.max()), unit="m", above=-1.0, most=SAME_M)
    yield Figure(line="42", what=f"{what}, rotation", value=float(off_deg.max()), unit="deg", above=-1.0, most=SAME_DEG)
    again = run.stages_run_again()
    remark = "; ".join(again[:3])
    yield replace(exactly("42", f"{title}: finished stages run twice + 1", len(again) + 1, 1), remark=remark)


@dataclass(frozen=True, kw_only=True)
class _Kill:
    """A worker that was killed while it was in a stage of a sub-map.

    Attributes
    ----------
    fence
        Number of the attempt that it ended.
    finished
        Stages of that sub-map whose results were stored by then.
    reused
        Those that the attempt had found finished.
    """

    job_id: str
    fence: int
    stage: str
    finished: frozenset[str]
    reused: frozenset[str]


@dataclass
class _Service:
    """A whole service for one reconstruction.

    Attributes
    ----------
    kills
        Those of workers so far.
    """

    folder: Path
    workers: int
    kills: list[_Kill] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.folder.mkdir()
        self._installation = Installation(self.folder, random.Random(SEED), workers=self.workers)
        self.records = Records(self._installation.data)

    def reconstruct(self, drive: Path, *, kills: int = 0) -> tuple[Path, float]:
        """Upload a drive and wait for its scene, while so many workers are killed.

        Returns
        -------
        scene
            Folder of the scene.
        seconds
            Between the job's begin and its end.
        """
        scene, ended = self.folder / "scene", threading.Event()
        try:
            self._installation.start()
            key_file = self.folder / "key"
            write_private_file(key_file, self._installation.key)
            address = ("--url", self._installation.url, "--key-file", key_file)
            with ThreadPoolExecutor(1) as pool:
                killing = pool.submit(self._kill, ended, kills)
                try:
                    mrasfm("upload", drive, *address, "--out", scene, timeout_s=TIMEOUT_S)
                finally:
                    ended.set()
                killing.result()
            statement = "SELECT started_us, finished_us FROM jobs WHERE kind = ? AND parent_id IS NULL"
            ((begun_us, ended_us),) = self.records.rows(statement, JobKind.RECONSTRUCTION)
            return scene, (ended_us - begun_us) / 1e6
        finally:
            self._installation.stop()

    def _kill(self, ended: threading.Event, kills: int) -> None:
        """Kill a worker that is in a stage of a sub-map so many times; Celery puts another one in its place.

        Sub-maps take turns: one whose stage takes longer than the time between kills would else get no further.
        """
        next_s = None
        while len(self.kills_that_counted()) < kills and not ended.wait(SAMPLED_EVERY_S):
            if next_s is not None and time.monotonic() < next_s:
                continue
            busy = self._busy()
            if not busy:
                continue
            if next_s is None:
                next_s = time.monotonic() + KILLED_EVERY_S
                continue
            killed = Counter(one.job_id for one in self.kills)
            owner, planned = min(busy, key=lambda each: killed[each[1].job_id])
            victims = [one for one in tree_of(self._installation.pid or 0) if one.pid == owner]
            if [victim.role for victim in victims] == [Role.WORKER_POOL] and kill(victims[0]):
                self.kills.append(planned)
                next_s += KILLED_EVERY_S

    def _busy(self) -> list[tuple[int, _Kill]]:
        """Workers that are in a stage of a sub-map: the process, and what its kill would be."""
        rows = self.records.rows(
            "SELECT owner, id, fence, stage, request, reused FROM jobs WHERE parent_id IS NOT NULL AND state = ?",
            JobState.RUNNING,
        )
        return [
            (
                int(owner.rpartition(":")[2]),
                _Kill(
                    job_id=job_id,
                    fence=fence,
                    stage=stage,
                    finished=self._finished(json.loads(request)["number"]),
                    reused=frozenset(json.loads(reused)),
                ),
            )
            for owner, job_id, fence, stage, request, reused in rows
            if stage in SUBMAP_STAGES
        ]

    def _finished(self, number: int) -> frozenset[str]:
        """Stages of a sub-map whose results the store has."""
        stored = {name for (name,) in self.records.rows("SELECT name FROM checkpoints")}
        return frozenset(s for s in SUBMAP_STAGES if checkpoint_file(submap_checkpoint(number, s)) in stored)

    def kills_that_counted(self) -> list[_Kill]:
        """Kills that cost an attempt: others met a worker that had just ended its sub-map."""
        statement = "SELECT outcome FROM job_attempts WHERE job_id = ? AND fence = ?"
        return [one for one in self.kills if self.records.rows(statement, one.job_id, one.fence) == [("worker-lost",)]]

    def stages_run_again(self) -> list[str]:
        """Stages of sub-maps that were run although their results were stored, in words."""
        finished: defaultdict[str, frozenset[str]] = defaultdict(frozenset)
        again = []
        for one in self.kills_that_counted():
            begun = SUBMAP_STAGES[: SUBMAP_STAGES.index(Stage(one.stage)) + 1]
            again += [f"{one.job_id}: {s}" for s in begun if s in finished[one.job_id] - one.reused]
            finished[one.job_id] = one.finished
        for job_id, reused in self.records.rows("SELECT id, reused FROM jobs WHERE parent_id IS NOT NULL"):
            again += [f"{job_id}: {s}" for s in finished[job_id] - set(json.loads(reused))]
        return again + [f"{name} in the join" for name in stages_run_in_join(read_report(self.folder / "scene"))]


def _rendered(work: Path) -> Path:
    """The long drive, which both lines use."""
    drive = work / "a long drive"
    if not (drive / "drive.json").exists():
        options = ("--cameras", CAMERAS, "--units", UNITS, "--seed", SEED, *SIZE, "--no-masks")
        mrasfm("synth", *options, "--out", drive, timeout_s=TIMEOUT_S)
    return drive


def _beginning(drive: Path, units: int) -> Path:
    """The first units of a drive as a drive beside it, with the same images."""
    beginning = drive.with_name(f"{drive.name}, {units} units")

    def edit(manifest: dict[str, Any]) -> None:
        manifest["frames"] = manifest["frames"][:units]
        end_us = manifest["frames"][-1]["timestamp_us"]
        samples = manifest["gnss"]["samples"]
        manifest["gnss"]["samples"] = [sample for sample in samples if sample["timestamp_us"] <= end_us]

    return edited_drive(drive, beginning, edit)


def _warm_up(work: Path) -> None:
    """Compile what no run on this machine has: it is no part of any time here."""
    drive, scene = work / "warm-up", work / "warm-up, scene"
    if not scene.exists():
        mrasfm("synth", "--cameras", 2, "--units", 12, *SIZE, "--no-masks", "--out", drive)
        mrasfm("reconstruct", drive, "--out", scene)


def _peak_gb(*arguments: object) -> float:
    """Run `mrasfm ARGUMENTS`; the most memory that it and all below it had at one time.

    A page that several processes share counts for each of them by its part.
    """
    peak_bytes, end_s = 0, time.monotonic() + TIMEOUT_S
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen([*MRASFM, *map(str, arguments)], stdout=output, stderr=output)
        try:
            while process.poll() is None:
                if time.monotonic() > end_s:
                    raise CommandFailed(f"mrasfm {arguments[0]} has not ended after {TIMEOUT_S:.0f} s")
                peak_bytes = max(peak_bytes, sum(map(_pss_bytes, _tree(process.pid))))
                time.sleep(SAMPLED_EVERY_S)
        finally:
            for one in _tree(process.pid):
                with suppress(psutil.Error):
                    one.kill()
            process.wait()
        if process.returncode != 0:
            output.seek(0)
            last = output.read().decode(errors="replace").strip()[-300:]
            raise CommandFailed(f"mrasfm {arguments[0]} ended with {process.returncode}: {last}")
    return peak_bytes / 1e9


def _tree(pid: int) -> list[psutil.Process]:
    """A process and all below it, as far as they live."""
    with suppress(psutil.Error):
        parent = psutil.Process(pid)
        return [parent, *parent.children(recursive=True)]
    return []


def _pss_bytes(process: psutil.Process) -> int:
    """Memory of a process now; none where it has ended."""
    with suppress(psutil.Error):
        return int(process.memory_full_info().pss)
    return 0
