from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.geometry.camera_model import PERSPECTIVE, packed, project_points
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.triangulation.tracks import Keypoints, Tracks, build_tracks
from tests.helpers.simulated_drive import make_simulated_drive, true_matches


def keypoints_of(per_image: list[int]) -> Keypoints:
    counts = np.array(per_image)
    image = np.repeat(np.arange(len(counts)), counts).astype(np.int64)
    n = len(image)
    return Keypoints(
        first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        number=np.concatenate([np.arange(count) for count in per_image]).astype(np.int64),
        image=image,
        unit=image,
        camera=np.zeros(n, dtype=np.int64),
        band=image,
        xy_px=np.zeros((n, 2)),
        rays=np.tile([0.0, 0, 1], (n, 1)),
    )


def pair(a: int, b: int, matches: list[tuple[int, int]], inliers: list[bool] | None = None) -> PairMatches:
    return PairMatches(
        image_a=a,
        image_b=b,
        matches=np.array(matches, dtype=np.int32).reshape(-1, 2),
        inliers=np.array([True] * len(matches) if inliers is None else inliers, dtype=np.bool_),
    )


def members(tracks: Tracks) -> list[list[int]]:
    return [tracks.keypoints[tracks.first[t] : tracks.first[t + 1]].tolist() for t in range(len(tracks))]


def check_consistent(tracks: Tracks, keypoints: Keypoints) -> None:
    for t, group in enumerate(members(tracks)):
        assert len(group) >= 2
        assert group == sorted(group)
        assert (tracks.of_keypoint[group] == t).all()
        assert len(np.unique(keypoints.image[group])) == len(group)  # never two keypoints of one image
    assert (tracks.of_keypoint >= 0).sum() == len(tracks.keypoints)


def test_matches_chain_into_tracks() -> None:
    keypoints = keypoints_of([2, 2, 2])
    tracks = build_tracks(keypoints, [pair(0, 1, [(0, 1)]), pair(1, 2, [(1, 0), (0, 1)])])
    check_consistent(tracks, keypoints)
    assert sorted(members(tracks)) == [[0, 3, 4], [2, 5]]
    assert tracks.of_keypoint[1] == -1


def test_only_inliers_count() -> None:
    tracks = build_tracks(keypoints_of([2, 2]), [pair(0, 1, [(0, 0), (1, 1)], [True, False])])
    assert members(tracks) == [[0, 2]]


def test_a_conflict_is_left_out_and_the_stronger_pair_wins() -> None:
    keypoints = keypoints_of([6, 6, 6])
    strong = pair(0, 1, [(k, k) for k in range(6)])
    # By way of image 2, keypoint 0 of image 0 and keypoint 1 of image 1 would be one point.
    weak = [pair(0, 2, [(0, 0)]), pair(1, 2, [(1, 0)])]
    for pairs in ([strong, *weak], [*weak, strong]):
        tracks = build_tracks(keypoints, pairs)
        check_consistent(tracks, keypoints)
        for k in range(6):
            assert tracks.of_keypoint[k] == tracks.of_keypoint[6 + k] >= 0
        assert tracks.of_keypoint[0] != tracks.of_keypoint[1]


@pytest.mark.parametrize("seed", range(3))
def test_random_matches_never_put_two_keypoints_of_an_image_together(seed: int) -> None:
    rng = np.random.default_rng(seed)
    keypoints = keypoints_of([30] * 8)
    pairs = [
        pair(a, b, list(zip(rng.integers(0, 30, 25).tolist(), rng.integers(0, 30, 25).tolist(), strict=True)))
        for a in range(8)
        for b in range(a + 1, 8)
    ]
    tracks = build_tracks(keypoints, pairs)
    check_consistent(tracks, keypoints)
    assert max(len(m) for m in members(tracks)) <= 8
    assert len(tracks) > 5


def test_planted_wrong_matches_do_not_merge_everything() -> None:
    simulated = make_simulated_drive(units=6, cameras=2, points=500, clutter=20)
    keypoints = Keypoints.from_features(simulated.drive, simulated.features)
    truth = np.concatenate(simulated.point_of_keypoint)
    purity = {}
    for wrong in (0, 3):
        pairs = true_matches(simulated, wrong=wrong)
        tracks = build_tracks(keypoints, pairs)
        check_consistent(tracks, keypoints)
        groups = [truth[m] for m in members(tracks)]
        purity[wrong] = np.mean([(g == np.bincount(g + 1).argmax() - 1).mean() for g in groups])
        assert max(len(g) for g in groups) <= 12
        assert len(tracks) > 0.9 * len(np.unique(truth[truth >= 0]))
    assert purity[0] == 1.0
    assert 0.8 < purity[3] < 1.0


