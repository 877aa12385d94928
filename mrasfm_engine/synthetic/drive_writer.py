"""Renders drives into folders: images, masks, manifest and the truth."""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from mrasfm_engine.errors import InputError, StorageError
from mrasfm_engine.geometry import se3
from mrasfm_engine.preflight.drive_reader import foreign_file
from mrasfm_engine.scene.drive import pose_from_matrix
from mrasfm_engine.synthetic import gnss
from mrasfm_engine.synthetic.calibration import given_cameras
from mrasfm_engine.synthetic.light import along_street, daylight, dusk
from mrasfm_engine.synthetic.motion import Motion, drive_motion
from mrasfm_engine.synthetic.moving_shadows import street_heading
from mrasfm_engine.synthetic.options import SynthOptions
from mrasfm_engine.synthetic.own_car import OwnCar, own_car_before
from mrasfm_engine.synthetic.render import Lens, View, develop, render
from mrasfm_engine.synthetic.rigs import TrueCamera, true_cameras
from mrasfm_engine.synthetic.scene_in_time import SceneInTime, build_scene
from mrasfm_engine.synthetic.streets import GROUND_GRID_M, Ground
from mrasfm_engine.synthetic.world import StaticWorld, build_world
from mrasfm_engine.types import Bytes, CountProgress, Floats, Ints
from schemas import DriveManifest, Frame, FrameImage, LabelMap, Rig, RoughPose, RoughTrajectory
from schemas.file_names import MANIFEST_NAME, TRUTH_NAME, is_ignored

