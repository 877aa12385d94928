from __future__ import annotations

import fcntl
import gc
import hashlib
import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from xdist.scheduler import LoadFileScheduling

REPOSITORY = Path(__file__).resolve().parent.parent

# What a shell starts in the background ignores interrupts, and so would every process that the tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Tests start hundreds of processes, each of which would compile all sources first. Where bytecode goes, in __pycache__,
# numba writes its kernels in any case.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Three test processes share two cores. OpenBLAS would start a thread for each core in all of them, whose small matrices
# then wait for one another: most of the time of some tests. Those of xdist load it after this line.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Kernels are compiled once for all test processes, while these run the tests that need none.
_KERNEL_LOCK = "MRASFM_TEST_KERNEL_LOCK"
NICENESS = 5  # of test processes beside which kernels are compiled, to their end: only root can take it back
_OF_UNIT = ("commands", "documentation", "importers", "io", "learned", "preflight", "scene", "schemas")
_CONSOLE = REPOSITORY / "tests" / "console"
_WITHOUT_KERNELS = (  # or with a few that compile in a second
    _CONSOLE,
    REPOSITORY / "tests" / "service",
    *(REPOSITORY / "tests" / "unit" / name for name in (*_OF_UNIT, "test_vocabulary.py")),
)
_compiler = pytest.StashKey[subprocess.Popen[bytes]]()


def pytest_configure(config: pytest.Config) -> None:
    """Begin to compile before the test processes begin, which give way to it: all of them wait for it in the end."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        gc.disable()  # what is imported and collected stays
        os.nice(NICENESS if _KERNEL_LOCK in os.environ else 0)
        return
    if not getattr(config.option, "numprocesses", None) or _is_compiled(config):
        return
    path = Path(config.cache.mkdir("kernels")) / "lock" if config.cache else REPOSITORY / ".kernels.lock"
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        config.stash[_compiler] = subprocess.Popen(
            [sys.executable, "-m", "tests.helpers.compile_kernels"],
            cwd=REPOSITORY,
            pass_fds=(lock.fileno(),),  # the lock ends with the process
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
    os.environ[_KERNEL_LOCK] = str(path)


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remember that the kernels are compiled."""
    process = config.stash.get(_compiler, None)
    if process is None:
        return
    if process.poll() is None:
        process.kill()
    if process.wait() == 0 and config.cache:
        config.cache.set(_CACHED, _kernel_version())


_CACHED = "mrasfm/kernels"


def _is_compiled(config: pytest.Config) -> bool:
    return config.cache is not None and config.cache.get(_CACHED, None) == _kernel_version()


def _kernel_version() -> str:
    """Of the sources that numba compiles, and of what it compiles them for."""
    digest = hashlib.sha256(f"{platform.python_version()} {os.environ.get('NUMBA_CACHE_DIR')}".encode())
    for path in sorted((REPOSITORY / "mrasfm_engine").rglob("*.py")):
        digest.update(f"{path} {path.stat().st_mtime_ns}\n".encode())
    return digest.hexdigest()


class _Scheduling(LoadFileScheduling):
    """Gives whole files to test processes, and the console's all to one: each would start a browser and a service."""

    def _split_scope(self, nodeid: str) -> str:
        scope: str = super()._split_scope(nodeid)
        return "tests/console" if scope.startswith("tests/console/") else scope


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> _Scheduling | None:
    """Schedule tests by what they share, where whole files are asked for."""
    return _Scheduling(config, log) if config.getoption("dist") == "loadfile" else None


