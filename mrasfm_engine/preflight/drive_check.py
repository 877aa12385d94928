"""The check of a drive that takes seconds and comes before hours of work."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.findings import Finding, Severity, error, listed, warning
from mrasfm_engine.io.axes import manifest_in_flu
from mrasfm_engine.preflight.gnss import check_gnss
from mrasfm_engine.preflight.image_files import check_images
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.types import CountProgress
from schemas import DriveManifest

MAX_UNSYNCHRONISED_US = 60_000  # nuScenes' cameras are up to 50 ms apart
MIN_FRAME_INTERVAL_US = 1_000
MAX_FRAME_INTERVAL_US = 20_000_000
MAX_CAMERA_ROLL_DEG = 60.0


class UnsoundDriveError(InputError):
    """The check of a drive found errors: says the first, and how many more there are.

    Parameters
    ----------
    findings
        All that the check found, errors first.
    """

    def __init__(self, findings: Sequence[Finding]) -> None:
        errors = [finding for finding in findings if finding.severity is Severity.ERROR]
        more = f" ({len(errors) - 1} more errors)" if len(errors) > 1 else ""
        super().__init__(errors[0].what + more, remedy=errors[0].remedy, code=errors[0].code)
        self.findings = tuple(findings)


def check_manifest(manifest: DriveManifest, *, use_gnss: bool = True) -> list[Finding]:
    """List the errors and oddities of a drive that its manifest shows; no file is opened.

    Parameters
    ----------
    manifest
        In any body axes.
    use_gnss
        Whether the reconstruction will use the drive's GNSS.

    Returns
    -------
    list of Finding
        Errors first. With any error the drive cannot be reconstructed.
    """
    return _errors_first(_findings_of_manifest(Drive(Path(), manifest_in_flu(manifest)), use_gnss=use_gnss))


def check_drive(drive: Drive, *, use_gnss: bool = True, progress: CountProgress | None = None) -> list[Finding]:
    """Everything that is wrong or odd about a drive, from its manifest and its files' headers.

    Parameters
    ----------
    use_gnss
        Whether the reconstruction will use the drive's GNSS.
    progress
        Called with how many of how many files are checked.

    Returns
    -------
    list of Finding
        Errors first. With any error the drive cannot be reconstructed.
    """
    return _errors_first([*_findings_of_manifest(drive, use_gnss=use_gnss), *check_images(drive, progress)])


def is_sound(findings: Sequence[Finding]) -> bool:
    """Return whether no finding is an error."""
    return all(finding.severity is not Severity.ERROR for finding in findings)


def require_sound(findings: list[Finding]) -> None:
    """Raise the first error among the findings, with the number of further ones.

    Raises
    ------
    UnsoundDriveError
        If any finding is an error.
    """
    if not is_sound(findings):
        raise UnsoundDriveError(findings)


def _findings_of_manifest(drive: Drive, *, use_gnss: bool) -> list[Finding]:
    return [
        *_check_frames(drive),
        *_check_times(drive),
        *_check_rig(drive),
        *_check_scale(drive, use_gnss=use_gnss),
        *_check_rough_poses(drive),
        *(check_gnss(drive) if use_gnss else []),
    ]


def _errors_first(findings: list[Finding]) -> list[Finding]:
    return sorted(findings, key=lambda finding: finding.severity is not Severity.ERROR)


def _check_frames(drive: Drive) -> list[Finding]:
    frames = drive.manifest.frames
    empty = [f"frames.{i}" for i, frame in enumerate(frames) if not frame.images]
    findings = []
    if len(frames) - len(empty) < 2:
        findings.append(
            error(
                "too-few-frames",
                f"drive {drive.manifest.name!r} has {len(frames) - len(empty)} frames with images",
                "Give at least two frames: structure comes from motion.",
            )
        )
    if empty:
        findings.append(
            warning("frame-without-images", f"no images in {listed(empty)}", "Take these frames out of drive.json.")
        )
    used = {image.camera for image in drive.images}
    unused = [camera.name for k, camera in enumerate(drive.cameras) if k not in used]
    if unused and used:
        findings.append(
            warning("camera-without-images", f"no images of camera {listed(unused)}", "Take it out of the rig.")
        )
    return findings


def _check_times(drive: Drive) -> list[Finding]:
    findings = []
    if len(drive.timestamps_us) > 1:
        median = float(np.median(np.diff(drive.timestamps_us)))
        unit = ""
        if median < MIN_FRAME_INTERVAL_US:
            unit = "milliseconds"
        elif median > MAX_FRAME_INTERVAL_US:
            unit = "nanoseconds"
        if unit:
            findings.append(
                error(
                    "frame-rate",
                    f"frames are {median / 1e6:g} s apart: their timestamps look like {unit}",
                    "Give frames.timestamp_us in microseconds, and the samples of gnss and rough_poses too.",
                )
            )
    off = [
        (abs(image.timestamp_us - int(drive.timestamps_us[image.unit])), image.file)
        for image in drive.images
        if abs(image.timestamp_us - int(drive.timestamps_us[image.unit])) > MAX_UNSYNCHRONISED_US
    ]
    if off:
        worst = max(off)
        findings.append(
            warning(
                "unsynchronised",
                f"{len(off)} images are over {MAX_UNSYNCHRONISED_US // 1000} ms from their frame's time, most "
                f"{worst[1]} with {worst[0] / 1000:.0f} ms",
                "Put images into the frame that is nearest in time.",
            )
        )
    return findings


def _check_rig(drive: Drive) -> list[Finding]:
    """Cameras stand about upright on a vehicle; if none does, the rig's axes are not what was said."""
    # The image's up is -y of the camera; its z component in the rig is the cosine of how far it is turned.
    cosines = -drive.rig_from_cam[:, 2, 1]
    turned = [
        camera.name
        for camera, cosine in zip(drive.cameras, cosines, strict=True)
        if cosine < np.cos(np.radians(MAX_CAMERA_ROLL_DEG))
    ]
    if not turned:
        return []
    what = f"camera {listed(turned)} is turned by over {MAX_CAMERA_ROLL_DEG:g} degrees against the vehicle's upright"
    remedy = (
        "Check rig.body_axes and that rig_from_cam is the camera's pose in the rig, not its inverse; camera axes are "
        "x right, y down, z forward."
    )
    if len(turned) == len(drive.cameras):
        return [error("rig-axes", what, remedy)]
    return [warning("camera-turned", what, remedy)]


