"""Check of a drive's manifest: errors and oddities that show without opening a file.

`python -m schemas.manifest_check MEGABYTES` checks the manifest in its standard input, within so much more memory than
it begins with, and prints the findings as JSON.
"""

from __future__ import annotations

import json
import math
import resource
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.drive import (
    LONGEST_VEHICLE_M,
    SIGMA_TRANSLATION_M,
    BodyAxes,
    Camera,
    DriveManifest,
    Pose,
    RoughTrajectory,
)
from schemas.findings import Finding, Severity, as_json, error, listed, warning
from schemas.gnss_check import JUMP_SIGMAS, MAX_SPEED_MPS, OTHER_UNITS_US, check_gnss, unit_by_cover
from schemas.parsing import DocumentError, parse_manifest
from schemas.synchronisation_check import MAX_UNSYNCHRONISED_US, TimedImage, check_synchronisation

MIN_FRAME_INTERVAL_US = 1_000
MAX_FRAME_INTERVAL_US = 20_000_000
USUAL_INTERVAL_US = 100_000
PAUSE_INTERVALS = 1.5  # of the usual ones: a frame or more is missing in between
MAX_CAMERA_ROLL_DEG = 60.0
MAX_VEHICLE_TILT_DEG = 60.0  # no road is steeper than 20
LEVEL_DEG = 45.0  # half of what tells one axis from another

_UP_IN_BODY = {BodyAxes.FLU: (0, 0, 1), BodyAxes.RDF: (0, -1, 0), BodyAxes.FRD: (0, 0, -1)}
_FORWARD_IN_BODY = {BodyAxes.FLU: (1, 0, 0), BodyAxes.RDF: (0, 0, 1), BodyAxes.FRD: (1, 0, 0)}


def check_manifest(manifest: DriveManifest, *, use_gnss: bool = True) -> list[Finding]:
    """List the errors and oddities of a drive that its manifest shows; no file is opened.

    Parameters
    ----------
    manifest
        In any body axes.
    use_gnss
        The reconstruction will use the drive's GNSS.

    Returns
    -------
    list of Finding
        Errors first. With any error the drive cannot be reconstructed.
    """
    recorded = _Recorded(manifest)
    return errors_first(
        [
            *_check_frames(recorded),
            *_check_times(recorded),
            *_check_rig(manifest),
            *_check_extent(recorded),
            *_check_scale(recorded, use_gnss=use_gnss),
            *_check_rough_poses(recorded),
            *(check_gnss(manifest, recorded.image_times_us) if use_gnss else []),
        ]
    )


def errors_first(findings: list[Finding]) -> list[Finding]:
    """Sort errors before warnings, otherwise in their order."""
    return sorted(findings, key=lambda finding: finding.severity is not Severity.ERROR)


@dataclass(frozen=True)
class _Recorded:
    """Times and cameras of a manifest's images."""

    manifest: DriveManifest

    @cached_property
    def timestamps_us(self) -> NDArray[np.int64]:
        """Timestamps (frames,)."""
        return np.array([frame.timestamp_us for frame in self.manifest.frames], dtype=np.int64)

    @property
    def timed_images(self) -> Iterator[tuple[str, TimedImage]]:
        """Camera and times of every image."""
        for frame in self.manifest.frames:
            for camera, image in frame.images.items():
                own_us = frame.timestamp_us if image.timestamp_us is None else image.timestamp_us
                yield camera, TimedImage(file=image.file, own_us=own_us, frame_us=frame.timestamp_us)

    @cached_property
    def used_cameras(self) -> set[str]:
        """Cameras with images."""
        return {camera for camera, _ in self.timed_images}

    @cached_property
    def baselines(self) -> list[tuple[Camera, Camera, float]]:
        """Pairs of cameras with images, and their distance in metres."""
        used = [camera for camera in self.manifest.rig.cameras if camera.name in self.used_cameras]
        return [
            (a, b, math.dist(a.rig_from_cam.translation_m, b.rig_from_cam.translation_m))
            for a, b in combinations(used, 2)
        ]

    @cached_property
    def image_times_us(self) -> NDArray[np.int64]:
        """Timestamps of all images, or of the frames where there is no image."""
        times = [image.own_us for _, image in self.timed_images]
        return np.array(times, dtype=np.int64) if times else self.timestamps_us


