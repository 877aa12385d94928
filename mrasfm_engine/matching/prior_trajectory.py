"""Prior trajectory of the units, before any image is read: from rough poses, from GNSS, or unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.config import GnssConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import geodesy, se3
from mrasfm_engine.geometry.gnss_track import GnssTrack, RoughTrajectory, find_gross_errors, find_held, rough_trajectory
from mrasfm_engine.io.heights import ellipsoidal_heights
from mrasfm_engine.scene.drive import Drive, matrix_from_pose
from mrasfm_engine.scene.scene import Georeference
from mrasfm_engine.types import Floats

SLACK_US = 100_000  # by which units may lie before or after the poses
POLE_DEG = 89.0  # beyond it, degrees of longitude are too short to tell anything
MARGIN_US = 10_000_000  # of samples before and after the drive that are looked at


@dataclass(frozen=True, kw_only=True)
class PriorTrajectory:
    """Trajectory that is known before reconstruction; NaN for units of which nothing is known.

    GNSS is in an east-north-up frame at the track's middle, rough poses are in their own world, moved to begin near
    zero. `world_from_rig` is in the frame of its source.
    """

    source: str  # "rough poses", "GNSS" or "none"
    world_from_rig: Floats | None  # (units, 4, 4)
    sigma: Floats | None = None  # (units, 6) of rotations about the world's axes (rad) and of positions (m)
    gnss: GnssTrack | None = None
    antenna_in_rig_m: Floats | None = None
    sigma_antenna_m: float = 0.0  # 0: it is taken to be exact
    georeference: Georeference | None = None
    rough_world_from_rig: Floats | None = None  # (units, 4, 4)
    rough_world_from_local: Floats | None = None  # (4, 4)


def prior_trajectory(drive: Drive, config: GnssConfig, *, use_gnss: bool) -> PriorTrajectory:
    """Interpolate what the manifest knows to the units' timestamps.

    Rough poses are preferred where there are both, as they know headings; GNSS then still georeferences.
    """
    gnss = drive.manifest.gnss if use_gnss else None
    track, georeference = (None, None) if gnss is None else _track(drive, config)
    rough = rough_world_from_local = None
    if drive.manifest.rough_poses is not None:
        rough, rough_world_from_local = _rough(drive)
    antenna = None if gnss is None else np.array(gnss.antenna_in_rig_m)
    found, source = _with_sigmas(drive, rough), "rough poses"
    if found is not None and np.isnan(found.world_from_rig[:, 0, 3]).mean() > 0.5:
        found = None  # too few to choose pairs by
    if found is None and track is not None and antenna is not None:
        found, source = rough_trajectory(track, drive.timestamps_us, antenna), "GNSS"
    return PriorTrajectory(
        source="none" if found is None else source,
        world_from_rig=None if found is None else found.world_from_rig,
        sigma=None if found is None else found.sigma,
        gnss=track,
        antenna_in_rig_m=antenna,
        sigma_antenna_m=0.0 if gnss is None else gnss.sigma_antenna_m or 0.0,
        georeference=georeference,
        rough_world_from_rig=rough,
        rough_world_from_local=rough_world_from_local,
    )


def _with_sigmas(drive: Drive, rough: Floats | None) -> RoughTrajectory | None:
    """The manifest's rough poses at the units' times with its sigmas."""
    declared = drive.manifest.rough_poses
    if rough is None or declared is None:
        return None
    sigma = [*[np.radians(declared.sigma_rotation_deg)] * 3, *[declared.sigma_translation_m] * 3]
    return RoughTrajectory(world_from_rig=rough, sigma=np.tile(sigma, (len(rough), 1)))


def _track(drive: Drive, config: GnssConfig) -> tuple[GnssTrack, Georeference]:
    gnss = drive.manifest.gnss
    if gnss is None or not gnss.samples:
        raise InputError("gnss.samples is empty", remedy="Give samples, leave gnss out, or use --no-gnss.")
    first, last = int(drive.timestamps_us[0]) - MARGIN_US, int(drive.timestamps_us[-1]) + MARGIN_US
    near = [s for s in gnss.samples if first <= s.timestamp_us <= last]
    gnss = gnss.model_copy(update={"samples": near or gnss.samples})
    geodetic = np.array([(s.latitude_deg, s.longitude_deg, 0.0) for s in gnss.samples])
    geodetic[:, 2] = ellipsoidal_heights(gnss)
    origin = geodetic[len(geodetic) // 2]  # not the median, which 180 degrees of longitude would tear apart
    ecef_from_local = geodesy.ecef_from_local(origin)
    position = geodesy.local_from_geodetic(geodetic, ecef_from_local)
    sigma = np.array([(s.sigma_horizontal_m, s.sigma_horizontal_m, s.sigma_vertical_m) for s in gnss.samples])
    times = np.array([s.timestamp_us for s in gnss.samples], dtype=np.int64)
    held = find_held(times, position, sigma)
    good = ~held
    bad = find_gross_errors(times[good], position[good], sigma[good], outlier_sigmas=config.outlier_sigmas)
    good[good] = ~bad
    return (
        GnssTrack(
            timestamps_us=times,
            position_m=position,
            sigma_m=sigma,
            good=good,
            held=held,
            swapped_from_local=_swapped_from_local(float(origin[0]), float(origin[1])),
        ),
        Georeference(
            origin_latitude_deg=float(origin[0]),
            origin_longitude_deg=float(origin[1]),
            origin_ellipsoidal_height_m=float(origin[2]),
            height_datum=gnss.height_datum,
            ecef_from_local=ecef_from_local,
        ),
    )


def _swapped_from_local(latitude_deg: float, longitude_deg: float) -> Floats | None:
    """The map (3, 3) of directions from a place to the one that has its coordinates swapped, on a sphere."""
    if abs(longitude_deg) >= POLE_DEG or abs(latitude_deg) >= POLE_DEG:
        return None
    from_north, from_east = np.cos(np.radians(longitude_deg)), 1.0 / np.cos(np.radians(latitude_deg))
    return np.array([[0.0, from_north, 0.0], [from_east, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _rough(drive: Drive) -> tuple[Floats, Floats]:
    """Rough poses at the units' times in a local frame near zero, and the shift back."""
    rough = drive.manifest.rough_poses
    assert rough is not None
    times = np.array([p.timestamp_us for p in rough.poses], dtype=np.int64)
    if (np.diff(times) <= 0).any():
        raise InputError(
            "rough_poses.poses are not ascending in time", remedy="Sort them and drop repeated timestamps."
        )
    poses = np.stack([matrix_from_pose(p.world_from_rig) for p in rough.poses])
    shift = np.round(poses[0, :3, 3])
    poses[:, :3, 3] -= shift
    at = drive.timestamps_us
    result = se3.interpolate(times, poses, at)
    result[(at < times[0] - SLACK_US) | (at > times[-1] + SLACK_US)] = np.nan
    return result, se3.transform(np.eye(3), shift)