# Files of these take up to two minutes each. What comes last are the many short ones of `tests/unit`: with long files
# at the end one test process would work alone.
_LONG = tuple(REPOSITORY / "tests" / name for name in ("integration", "worker"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests first that need no kernels, and of the others the long ones.

    Those of the console follow what needs no kernels: their browser leaves an event loop in its process, in which the
    service's tests could start no other.
    """
    needing = {item.path for item in items if _needs_kernels(item)}  # files go to test processes in one piece
    items.sort(
        key=lambda item: (item.path in needing, _is_below(item.path, (_CONSOLE,)), not _is_below(item.path, _LONG))
    )


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection() -> Iterator[None]:
    """Collect in one test process before the others where sources have changed.

    All of them collect all tests. The first one leaves bytecode of the tests, with their rewritten assertions, which
    takes twice as long as to collect them.
    """
    path = os.environ.get(_KERNEL_LOCK) if "PYTEST_XDIST_WORKER" in os.environ else None
    if path is None:
        return (yield)
    with open(f"{path}.collection", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fcntl.flock(lock, fcntl.LOCK_SH)
        return (yield)


def pytest_collection_finish() -> None:
    """Look for garbage again where it was not looked for, but not among the tests."""
    gc.freeze()
    gc.enable()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Wait for the kernels before the first test that needs them."""
    path = os.environ.get(_KERNEL_LOCK) if _needs_kernels(item) else None
    if path is not None:
        with open(path) as lock:
            fcntl.flock(lock, fcntl.LOCK_SH)
        del os.environ[_KERNEL_LOCK]


def _needs_kernels(item: pytest.Item) -> bool:
    return item.get_closest_marker("engine") is not None or not _is_below(item.path, _WITHOUT_KERNELS)


@cache
def _is_below(path: Path, folders: tuple[Path, ...]) -> bool:
    return any(path.is_relative_to(folder) for folder in folders)


@pytest.fixture(scope="session")
def shared_folder() -> Path:
    """The folder of real drives and weights; skips where it is missing, fails if MRASFM_REQUIRE_DATA is 1."""
    folder = Path(os.environ.get("MRASFM_TEST_DATA", REPOSITORY.parent / "shared"))
    if not (folder / "data").is_dir():
        message = f"real drives are missing: {folder / 'data'} (set MRASFM_TEST_DATA)"
        if os.environ.get("MRASFM_REQUIRE_DATA") == "1":
            pytest.fail(message)
        pytest.skip(message)
    return folder


@pytest.fixture(scope="session")
def shared_data(shared_folder: Path) -> Path:
    """The folder that holds the real drives kitti06, kitti02 and ddad."""
    return shared_folder / "data"


def camera_document(name: str, y_m: float) -> dict[str, Any]:
    """A forward-looking camera of 48x32 pixels."""
    return {
        "name": name,
        "model": "PINHOLE",
        "width": 48,
        "height": 32,
        "params": [40.0, 40.0, 24.0, 16.0],
        "rig_from_cam": {"rotation_xyzw": [-0.5, 0.5, -0.5, 0.5], "translation_m": [1.0, y_m, 1.5]},
    }


@pytest.fixture
def drive_document() -> dict[str, Any]:
    """The manifest of a sound drive of two cameras and five units at 10 Hz, driving north at 10 m/s."""
    start_us = 1_000_000
    times = [start_us + 100_000 * i for i in range(5)]
    return {
        "version": 1,
        "name": "small",
        "rig": {"body_axes": "flu", "cameras": [camera_document("left", 0.3), camera_document("right", -0.3)]},
        "frames": [
            {
                "timestamp_us": t,
                "source_frame": i,
                "images": {name: {"file": f"images/{name}/{i:06d}.png"} for name in ("left", "right")},
            }
            for i, t in enumerate(times)
        ],
        "gnss": {
            "height_datum": "ellipsoidal",
            "antenna_in_rig_m": [0.0, 0.0, 1.8],
            "samples": [
                {
                    "timestamp_us": t,
                    "latitude_deg": 49.0 + i / 111_000,
                    "longitude_deg": 8.4,
                    "height_m": 110.0,
                    "sigma_horizontal_m": 0.1,
                    "sigma_vertical_m": 0.2,
                }
                for i, t in enumerate(times)
            ],
        },
    }


WriteDrive = Callable[[dict[str, Any]], Path]


@pytest.fixture
def write_drive(tmp_path: Path) -> WriteDrive:
    """A function that writes a manifest and random images (and masks of zeros) for all files that it names."""

    def write(document: dict[str, Any]) -> Path:
        rng = np.random.default_rng(0)
        root = tmp_path / "drive"
        sizes = {c["name"]: (c["height"], c["width"]) for c in document["rig"]["cameras"]}
        for frame in document["frames"]:
            for name, image in frame["images"].items():
                (root / image["file"]).parent.mkdir(parents=True, exist_ok=True)
                pixels = rng.integers(0, 256, (*sizes[name], 3), dtype=np.uint8)
                assert cv2.imwrite(str(root / image["file"]), pixels)
                if "mask" in image:
                    (root / image["mask"]).parent.mkdir(parents=True, exist_ok=True)
                    assert cv2.imwrite(str(root / image["mask"]), np.zeros(sizes[name], np.uint8))
        (root / "drive.json").write_text(json.dumps(document), encoding="utf-8")
        return root

    return write
