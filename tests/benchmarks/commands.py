"""The command line as a user has it."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

MRASFM = (sys.executable, "-c", "import sys; from mrasfm_engine.cli import main; sys.exit(main())")


class CommandFailed(Exception):
    """A command ended with an error; its last lines are the message."""


def mrasfm(*arguments: object, timeout_s: float = 1800.0) -> str:
    """Run `mrasfm ARGUMENTS` and return what it printed.

    Raises
    ------
    CommandFailed
        Where it ends with another exit code than 0.
    """
    words = [str(argument) for argument in arguments]
    result = subprocess.run([*MRASFM, *words], capture_output=True, text=True, timeout=timeout_s, check=False)
    if result.returncode != 0:
        last = " / ".join(result.stderr.strip().splitlines()[-2:])
        raise CommandFailed(f"mrasfm {' '.join(words[:2])} ended with {result.returncode}: {last}")
    return result.stdout


def evaluate(scene: Path, drive: Path) -> dict[str, Any]:
    """What `mrasfm evaluate --json` says."""
    document: dict[str, Any] = json.loads(mrasfm("evaluate", scene, "--truth", drive / "truth.tum", "--json"))
    return document


def read_report(scene: Path) -> dict[str, Any]:
    """A scene's report, its stages by name."""
    report: dict[str, Any] = json.loads((scene / "report.json").read_text(encoding="utf-8"))
    report["by_stage"] = {stage["stage"]: stage for stage in report["stages"]}
    return report


def cpu_time_s() -> float:
    """CPU time of all commands so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
