"""Two scenes against one another: how they lie, how well that is known, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.association import coarse_transform
from mrasfm_engine.aggregation.map_report import nothing_connected
from mrasfm_engine.aggregation.scene_matching import CrossMatcher, CrossMatches
from mrasfm_engine.aggregation.seam import Seam, find_seam
from mrasfm_engine.aggregation.seam_refinement import Shared, adjust_transform, matches_fit, merge_points, scale_ratio
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.nearest_neighbour import NearestNeighbourMatcher
from tests.helpers.slow import slow
from tests.helpers.small_scenes import (
    CONFIG,
    Driven,
    Street,
    configured,
    drive_along,
    in_assembly,
    make_street,
    noisy,
    off,
    shared_points,
    true_a_from_b,
    true_matches,
    with_noise,
)

WAY_A, WAY_B = np.arange(0.0, 16.0, 2.0), np.arange(3.0, 19.0, 2.0)


@pytest.fixture(scope="module")
def street() -> Street:
    return make_street(length_m=20.0, points=800)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("seam")


@pytest.fixture(scope="module")
def a(street: Street, folder: Path) -> Driven:
    return drive_along(street, folder / "a", WAY_A)


@pytest.fixture(scope="module")
def b(street: Street, folder: Path) -> Driven:
    return drive_along(street, folder / "b", WAY_B, lateral_m=0.7, bias_m=(2.5, -1.5, 0.8), seed=1)


def seam_of(a: Driven, b: Driven, config: EngineConfig = CONFIG) -> Seam:
    return find_seam(
        a.source,
        b.source,
        coarse_transform(a.source, b.source),
        NearestNeighbourMatcher(config.matching),
        config,
        cancel=lambda: False,
        progress=lambda done, total: None,
    )


@pytest.fixture(scope="module")
def found(a: Driven, b: Driven) -> Seam:
    return seam_of(a, b)


def error(seam: Seam, a: Driven, b: Driven) -> tuple[float, float]:
    return off(seam.a_from_b, true_a_from_b(a, b), seam.place_b_m)


def test_a_seam_is_found_and_says_how_good_it_is(found: Seam, a: Driven, b: Driven) -> None:
    assert found.accepted, found.reason
    quality = found.quality
    shift, turn = error(found, a, b)
    assert 0 < shift < 0.02
    assert 0 < turn < 0.1
    assert off(found.coarse_a_from_b, true_a_from_b(a, b), found.place_b_m)[0] == pytest.approx(3.02, abs=0.02)
    assert quality["positions_off_m"] == pytest.approx(3.02, abs=0.05)
    assert 0.3 < quality["residual_after_px"] < 0.8  # noise of 0.4 px an axis
    assert quality["residual_before_px"] > 10 * quality["residual_after_px"]
    assert 0 < quality["sigma_translation_m"] < 0.03
    assert 0 < abs(quality["scale"] - 1.0) < 0.01
    assert quality["units_agreeing"] >= 4
    assert quality["units_elsewhere"] == 0
    # Of what both scenes have a point of, most is joined, and rightly.
    truth = {tuple(p) for p in shared_points(a, b).tolist()}
    pairs = [tuple(p) for p in found.shared.tolist()]
    assert 0.5 * len(truth) < len(pairs) <= len(truth)
    assert sum(p in truth for p in pairs) > 0.98 * len(pairs)
    assert quality["inliers"] == len(pairs)
    again = Seam.unpack("x", "y", *found.pack())
    assert (again.a, again.b, again.accepted, again.quality) == ("x", "y", True, quality)
    assert np.array_equal(again.a_from_b, found.a_from_b)


def test_what_cameras_are_off_by_is_in_the_sigma_of_a_seam(street: Street, folder: Path) -> None:
    """A camera that looks elsewhere than its scene thinks turns and shifts the seam, and no residual shows it."""
    shifts, turns = [], []
    for seed in range(0, 6, 2):
        a, b = (
            drive_along(
                street,
                folder / f"off {seed + k}",
                way,
                cameras=3,
                cameras_off_deg=0.3,
                lateral_m=0.7 * k,
                seed=seed + k,
            )
            for k, way in enumerate((WAY_A, WAY_B))
        )
        seam = seam_of(a, b)
        assert seam.accepted, seam.reason
        shift_m, turn_deg = error(seam, a, b)
        shifts.append(shift_m / seam.quality["sigma_translation_m"])
        turns.append(turn_deg / seam.quality["sigma_rotation_deg"])
    assert 0.2 < np.sqrt(np.mean(np.square(shifts))) < 2.0
    assert 0.2 < np.sqrt(np.mean(np.square(turns))) < 2.0


def test_a_drive_the_other_way_is_joined_by_its_back_camera(street: Street, folder: Path, a: Driven) -> None:
    back = drive_along(street, folder / "back", WAY_B[::-1], lateral_m=-0.5, back=True, bias_m=(-2, 1, 0), seed=2)
    seam = seam_of(a, back)
    assert seam.accepted, seam.reason
    assert 0 < error(seam, a, back)[0] < 0.02


def test_too_little_in_common_is_refused(a: Driven, b: Driven) -> None:
    few = seam_of(a, b, configured(min_inliers=5000))
    assert not few.accepted
    assert "points are shared, 5000 are needed" in few.reason
    assert 60 < few.quality["inliers"] < 5000
    units = seam_of(a, b, configured(min_units=50))
    assert not units.accepted
    assert "units agree how the scenes lie, 50 are needed" in units.reason
    assert not np.isfinite(units.covariance).any()
    assert np.array_equal(units.a_from_b, units.coarse_a_from_b)


def test_positions_that_contradict_are_named(street: Street, folder: Path, a: Driven) -> None:
    """Positions 5 m off where the settings say that they are never over 4 m off."""
    far = drive_along(street, folder / "far", WAY_B, bias_m=(4.0, 3.0, 0.0), seed=3)
    seam = seam_of(a, far, configured(position_error_m=4.0))
    assert not seam.accepted
    assert "positions contradict it by 5.0 m" in seam.reason
    assert seam_of(a, far).accepted


def test_heights_that_keep_views_apart_are_named(a: Driven, b: Driven) -> None:
    """As where one receiver counts heights from the ellipsoid, and another one from the sea."""
    high = replace(b.source, ecef_from_local=b.source.ecef_from_local @ se3.transform(np.eye(3), [0, 0, 47.0]))
    seam = seam_of(a, replace(b, source=high))
    assert not seam.accepted
    assert seam.reason == "positions put one 48 m above the other: compare the height datums of their drives"
    finding = nothing_connected([seam], CONFIG.aggregation)
    expected = (
        "all scenes are placed by positions only: positions put scenes that meet above one another, by up to 48 m"
    )
    assert finding.what == expected
    assert "height_datum" in finding.remedy
    elsewhere = seam_of(a, replace(b, source=high), configured(position_error_m=60.0))
    assert elsewhere.accepted, elsewhere.reason


@pytest.mark.parametrize(
    ("position_error_m", "why", "remedy"),
    [
        (12.0, "no seam is left to use", "loops"),
        (4.0, "what they share contradicts their positions, by up to 5 m", "position_error_m"),
    ],
)
def test_why_nothing_is_connected(
    street: Street, folder: Path, a: Driven, position_error_m: float, why: str, remedy: str
) -> None:
    far = drive_along(street, folder / f"why {why}", WAY_B, bias_m=(4.0, 3.0, 0.0), seed=3)
    config = configured(position_error_m=position_error_m)
    finding = nothing_connected([seam_of(a, far, config)], config.aggregation)
    assert finding.what == f"all scenes are placed by positions only: {why}"
    assert remedy in finding.remedy
    assert "near enough to be compared" in nothing_connected([], config.aggregation).what


def test_scenes_that_share_nothing(folder: Path, a: Driven) -> None:
    elsewhere = drive_along(make_street(length_m=20.0, points=800, seed=9), folder / "elsewhere", WAY_B, seed=4)
    seam = seam_of(a, elsewhere)
    assert not seam.accepted
    assert "units" in seam.reason
    assert len(seam.shared) == 0
    away = replace(a.source, ecef_from_local=a.source.ecef_from_local @ se3.transform(np.eye(3), [300.0, 0, 0]))
    seam = seam_of(a, replace(elsewhere, source=away))
    assert (seam.accepted, seam.reason) == (False, "their views do not overlap")
    assert nothing_connected([seam], CONFIG.aggregation).what.endswith("no two of them see the same")


@pytest.mark.parametrize("scale", [0.97, *slow(1.03)])
def test_lengths_that_differ_are_found_and_refused_beyond_the_limit(
    street: Street, folder: Path, a: Driven, scale: float
) -> None:
    other = drive_along(street, folder / f"scale{scale}", WAY_B, scale=scale, seed=5)
    seam = seam_of(a, other)
    assert seam.accepted, seam.reason
    assert seam.quality["scale"] == pytest.approx(1 / scale, abs=0.006)  # lengths of a in those of b
    assert 0 < seam.quality["sigma_scale"] < 0.004
    strict = seam_of(a, other, configured(max_scale_error=0.01))
    assert not strict.accepted
    assert strict.reason.startswith("lengths of the scenes differ by")
    assert 2.4 < float(strict.reason.split()[-2]) < 3.6
    assert strict.off_in_length == 0.0


@pytest.mark.parametrize(("sigma", "accepted"), [(0.001, False), (0.01, True)])
def test_lengths_may_differ_by_what_scenes_state_of_them(
    street: Street, folder: Path, a: Driven, sigma: float, accepted: bool
) -> None:
    other = drive_along(street, folder / f"stated{sigma}", WAY_B, scale=0.97, seed=5)
    report = {"scale": {"sigma_relative": sigma}}
    stated = [replace(one, source=replace(one.source, report=one.source.report | report)) for one in (a, other)]
    seam = seam_of(stated[0], stated[1], configured(max_scale_error=0.01))
    assert seam.accepted == accepted, seam.reason
    assert seam.off_in_length == pytest.approx(0.03 if accepted else 0.0, abs=0.006)
    if not accepted:
        finding = nothing_connected([seam], CONFIG.aggregation)
        assert finding.what.endswith(f"{seam.a} and {seam.b} see the same, but {seam.reason}")


def test_where_lengths_differ_vehicles_at_different_places_are_less_certain_of_their_distance(
    street: Street, folder: Path, a: Driven
) -> None:
    scale = 0.97
    behind = drive_along(street, folder / "behind", np.arange(-9.0, -1.0, 2.0), scale=scale, seed=9)
    seam = seam_of(a, behind)
    assert seam.accepted, seam.reason
    truth_m = se3.apply(true_a_from_b(a, behind), seam.place_b_m[None] / scale)
    off_m = float(np.linalg.norm(se3.apply(seam.a_from_b, seam.place_b_m[None]) - truth_m))
    assert off_m > 0.1
    assert off_m < 2.0 * seam.quality["sigma_translation_m"]
    beside = seam_of(a, drive_along(street, folder / "beside", WAY_A + 0.5, scale=scale, seed=10))
    assert beside.accepted, beside.reason
    assert beside.quality["sigma_translation_m"] < 0.3 * seam.quality["sigma_translation_m"]


def test_without_agreeing_units_nothing_but_the_number_of_points_is_asked(
    street: Street, folder: Path, a: Driven
) -> None:
    other = drive_along(street, folder / "loose", WAY_B, scale=1.03, seed=6)
    seam = seam_of(a, other, configured(max_scale_error=0.01, agreeing_units=False))
    assert seam.accepted
    assert seam.quality["units_agreeing"] == 1


def test_what_the_adjustment_says_of_its_own_error_is_honest(street: Street, folder: Path) -> None:
    """Errors of a seam over twenty measurements of its keypoints, and standard deviations as reported.

    These count keypoints of one image as partly one, so that under independent noise they are on the large side.
    """
    rng = np.random.default_rng(0)
    a = drive_along(street, folder / "exact-a", WAY_A, noise_px=0.0, seed=7)
    b = drive_along(street, folder / "exact-b", WAY_B, noise_px=0.0, lateral_m=0.7, seed=8)
    truth, at = true_a_from_b(a, b), b.source.trajectory_m.mean(0)
    shared = Shared(pairs=in_assembly(shared_points(a, b), a))
    errors, sigmas = [], []
    for _ in range(20):
        assembly = Assembly(scenes=[with_noise(d.source, rng, 0.6) for d in (a, b)])
        fine = adjust_transform(assembly, noisy(truth, rng, m=0.05, deg=0.1), shared, CONFIG, cancel=lambda: False)
        turn = se3.log_so3(fine.a_from_b[:3, :3] @ truth[:3, :3].T)
        shift = se3.apply(fine.a_from_b, at[None])[0] - se3.apply(truth, at[None])[0]
        errors.append(np.concatenate([turn, shift]))
        sigmas.append(np.sqrt(np.diag(fine.covariance)))
    ratio = np.median(sigmas, axis=0) / np.sqrt(np.mean(np.square(errors), axis=0))
    assert 0.8 < np.exp(np.log(ratio).mean()) < 2.3
    assert (ratio > 0.6).all()
    assert (ratio < 3.0).all()


def test_the_adjustment_finds_back_and_drops_what_is_not_one_point(a: Driven, b: Driven) -> None:
    rng = np.random.default_rng(1)
    truth = true_a_from_b(a, b)
    pairs = shared_points(a, b)
    wrong = np.arange(len(pairs)) % 10 == 0
    mixed = pairs.copy()
    mixed[wrong, 1] = np.roll(pairs[wrong, 1], 1)
    assembly = Assembly(scenes=[a.source, b.source])
    start = noisy(truth, rng, m=0.15, deg=0.3)
    fine = adjust_transform(assembly, start, Shared(pairs=in_assembly(mixed, a)), CONFIG, cancel=lambda: False)
    at = b.source.trajectory_m.mean(0)
    assert off(start, truth, at)[0] > 0.1
    assert 0 < off(fine.a_from_b, truth, at)[0] < 0.02
    kept = {tuple(p) for p in (fine.shared.pairs - in_assembly(np.zeros(2, dtype=np.int64), a)).tolist()}
    assert len(kept & {tuple(p) for p in mixed[wrong].tolist()}) <= 0.1 * wrong.sum()
    assert len(kept & {tuple(p) for p in mixed[~wrong].tolist()}) >= 0.9 * (~wrong).sum()


def test_one_point_is_joined_with_one_only(a: Driven, b: Driven) -> None:
    """Of two partners that matches give a point, it gets the one with more matches that fit."""
    matches = true_matches(a, b)
    of_b = b.source.keypoint_point[matches.b]
    again = [np.flatnonzero(b.source.keypoint_point == of_b[k])[-1] for k in (0, 1)]
    assert (np.array(again) != matches.b[:2]).all()
    extra = CrossMatches(a=matches.a[[0, 1, 0]], b=np.array([*again, matches.b[1]]))
    assembly = Assembly(scenes=[a.source, b.source])
    joined = CrossMatches.joined([matches, extra, extra])
    assert len(joined) == len(matches) + 3
    everything = np.ones(len(joined), dtype=np.bool_)
    pairs = merge_points(assembly, joined, everything).pairs - [0, len(a.source.points_m)]
    assert {tuple(p) for p in pairs.tolist()} == {tuple(p) for p in shared_points(a, b).tolist()}
    state = assembly.state(np.stack([np.eye(4), true_a_from_b(a, b)]))
    fits = matches_fit(assembly, state, joined, 0.012)
    false = (joined.a == matches.a[0]) & (joined.b == matches.b[1])
    assert not fits[false].any()
    assert fits.mean() > 0.8
    nothing = merge_points(assembly, joined, np.zeros(len(joined), dtype=np.bool_))
    assert nothing.pairs.shape == (0, 2)


def test_scale_of_points_that_are_known(a: Driven, b: Driven) -> None:
    """A tenth of the shared points is wrong, and the ratio is right nonetheless."""
    truth, pairs = true_a_from_b(a, b), shared_points(a, b)
    rng = np.random.default_rng(2)
    points = 1.02 * b.source.points_m
    wrong = rng.choice(len(points), len(points) // 10, replace=False)
    points[wrong] += rng.normal(0.0, 3.0, (len(wrong), 3))
    assembly = Assembly(scenes=[a.source, replace(b.source, points_m=points)])
    shared = Shared(pairs=in_assembly(pairs, a))
    scale, sigma = scale_ratio(assembly, truth, shared)
    assert 0 < abs(1.02 * scale - 1.0) < 0.004
    assert 0 < sigma < 0.003
    nan, infinite = scale_ratio(assembly, truth, Shared(pairs=shared.pairs[:2]))
    assert np.isnan(nan)
    assert infinite == np.inf


def test_pairs_are_compared_once_and_verified_ones_fit_one_essential_matrix(a: Driven, b: Driven) -> None:
    cross = CrossMatcher(a.source, b.source, NearestNeighbourMatcher(CONFIG.matching), CONFIG.matching, threads=1)
    pairs = np.array([[4 * 3, 4 * 1], [4 * 3 + 3, 4 * 1]])  # front to front, and back to front
    found, verified = (cross.match(pairs, verified=v, cancel=lambda: False) for v in (False, True))
    assert cross.compared == 2
    truth = {tuple(p) for p in shared_points(a, b).tolist()}
    points = list(zip(a.source.keypoint_point[found[0].a], b.source.keypoint_point[found[0].b], strict=True))
    assert len(points) > 50
    assert sum((int(p), int(q)) in truth for p, q in points) > 0.97 * len(points)
    assert 0.7 * len(found[0]) < len(verified[0]) <= len(found[0])
    assert len(verified[1]) == 0
    with pytest.raises(CancelledError):
        cross.match(np.array([[0, 0]]), verified=False, cancel=lambda: True)
