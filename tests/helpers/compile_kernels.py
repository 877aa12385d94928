"""Compiles the engine's kernels once for all test processes: `python -m tests.helpers.compile_kernels`.

numba compiles a function in each process that calls it before another has left the result on the disk. Two drives are
rendered, reconstructed and aggregated here, and one whose cameras are not simultaneous, for which the adjustment is
compiled another time; that calls nearly all of them.
"""

from __future__ import annotations

import gc
import sys
import tempfile
from pathlib import Path

from mrasfm_engine.cli import main

WITHOUT_PICTURES = Path(__file__).parents[1] / "integration" / "without_pictures.toml"


def compile_kernels(folder: Path) -> None:
    """Run the commands on drives that are as small as they may be."""
    options = ("--cameras", "3", "--units", "6", "--width", "320", "--height", "180", "--texture-px", "128")
    drives, scenes = folder / "drives", [folder / "a", folder / "b"]
    _run("synth", "--out", drives, "--drives", "2", *options)
    first, second = sorted(path.parent for path in drives.glob("*/drive.json"))
    _run("reconstruct", first, "--out", scenes[0])
    _run("reconstruct", second, "--out", scenes[1], "--config", WITHOUT_PICTURES)
    _run("aggregate", *scenes, "--out", folder / "map")
    apart = folder / "apart"
    _run("synth", "--out", apart, "--time-skew-ms", "40", "--cameras", "2", "--units", "6", *options[4:])
    _run("reconstruct", apart, "--out", folder / "c", "--config", WITHOUT_PICTURES)


def _run(*arguments: object) -> None:
    if main([str(argument) for argument in arguments]) != 0:
        sys.exit(f"mrasfm {arguments[0]} failed")


if __name__ == "__main__":
    gc.disable()  # the compiler's objects stay, and looking through them takes a fifteenth of the time
    with tempfile.TemporaryDirectory(prefix="kernels") as made:
        compile_kernels(Path(made))
