"""Format `kitti`: trajectories as KITTI odometry has them.

`SEQUENCE/poses.txt` holds a line for each registered unit, the upper three rows of the pose of the first camera in the
frame of its first pose (x right, y down, z forward); `times.txt` its seconds since the first, and `frames.txt` its
`source_frame`: units without a pose have no line. `calib.txt` holds `Tr_NAME`, which maps coordinates of the first
camera into those of camera NAME; projection matrices have no place for distortion, and are not there. A map has a
sequence for each scene, a scene the sequence `00`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from mrasfm_engine.export.check import Check
from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.contract import ExportSource, ExportWork, Written
from mrasfm_engine.export.file_contents import write_content
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats, Ints

ONLY_SEQUENCE = "00"
POSES, TIMES, FRAMES, CALIBRATION = "poses.txt", "times.txt", "frames.txt", "calib.txt"
DECIMALS = 9  # of a metre, and of elements of rotations
TOLERANCE = 0.51e-9


def write_kitti(work: ExportWork) -> Written:
    """Write a folder for each sequence that has a pose."""
    checks: list[Check] = []
    digests: dict[str, str] = {}
    for name, units in sequences(work.source):
        folder = work.folder / name
        folder.mkdir()
        poses = first_camera_poses(work.source, units)
        rows = [" ".join(f"{v:.{DECIMALS}f}" for v in row) + "\n" for row in poses[:, :3].reshape(-1, 12).tolist()]
        times_us = work.source.scene.drive.timestamps_us[units]
        seconds = [f"{us // 1_000_000}.{us % 1_000_000:06d}\n" for us in (times_us - times_us[0]).tolist()]
        frames = [f"{work.source.scene.drive.manifest.frames[u].source_frame}\n" for u in units.tolist()]
        lines = [
            f"Tr_{camera}: {' '.join(f'{v:.{DECIMALS}f}' for v in pose[:3].ravel().tolist())}\n"
            for camera, pose in cameras_from_first(work.source, units).items()
        ]
        for file, texts in ((POSES, rows), (TIMES, seconds), (FRAMES, frames), (CALIBRATION, lines)):
            digests[f"{name}/{file}"] = write_content(folder / file, "".join(texts))
        checks += _checks(work.source, name, units)
    return Written(checks=checks, digests=digests)


def sequences(source: ExportSource) -> Iterator[tuple[str, Ints]]:
    """Names of sequences and their registered units in order of time."""
    scene = source.scene
    for name in dict.fromkeys(source.scene_of_unit):
        units = np.flatnonzero(scene.unit_registered & np.array([own == name for own in source.scene_of_unit]))
        if len(units):
            ordered = units[np.argsort(scene.drive.timestamps_us[units], kind="stable")]
            yield name if source.is_map else ONLY_SEQUENCE, ordered


def first_camera_poses(source: ExportSource, units: Ints) -> Floats:
    """Poses (n, 4, 4) of a sequence's first camera in the frame of the first of them."""
    first = _cameras(source, units)[0]
    poses = source.scene.world_from_rig[units] @ source.scene.calibration[first].rig_from_cam
    result: Floats = se3.inverse(poses[0]) @ poses
    return result


def cameras_from_first(source: ExportSource, units: Ints) -> dict[str, Floats]:
    """Poses (4, 4) of the first camera in all cameras of a sequence, by their names."""
    cameras, scene = _cameras(source, units), source.scene
    rig_from_first = scene.calibration[cameras[0]].rig_from_cam
    prefix = f"{source.scene_of_unit[int(units[0])]}/" if source.is_map else ""
    return {
        scene.drive.cameras[k].name.removeprefix(prefix): se3.inverse(scene.calibration[k].rig_from_cam)
        @ rig_from_first
        for k in cameras
    }


def _cameras(source: ExportSource, units: Ints) -> list[int]:
    """Cameras of the vehicle that a sequence's units are of."""
    unit = int(units[0])
    if not source.is_map:
        return list(range(len(source.scene.drive.cameras)))
    prefix = f"{source.scene_of_unit[unit]}/"
    return [k for k, camera in enumerate(source.scene.drive.cameras) if camera.name.startswith(prefix)]


def _checks(source: ExportSource, name: str, units: Ints) -> list[Check]:
    return [
        Check(f"{name}/{POSES}", _numbers, partial(_poses, source, units)),
        Check(f"{name}/{TIMES}", _lines, partial(_times, source, units)),
        Check(f"{name}/{FRAMES}", _lines, partial(_frames, source, units)),
        Check(f"{name}/{CALIBRATION}", _lines, partial(_calibration, source, units)),
    ]


def _lines(path: Path) -> list[str]:
    text = path.read_text(encoding="utf-8")
    if not text.endswith("\n"):
        raise ValueError("it ends early")
    return text.removesuffix("\n").split("\n")


def _numbers(path: Path) -> Floats:
    return np.array([[float(word) for word in line.split(" ")] for line in _lines(path)])


def _poses(source: ExportSource, units: Ints, rows: Floats) -> Rows:
    scene = source.scene
    world_from_cam = scene.world_from_rig[units] @ scene.calibration[_cameras(source, units)[0]].rig_from_cam
    expected = np.linalg.solve(world_from_cam[0], world_from_cam)
    yield Row("a pose", rows, expected[:, :3].reshape(-1, 12), TOLERANCE)


def _times(source: ExportSource, units: Ints, lines: list[str]) -> Rows:
    times_us = source.scene.drive.timestamps_us[units]
    yield Row("a time", [int(line.replace(".", "")) for line in lines], (times_us - times_us[0]).tolist())
    yield Row("decimals of a time", [len(line.partition(".")[2]) for line in lines], [6] * len(units))


def _frames(source: ExportSource, units: Ints, lines: list[str]) -> Rows:
    frames = source.scene.drive.manifest.frames
    yield Row("a frame", lines, [str(frames[u].source_frame) for u in units.tolist()])


def _calibration(source: ExportSource, units: Ints, lines: list[str]) -> Rows:
    scene, cameras = source.scene, _cameras(source, units)
    yield Row("its number of cameras", len(lines), len(cameras))
    for k, line in zip(cameras, lines, strict=True):
        name, _, numbers = line.partition(": ")
        own = scene.drive.cameras[k].name
        yield Row("a camera", name, f"Tr_{own.split('/')[-1] if source.is_map else own}")
        found = [float(word) for word in numbers.split(" ")]
        expected = np.linalg.solve(scene.calibration[k].rig_from_cam, scene.calibration[cameras[0]].rig_from_cam)
        yield Row(f"{own}'s pose", found, expected[:3].ravel(), TOLERANCE)