def _check_frames(recorded: _Recorded) -> list[Finding]:
    frames = recorded.manifest.frames
    empty = [f"frames.{i}" for i, frame in enumerate(frames) if not frame.images]
    findings = []
    if len(frames) - len(empty) < 2:
        findings.append(
            error(
                "too-few-frames",
                f"drive {recorded.manifest.name!r} has {len(frames) - len(empty)} frames with images",
                "Give at least two frames: structure comes from motion.",
            )
        )
    if empty:
        findings.append(
            warning("frame-without-images", f"no images in {listed(empty)}", "Take these frames out of drive.json.")
        )
    unused = [camera.name for camera in recorded.manifest.rig.cameras if camera.name not in recorded.used_cameras]
    if unused and recorded.used_cameras:
        findings.append(
            warning("camera-without-images", f"no images of camera {listed(unused)}", "Take it out of the rig.")
        )
    return [*findings, *_check_common_frames(recorded)]


def _check_common_frames(recorded: _Recorded) -> list[Finding]:
    """Find cameras whose frames have images of no other: only the motion between frames relates them to the rig."""
    together = {camera for frame in recorded.manifest.frames if len(frame.images) > 1 for camera in frame.images}
    alone = [c.name for c in recorded.manifest.rig.cameras if c.name in recorded.used_cameras - together]
    if len(recorded.used_cameras) < 2:
        return []
    if not alone:
        return _check_clocks(recorded)
    return [
        warning(
            "camera-alone",
            f"no frame with an image of {listed(alone)} has one of another camera",
            "Put images that were taken together into one frame, by the time that is nearest. Are all cameras on one "
            "clock?",
        )
    ]


def _check_clocks(recorded: _Recorded) -> list[Finding]:
    """Find a camera that is alone before or after the drive's longest pause: its clock leaps there, or begins anew.

    Of one that merely begins earlier or ends later than the others, no pause parts these images from the rest.
    """
    frames = recorded.manifest.frames
    if len(frames) < 3:
        return []
    intervals_us = np.diff(recorded.timestamps_us)
    last = int(np.argmax(intervals_us))
    if intervals_us[last] < PAUSE_INTERVALS * np.median(intervals_us):
        return []
    for part, where in (
        (frames[: last + 1], f"up to frames.{last}"),
        (frames[last + 1 :], f"from frames.{last + 1} on"),
    ):
        alone = {camera for frame in part for camera in frame.images}
        if len(alone) == 1 and len(part) > 1:
            return [
                warning(
                    "camera-alone",
                    f"{where} there are images of {alone.pop()} alone, and between frames.{last} and frames.{last + 1} "
                    f"is the longest pause, {intervals_us[last] / 1e6:.1f} s",
                    "Where the camera's clock leaps there or begins anew, correct timestamp_us, and put images that "
                    "were taken together into one frame. Where the other cameras were off, nothing needs to be done.",
                )
            ]
    return []


def _check_times(recorded: _Recorded) -> list[Finding]:
    findings = []
    if len(recorded.timestamps_us) > 1:
        median_us = float(np.median(np.diff(recorded.timestamps_us)))
        if not MIN_FRAME_INTERVAL_US <= median_us <= MAX_FRAME_INTERVAL_US:
            findings.append(
                error(
                    "frame-rate",
                    f"frames are {median_us / 1e6:g} s apart: their timestamps {_complaint_of(median_us)}",
                    "Give frames.timestamp_us in microseconds, and the samples of gnss and rough_poses too.",
                )
            )
    return [*findings, *check_synchronisation(recorded.timed_images)]


def _complaint_of(median: float) -> str:
    """The unit in which frames that are so far apart have the most usual rate, if there is one."""
    intervals_us = {unit: median * each_us for unit, each_us in OTHER_UNITS_US.items()}
    unit = min(intervals_us, key=lambda name: abs(math.log(max(intervals_us[name], 1e-9) / USUAL_INTERVAL_US)))
    usual = MIN_FRAME_INTERVAL_US <= intervals_us[unit] <= MAX_FRAME_INTERVAL_US
    return f"look like {unit}" if usual else "are not microseconds"


