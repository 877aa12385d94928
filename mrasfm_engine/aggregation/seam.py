"""A seam: two scenes that see the same, how they lie to one another, and how good that is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.image_search import similar_images
from mrasfm_engine.aggregation.pairs import Probe, guided_pairs, height_between_m, probes
from mrasfm_engine.aggregation.relocalization import Matches2D3D, Relocaliser, Relocalization, matches_2d3d
from mrasfm_engine.aggregation.scene_matching import CrossMatcher, CrossMatches
from mrasfm_engine.aggregation.seam_refinement import (
    RefinedSeam,
    Shared,
    adjust_transform,
    errors_focal,
    matches_fit,
    merge_points,
    scale_ratio,
)
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import AggregationConfig, EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.stage_store import Arrays
from mrasfm_engine.matching.prepared_images import Matcher
from mrasfm_engine.types import CountProgress, Floats, Ints

BATCH_UNITS = 4  # relocalised between two tests of their agreement
ENOUGH_AGREEING = 4  # units, after which no more are looked for
MATCH_ERRORS = (0.012, 0.005)  # how far matches of a round may be off, shares of the focal length
SIGMAS_OF_LENGTH = 3.0  # by which lengths may differ beyond `aggregation.max_scale_error`
MAX_SHIFT_M, MAX_TURN_DEG = 0.5, 1.0  # by which the fine assembly may correct the consensus
LEAST_SIGMA_RAD, LEAST_SIGMA_M = np.radians(0.02), 0.01  # it averages over the bends of both scenes there
NO_COMMON_VIEWS = "their views do not overlap"
MIN_POINTS_OF_UNIT = 5  # shared points that a unit sees, for it to be part of the seam


@dataclass(frozen=True, kw_only=True)
class Seam:
    """Two scenes a and b, by their names; without `accepted` they are not connected, and the reason says why."""

    a: str
    b: str
    accepted: bool
    reason: str
    coarse_a_from_b: Floats  # (4, 4) by positions; where a scene has none, by the units that were relocalised first
    a_from_b: Floats  # (4, 4); the coarse one where nothing better is known, NaN where nothing is
    covariance: Floats  # (6, 6) of [omega, v] about the middle of b's units at the seam, in a's axes, without bends
    shared: Ints  # (n, 2) points of a and of b that are one
    units_a: Ints  # that see shared points
    units_b: Ints
    place_b_m: Floats  # (3,) the middle of b's units there, in b's frame
    quality: dict[str, Any] = field(default_factory=dict)

    @property
    def off_in_length(self) -> float:
        """Relative difference of the scenes' lengths; zero where the seam is not used or does not know it."""
        return abs(float(self.quality.get("scale", 1.0)) - 1.0) if self.accepted else 0.0

    def pack(self) -> tuple[Arrays, dict[str, Any]]:
        """Arrays and report for a finished stage; names are not part of them."""
        arrays = {
            name: getattr(self, name)
            for name in ("coarse_a_from_b", "a_from_b", "covariance", "shared", "units_a", "units_b", "place_b_m")
        }
        return arrays, {"accepted": self.accepted, "reason": self.reason, "quality": self.quality}

    @staticmethod
    def unpack(a: str, b: str, arrays: Arrays, documents: dict[str, Any]) -> Seam:
        """Restore a seam from `pack`, for scenes with these names."""
        return Seam(
            a=a, b=b, accepted=documents["accepted"], reason=documents["reason"], quality=documents["quality"], **arrays
        )


