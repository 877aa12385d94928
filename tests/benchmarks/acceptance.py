"""Figures of README.md and docs/: `python -m tests.benchmarks.acceptance`.

Without arguments it measures the headline figures, with --thorough all lines but 4, which takes many hours; --only N
makes parts of it. The results of a line are kept with commit and date, see --kept.

| line | what |
|---|---|
| 1 | accuracy on real drives, and COLMAP beside it on the same matches |
| 2 | time of mapping a real drive beside COLMAP's mappers on the same matches, and of the whole way from images |
| 3 | rendered drives: calibration found again, scale, a route that returns |
| 4 | a fresh clone: tests and demo (only with --fresh-clone) |
| 5 | the service: the command's result over HTTP, large uploads, many clients, made-up requests |
| 6 | the road: bumps and bays, moving shadows, a real drive on held-out images, with and without semantics |
| 7 | covered cameras: their images' poses, and what is left without camera set registration |
| 8 | a camera with a wrong extrinsic; what a straight street lets a drive observe |
| 9 | cameras that are not simultaneous, against the same drive with cameras that are |
| 10 | ablation: the method without each of its parts |
| 11 | the road from above, before and after recalibration |
| 12 | learned keypoints and matches: accuracy on a real drive, and light that changes |
| 13 | camera set bundle adjustment beside Ceres, on one problem |
| 14 | time of mapping a rendered drive of six cameras beside COLMAP's mappers on the same matches |
| 15 | how time, memory and error grow with the length of simulated routes |
| 16 | extraction and matching beside COLMAP's, with as many keypoints, on the same pairs |
| 17 | the service while its processes are killed: nothing lost, twice, stuck, wrong or left |
| 18 | a real drive whose manifest is wrong: cameras, focal lengths, and faults of its receiver and its files |
| 19 | sigmas: halves of real drives against one another, simulated drives against the truth |
| 20 | aggregation: seams of real and rendered drives, repeated facades, loops, vehicles, adding a scene, over HTTP |
| 21 | real drives with poorer receivers than theirs, and with cameras left out |
| 22 | the cameras of a real car beside COLMAP's mappers on the same matches, and the cost of GNSS for their images |
| 23 | simulated routes whose calibration is slightly off, with receivers from poor to very good |
| 24 | which of many seams is wrong, by loops of simulated scenes |
| 25 | the own car in images without masks, rendered and real; a bar with the time over a fifth of all images |
| 26 | traffic without masks: tracks on vehicles that move, and those of the street |
| 27 | the road's picture of the best views: markings against the painted ones |
| 28 | a real drive with grey images: parts that images, positions or nothing links, and a map that joins them |
| 29 | a stop of a minute: what it costs beyond hashing, and where its units are |
| 30 | drives cut into sub-maps, beside the same in one piece; a loop of 600 units that closes over their borders |
| 31 | files for other programs, as readers of others read them; colours of points; a COPC of five million points |
| 32 | fisheyes of 190 deg beside pinholes |
| 33 | exports of images for splatting; the client's wheel in an environment of its own |
| 34 | recordings of other programs in, and scenes out to the development kits of data sets |
| 35 | the whole command on real drives beside COLMAP's extraction, matching and global mapper |
| 36 | simulated routes whose descriptors lie on disk: memory and time of matching and mapping |
| 37 | maps of 15 and of 60 simulated scenes: time and memory of a scene |
| 38 | the web console: five million points as they stream, a camera turned by 3 deg, the wheel in a fresh environment |
| 39 | tests of the engine that make test leaves out for their time |
| 40 | tests of service, workers and console that make test leaves out for their time |
| 41 | a drive of 3,600 images by the command: memory, and the time of a unit beside a quarter of it |
| 42 | the same drive on two workers beside one, and while workers are killed |
| 43 | real drives varied so that their geometry stays: cameras turned, mirrored, backwards, elsewhere, in other light |
| 44 | real drives of which every second to tenth frame is there |

What is timed runs alone, with all cores. What is not runs after it, a drive on each core.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from rich.console import Console

from mrasfm_engine import __version__
from tests.benchmarks.ablation import ablation
from tests.benchmarks.adjustment import adjustment
from tests.benchmarks.aggregation import crossing, kitti, loop, repeated, speed_of_aggregation
from tests.benchmarks.birds_eye import birds_eye
from tests.benchmarks.commands import CommandFailed
from tests.benchmarks.console import console, turned_camera, wheel
from tests.benchmarks.correspondence import correspondence
from tests.benchmarks.export_formats import client_wheel, exports_of_images
from tests.benchmarks.faults import faults
from tests.benchmarks.fisheyes import fisheyes
from tests.benchmarks.foreign_readers import foreign_readers
from tests.benchmarks.fresh_clone import fresh_clone
from tests.benchmarks.gaps import components_in_map, gaps
from tests.benchmarks.learned import learned
from tests.benchmarks.long_drives import memory_of_long_drives, on_several_workers
from tests.benchmarks.many_scenes import many_scenes
from tests.benchmarks.motion import motion
from tests.benchmarks.moving_objects import moving_objects
from tests.benchmarks.occlusion import occlusion
from tests.benchmarks.own_car import bar_with_time, real_own_car, rendered_own_car
from tests.benchmarks.real_drives import accuracy
from tests.benchmarks.recalibration import recalibration, straight_street
from tests.benchmarks.receivers import receivers
from tests.benchmarks.recordings import recordings
from tests.benchmarks.rendered_drives import SEEDS, rendered, rendered_loop
from tests.benchmarks.road_picture import real_pictures, rendered_markings
from tests.benchmarks.road_shapes import road_shapes
from tests.benchmarks.seam_graphs import seam_graphs
from tests.benchmarks.semantics import real_road, shadowed_road
from tests.benchmarks.service import kills, maps_over_http, service
from tests.benchmarks.sigmas import halves, simulated, with_wrong_lenses, without_positions
from tests.benchmarks.simulated_routes import simulated_routes
from tests.benchmarks.slow_tests import slow_tests_of_engine, slow_tests_of_service
from tests.benchmarks.sparse_frames import sparse_frames
from tests.benchmarks.speed import from_descriptors, long_routes, speed, surround_speed
from tests.benchmarks.stops import stops
from tests.benchmarks.submaps import loop_over_borders, submaps
from tests.benchmarks.surround_peers import surround_peers
from tests.benchmarks.table import Figure, failed, load, save, show
from tests.benchmarks.variations import varied_pairs, varied_surround
from tests.benchmarks.vehicles import vehicles
from tests.benchmarks.whole_command import whole_command
from tests.benchmarks.wrong_manifests import wrong_manifests

REPOSITORY = Path(__file__).resolve().parents[2]
THOROUGH_REPEAT = 3


@dataclass(frozen=True)
class Line:
    """What is measured under one number. All of it works on folders that the measurement is given and may fill."""

    timed: tuple[Callable[[Path, Path], Iterator[Figure]], ...] = ()  # of the real drives' folder and of work
    repeated: tuple[Callable[[Path, Path, int], Iterator[Figure]], ...] = ()  # timed, and how often: medians count
    untimed: tuple[Callable[[Path, Path], Iterator[Figure]], ...] = ()
    by_seed: tuple[Callable[[Path, int], Iterator[Figure]], ...] = ()  # of a folder of work and a seed

    def tasks(self, seeds: int) -> int:
        """Number of measurements with so many seeds."""
        return len(self.timed) + len(self.repeated) + len(self.untimed) + seeds * len(self.by_seed)


LINES = {
    "1": Line(timed=(accuracy,)),
    "2": Line(repeated=(speed,)),
    "3": Line(by_seed=(rendered, rendered_loop)),
    "4": Line(timed=(fresh_clone,)),
    "5": Line(timed=(service,)),
    "6": Line(timed=(road_shapes,), by_seed=(shadowed_road,), untimed=(real_road,)),
    "7": Line(by_seed=(occlusion,)),
    "8": Line(by_seed=(recalibration, straight_street)),
    "9": Line(by_seed=(motion,)),
    "10": Line(timed=(ablation,)),
    "11": Line(untimed=(birds_eye,)),
    "12": Line(untimed=(learned,)),
    "13": Line(repeated=(adjustment,)),
    "14": Line(repeated=(surround_speed,)),
    "15": Line(timed=(long_routes,)),
    "16": Line(repeated=(correspondence,)),
    "17": Line(timed=(kills,)),
    "18": Line(untimed=(wrong_manifests, faults)),
    "19": Line(untimed=(halves, simulated, without_positions, with_wrong_lenses)),
    "20": Line(timed=(kitti, speed_of_aggregation, maps_over_http), by_seed=(crossing, repeated, loop, vehicles)),
    "21": Line(untimed=(receivers,)),
    "22": Line(timed=(surround_peers,)),
    "23": Line(untimed=(simulated_routes,)),
    "24": Line(timed=(seam_graphs,)),
    "25": Line(untimed=(real_own_car,), by_seed=(rendered_own_car, bar_with_time)),
    "26": Line(by_seed=(moving_objects,)),
    "27": Line(by_seed=(rendered_markings,), untimed=(real_pictures,)),
    "28": Line(untimed=(gaps, components_in_map)),
    "29": Line(timed=(stops,)),
    "30": Line(untimed=(submaps, loop_over_borders)),
    "31": Line(timed=(foreign_readers,)),
    "32": Line(by_seed=(fisheyes,)),
    "33": Line(untimed=(exports_of_images, client_wheel)),
    "34": Line(timed=(recordings,)),
    "35": Line(timed=(whole_command,)),
    "36": Line(timed=(from_descriptors,)),
    "37": Line(timed=(many_scenes,)),
    "38": Line(timed=(console,), untimed=(turned_camera, wheel)),
    "39": Line(timed=(slow_tests_of_engine,)),
    "40": Line(timed=(slow_tests_of_service,)),
    "41": Line(timed=(memory_of_long_drives,)),
    "42": Line(timed=(on_several_workers,)),
    "43": Line(untimed=(varied_surround, varied_pairs)),
    "44": Line(untimed=(sparse_frames,)),
}
# Accuracy on real drives, speed of mapping, of the adjustment and of the whole command, and drives with gaps.
HEADLINE = ("1", "2", "13", "28", "35")
KEPT = REPOSITORY / ".acceptance"


@dataclass
class Run:
    """The measurement's figures so far, by line and task."""

    data: Path
    work: Path
    about: dict[str, Any]  # what is kept with the figures of every line
    started_s: float = field(default_factory=time.perf_counter)
    figures: dict[tuple[str, int], list[Figure]] = field(default_factory=dict)
    seconds: Counter[str] = field(default_factory=Counter)  # by line, of all its tasks
    measured: Counter[str] = field(default_factory=Counter)  # tasks by line
    keeping: threading.Lock = field(default_factory=threading.Lock)

    def measure(self, line: str, part: int, measure: Callable[[Path], Iterator[Figure]], work: Path) -> None:
        """Run one task and keep the line's figures; what keeps it from its end is a figure that fails."""
        figures, started_s = self.figures[line, part], time.perf_counter()
        try:
            for figure in measure(work):
                figures.append(figure)
                print(_progress(figure, time.perf_counter() - self.started_s), file=sys.stderr, flush=True)
        except Exception as problem:  # whatever it is: other lines can be measured
            said = str(problem) if isinstance(problem, CommandFailed | AssertionError) else repr(problem)
            figures.append(failed(line, "the line was not measured to its end", said))
            print(f"line {line}: {said}", file=sys.stderr, flush=True)
        with self.keeping:
            self.seconds[line] += time.perf_counter() - started_s
            self.measured[line] += 1
            self._keep(line)

    def _keep(self, line: str) -> None:
        """Keep the line's figures; those of an earlier measurement go once all tasks are done."""
        tasks = LINES[line].tasks(len(self.about["seeds"]))
        path = KEPT / f"{line}{'-thorough' if self.about['thorough'] else ''}.json"
        partial_path = path.with_suffix(".partial.json")
        about = {"seconds": round(self.seconds[line], 1), "measured": self.measured[line], "tasks": tasks}
        save(self.of_line(line), partial_path, self.about | about)
        if self.measured[line] == tasks:
            partial_path.replace(path)

    def of_line(self, line: str) -> list[Figure]:
        """Figures of a line, in the order of its tasks."""
        return [figure for key, part in list(self.figures.items()) if key[0] == line for figure in part]

    def alone(self, lines: Sequence[str], repeat: int) -> None:
        """What is timed, one after the other in one folder: scenes are used again."""
        for line in lines:
            repeated = [partial(_repeated, measure, repeat) for measure in LINES[line].repeated]
            for measure in (*LINES[line].timed, *repeated):
                part = len(self.figures)
                self.figures[line, part] = []
                self.measure(line, part, partial(measure, self.data), self.work)

    def side_by_side(self, lines: Sequence[str], seeds: Sequence[int]) -> None:
        """What is not timed, each task on a core and in a folder of its own."""
        tasks: list[tuple[str, Callable[[Path], Iterator[Figure]]]] = []
        for line in lines:
            tasks += [(line, partial(measure, self.data)) for measure in LINES[line].untimed]
            tasks += [(line, partial(_seeded, measure, seed)) for measure in LINES[line].by_seed for seed in seeds]
        cores: SimpleQueue[int] = SimpleQueue()
        for core in sorted(os.sched_getaffinity(0)):
            cores.put(core)

        def run(line: str, part: int, measure: Callable[[Path], Iterator[Figure]]) -> None:
            core = cores.get()
            os.sched_setaffinity(0, {core})  # of this thread, and of the commands that it starts
            work = self.work / f"line {line}, {part}"
            work.mkdir()
            try:
                self.measure(line, part, measure, work)
            finally:
                shutil.rmtree(work)
                cores.put(core)

        with ThreadPoolExecutor(cores.qsize()) as pool:
            begun = []
            for line, measure in tasks:
                begun.append((line, len(self.figures), measure))
                self.figures[line, len(self.figures)] = []
            for future in [pool.submit(run, *task) for task in begun]:
                future.result()