def _check_rig(manifest: DriveManifest) -> list[Finding]:
    """Cameras stand about upright on a vehicle; if none does, the rig's axes are not what was said.

    Unless they stand on edge, as portrait cameras do whose images are stored as they were read: all of them look about
    level, and not only aside, which wrong axes and poses given as their inverse do not leave so. Or all of them look
    down, as those of a vehicle that surveys the road: steep enough, and an image's upper edge points ahead or aside.
    """
    up = np.array(_UP_IN_BODY[manifest.rig.body_axes], dtype=np.float64)
    forward = np.array(_FORWARD_IN_BODY[manifest.rig.body_axes], dtype=np.float64)
    axes = np.array([_image_axes(camera.rig_from_cam) for camera in manifest.rig.cameras])  # (c, 2, 3)
    upright = axes[:, 0] @ up
    turned = upright < np.cos(np.radians(MAX_CAMERA_ROLL_DEG))
    if not turned.any():
        return []
    names = [camera.name for camera, is_turned in zip(manifest.rig.cameras, turned, strict=True) if is_turned]
    cameras = f"camera {names[0]} is" if len(names) == 1 else f"cameras {listed(names)} are"
    what = f"rig.cameras: {cameras} turned by over {MAX_CAMERA_ROLL_DEG:g} degrees against the vehicle's upright"
    remedy = (
        "Check rig.body_axes, that rig_from_cam is the camera's pose in the rig, not its inverse, and that its "
        "quaternion ends with w; camera axes are x right, y down, z forward."
    )
    nearly_level, rise = np.sin(np.radians(LEVEL_DEG)), axes[:, 1] @ up
    level, down = np.abs(rise) < nearly_level, rise < -nearly_level
    ahead = np.abs(axes[:, 1] @ forward) > np.cos(np.radians(LEVEL_DEG))
    on_edge = np.abs(upright) < nearly_level
    if not turned.all():
        return [warning("camera-turned", what, f"Nothing needs to be done where it is mounted so. {remedy}")]
    if down.all():
        return [warning("rig-axes", what, f"Nothing needs to be done where they look down at the road. {remedy}")]
    if level.all() and ahead.any() and on_edge.all():
        return [warning("rig-axes", what, f"Nothing needs to be done where they stand on edge. {remedy}")]
    return [
        error("rig-axes", what, f"{remedy} Of cameras mounted upside down, turn images and calibration by 180 degrees.")
    ]


def _check_extent(recorded: _Recorded) -> list[Finding]:
    """Find cameras farther apart than a vehicle is long: centimetres, or the map's coordinates."""
    apart = [(distance_m, a.name, b.name) for a, b, distance_m in recorded.baselines if distance_m > LONGEST_VEHICLE_M]
    if not apart:
        return []
    distance_m, *names = max(apart)
    return [
        warning(
            "rig-extent",
            f"rig.cameras: cameras {' and '.join(names)} are {distance_m:.1f} m apart, and the longest rigid road "
            f"vehicle has {LONGEST_VEHICLE_M:g} m",
            "Give the translation_m of rig_from_cam in metres, not in centimetres or millimetres.",
        )
    ]


def _check_scale(recorded: _Recorded, *, use_gnss: bool) -> list[Finding]:
    if len(recorded.used_cameras) < 2:
        return _without_baselines(
            recorded,
            use_gnss=use_gnss,
            code="scale-not-from-rig",
            what="the drive has images of one camera only",
            remedy="Give the images of all cameras for a scale that the rig's baselines confirm.",
            or_else="Give a second camera, GNSS or rough poses.",
        )
    # A baseline within the error of its ends may as well be none. Cameras that are close together and measured to
    # millimetres say so by their sigmas.
    if any(distance_m > 0 and distance_m >= max(map(_sigma_m, (a, b))) for a, b, distance_m in recorded.baselines):
        return []
    longest_m = max(distance_m for *_, distance_m in recorded.baselines)
    place = f"within {longest_m:.2g} m, less than their sigma_translation_m" if longest_m else "at one place"
    measure = "Measure where the cameras are on the vehicle and give it as the translation_m of rig_from_cam"
    return _without_baselines(
        recorded,
        use_gnss=use_gnss,
        code="baselines-missing",
        what=f"rig.cameras: all cameras are {place}, so that no baseline gives a scale",
        remedy=f"{measure}.",
        or_else=f"{measure}, with sigma_translation_m where they are close together; or give GNSS or rough poses.",
    )


def _without_baselines(
    recorded: _Recorded, *, use_gnss: bool, code: str, what: str, remedy: str, or_else: str
) -> list[Finding]:
    """The finding of a drive whose rig gives no scale: an error where nothing else gives it one.

    Parameters
    ----------
    remedy, or_else
        Of the warning, and of the error.
    """
    gnss = use_gnss and recorded.manifest.gnss is not None
    if gnss or recorded.manifest.rough_poses is not None:
        source = "GNSS" if gnss else "the rough poses"
        return [warning(code, f"{what}: the drive's scale comes from {source} alone", remedy)]
    lacks = "and there are neither GNSS nor rough poses: nothing gives the drive a scale"
    return [error("no-metric-scale", f"{what}, {lacks}", or_else)]


def _sigma_m(camera: Camera) -> float:
    return SIGMA_TRANSLATION_M if camera.sigma_translation_m is None else camera.sigma_translation_m


