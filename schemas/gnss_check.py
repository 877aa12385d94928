"""Check of a drive's GNSS samples, before hours of work rest on them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from schemas.drive import LAST_TIMESTAMP_US, MAX_GNSS_GAP_S, DriveManifest, Gnss
from schemas.findings import Finding, error, listed, warning

# Between GPS time and UTC: 18 s since 2017; a neighbouring value betrays an old table of leap seconds.
LEAP_SECONDS = (18, 17, 19)
OTHER_UNITS_US = {"nanoseconds": 1e-3, "milliseconds": 1e3, "seconds": 1e6}
MAX_SPEED_MPS = 100.0
JUMP_SIGMAS = 4.0
# Positions this far beyond the first or last sample can be extrapolated: in samples, and at most in time.
EXTRAPOLATED_SAMPLES = 1.5
MAX_EXTRAPOLATION_US = 2_000_000
SEA_DEG = (np.pi / 2, np.pi)  # latitude and longitude off 0, 0 up to which there is no land; all radians are there
WGS84_A_M, WGS84_E2 = 6_378_137.0, 6.69437999014e-3  # semi-major axis, first eccentricity squared

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def check_gnss(manifest: DriveManifest, image_times_us: NDArray[np.int64]) -> list[Finding]:
    """List the findings about the manifest's GNSS samples; none if it has no `gnss`.

    Parameters
    ----------
    image_times_us
        Timestamps (images,).
    """
    gnss = manifest.gnss
    if gnss is None:
        return []
    if not gnss.samples:
        return [
            error("gnss-empty", "gnss.samples is empty", "Give samples, take gnss out of drive.json, or use --no-gnss.")
        ]
    times = np.array([sample.timestamp_us for sample in gnss.samples], dtype=np.int64)
    findings = _check_order(times)
    if findings:
        return findings  # the rest assumes an order
    return [
        *_check_land(gnss),
        *_check_heights(gnss),
        *(_check_cover(image_times_us, times) or _check_gaps(image_times_us, times)),
        *_check_jumps(gnss, times),
        *_check_swapped(manifest, times),
    ]


def _check_order(times: Ints) -> list[Finding]:
    back = np.flatnonzero(np.diff(times) < 0) + 1
    same = np.flatnonzero(np.diff(times) == 0) + 1
    findings = []
    if len(back):
        i = int(back[0])
        findings.append(
            error(
                "gnss-order",
                f"gnss.samples.{i}.timestamp_us goes back from {times[i - 1]} to {times[i]} ({len(back)} such samples)",
                "Sort the samples by time; a clock that was set back in between splits the drive in two.",
            )
        )
    if len(same):
        i = int(same[0])
        findings.append(
            error(
                "gnss-repeats",
                f"gnss.samples.{i}.timestamp_us repeats {times[i]} ({len(same)} such samples)",
                "Keep one sample of every instant.",
            )
        )
    return findings


def _check_land(gnss: Gnss) -> list[Finding]:
    """Find positions in radians, and those of a receiver without a fix that gives zeros."""
    degrees = np.array([(sample.latitude_deg, sample.longitude_deg) for sample in gnss.samples])
    at_sea = (np.abs(degrees) <= SEA_DEG).all(axis=1)
    if not at_sea.any():
        return []
    return [
        warning(
            "gnss-at-sea",
            f"{int(at_sea.sum())} of {len(degrees)} gnss.samples lie in the sea around latitude 0, longitude 0",
            "Give latitude_deg and longitude_deg in degrees, not in radians, and leave out samples without a fix.",
        )
    ]


def _check_heights(gnss: Gnss) -> list[Finding]:
    """Find heights that are all zero, which no receiver measures: what writes the samples fills them in."""
    count = len(gnss.samples)
    if count < 2 or any(sample.height_m != 0.0 for sample in gnss.samples):
        return []
    return [
        warning(
            "gnss-heights-zero",
            f"all {count} gnss.samples have a height_m of exactly 0, as where heights are missing: the scene is made "
            "level, at height 0, and its sigmas say that this is known",
            "Give the receiver's heights. Where there are none, give a sigma_vertical_m of some hundreds of metres.",
        )
    ]


def _covered(images: Ints, samples: Ints) -> Bools:
    spacing = float(np.median(np.diff(samples))) if len(samples) > 1 else 0.0
    slack = min(EXTRAPOLATED_SAMPLES * spacing, MAX_EXTRAPOLATION_US)
    covered: Bools = (images >= samples[0] - slack) & (images <= samples[-1] + slack)
    return covered


def unit_by_cover(images: Ints, times: Ints) -> str:
    """Name of the unit other than microseconds in which times (n,) cover most images (m,); empty if there is none."""
    for unit, each_us in OTHER_UNITS_US.items():
        in_us = times * each_us
        if in_us[-1] <= LAST_TIMESTAMP_US and _covered(images, np.round(in_us).astype(np.int64)).mean() >= 0.5:
            return unit
    return ""


def _check_cover(images: Ints, times: Ints) -> list[Finding]:
    covered = _covered(images, times)
    if covered.all():
        return []
    span = (
        f"the images span {_seconds(images.min())} to {_seconds(images.max())} s, the GNSS samples "
        f"{_seconds(times[0])} to {_seconds(times[-1])} s"
    )
    for leap in LEAP_SECONDS:
        for sign, direction in ((1, "early"), (-1, "late")):
            if _covered(images, times + sign * leap * 1_000_000).all():
                # A receiver that began late and ran on would look the same, unless just that time is missing.
                edge = (images.max() - times[-1] if sign > 0 else times[0] - images.min()) / 1e6
                certain = covered.mean() < 0.5 or abs(edge - leap) < 1.0
                finding = error if certain else warning
                return [
                    finding(
                        "gnss-leap-seconds",
                        f"{span}; the samples {'are' if certain else 'may be'} {leap} s too {direction}, as when one "
                        "clock counts GPS time and the other UTC",
                        f"{'' if certain else 'If so: '}{'Add' if sign > 0 else 'Subtract'} {leap * 1_000_000} "
                        f"{'to' if sign > 0 else 'from'} every gnss.samples timestamp_us, or convert both clocks to "
                        "one.",
                    )
                ]
    if covered.mean() < 0.5:
        unit = unit_by_cover(images, times)
        return [
            error(
                "gnss-not-covering",
                f"{span}: {int((~covered).sum())} of {len(images)} images have none"
                f"{unit and f'; timestamp_us of gnss.samples look like {unit}'}",
                "Give gnss.samples of the drive's whole time with timestamp_us in microseconds on the clock of the "
                "images, or use --no-gnss.",
            )
        ]
    what = f"{span}: {int((~covered).sum())} of {len(images)} images are without GNSS"
    return [warning("gnss-partial", what, "Nothing needs to be done; positions there come from the images alone.")]


def _check_gaps(images: Ints, times: Ints) -> list[Finding]:
    """The finding that most images lie between samples that are far apart, as where timestamps have another unit."""
    after = np.clip(np.searchsorted(times, images), 1, max(len(times) - 1, 1))
    gaps_us = np.diff(times)[after - 1] if len(times) > 1 else np.zeros(len(images), dtype=np.int64)
    lost = (gaps_us > MAX_GNSS_GAP_S * 1e6) & ~np.isin(images, times)
    if lost.mean() <= 0.5:
        return []
    return [
        warning(
            "gnss-sparse",
            f"{int(lost.sum())} of {len(images)} images lie between gnss.samples that are over "
            f"{MAX_GNSS_GAP_S:.0f} s apart, by up to {gaps_us.max() / 1e6:.3g} s: they have no position",
            "Check that timestamp_us of gnss.samples are microseconds. Of a receiver that comes so seldom, samples at "
            "the times of images count.",
        )
    ]


def _seconds(time_us: np.int64) -> str:
    return f"{int(time_us) / 1e6:.3f}"


def _positions(gnss: Gnss, *, swapped: bool) -> Floats:
    """Local east and north (samples, 2) at the first sample, metres; `swapped` exchanges latitude and longitude.

    Heights may count from any datum: a difference of 100 m changes these distances by 2e-5 of them.
    """
    degrees = np.array([(sample.latitude_deg, sample.longitude_deg) for sample in gnss.samples])
    latitude, longitude = np.radians(degrees[:, ::-1] if swapped else degrees).T
    height = np.array([sample.height_m for sample in gnss.samples])
    # Earth-centred coordinates on WGS84's ellipsoid.
    normal = WGS84_A_M / np.sqrt(1 - WGS84_E2 * np.sin(latitude) ** 2)
    ecef = np.stack(
        [
            (normal + height) * np.cos(latitude) * np.cos(longitude),
            (normal + height) * np.cos(latitude) * np.sin(longitude),
            (normal * (1 - WGS84_E2) + height) * np.sin(latitude),
        ],
        -1,
    )
    sin_lat, cos_lat, sin_lon, cos_lon = (f(v) for v in (latitude[0], longitude[0]) for f in (np.sin, np.cos))
    east, north = (-sin_lon, cos_lon, 0.0), (-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat)
    result: Floats = (ecef - ecef[0]) @ np.array([east, north]).T
    return result


def _check_jumps(gnss: Gnss, times: Ints) -> list[Finding]:
    sigma = np.array([sample.sigma_horizontal_m for sample in gnss.samples])
    seconds = np.diff(times) / 1e6
    distance = np.linalg.norm(np.diff(_positions(gnss, swapped=False), axis=0), axis=1)
    excess = distance - JUMP_SIGMAS * np.hypot(sigma[1:], sigma[:-1])
    jumps = np.flatnonzero(excess > MAX_SPEED_MPS * seconds) + 1
    if not len(jumps):
        return []
    i = int(jumps[0])
    return [
        warning(
            "gnss-jump",
            f"GNSS jumps at {listed([f'gnss.samples.{k}' for k in jumps])}: {distance[i - 1]:.0f} m in "
            f"{seconds[i - 1]:g} s at the first",
            "Nothing needs to be done for single outliers, which are rejected; for many, check the receiver's data or "
            "give larger sigmas.",
        )
    ]


def _check_swapped(manifest: DriveManifest, times: Ints) -> list[Finding]:
    """Compares the track with the rough poses: swapped latitude and longitude mirror and stretch it."""
    gnss, rough = manifest.gnss, manifest.rough_poses
    assert gnss is not None
    if rough is None or max(abs(sample.longitude_deg) for sample in gnss.samples) > 90:
        return []
    rough_times = np.array([pose.timestamp_us for pose in rough.poses], dtype=np.int64)
    inside = (rough_times >= times[0]) & (rough_times <= times[-1])
    if inside.sum() < 3:
        return []
    track = np.array([pose.world_from_rig.translation_m[:2] for pose in rough.poses])[inside]
    residual = {
        swapped: _misfit(track, _at(rough_times[inside], times, _positions(gnss, swapped=swapped)))
        for swapped in (False, True)
    }
    noise = float(np.median([sample.sigma_horizontal_m for sample in gnss.samples])) + rough.sigma_translation_m
    if residual[False] < 3 * noise or residual[True] > residual[False] / 3:
        return []
    return [
        error(
            "gnss-swapped",
            f"the GNSS track differs from the rough poses by {residual[False]:.1f} m, and by {residual[True]:.1f} m "
            "with latitude and longitude exchanged",
            "Exchange latitude_deg and longitude_deg in gnss.samples.",
        )
    ]


def _at(when: Ints, times: Ints, positions: Floats) -> Floats:
    return np.stack([np.interp(when, times, positions[:, axis]) for axis in range(positions.shape[1])], -1)


def _misfit(a: Floats, b: Floats) -> float:
    """Root mean square distance (m) of two plane tracks (n, 2) after the best rotation and shift."""
    a, b = a - a.mean(0), b - b.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    rotation = u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.sqrt(((a @ rotation - b) ** 2).sum(1).mean()))
