"""Every figure that the README claims: `python -m tests.benchmarks.acceptance`.

| line | what |
|---|---|
| 1 | accuracy on real drives, and COLMAP beside it on the same matches |
| 2 | time of mapping against COLMAP's global mapper on the same matches |
| 3 | rendered drives: calibration found again, scale, a route that returns |
| 4 | a fresh clone: tests and demo (only with --fresh-clone) |
| 5 | the service: the command's result over HTTP, large uploads, many clients, made-up requests, crashes |
| 6 | the road under moving shadows, and of a real drive on held-out images, with and without semantics |
| 7 | covered cameras: their images' poses, and what is left without camera set registration |
| 8 | a camera with a wrong extrinsic; what a straight street lets a drive observe |
| 9 | cameras that are not simultaneous, against the same drive with cameras that are |
| 10 | ablation: the method without each of its parts |
| 11 | the road from above, before and after recalibration |
| 12 | learned keypoints and matches: accuracy on a real drive, and light that changes |
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from mrasfm_engine import __version__
from tests.benchmarks.ablation import ablation
from tests.benchmarks.birds_eye import birds_eye
from tests.benchmarks.commands import CommandFailed
from tests.benchmarks.fresh_clone import fresh_clone
from tests.benchmarks.learned import learned
from tests.benchmarks.motion import motion
from tests.benchmarks.occlusion import occlusion
from tests.benchmarks.real_drives import accuracy, speed
from tests.benchmarks.recalibration import recalibration
from tests.benchmarks.rendered_drives import SEEDS, rendered
from tests.benchmarks.semantics import semantics
from tests.benchmarks.service import service
from tests.benchmarks.table import Figure, failed, save, show

REPOSITORY = Path(__file__).resolve().parents[2]
Line = Callable[[Path, Path], Iterator[Figure]]  # of the folders of real drives and of work


def lines_for(seeds: Sequence[int]) -> dict[str, Line]:
    """What can be measured, by number."""
    return {
        "1": accuracy,
        "2": speed,
        "3": lambda data, work: rendered(work, seeds),
        "4": fresh_clone,
        "5": service,
        "6": lambda data, work: semantics(data, work, seeds),
        "7": lambda data, work: occlusion(work, seeds),
        "8": lambda data, work: recalibration(work, seeds),
        "9": lambda data, work: motion(work, seeds),
        "10": ablation,
        "11": birds_eye,
        "12": learned,
    }


def main() -> int:
    """Measure, print, and save; 1 where a figure is out of its bounds."""
    parser = argparse.ArgumentParser(
        prog="acceptance", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", metavar="LINE[,LINE]", help="measure these lines only")
    parser.add_argument("--seeds", default=",".join(map(str, SEEDS)), help="of lines 3, 6 to 9 (default: %(default)s)")
    parser.add_argument("--fresh-clone", action="store_true", help="line 4 too")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "build" / "acceptance.json", metavar="FILE")
    arguments = parser.parse_args()
    known = lines_for([int(seed) for seed in arguments.seeds.split(",")])
    lines = arguments.only.split(",") if arguments.only else [line for line in known if line != "4"]
    lines += ["4"] if arguments.fresh_clone and "4" not in lines else []
    if unknown := set(lines) - set(known):
        parser.error(f"there is no line {', '.join(sorted(unknown))}")
    data = Path(os.environ.get("MRASFM_TEST_DATA", REPOSITORY.parent / "shared")) / "data"
    if not data.is_dir():
        parser.error(f"real drives are missing: {data} (set MRASFM_TEST_DATA)")
    figures, seconds = _measure({line: known[line] for line in lines}, data.resolve())
    console = Console(width=140)
    show(figures, console)
    bad = [figure for figure in figures if not figure.passed]
    save(figures, arguments.out, _about(seconds))
    console.print(f"{len(bad)} of {sum(f.bounded for f in figures)} figures out of bounds, {seconds / 60:.0f} min")
    console.print(f"Written to {arguments.out}", soft_wrap=True)
    return 1 if bad or not figures else 0


def _measure(lines: dict[str, Line], data: Path) -> tuple[list[Figure], float]:
    started = time.perf_counter()
    figures: list[Figure] = []
    with tempfile.TemporaryDirectory(prefix="mrasfm-acceptance-") as work:
        for line, measure in lines.items():
            try:
                for figure in measure(data, Path(work)):
                    figures.append(figure)
                    print(_progress(figure, time.perf_counter() - started), file=sys.stderr, flush=True)
            except (CommandFailed, AssertionError) as problem:
                figures.append(failed(line, "the line was not measured to its end", str(problem)))
                print(f"line {line}: {problem}", file=sys.stderr, flush=True)
    return figures, time.perf_counter() - started


def _progress(figure: Figure, elapsed_s: float) -> str:
    verdict = "" if figure.passed else "  FAIL"
    return f"[{elapsed_s:6.0f} s] {figure.line} {figure.what}: {figure.value:.4g} {figure.unit}{verdict}"


def _about(seconds: float) -> dict[str, object]:
    return {
        "version": __version__,
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "cores": os.cpu_count(),
        "seconds": round(seconds, 1),
    }


if __name__ == "__main__":
    sys.exit(main())