def find_seam(
    a: SourceScene,
    b: SourceScene,
    coarse_a_from_b: Floats | None,
    matcher: Matcher,
    config: EngineConfig,
    *,
    cancel: Callable[[], bool],
    progress: CountProgress,
) -> Seam:
    """Look for how two scenes lie to one another, from where their positions put them.

    Parameters
    ----------
    coarse_a_from_b
        By positions (4, 4); None where a scene has none: then images that look similar are compared.

    Returns
    -------
    Seam
        Not accepted where they share too little, or what they share does not agree.
    """
    cross = CrossMatcher(a, b, matcher, config.matching, threads=config.threads)
    settings, by_positions = config.aggregation, coarse_a_from_b
    wanted = (
        similar_images(a, b, settings, cancel=cancel) if by_positions is None else probes(a, b, by_positions, settings)
    )
    found, tried = _relocalise(a, b, wanted, cross, config, cancel=cancel, progress=progress)
    quality: dict[str, Any] = {
        "units_tried": found.units_tried,
        "units_agreeing": len(found.units_agreeing),
        "units_elsewhere": found.runner_up,
        "units_looked_for": tried,
    }
    if not wanted and by_positions is not None:
        quality["height_between_m"] = abs(height_between_m(a, b, by_positions))
        found = replace(found, reason=_why_no_views(quality["height_between_m"], settings))
    if found.a_from_b is None:
        quality["pairs_compared"] = cross.compared
        return _unconnected(a, b, by_positions, found.reason, quality)
    assembly = Assembly(scenes=(a, b))
    refined = _assemble(assembly, found.a_from_b, cross, config, cancel=cancel, progress=progress)
    quality["pairs_compared"] = cross.compared
    if refined is None:
        return _unconnected(a, b, by_positions, "too few points of both scenes fit together", quality)
    return _judged(assembly, by_positions, found, refined, quality, config)


def _why_no_views(height_m: float, settings: AggregationConfig) -> str:
    """Reason for two scenes without a common view by their positions, heights of different datums among them."""
    if height_m <= settings.position_error_m:
        return NO_COMMON_VIEWS
    return f"positions put one {height_m:.0f} m above the other: compare the height datums of their drives"


def _relocalise(
    a: SourceScene,
    b: SourceScene,
    wanted: Sequence[Probe],
    cross: CrossMatcher,
    config: EngineConfig,
    *,
    cancel: Callable[[], bool],
    progress: CountProgress,
) -> tuple[Relocalization, int]:
    """Look for units of b in a, a few at a time, until enough agree; and how many were looked for."""
    relocaliser = Relocaliser(b, config.aggregation, seed=config.seed)
    parts: list[CrossMatches] = []
    found = Relocalization(
        a_from_b=None, reason=NO_COMMON_VIEWS, units_tried=0, units_agreeing=(), runner_up=0, inliers=0
    )
    # From the start and from the middle at once, so that the first units are not all at one place.
    order = [wanted[i] for k in range(BATCH_UNITS) for i in range(k, len(wanted), BATCH_UNITS)]
    for start in range(0, len(order), BATCH_UNITS):
        batch = order[start : start + BATCH_UNITS]
        pairs = np.concatenate([probe.pairs for probe in batch])
        parts += cross.match(pairs, verified=True, cancel=cancel)
        progress(min(start + BATCH_UNITS, len(order)), len(order))
        matches = CrossMatches.joined(parts)
        seen: Matches2D3D = matches_2d3d(a, b, matches.a, matches.b)
        found = relocaliser.relocalise(seen)
        if found.a_from_b is not None and len(found.units_agreeing) >= ENOUGH_AGREEING and not found.runner_up:
            return found, start + len(batch)
    return found, len(order)


def _assemble(
    assembly: Assembly,
    a_from_b: Floats,
    cross: CrossMatcher,
    config: EngineConfig,
    *,
    cancel: Callable[[], bool],
    progress: CountProgress,
) -> RefinedSeam | None:
    """Match, merge and adjust in turns, each time from the better transform."""
    a, b = assembly.scenes
    refined: RefinedSeam | None = None
    for match_error in MATCH_ERRORS:
        pairs = guided_pairs(a, b, a_from_b, config.aggregation)
        if not len(pairs):
            return None
        matches = CrossMatches.joined(cross.match(pairs, verified=False, cancel=cancel, progress=progress))
        state = assembly.state(np.stack([np.eye(4), a_from_b]))
        shared = merge_points(assembly, matches, matches_fit(assembly, state, matches, match_error))
        if len(shared) < 3:
            return None
        refined = adjust_transform(assembly, a_from_b, shared, config, cancel=cancel)
        if len(refined.shared) < 3:
            return None
        a_from_b = refined.a_from_b
    return refined