def _check_scale(drive: Drive, *, use_gnss: bool) -> list[Finding]:
    if len({image.camera for image in drive.images}) > 1:
        return []
    gnss = use_gnss and drive.manifest.gnss is not None
    if gnss or drive.manifest.rough_poses is not None:
        source = "GNSS" if gnss else "the rough poses"
        return [
            warning(
                "scale-not-from-rig",
                f"the drive has images of one camera only: its scale comes from {source} alone",
                "Give the images of all cameras for a scale that the rig's baselines confirm.",
            )
        ]
    return [
        error(
            "no-metric-scale",
            "the drive has images of one camera only and neither GNSS nor rough poses: nothing gives it a scale",
            "Give a second camera, GNSS or rough poses.",
        )
    ]


def _check_rough_poses(drive: Drive) -> list[Finding]:
    rough = drive.manifest.rough_poses
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
    units = drive.timestamps_us
    covered = (units >= times[0] - MAX_UNSYNCHRONISED_US) & (units <= times[-1] + MAX_UNSYNCHRONISED_US)
    if not covered.any():
        return [
            error(
                "rough-poses-not-covering",
                f"the rough poses span {times[0] / 1e6:.3f} to {times[-1] / 1e6:.3f} s, the frames "
                f"{units[0] / 1e6:.3f} to {units[-1] / 1e6:.3f} s",
                "Give rough poses of the drive's time, or leave them out.",
            )
        ]
    if not covered.all():
        what = f"{int((~covered).sum())} of {len(units)} frames are outside the rough poses' time"
        return [warning("rough-poses-partial", what, "Give rough poses of the drive's whole time.")]
    return []