FIRST_EPOCH_US = 1_750_000_000_000_000
_BETWEEN_DRIVES_US = 3_600_000_000
TRUE_OWN_CAR_FOLDER = "truth_own_car"  # 255 where a camera sees the vehicle itself
_WORKERS = 2
_BAND_MS = 0.5  # of a rolling shutter's rows that are rendered as one instant


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One image to be taken; with a rolling shutter its middle row at its timestamp."""

    unit: int
    camera: int
    file: str
    mask: str | None
    timestamp_us: int
    world_from_cam: Floats  # true, at the true instant


def render_drives(
    options: SynthOptions,
    out: Path,
    *,
    force: bool = False,
    rig: list[TrueCamera] | None = None,
    progress: CountProgress | None = None,
) -> list[Path]:
    """Render one world's drives.

    Parameters
    ----------
    options
        What to render.
    out
        The drive's folder, or with several drives the folder of `drive_0`, `drive_1` and so on. It appears when
        everything is written, and not at all when something goes wrong.
    force
        Replace drives that are there.
    rig
        Cameras in the place of the arrangement that the options ask for.
    progress
        Called with the number of images done and of all.

    Returns
    -------
    The drives' folders.

    Raises
    ------
    InputError
        When `out` holds files already, with `force` others than those of drives.
    StorageError
        When it cannot be written.
    """
    _check_target(out, force=force)
    partial: Path | None = None
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
        partial.chmod(0o755)
        names = ["."] if options.drives == 1 else [f"drive_{k}" for k in range(options.drives)]
        _render_into([partial / name for name in names], options, rig, progress)
        _replace(partial, out)
    except OSError as error:
        raise StorageError(
            f"{out} could not be written: {error}", remedy="Free space or choose another folder."
        ) from error
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
    return [out / name for name in names]


def _check_target(out: Path, *, force: bool) -> None:
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not force:
        raise InputError(f"{out} is not an empty folder", remedy="Choose another --out, or replace it with --force.")
    foreign = _foreign_file(out) if out.is_dir() else out
    if foreign is not None:
        raise InputError(
            f"{foreign} is no file of a rendered drive, and --force would remove it", remedy="Choose another --out."
        )


def _foreign_file(out: Path) -> Path | None:
    """The first file that is of no drive, in the folder of one or of several; None where there is none."""
    drives = [path for path in sorted(out.glob("drive_*")) if (path / MANIFEST_NAME).is_file()]
    if (out / MANIFEST_NAME).is_file():
        return foreign_file(out)
    others = [path for path in sorted(out.iterdir()) if path not in drives and not is_ignored(path.name)]
    return next(filter(None, [*others, *map(foreign_file, drives)]), None)


def _replace(partial: Path, out: Path) -> None:
    old = None
    if out.exists():
        old = Path(tempfile.mkdtemp(prefix=f".{out.name}-old-", dir=out.parent))
        os.replace(out, old / "old")
    os.replace(partial, out)
    if old is not None:
        shutil.rmtree(old, ignore_errors=True)


def _render_into(
    folders: list[Path], options: SynthOptions, rig: list[TrueCamera] | None, progress: CountProgress | None
) -> None:
    # Each topic has its own stream of random numbers, so that an option changes nothing but its own topic.
    world = build_world(options, np.random.default_rng([options.seed, 0]))
    rig = rig or true_cameras(
        options.cameras,
        width=options.width,
        height=options.height,
        model=options.camera_model,
        rng=np.random.default_rng([options.seed, 1]),
    )
    lenses = [Lens(camera) for camera in rig]
    total = options.drives * options.units * len(rig)
    for drive, folder in enumerate(folders):
        folder.mkdir(exist_ok=True)
        done_before = drive * options.units * len(rig)

        def report(done: int, offset: int = done_before) -> None:
            if progress is not None:
                progress(offset + done, total)

        _render_drive(options, world, rig, lenses, drive, folder, report)
    if progress is not None:
        progress(total, total)


def _render_drive(
    options: SynthOptions,
    world: StaticWorld,
    rig: list[TrueCamera],
    lenses: list[Lens],
    drive: int,
    folder: Path,
    report: Callable[[int], None],
) -> None:
    rng = [np.random.default_rng([options.seed, 2, drive, topic]) for topic in range(9)]
    motion = drive_motion(options, world.layout, drive, rng[0])
    start_us = FIRST_EPOCH_US + drive * _BETWEEN_DRIVES_US
    unit_s = np.arange(options.units) / options.rate_hz
    unit_us = start_us + np.round(unit_s * 1e6).astype(np.int64)
    shots = _plan(options, motion, rig, unit_us, start_us, rng[1])
    light = daylight(rng[2])
    if options.dusk_drive == drive:
        light = dusk(light)
    off_m = (0.0, 0.0)
    if options.biased_drive == drive:
        angle = rng[7].uniform(0, 2 * np.pi)
        off_m = (options.biased_by_m * math.cos(angle), options.biased_by_m * math.sin(angle))
    if options.moving_shadows:
        # In the shade of houses nothing casts a shadow: the sun stands along the street.
        light = along_street(light, street_heading(motion, options))
    scene = build_scene(
        options,
        world,
        drive=drive,
        own=motion,
        rig=rig,
        light=light,
        rng=rng[3],
        shadow_rng=rng[6],
        same_way_rng=rng[8],
    )
    world_from_rig = motion.world_from_rig(unit_s)
    manifest = DriveManifest(
        name=f"synthetic {options.world} {drive}, seed {options.seed}",
        rig=Rig(cameras=given_cameras(options, rig, np.random.default_rng([options.seed, 3]))),
        frames=_frames(options, shots, rig, unit_us),
        gnss=gnss.receive(options, world_from_rig, unit_us, rng[4], off_m=off_m) if options.gnss else None,
        rough_poses=_rough(options, world_from_rig, unit_us, rng[5]) if options.rough_poses else None,
        label_map=LabelMap.cityscapes() if options.masks else None,
        notes=["rendered by mrasfm synth"],
    )
    for camera in rig:
        (folder / "images" / camera.name).mkdir(parents=True)
        if options.masks:
            (folder / "masks" / camera.name).mkdir(parents=True)
        if options.moving_masks:
            (folder / "truth_moving" / camera.name).mkdir(parents=True)
    (folder / MANIFEST_NAME).write_text(manifest.model_dump_json(exclude_none=True, indent=1) + "\n")
    _write_truth(folder, options, rig, shots, world_from_rig, unit_us, world.layout.ground)
    own_cars = _own_cars(options, lenses)
    for camera, own_car in zip(rig, own_cars, strict=True):
        if own_car is not None:
            (folder / TRUE_OWN_CAR_FOLDER).mkdir(exist_ok=True)
            _write(folder / TRUE_OWN_CAR_FOLDER / f"{camera.name}.png", own_car.mask.astype(np.uint8) * 255, [])
    with ThreadPoolExecutor(_WORKERS) as pool:
        tasks = [
            pool.submit(
                _take,
                options,
                scene,
                lenses[shot.camera],
                shot,
                folder,
                start_us=start_us,
                drive=drive,
                motion=motion,
                own_car=own_cars[shot.camera],
            )
            for shot in shots
        ]
        try:
            for done, task in enumerate(tasks, 1):
                task.result()
                report(done)
        finally:
            for task in tasks:
                task.cancel()


def _own_cars(options: SynthOptions, lenses: list[Lens]) -> list[OwnCar | None]:
    """Each camera's view of the vehicle, the same in all drives."""
    if not options.own_car:
        return [None] * len(lenses)
    rng = np.random.default_rng([options.seed, 5])
    return [own_car_before(lens, rng) for lens in lenses]