def _judged(
    assembly: Assembly,
    by_positions: Floats | None,
    found: Relocalization,
    refined: RefinedSeam,
    quality: dict[str, Any],
    config: EngineConfig,
) -> Seam:
    a, b = assembly.scenes
    assert found.a_from_b is not None
    coarse = found.a_from_b if by_positions is None else by_positions
    settings = config.aggregation
    units_a, units_b = (_units_at(assembly, refined.shared, side) for side in (0, 1))
    scale, sigma_scale = scale_ratio(assembly, refined.a_from_b, refined.shared)
    at = _middle_m(b, units_b)
    covariance = _about(refined.covariance, b, refined.a_from_b, at)
    apart_m = se3.apply(refined.a_from_b, at[None])[0] - _middle_m(a, units_a)
    most = _largest_difference_of_lengths(a, b, settings)
    covariance[3:, 3:] += np.outer(apart_m, apart_m) * min(max(abs(scale - 1.0), sigma_scale), most) ** 2
    stated = with_bends(covariance)
    shift = float(np.linalg.norm(se3.apply(refined.a_from_b, at[None])[0] - se3.apply(coarse, at[None])[0]))
    turn = float(se3.rotation_angle_deg(refined.a_from_b[:3, :3] @ coarse[:3, :3].T))
    before = _residual_px(assembly, coarse, refined.shared)
    quality |= {
        "units_a": len(units_a),
        "units_b": len(units_b),
        "inliers": len(refined.shared),
        "observations": len(refined.errors_px),
        "residual_before_px": before,
        "residual_after_px": float(np.median(refined.errors_px)),
        "sigma_translation_m": float(np.sqrt(np.trace(stated[3:, 3:]))),
        "sigma_rotation_deg": float(np.degrees(np.sqrt(np.trace(stated[:3, :3])))),
        "scale": scale,
        "sigma_scale": sigma_scale,
    }
    if by_positions is not None:
        quality |= {"positions_off_m": shift, "positions_off_deg": turn}
    reason = _why_not(found, refined, at, quality, settings.agreeing_units, most, config)
    return Seam(
        a=a.name,
        b=b.name,
        accepted=not reason,
        reason=reason,
        coarse_a_from_b=coarse,
        a_from_b=refined.a_from_b,
        covariance=covariance,
        shared=refined.shared.pairs - [0, assembly.first_point[1]],
        units_a=units_a,
        units_b=units_b,
        place_b_m=at,
        quality=quality,
    )


def _why_not(
    found: Relocalization,
    refined: RefinedSeam,
    at: Floats,
    quality: dict[str, Any],
    strict: bool,
    most: float,
    config: EngineConfig,
) -> str:
    """Reason against trusting a seam of scenes whose lengths may differ by up to `most`; empty where there is none."""
    settings = config.aggregation
    if quality["inliers"] < settings.min_inliers:
        return f"only {quality['inliers']} points are shared, {settings.min_inliers} are needed"
    if not np.isfinite(refined.covariance).all():
        return "what is shared does not determine how the scenes lie"
    if not strict:
        return ""
    assert found.a_from_b is not None
    least = min(quality["units_a"], quality["units_b"])
    if least < settings.min_units:
        return f"only {least} units of a scene see what is shared, {settings.min_units} are needed"
    shift = float(np.linalg.norm(se3.apply(refined.a_from_b, at[None])[0] - se3.apply(found.a_from_b, at[None])[0]))
    turn = float(se3.rotation_angle_deg(refined.a_from_b[:3, :3] @ found.a_from_b[:3, :3].T))
    if shift > MAX_SHIFT_M or turn > MAX_TURN_DEG:
        return f"what is shared contradicts the units that agree, by {shift:.2f} m and {turn:.2f} deg"
    off, unsure = abs(quality["scale"] - 1.0), SIGMAS_OF_LENGTH * quality["sigma_scale"]
    if off > most + unsure:
        return f"lengths of the scenes differ by {100 * off:.1f} %"
    if quality.get("positions_off_m", 0.0) > settings.position_error_m:
        return (
            f"the scenes' positions contradict it by {quality['positions_off_m']:.1f} m, more than "
            f"aggregation.position_error_m"
        )
    return ""