def _seeded(measure: Callable[[Path, int], Iterator[Figure]], seed: int, work: Path) -> Iterator[Figure]:
    return measure(work, seed)


def _repeated(
    measure: Callable[[Path, Path, int], Iterator[Figure]], repeat: int, data: Path, work: Path
) -> Iterator[Figure]:
    return measure(data, work, repeat)


def main() -> int:
    """Measure, print, and save; 1 where a figure is out of its bounds."""
    arguments = _arguments()
    if arguments.kept:
        return _show_kept()
    data = Path(os.environ.get("MRASFM_TEST_DATA", REPOSITORY.parent / "shared")) / "data"
    if not data.is_dir():
        sys.exit(f"real drives are missing: {data} (set MRASFM_TEST_DATA)")
    about = _about() | {name: getattr(arguments, name) for name in ("thorough", "seeds", "repeat")}
    with tempfile.TemporaryDirectory(prefix="mrasfm-acceptance-") as work:
        run = Run(data.resolve(), Path(work), about)
        run.alone(arguments.lines, arguments.repeat)
        run.side_by_side(arguments.lines, arguments.seeds)
        seconds = time.perf_counter() - run.started_s
    figures = [figure for line in arguments.lines for figure in run.of_line(line)]
    console = Console(width=140)
    show(figures, console)
    bad = [figure for figure in figures if not figure.passed]
    if arguments.out is not None:
        save(figures, arguments.out, about | {"seconds": round(seconds, 1)})
    console.print(f"{len(bad)} of {sum(f.bounded for f in figures)} figures out of bounds, {seconds / 60:.0f} min")
    console.print(f"Kept in {KEPT}", soft_wrap=True)
    return 1 if bad or not figures else 0