def test_no_matches_no_tracks() -> None:
    keypoints = keypoints_of([3, 0, 2])
    for pairs in ([], [pair(0, 2, [])], [pair(0, 2, [(0, 0)], [False])]):
        tracks = build_tracks(keypoints, pairs)
        assert len(tracks) == 0
        assert (tracks.of_keypoint == -1).all()


def test_tracks_come_back_from_their_labels() -> None:
    tracks = build_tracks(keypoints_of([4, 4, 4]), [pair(0, 1, [(0, 1), (2, 2)]), pair(1, 2, [(2, 3)])])
    again = Tracks.from_labels(tracks.of_keypoint)
    for name in ("of_keypoint", "first", "keypoints"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tracks, name))
    gaps = Tracks.from_labels(np.array([7, -1, 3, 7, 3], dtype=np.int64))
    assert members(gaps) == [[2, 4], [0, 3]]


def test_keypoints_line_up_images_and_their_rays() -> None:
    simulated = make_simulated_drive(
        units=2, cameras=3, points=200, hidden=lambda unit, camera: (unit, camera) == (0, 1)
    )
    keypoints = Keypoints.from_features(simulated.drive, simulated.features)
    assert keypoints.first[2] == keypoints.first[1]  # an image without keypoints
    for i, (image, f) in enumerate(zip(simulated.drive.images, simulated.features, strict=True)):
        rows = slice(keypoints.first[i], keypoints.first[i + 1])
        np.testing.assert_array_equal(keypoints.xy_px[rows], f.xy_px.astype(float))
        assert (keypoints.image[rows] == i).all()
        assert (keypoints.unit[rows] == image.unit).all()
        assert (keypoints.camera[rows] == image.camera).all()
        _, params = packed(PERSPECTIVE, simulated.truth.camera_params[image.camera])
        if len(f.xy_px):
            np.testing.assert_allclose(project_points(0, params, keypoints.rays[rows]), f.xy_px, atol=1e-3)


def test_keypoints_of_matches_make_the_tracks_of_all_keypoints() -> None:
    simulated = make_simulated_drive(units=4, seed=3)
    rng = np.random.default_rng(0)
    pairs = [replace(p, inliers=rng.random(len(p.matches)) < 0.5) for p in true_matches(simulated)]
    every = Keypoints.from_features(simulated.drive, simulated.features)
    few, numbered = Keypoints.from_matches(simulated.drive, simulated.features, pairs)
    assert len(few.image) < len(every.image)
    rows = every.first[few.image] + few.number
    for name in ("image", "unit", "camera", "band", "xy_px", "rays", "classes"):
        assert np.array_equal(getattr(few, name), getattr(every, name)[rows]), name
    of_all, of_few = build_tracks(every, pairs), build_tracks(few, numbered)
    assert len(of_few) > 0
    assert np.array_equal(of_few.first, of_all.first)
    assert np.array_equal(rows[of_few.keypoints], of_all.keypoints)


def test_keypoints_of_matches_are_inliers_and_all_matches_within_a_unit() -> None:
    simulated = make_simulated_drive(units=2, seed=1)
    unit = [image.unit for image in simulated.drive.images]
    pairs = [replace(p, inliers=np.arange(len(p.matches)) % 2 == 0) for p in true_matches(simulated)]
    _, numbered = Keypoints.from_matches(simulated.drive, simulated.features, pairs)
    within = [unit[p.image_a] == unit[p.image_b] for p in pairs]
    assert any(within)
    assert not all(within)
    for before, after, same_unit in zip(pairs, numbered, within, strict=True):
        if same_unit:
            assert np.array_equal(after.inliers, before.inliers)
        else:
            assert len(after.matches) == before.inliers.sum()
            assert after.inliers.all()


def test_keypoints_of_no_match_are_none() -> None:
    simulated = make_simulated_drive(units=2, seed=1)
    keypoints, pairs = Keypoints.from_matches(simulated.drive, simulated.features, [])
    assert not pairs
    assert (keypoints.xy_px.shape, keypoints.rays.shape) == ((0, 2), (0, 3))
