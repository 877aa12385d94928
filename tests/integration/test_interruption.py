"""Ctrl-C, SIGTERM and a full disk leave nothing half-written, and the next run goes on from there."""

from __future__ import annotations

import resource
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from mrasfm_engine.cli import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_TERMINATED
from tests.integration.conftest import WITHOUT_PICTURES, CommandResult, Variant, leftovers, mrasfm_process, read_report

Run = Callable[..., CommandResult]


def _wait_for(path: Path, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not path.exists():
        assert time.monotonic() < end, f"{path} did not appear"
        time.sleep(0.02)


def _stopped(variant: Variant, number: int, code: int, *, meanwhile: Callable[[], None] = lambda: None) -> None:
    """Send a signal to a run whose features are stored, and look at how it ends."""
    variant.keep(cameras=["front", "left"], units=5).save()
    process = mrasfm_process("reconstruct", variant.root, "--out", variant.scene, *WITHOUT_PICTURES)
    _wait_for(variant.scene / ".stages" / "features.npz")
    process.send_signal(signal.SIGSTOP)  # it does not end meanwhile
    meanwhile()
    process.send_signal(signal.SIGCONT)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == code
    assert "stopping; finished stages are kept" in errors
    assert "Traceback" not in errors
    assert "Aborted" not in errors  # as COLMAP's handler of SIGTERM says
    assert "cancelled" in errors
    assert {path.name for path in variant.scene.iterdir()} == {".stages"}
    assert leftovers(variant.scene.parent) == []


def test_interrupted_run_resumes(variant: Variant, mrasfm: Run) -> None:
    def run_beside() -> None:
        beside = mrasfm("reconstruct", variant.root, "--out", variant.scene, *WITHOUT_PICTURES)
        assert beside.code == EXIT_BAD_INPUT
        assert f"another run is making a result in {variant.scene}" in beside.err

    _stopped(variant, signal.SIGINT, EXIT_INTERRUPTED, meanwhile=run_beside)
    result = mrasfm("reconstruct", variant.root, "--out", variant.scene, *WITHOUT_PICTURES)
    assert result.code == 0
    stages = read_report(variant.scene)["by_stage"]
    assert stages["features"]["reused"]
    assert not stages["mapping"]["reused"]


def test_terminated_run_leaves_finished_stages(variant: Variant) -> None:
    """What the next run does with them is as after an interrupt."""
    _stopped(variant, signal.SIGTERM, EXIT_TERMINATED)


def _small_files() -> None:
    """As a full disk: writing beyond 200 kB fails, with an error and not with a signal."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))


def test_full_disk(variant: Variant) -> None:
    variant.keep(cameras=["front", "left"], units=3).save()
    process = mrasfm_process(
        "reconstruct", variant.root, "--out", variant.scene, *WITHOUT_PICTURES, preexec_fn=_small_files
    )
    _, errors = process.communicate(timeout=120)
    assert process.returncode == EXIT_BAD_INPUT
    assert "Traceback" not in errors
    assert "cannot write" in errors or "no space left" in errors
    assert leftovers(variant.scene.parent) == []
    assert {path.name for path in variant.scene.rglob("*.npz")} <= {
        "own-car.npz",
        "extraction-size.npz",
    }  # small enough


@pytest.mark.slow
def test_disk_fills_while_the_scene_is_written(surround_drive: Path, variant: Variant, mrasfm: Run) -> None:
    """The stages are kept, and of the scene there is nothing."""
    variant.keep(cameras=["front", "left"], units=3).save()
    assert mrasfm("reconstruct", variant.root, "--out", variant.scene, *WITHOUT_PICTURES).code == 0
    stages = variant.scene / ".stages"
    other = variant.scene.parent / "other"
    other.mkdir()
    stages.rename(other / ".stages")
    process = mrasfm_process("reconstruct", variant.root, "--out", other, *WITHOUT_PICTURES, preexec_fn=_small_files)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == EXIT_BAD_INPUT
    assert "Traceback" not in errors
    assert "cannot be written" in errors
    assert {path.name for path in other.iterdir()} == {".stages"}