def _check_rough_poses(recorded: _Recorded) -> list[Finding]:
    rough = recorded.manifest.rough_poses
    if rough is None:
        return []
    times = np.array([pose.timestamp_us for pose in rough.poses], dtype=np.int64)
    wrong = np.flatnonzero(np.diff(times) <= 0) + 1
    if len(wrong):
        i = int(wrong[0])
        return [
            error(
                "rough-poses-order",
                f"rough_poses.poses.{i}.timestamp_us {times[i]} does not come after the pose before it",
                "Sort the rough poses by time and give every one its own timestamp.",
            )
        ]
    if findings := _check_rough_speed(rough, times):
        return findings
    units = recorded.timestamps_us
    covered = (units >= times[0] - MAX_UNSYNCHRONISED_US) & (units <= times[-1] + MAX_UNSYNCHRONISED_US)
    if not covered.any():
        unit = unit_by_cover(units, times)
        return [
            error(
                "rough-poses-not-covering",
                f"the rough poses span {times[0] / 1e6:.3f} to {times[-1] / 1e6:.3f} s, the frames "
                f"{units[0] / 1e6:.3f} to {units[-1] / 1e6:.3f} s{unit and f'; their timestamps look like {unit}'}",
                "Give rough_poses.poses of the drive's time with timestamp_us in microseconds on the clock of the "
                "frames, or leave them out.",
            )
        ]
    found = _check_rough_world(recorded.manifest, rough)
    if not covered.all():
        what = f"{int((~covered).sum())} of {len(units)} frames are outside the rough poses' time"
        found.append(warning("rough-poses-partial", what, "Give rough poses of the drive's whole time."))
    return found


def _check_rough_speed(rough: RoughTrajectory, times_us: NDArray[np.int64]) -> list[Finding]:
    """Find rough poses that are not in metres."""
    positions_m = np.array([pose.world_from_rig.translation_m for pose in rough.poses])
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    excess_m = steps_m - JUMP_SIGMAS * math.sqrt(2.0) * rough.sigma_translation_m
    steps_s = np.diff(times_us) / 1e6
    if not len(steps_m) or np.median(excess_m - MAX_SPEED_MPS * steps_s) <= 0.0:
        return []
    return [
        error(
            "rough-poses-speed",
            f"rough_poses.poses are mostly further apart than a vehicle drives: {np.median(steps_m):.0f} m in "
            f"{np.median(steps_s):g} s",
            "Give the translation_m of world_from_rig in metres, not in centimetres or millimetres, and "
            "timestamp_us in microseconds.",
        )
    ]


def _check_rough_world(manifest: DriveManifest, rough: RoughTrajectory) -> list[Finding]:
    """Find rough poses of a world whose z axis does not point up."""
    x, y, z, w = np.array([pose.world_from_rig.rotation_xyzw for pose in rough.poses]).T
    axes_up = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=-1)
    upright = axes_up @ np.array(_UP_IN_BODY[manifest.rig.body_axes], dtype=np.float64)
    if np.median(upright) > np.cos(np.radians(MAX_VEHICLE_TILT_DEG)):
        return []
    return [
        warning(
            "rough-poses-world",
            f"rough_poses.poses have the vehicle mostly turned by over {MAX_VEHICLE_TILT_DEG:g} degrees against the z "
            "axis of their world: the scene lies as they do, and its pictures take that axis for up",
            "Give world_from_rig in a world whose z axis points up; check rig.body_axes, and that the quaternion ends "
            "with w.",
        )
    ]


def _image_axes(rig_from_cam: Pose) -> NDArray[np.float64]:
    """The image's upward direction and the optical axis (2, 3) in the rig: -y and z of the camera."""
    x, y, z, w = np.array(rig_from_cam.rotation_xyzw) / np.linalg.norm(rig_from_cam.rotation_xyzw)
    return np.array(
        [
            [-2 * (x * y - z * w), 2 * (x * x + z * z) - 1, -2 * (y * z + x * w)],
            [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def main() -> None:
    """Print the findings of the manifest in the standard input."""
    _bound_memory(int(sys.argv[1]))
    try:
        findings = check_manifest(parse_manifest(sys.stdin.buffer.read()))
    except DocumentError as problem:
        fields = ", ".join(p.path for p in problem.problems[:3] if p.path) or "the file"
        findings = [error("bad-document", f"drive manifest: {problem}", f"Correct {fields}.")]
    print(json.dumps({"findings": [as_json(finding) for finding in findings]}, allow_nan=False))


def _bound_memory(megabytes: int) -> None:
    """Let this process take so much more memory than it has now.

    Small JSON can unpack to a hundred times its bytes. Where memory is refused to Python it raises MemoryError; where
    to pydantic, that aborts the process.
    """
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    bound = pages * resource.getpagesize() + megabytes * 1_000_000
    resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    main()
