"""A small rendered drive, and how long to wait for processes."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from mrasfm_engine.synthetic.drive_writer import render_drives
from mrasfm_engine.synthetic.options import SynthOptions
from service.settings import Settings
from tests.helpers.made_once import made_once
from tests.helpers.service_world import World
from worker.child_protocol import Work
from worker.progress import ProgressMeter
from worker.termination import CheckStop, StopReason, StopRequest

DEADLINE_S = 60.0


@pytest.fixture(scope="session")
def small_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered drive of 2 cameras and 6 units. Tests only read it."""
    options = SynthOptions(cameras=2, units=6, seed=3, width=480, height=270, texture_px=256)
    return made_once(tmp_path_factory, "small-drive", lambda out: render_drives(options, out))


@pytest.fixture(scope="session")
def brief_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered drive of 2 cameras and 4 units, reconstructed in seconds. Tests only read it."""
    options = SynthOptions(cameras=2, units=4, seed=3, width=320, height=180, texture_px=128)
    return made_once(tmp_path_factory, "brief-drive", lambda out: render_drives(options, out))


@pytest.fixture(scope="session")
def long_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered drive of 2 cameras that can be cut into three sub-maps. Tests only read it."""
    options = SynthOptions(cameras=2, units=41, seed=3, width=320, height=180, texture_px=128, rate_hz=5.0)
    return made_once(tmp_path_factory, "long-drive", lambda out: render_drives(options, out))


@pytest.fixture
def make_world(tmp_path: Path) -> Iterator[Callable[..., World]]:
    """A function that makes an installation with a broker and settings of the test's."""
    worlds: list[World] = []

    def make(**changed: object) -> World:
        folder = tmp_path / f"world{len(worlds)}"
        folder.mkdir()
        worlds.append(World(folder, **changed))
        worlds[-1].broker.start()
        return worlds[-1]

    yield make
    for made in worlds:
        made.close()


@pytest.fixture
def world(make_world: Callable[..., World]) -> World:
    """An installation with a broker, and neither workers nor reconciler yet."""
    return make_world()


@pytest.fixture
def own_drive(small_drive: Path, tmp_path: Path) -> Path:
    """A copy of the small drive to damage."""
    return Path(shutil.copytree(small_drive, tmp_path / "drive"))


@pytest.fixture
def own_brief_drive(brief_drive: Path, tmp_path: Path) -> Path:
    """A copy of the brief drive to damage."""
    return Path(shutil.copytree(brief_drive, tmp_path / "drive"))


@pytest.fixture
def scratch(tmp_path: Path) -> Path:
    """The folder of an attempt."""
    folder = tmp_path / "attempt"
    folder.mkdir()
    return folder


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    """Settings with steps that a test can wait for."""
    return settings_with(tmp_path)


def settings_with(data_dir: Path, **fields: float) -> Settings:
    """Settings of a test, with some of them changed."""
    values = {"terminate_after_seconds": 20.0, "kill_after_seconds": 40.0, "engine_threads": 1, **fields}
    return Settings(data_dir=data_dir, **values)


def meter_of(work: Work = Work.RECONSTRUCTION) -> ProgressMeter:
    """A meter that starts now."""
    return ProgressMeter(work, started_s=time.monotonic())


def go_on() -> None:
    """The check of an attempt that nobody stops."""


def stop_once_it_works(meter: ProgressMeter, reason: StopReason) -> CheckStop:
    """The check of an attempt that is stopped as soon as it reports a stage."""

    def check_stop() -> None:
        if meter.stage:
            raise StopRequest(reason)

    return check_stop


def wait_until(is_so: Callable[[], bool], what: str) -> None:
    """Wait for something that happens soon."""
    end_s = time.monotonic() + DEADLINE_S
    while not is_so():
        assert time.monotonic() < end_s, f"{what} did not happen"
        time.sleep(0.02)


def is_gone(pid: int) -> bool:
    """Whether a process has ended; one that only waits to be reaped has."""
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