def _units_at(assembly: Assembly, shared: Shared, side: int) -> Ints:
    """Units of one scene that see enough of what is shared."""
    scene = assembly.scenes[side]
    points = shared.pairs[:, side] - assembly.first_point[side]
    is_shared = np.zeros(len(scene.points_m) + 1, dtype=np.bool_)
    is_shared[points] = True
    rows = np.flatnonzero(is_shared[scene.keypoint_point])
    image = np.searchsorted(scene.keypoint_first, rows, side="right") - 1
    counts = np.bincount(scene.image_unit[image], minlength=len(scene.unit_registered))
    return np.flatnonzero(counts >= MIN_POINTS_OF_UNIT)


def _middle_m(scene: SourceScene, units: Ints) -> Floats:
    """The middle (3,) of some units of a scene, or of all that are registered where there are none."""
    chosen = units if len(units) else np.flatnonzero(scene.unit_registered)
    result: Floats = scene.world_from_rig[chosen].mean(0)[:3, 3]
    return result


def _about(covariance: Floats, b: SourceScene, a_from_b: Floats, at_b: Floats) -> Floats:
    """The covariance of a step about b's mean place as one about another place of b."""
    pivot = se3.apply(a_from_b, b.trajectory_m.mean(0)[None])[0]
    arm = se3.apply(a_from_b, at_b[None])[0] - pivot
    change = np.eye(6)
    change[3:, :3] = -se3.skew(arm)
    result: Floats = change @ covariance @ change.T
    return result


def _largest_difference_of_lengths(a: SourceScene, b: SourceScene, settings: AggregationConfig) -> float:
    """Largest relative difference of the lengths of two scenes, by what they state of them.

    The way between their vehicles at a seam may be off by that much. Where both drove at one place there is no such
    error: points that are too far on the same line of sight move in no image.
    """
    stated = np.hypot(a.sigma_scale or 0.0, b.sigma_scale or 0.0)
    return settings.max_scale_error + SIGMAS_OF_LENGTH * float(stated)


def with_bends(covariance: Floats) -> Floats:
    """A seam's covariance (6, 6) with what the scenes' bends there add."""
    result: Floats = covariance + np.diag([LEAST_SIGMA_RAD**2] * 3 + [LEAST_SIGMA_M**2] * 3)
    return result


def _residual_px(assembly: Assembly, a_from_b: Floats, shared: Shared) -> float:
    """Median reprojection error of scene b's shared points in scene a's images if the scenes lie so."""
    a = assembly.scenes[0]
    state = assembly.state(np.stack([np.eye(4), a_from_b]))
    partner = np.full(len(a.points_m), -1, dtype=np.int64)
    partner[shared.pairs[:, 0]] = shared.pairs[:, 1]
    rows = np.flatnonzero(a.keypoint_point >= 0)
    rows = rows[partner[a.keypoint_point[rows]] >= 0]
    off = errors_focal(assembly, state, rows, state.points_m[partner[a.keypoint_point[rows]]])
    camera = assembly.image_camera[assembly.keypoint_image[rows]]
    off_px = off * state.camera_params[camera, :2].mean(1)
    finite = off_px[np.isfinite(off_px)]
    return float(np.median(finite)) if len(finite) else float(max(a.drive.cameras[0].width, a.drive.cameras[0].height))


def _unconnected(
    a: SourceScene, b: SourceScene, by_positions: Floats | None, reason: str, quality: dict[str, Any]
) -> Seam:
    coarse = np.full((4, 4), np.nan) if by_positions is None else by_positions
    none = np.zeros(0, dtype=np.int64)
    return Seam(
        a=a.name,
        b=b.name,
        accepted=False,
        reason=reason,
        coarse_a_from_b=coarse,
        a_from_b=coarse,
        covariance=np.full((6, 6), np.inf),
        shared=np.zeros((0, 2), dtype=np.int64),
        units_a=none,
        units_b=none,
        place_b_m=b.midpoint_m,
        quality=quality,
    )
