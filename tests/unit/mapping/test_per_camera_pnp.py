from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.per_camera_pnp import (
    Expectation,
    Vote,
    agree,
    calibration_covariance,
    calibration_spread,
    largest_agreement,
)
from tests.helpers.slow import slow

TRUE = se3.transform(se3.exp_so3([0.1, -0.2, 1.3]), [12.0, -4.0, 0.5])
PRIOR_DEG, PRIOR_M = 2.0, 0.05


def vote(
    camera: int,
    *,
    turned_deg: float = 0.0,
    moved_m: float = 0.0,
    inliers: int = 100,
    pnp_deg: float = 0.03,
    pnp_m: float = 0.01,
    prior: float = 1.0,
) -> Vote:
    """A vote that is off, with the sigmas of its PnP and a share of the usual prior's."""
    off = se3.transform(se3.exp_so3(np.radians([0.0, 0.0, turned_deg])), [moved_m, 0.0, 0.0])
    return Vote(
        camera=camera,
        world_from_rig=TRUE @ off,
        inliers=inliers,
        pnp_covariance=np.diag(np.repeat([np.radians(pnp_deg), pnp_m], 3) ** 2),
        calibration_covariance=calibration_covariance(
            TRUE,
            np.zeros(3),
            sigma_rotation_rad=prior * np.radians(PRIOR_DEG),
            sigma_translation_m=prior * PRIOR_M,
        ),
    )


def votes_apart(count: int, share: float, rng: np.random.Generator, *, pnp: float = 0.1) -> list[Vote]:
    """Votes of cameras that are off by a share of the prior's sigma, and by PnP as these say: a part of that share."""
    sigma = np.repeat([np.radians(PRIOR_DEG), PRIOR_M], 3) * share * np.hypot(1.0, pnp)
    result = []
    for camera in range(count):
        step = rng.normal(size=6) * sigma
        found = vote(camera, pnp_deg=pnp * share * PRIOR_DEG, pnp_m=pnp * share * PRIOR_M)
        pose = se3.transform(se3.exp_so3(step[:3]) @ TRUE[:3, :3], TRUE[:3, 3] + step[3:])
        result.append(Vote(**{**vars(found), "world_from_rig": pose}))
    return result


def errors(pose: np.ndarray) -> tuple[float, float]:
    return (
        float(np.linalg.norm(pose[:3, 3] - TRUE[:3, 3])),
        float(se3.rotation_angle_deg(pose[:3, :3] @ TRUE[:3, :3].T)),
    )


def test_nobody_agrees_on_nothing() -> None:
    assert largest_agreement([]) is None


@pytest.mark.parametrize("wrong_deg", [3.0, 15.0])
def test_one_wrong_camera_among_six_moves_nothing(wrong_deg: float) -> None:
    """3 deg are likely by the prior, but the others are much nearer to one another."""
    votes = [vote(c, turned_deg=0.1 * (-1) ** c, moved_m=0.01 * (-1) ** c) for c in range(5)]
    found = largest_agreement([*votes, vote(5, turned_deg=wrong_deg, inliers=1000)])
    assert found is not None
    np.testing.assert_array_equal(found.agreeing, [True] * 5 + [False])
    position_m, rotation_deg = errors(found.world_from_rig)
    assert 0 < position_m < 0.005
    assert 0 < rotation_deg < 0.05


def test_a_camera_that_pnp_leaves_uncertain_is_not_voted_out() -> None:
    """It is as far off as a wrong one, but sees too little to tell."""
    votes = [vote(c, turned_deg=0.1 * (-1) ** c) for c in range(5)]
    for pnp_deg, agrees in ((1.5, True), (0.1, False)):
        found = largest_agreement([*votes, vote(5, turned_deg=3.0, pnp_deg=pnp_deg)])
        assert found is not None
        assert found.agreeing[:5].all()
        assert found.agreeing[5] == agrees
        assert errors(found.world_from_rig)[1] < 0.05


def test_in_a_rig_that_is_off_as_its_prior_says_nobody_is_voted_out() -> None:
    turned = [-2.5, 1.8, -1.2, 0.6, 2.2]
    found = largest_agreement([vote(c, turned_deg=deg) for c, deg in enumerate([*turned, 3.0])])
    assert found is not None
    assert found.agreeing.all()
    # The same rig is wrong where much less was declared.
    strict = largest_agreement([vote(c, turned_deg=deg, prior=0.05) for c, deg in enumerate([*turned, 3.0])])
    assert strict is not None
    assert 1 <= strict.agreeing.sum() <= 2


@pytest.mark.parametrize("cameras", [3, 6, *slow(4, 8)])
@pytest.mark.parametrize("share", [0.05, 0.3])
def test_the_spread_is_what_calibrations_are_apart_by(cameras: int, share: float) -> None:
    rng = np.random.default_rng(cameras)
    found = [calibration_spread(votes_apart(cameras, share, rng)) for _ in range(100)]
    assert 0.7 * share < np.median(found) < 1.3 * share


def test_the_spread_is_bounded_by_the_prior_and_by_pnp() -> None:
    rng = np.random.default_rng(0)
    assert calibration_spread(votes_apart(6, 5.0, rng)) == 1.0
    assert calibration_spread(votes_apart(2, 0.01, rng)) == 1.0  # no majority
    explained = [calibration_spread(votes_apart(6, 0.01, rng, pnp=10.0)) for _ in range(50)]
    assert 0 < np.median(explained) < 0.05