def _plan(
    options: SynthOptions,
    motion: Motion,
    rig: list[TrueCamera],
    unit_us: Ints,
    start_us: int,
    rng: np.random.Generator,
) -> list[Shot]:
    """Times and poses of all images; dropped images are left out."""
    spread = np.linspace(-0.5, 0.5, len(rig)) if len(rig) > 1 else np.zeros(1)
    skew_us = np.round(rng.permutation(spread) * options.time_skew_ms * 1000).astype(np.int64)
    dropped = rng.random((len(unit_us), len(rig))) < options.drop_images
    shots = []
    for unit, at_us in enumerate(unit_us):
        for k, camera in enumerate(rig):
            if dropped[unit, k]:
                continue
            t = int(at_us + skew_us[k])
            world_from_cam = motion.world_from_rig((t - start_us) / 1e6) @ camera.rig_from_cam
            shots.append(
                Shot(
                    unit=unit,
                    camera=k,
                    file=f"images/{camera.name}/{unit:06d}.jpg",
                    mask=f"masks/{camera.name}/{unit:06d}.png" if options.masks else None,
                    timestamp_us=t,
                    world_from_cam=world_from_cam,
                )
            )
    return shots


def _frames(options: SynthOptions, shots: list[Shot], rig: list[TrueCamera], unit_us: Ints) -> list[Frame]:
    images: list[dict[str, FrameImage]] = [{} for _ in unit_us]
    for shot in shots:
        images[shot.unit][rig[shot.camera].name] = FrameImage(
            file=shot.file, mask=shot.mask, timestamp_us=shot.timestamp_us if options.time_skew_ms > 0 else None
        )
    return [Frame(timestamp_us=int(t), source_frame=unit, images=images[unit]) for unit, t in enumerate(unit_us)]


def _rough(options: SynthOptions, world_from_rig: Floats, unit_us: Ints, rng: np.random.Generator) -> RoughTrajectory:
    n = len(world_from_rig)
    rough = world_from_rig.copy()
    rough[:, :3, 3] += options.rough_noise_m * rng.normal(size=(n, 3))
    rough[:, :3, :3] = rough[:, :3, :3] @ se3.exp_so3(np.radians(options.rough_noise_deg) * rng.normal(size=(n, 3)))
    return RoughTrajectory(
        poses=[
            RoughPose(timestamp_us=int(t), world_from_rig=pose_from_matrix(pose))
            for t, pose in zip(unit_us, rough, strict=True)
        ],
        sigma_translation_m=max(0.01, options.rough_noise_m),
        sigma_rotation_deg=max(0.01, options.rough_noise_deg),
    )


