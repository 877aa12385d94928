"""Line 34: recordings of other programs come in as they are, and scenes go out to the programs of data sets."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.geodesy import ecef_from_local, local_from_geodetic
from mrasfm_engine.io.images import read_image_gray
from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.drive import Drive, matrix_from_pose
from mrasfm_engine.types import Floats
from schemas import Pose
from tests.benchmarks.commands import evaluate, mrasfm
from tests.benchmarks.foreign_readers import READERS, output_of, problem_of, python_readers
from tests.benchmarks.real_drives import imported, reconstructed
from tests.benchmarks.table import Figure, exactly
from tests.helpers.av2_writing import write_log
from tests.helpers.bag_writing import FORMATS, messages_of_drive

LINE = "34"
START_US = 1_700_000_000_000_000
RENDERED = ("--cameras", 6, "--units", 20, "--seed", 7)
CONVERTED, CONVERTED_DEG = 1e-6, 1e-9
SAME = 1e-9


def recordings(data: Path, work: Path) -> Iterator[Figure]:
    """Readers that are not installed and cannot be are skipped by name."""
    yield from _bags(data, work)
    drive = work / "rendered for data sets"
    mrasfm("synth", *RENDERED, "--out", drive)
    kits = python_readers(work, "datasets.lock")
    if isinstance(kits, str):
        yield Figure(line=LINE, what="kits of data sets: skipped, cannot be installed here", value=0, remark=kits)
    yield from _argoverse(drive, work, kits)
    scene, out = reconstructed(drive, work / "rendered for data sets, scene"), work / "exports"
    mrasfm("export", scene, "--drive", drive, "--format", "nuscenes", "--format", "mcap", "--out", out)
    yield from _nuscenes(scene, drive, out / "nuscenes", work, kits)
    yield from _mcap(out / "mcap" / "scene.mcap", scene, work)


def _bags(data: Path, work: Path) -> Iterator[Figure]:
    direct = read_drive(imported(data, "kitti06", work))
    for kind in FORMATS:
        made = messages_of_drive(direct, is_ros1=kind == "ros1", start_us=START_US, compressed=kind == "sqlite")
        bag, folder = work / (f"{kind}.bag" if kind == "ros1" else f"{kind} bag"), work / f"drive of {kind}"
        mrasfm("import", made.write(bag, kind), "--out", folder)
        drive, title = read_drive(folder), f"kitti06 as a bag, {kind}"
        off = np.abs(_antennas(drive, direct) - _antennas(direct, direct)).max()
        yield Figure(line=LINE, what=f"{title}: GNSS, off", value=float(off), unit="m", above=-1, most=1e-3)
        same = [
            np.array_equal(*(read_image_gray(d.root / file) for d in (drive, direct)))
            for file in (image.file for image in direct.images)
        ]
        yield exactly(LINE, f"{title}: images that are the same", sum(same), len(direct.images))
        yield exactly(LINE, f"{title}: the same calibration", int(drive.cameras == direct.cameras), 1)


def _antennas(drive: Drive, origin: Drive) -> Floats:
    """Positions (n, 3) of the receiver, and of the antenna in the rig, in metres."""
    places = [
        np.array([(s.latitude_deg, s.longitude_deg, s.height_m) for s in d.manifest.gnss.samples])
        for d in (drive, origin)
    ]
    local = local_from_geodetic(places[0], ecef_from_local(places[1][0]))
    return np.vstack([local, drive.manifest.gnss.antenna_in_rig_m])


def _argoverse(drive_folder: Path, work: Path, kits: Path | str) -> Iterator[Figure]:
    drive, truth = read_drive(drive_folder), read_tum(drive_folder / "truth.tum").world_from_rig
    poses = dict(zip(drive.timestamps_us.tolist(), truth, strict=True))
    log, folder = write_log(drive, poses, work / "av2" / "log"), work / "drive of av2"
    mrasfm("import", log, "--out", folder)
    errors = evaluate(reconstructed(folder, work / "scene of av2"), folder)
    yield exactly(LINE, "Argoverse 2: images registered", errors["registered_images"], len(drive.images))
    rmse_m = errors["metric"]["rmse_m"]
    yield Figure(line=LINE, what="Argoverse 2: position, metric RMSE", value=rmse_m, unit="m", most=0.05)
    if isinstance(kits, str):
        return
    said, own = output_of([kits, READERS / "read_datasets.py", "av2", log], work), read_drive(folder)
    off = 0.0
    for camera, rig_from_cam in zip(own.cameras, own.rig_from_cam, strict=True):
        points = se3.apply(se3.inverse(rig_from_cam), np.array(said["points"]))
        fx, fy, cx, cy = camera.params
        pixels = points[:, :2] / points[:, 2:] * [fx, fy] + [cx, cy]
        off = max(off, float(np.abs(pixels - 0.5 - said["pixels"][camera.name]).max()))
    yield Figure(line=LINE, what="Argoverse 2: its API's pixels, off", value=off, unit="px", above=-1, most=1e-6)
    places = np.array([said["places"][str(time_us)] for time_us in own.timestamps_us.tolist()])
    off = float(np.abs(places - read_tum(folder / "truth.tum").world_from_rig[:, :3, 3]).max())
    yield Figure(line=LINE, what="Argoverse 2: its API's positions, off", value=off, unit="m", above=-1, most=1e-6)


def _nuscenes(scene: Path, drive_folder: Path, root: Path, work: Path, kits: Path | str) -> Iterator[Figure]:
    mrasfm("import", root, "--out", work / "drive of nuscenes")
    again, drive = read_drive(work / "drive of nuscenes"), read_drive(drive_folder)
    same = again.timestamps_us.tolist() == drive.timestamps_us.tolist() and len(again.images) == len(drive.images)
    yield exactly(LINE, "nuScenes tables: imported again, the same frames", int(same), 1)
    off = _calibration_off(scene, again)
    what = "nuScenes tables: imported again, calibration off the scene's"
    yield Figure(line=LINE, what=what, value=off, unit="px or m", above=-1, most=SAME)
    if isinstance(kits, str):
        return
    said = output_of([kits, READERS / "read_datasets.py", "nuscenes", root, scene], work)
    what = "nuScenes tables: reprojection by the development kit, median"
    yield Figure(line=LINE, what=what, value=said["median_px"], unit="px", most=0.3)
    value = said["without_half_px"]
    yield Figure(
        line=LINE, what="nuScenes tables: the same without half a pixel", value=value, unit="px", above=0.5, most=5.0
    )
    yield exactly(LINE, "nuScenes tables: samples", said["samples"], len(drive.manifest.frames))


def _calibration_off(scene: Path, again: Drive) -> float:
    """Largest difference of parameters and poses of the cameras, which are pinholes, from those that a scene found."""
    found = json.loads((scene / "calibration.json").read_text())["cameras"]
    refined = {f"CAM_{name.upper()}": camera["refined"] for name, camera in found.items()}
    off = 0.0
    for camera, rig_from_cam in zip(again.cameras, again.rig_from_cam, strict=True):
        own = refined.pop(camera.name)
        pose = matrix_from_pose(Pose(**own["rig_from_cam"]))
        off = max(off, float(np.abs(rig_from_cam - pose).max()))
        off = max(off, float(np.abs(np.subtract(camera.params, own["params"])).max()))
    if refined:
        raise AssertionError(f"nuScenes tables: cameras are missing: {', '.join(refined)}")
    return off


def _mcap(file: Path, scene: Path, work: Path) -> Iterator[Figure]:
    python = python_readers(work, "requirements.lock")
    if isinstance(python, str):
        yield Figure(line=LINE, what="rerun: skipped, cannot be installed here", value=0, remark=python)
        return
    rerun = python.with_name("rerun")
    for what, words in (("check", [file]), ("convert", [file, "-o", work / "scene.rrd"])):
        problem = problem_of([rerun, "mcap", what, *words], work)
        yield exactly(LINE, f"MCAP: rerun mcap {what}" + (f": {problem}" if problem else ""), int(not problem), 1)
    said = output_of([python, READERS / "read_rerun.py", work / "scene.rrd", scene], work)
    yield exactly(LINE, "MCAP: units that rerun has", said["units"], said["expected_units"])
    # Of a metre, or of the coordinate where that is larger: rerun's numbers have 24 bits there.
    for what, key in (("positions", "position_off"), ("rotations", "quaternion_off"), ("points", "point_off")):
        yield Figure(line=LINE, what=f"MCAP: {what} as rerun has them, off", value=said[key], above=-1, most=CONVERTED)
    off = said["degrees_off"]
    yield Figure(line=LINE, what="MCAP: places on the earth as rerun has them, off", value=off, unit="deg", above=-1,
                 most=CONVERTED_DEG)  # fmt: skip
    yield exactly(LINE, "MCAP: places on the earth that rerun has", said["fixes"], said["expected_units"])