@pytest.mark.parametrize("cameras", [2, 6, *slow(3)])
@pytest.mark.parametrize("share", [1.0, *slow(0.02)])
def test_cameras_of_one_pose_are_rarely_voted_out(cameras: int, share: float) -> None:
    rng, out = np.random.default_rng(1), 0
    for _ in range(100):
        votes = votes_apart(cameras, share, rng, pnp=0.5)
        agreement = largest_agreement(votes)
        assert agreement is not None
        out += int((~agreement.agreeing).sum())
    assert out <= 0.02 * 100 * cameras


def test_two_against_two_the_better_supported_win() -> None:
    right = [vote(0, inliers=120), vote(1, moved_m=0.02, inliers=90)]
    wrong = [vote(2, turned_deg=5.0, moved_m=3.0, inliers=80), vote(3, turned_deg=5.02, moved_m=3.0, inliers=70)]
    found = largest_agreement([*wrong, *right])
    assert found is not None
    np.testing.assert_array_equal(found.agreeing, [False, False, True, True])
    assert 0 < errors(found.world_from_rig)[0] < 0.02  # and not in the middle between both


def test_of_two_that_differ_one_is_believed_and_not_their_mean() -> None:
    found = largest_agreement([vote(0, inliers=60), vote(1, turned_deg=10.0, moved_m=1.0, inliers=50)])
    assert found is not None
    np.testing.assert_array_equal(found.agreeing, [True, False])
    assert errors(found.world_from_rig)[0] < 1e-9


@pytest.mark.parametrize(
    ("right_m", "wrong_m", "sigma_m", "by_motion"),
    [
        (0.0, 3.0, 0.05, True),
        (0.1, 3.0, 0.05, True),  # as far off as motion predicts
        (0.0, 0.6, 0.5, False),  # the vehicle may be at either
        (2.0, 3.0, 0.05, False),  # and here at none
    ],
)
def test_of_two_that_differ_the_one_is_right_that_is_where_motion_predicts(
    right_m: float, wrong_m: float, sigma_m: float, by_motion: bool
) -> None:
    votes = [vote(0, moved_m=right_m, inliers=50), vote(1, moved_m=wrong_m, inliers=60)]
    motion = Expectation(world_from_rig=TRUE, covariance=np.diag(np.repeat([0.05, sigma_m], 3) ** 2))
    found = largest_agreement(votes, motion)
    assert found is not None
    assert found.by_motion == by_motion
    np.testing.assert_array_equal(found.agreeing, [by_motion, not by_motion])


def test_a_majority_needs_no_motion() -> None:
    votes = [vote(0, inliers=100), vote(1, inliers=50, moved_m=3.0), vote(2, inliers=50, moved_m=3.0)]
    motion = Expectation(world_from_rig=TRUE, covariance=np.diag(np.repeat([0.05, 0.05], 3) ** 2))
    found = largest_agreement(votes, motion)
    assert found is not None
    np.testing.assert_array_equal(found.agreeing, [False, True, True])


def test_cameras_whose_pose_is_more_certain_count_for_more() -> None:
    votes = [vote(0, pnp_m=0.1, prior=0.0), vote(1, moved_m=0.2, pnp_m=0.2, prior=0.0)]
    found = largest_agreement(votes)
    assert found is not None
    assert found.agreeing.all()
    np.testing.assert_allclose(errors(found.world_from_rig)[0], 0.2 / (1 + 4), atol=1e-6)


def test_agreement_has_limits_in_angle_and_in_distance() -> None:
    """Of two cameras, by the prior: 4.74 sigmas are the chi-square limit at 0.1 % of 6 degrees of freedom."""
    limit_deg, limit_m = 4.739 * np.hypot(PRIOR_DEG, 0.03), 4.739 * np.hypot(PRIOR_M, 0.01)
    for values, agrees in (
        ({"turned_deg": 0.98 * limit_deg}, True),
        ({"turned_deg": 1.02 * limit_deg}, False),
        ({"moved_m": 0.98 * limit_m}, True),
        ({"moved_m": 1.02 * limit_m}, False),
    ):
        assert agree([vote(0), vote(1, **values)], TRUE).tolist() == [True, agrees]


def test_the_calibrations_covariance_is_that_of_poses_from_wrong_extrinsics() -> None:
    rng = np.random.default_rng(2)
    rig_from_cam = se3.transform(se3.exp_so3([0.3, 1.0, -0.4]), [1.6, -0.4, 1.2])
    world_from_cam = TRUE @ rig_from_cam
    sigma_rad, sigma_m = 0.01, 0.02
    steps = []
    for _ in range(4000):
        turn = se3.exp_so3(rng.normal(size=3) * sigma_rad) @ rig_from_cam[:3, :3]
        pose = world_from_cam @ se3.inverse(se3.transform(turn, rig_from_cam[:3, 3] + rng.normal(size=3) * sigma_m))
        steps.append(np.concatenate([se3.log_so3(pose[:3, :3] @ TRUE[:3, :3].T), pose[:3, 3] - TRUE[:3, 3]]))
    expected = calibration_covariance(
        TRUE, rig_from_cam[:3, 3], sigma_rotation_rad=sigma_rad, sigma_translation_m=sigma_m
    )
    sampled = np.cov(np.array(steps).T)
    scale = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
    np.testing.assert_allclose(sampled / scale, expected / scale, atol=0.08)
    assert np.abs(expected[:3, 3:] / scale[:3, 3:]).max() > 0.3  # a turned camera moves the unit, too