def _write_truth(
    folder: Path,
    options: SynthOptions,
    rig: list[TrueCamera],
    shots: list[Shot],
    world_from_rig: Floats,
    unit_us: Ints,
    ground: Ground,
) -> None:
    """Write what the engine never reads."""
    lines = []
    for t, pose in zip(unit_us.tolist(), world_from_rig, strict=True):
        numbers = [*pose[:3, 3], *se3.quaternion_from_rotation(pose[:3, :3])]
        lines.append(" ".join([f"{t // 10**6}.{t % 10**6:06d}", *(f"{v:.9f}" for v in numbers)]))
    (folder / TRUTH_NAME).write_text("\n".join(lines) + "\n")
    calibration = {camera.name: pose_from_matrix(camera.rig_from_cam).model_dump() for camera in rig}
    (folder / "truth_calibration.json").write_text(json.dumps(calibration, indent=1) + "\n")
    images = {
        shot.file: {
            "camera": rig[shot.camera].name,
            "unit": shot.unit,
            "timestamp_us": shot.timestamp_us,
            "world_from_cam": pose_from_matrix(shot.world_from_cam).model_dump(),
        }
        for shot in shots
    }
    (folder / "truth_cameras.json").write_text(json.dumps(images, indent=1) + "\n")
    origin = {
        "enu_origin": asdict(gnss.Origin()),
        "options": asdict(options),
        "ground": {
            "direction": ground.direction.tolist(),
            "first_m": ground.first_m,
            "step_m": GROUND_GRID_M,
            "heights_m": ground.nodes_m.tolist(),
        },
    }
    (folder / "truth_world.json").write_text(json.dumps(origin, indent=1) + "\n")


def _view(options: SynthOptions, scene: SceneInTime, lens: Lens, time_s: float, world_from_cam: Floats) -> View:
    mesh, boxes = scene.at(time_s)
    return render(
        mesh,
        scene.materials.atlas,
        lens,
        world_from_cam,
        light=scene.light,
        shadows=scene.shadows,
        shadow_strength=options.shadow_strength,
        moving_boxes=boxes,
        sky_texture=scene.materials.clouds,
    )


def _rolling(options: SynthOptions, scene: SceneInTime, lens: Lens, middle_s: float, motion: Motion) -> View:
    """Image of a rolling-shutter sensor, rendered in row bands of one instant each."""
    height = lens.camera.height
    count = min(height, math.ceil(options.readout_ms / _BAND_MS))
    bounds = np.linspace(0, height, count + 1).round().astype(int)
    views = []
    for first, stop in pairwise(bounds):
        time_s = middle_s + (0.5 * (first + stop) / height - 0.5) * options.readout_ms / 1000
        world_from_cam = motion.world_from_rig(time_s) @ lens.camera.rig_from_cam
        views.append(_view(options, scene, lens.rows(first, stop), time_s, world_from_cam))
    return View(
        intensity=np.concatenate([view.intensity for view in views]),
        labels=np.concatenate([view.labels for view in views]),
        is_moving=np.concatenate([view.is_moving for view in views]),
        depth_m=np.concatenate([view.depth_m for view in views]),
    )


def _take(
    options: SynthOptions,
    scene: SceneInTime,
    lens: Lens,
    shot: Shot,
    folder: Path,
    *,
    start_us: int,
    drive: int,
    motion: Motion,
    own_car: OwnCar | None,
) -> None:
    """Render, expose and write one image and its mask."""
    at_s = (shot.timestamp_us - start_us) / 1e6
    if options.readout_ms > 0:
        view = _rolling(options, scene, lens, at_s, motion)
    else:
        view = _view(options, scene, lens, at_s, shot.world_from_cam)
    if own_car is not None:
        view = own_car.drawn_over(view, lens, scene.light, shot.world_from_cam)
    # An image's noise must not depend on which thread comes first.
    rng = np.random.default_rng([options.seed, 4, drive, shot.unit, shot.camera])
    gain = scene.light.gain * float(np.exp(0.5 * options.exposure_jitter * rng.normal()))
    image = develop(view, lens, gain=gain, noise=options.noise, blur_px=options.blur_px, rng=rng)
    _write(folder / shot.file, image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, options.jpeg_quality])
    if shot.mask is not None:
        _write(folder / shot.mask, view.labels, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if options.moving_masks:
        path = folder / "truth_moving" / lens.camera.name / f"{shot.unit:06d}.png"
        _write(path, view.is_moving.astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 3])


def _write(path: Path, image: Bytes, parameters: list[int]) -> None:
    if not cv2.imwrite(str(path), image, parameters):
        raise OSError(f"{path} could not be encoded or written")