def _arguments() -> argparse.Namespace:
    """Arguments, with `lines` to measure, `seeds` and `repeat` as numbers."""
    parser = argparse.ArgumentParser(
        prog="acceptance", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", metavar="LINE[,LINE]", help="measure these lines only")
    parser.add_argument("--seeds", default="1", help="of rendered drives (default: %(default)s)")
    parser.add_argument("--repeat", type=int, default=1, help="times that count by their median (default: %(default)s)")
    parser.add_argument(
        "--thorough",
        action="store_true",
        help=f"all lines but 4, as published: seeds {','.join(map(str, SEEDS))}, medians of three",
    )
    parser.add_argument("--fresh-clone", action="store_true", help="line 4 too")
    parser.add_argument("--kept", action="store_true", help="measure nothing, show the kept results of all lines")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write all figures there as well")
    arguments = parser.parse_args()
    arguments.seeds = list(SEEDS) if arguments.thorough else [int(seed) for seed in arguments.seeds.split(",")]
    arguments.repeat = THOROUGH_REPEAT if arguments.thorough else arguments.repeat
    default = [line for line in LINES if line != "4"] if arguments.thorough else list(HEADLINE)
    arguments.lines = list(dict.fromkeys(arguments.only.split(","))) if arguments.only else default
    arguments.lines += ["4"] if arguments.fresh_clone and "4" not in arguments.lines else []
    if unknown := set(arguments.lines) - set(LINES):
        parser.error(f"there is no line {', '.join(sorted(unknown))}")
    return arguments


def _show_kept() -> int:
    """Print all kept results; 1 where a figure is out of its bounds, a task is missing, or a line has none.

    Line 4 is measured where it is asked for.
    """
    console, bad = Console(width=140), False
    for line in LINES:
        paths = sorted(KEPT.glob(f"{line}[-.]*json"))
        for path in paths:
            about, figures = load(path)
            seeds = ", ".join(map(str, about["seeds"]))
            console.print(
                f"line {line}: {about['at']}, commit {about['commit']}, {about['seconds'] / 60:.0f} min on "
                f"{about['cores']} cores, seeds {seeds}, medians of {about['repeat']}, "
                f"{about['measured']} of {about['tasks']} tasks"
            )
            show(figures, console)
            bad = bad or about["measured"] < about["tasks"] or not all(figure.passed for figure in figures)
        if not paths and line != "4":
            console.print(f"line {line}: not measured here")
            bad = True
    return 1 if bad else 0


def _progress(figure: Figure, elapsed_s: float) -> str:
    verdict = "" if figure.passed else "  FAIL"
    return f"[{elapsed_s:6.0f} s] {figure.line} {figure.what}: {figure.value:.4g} {figure.unit}{verdict}"


def _about() -> dict[str, Any]:
    return {
        "version": __version__,
        "commit": _commit(),
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "cores": os.cpu_count(),
    }


def _commit() -> str:
    """The commit that is measured, with a plus where files differ from it."""
    run = partial(subprocess.run, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    try:
        commit, changed = (
            run(["git", *arguments]).stdout.strip()
            for arguments in (("rev-parse", "--short", "HEAD"), ("status", "--porcelain"))
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit + ("+" if changed else "")


if __name__ == "__main__":
    sys.exit(main())
