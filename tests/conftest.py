from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parent.parent

# What a shell starts in the background ignores interrupts, and so would every process that the tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


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
