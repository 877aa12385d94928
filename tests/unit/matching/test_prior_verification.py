from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, GnssConfig, MatchConfig, PairConfig
from mrasfm_engine.geometry import geodesy, se3
from mrasfm_engine.matching.nearest_neighbour import NearestNeighbourMatcher
from mrasfm_engine.matching.pair_matching import NO_PRIOR, SearchResult, match_pairs
from mrasfm_engine.matching.pair_selection import pairs_without_selection
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory, prior_trajectory
from mrasfm_engine.scene.drive import Drive, pose_from_matrix
from mrasfm_engine.synthetic.simulate import poses_along
from schemas import Gnss, GnssSample, RoughPose, RoughTrajectory
from tests.helpers.simulated_drive import FIRST_US, SimulatedDrive, make_simulated_drive
from tests.helpers.slow import slow

UNITS, SPEED_M_PER_S = 14, 11.0
MUNICH = np.array([48.1, 11.6, 500.0])


@cache
def simulated_drive() -> SimulatedDrive:
    return make_simulated_drive(units=UNITS, cameras=2, points=1500)


def receiver(*, late_s: float = 0.0, swapped: bool = False, sigma_m: float = 0.02) -> Gnss:
    """A good receiver that has been on for half a minute, also on the path before the drive's."""
    t_s = np.arange(-30.0, 8.0, 0.1)
    # Before the drive the car went at two thirds of its speed, so that another time is another motion.
    along_m = np.where(t_s < 0, 0.66, 1.0) * SPEED_M_PER_S * (t_s - late_s)
    local = poses_along(along_m)[:, :3, 3] + np.random.default_rng(0).normal(0, sigma_m, (len(t_s), 3))
    geodetic = geodesy.geodetic_from_local(local, geodesy.ecef_from_local(MUNICH))
    if swapped:
        geodetic = geodetic[:, [1, 0, 2]]
    samples = [
        GnssSample(
            timestamp_us=FIRST_US + round(1e6 * t),
            latitude_deg=float(place[0]),
            longitude_deg=float(place[1]),
            height_m=float(place[2]),
            sigma_horizontal_m=sigma_m,
            sigma_vertical_m=sigma_m,
        )
        for t, place in zip(t_s, geodetic, strict=True)
    ]
    return Gnss(height_datum="ellipsoidal", antenna_in_rig_m=[0.0, 0.0, 0.0], samples=samples)


def prior_of(gnss: Gnss) -> PriorTrajectory:
    drive = simulated_drive().drive
    return prior_trajectory(
        Drive(drive.root, drive.manifest.model_copy(update={"gnss": gnss})), GnssConfig(), use_gnss=True
    )


@cache
def matched(prior: str) -> SearchResult:
    priors = {
        "none": lambda: NO_PRIOR,
        "right": lambda: prior_of(receiver()),
        "swapped": lambda: prior_of(receiver(swapped=True)),
        "late": lambda: prior_of(receiver(late_s=18.0)),
        "backwards": lambda: backwards(prior_of(receiver())),
        "one unit off": lambda: one_unit_off(prior_of(receiver())),
    }
    simulated, config = simulated_drive(), MatchConfig()
    pairs = pairs_without_selection(simulated.drive, PairConfig(window_units=3))
    return match_pairs(
        simulated.drive, simulated.features, pairs, NearestNeighbourMatcher(config), config, BundleAdjustmentConfig(),
        threads=1, prior=priors[prior](),
    )  # fmt: skip


def backwards(prior: PriorTrajectory) -> PriorTrajectory:
    """The heading is along the track, also where the car reverses."""
    assert prior.world_from_rig is not None
    return replace(prior, world_from_rig=prior.world_from_rig @ np.diag([-1.0, -1.0, 1.0, 1.0]))


def one_unit_off(prior: PriorTrajectory) -> PriorTrajectory:
    assert prior.world_from_rig is not None
    poses = prior.world_from_rig.copy()
    poses[7, :3, 3] += [2.0, -3.0, 0.5]
    return replace(prior, world_from_rig=poses)


def right_inliers(result: SearchResult) -> tuple[int, int]:
    """Inliers that show one point from two units, and those that don't."""
    simulated, right, wrong = simulated_drive(), 0, 0
    for pair in result.pairs:
        a = simulated.point_of_keypoint[pair.image_a][pair.matches[pair.inliers, 0]]
        b = simulated.point_of_keypoint[pair.image_b][pair.matches[pair.inliers, 1]]
        right += int(((a == b) & (a >= 0)).sum())
        wrong += int(((a != b) | (a < 0)).sum())
    return right, wrong


@pytest.mark.parametrize("prior", ["swapped", "late", *slow("right", "backwards", "one unit off")])
def test_no_prior_however_wrong_takes_matches_from_a_pair(prior: str) -> None:
    without, result = matched("none"), matched(prior)
    assert without.prior.predicted == 0
    assert result.prior.predicted > 40
    assert right_inliers(without)[0] > 5000
    assert right_inliers(result)[0] > 0.995 * right_inliers(without)[0]
    assert right_inliers(result)[1] <= right_inliers(without)[1]
    assert len(result.pairs) == len(without.pairs)


def test_pairs_that_contradict_the_prior_are_counted() -> None:
    assert matched("right").prior.against < 0.03 * matched("right").prior.predicted
    assert not matched("right").prior.left_out
    one_off = matched("one unit off").prior
    assert 5 < one_off.against < 0.5 * one_off.predicted
    assert not one_off.left_out
    reversing = matched("backwards").prior
    assert 0.9 * reversing.predicted < reversing.against <= reversing.predicted
    assert reversing.left_out


def rough(sigma_m: float, sigma_deg: float) -> PriorTrajectory:
    simulated = simulated_drive()
    poses = [
        RoughPose(timestamp_us=int(t), world_from_rig=pose_from_matrix(pose))
        for t, pose in zip(simulated.drive.timestamps_us, simulated.world_from_rig, strict=True)
    ]
    declared = RoughTrajectory(poses=poses, sigma_translation_m=sigma_m, sigma_rotation_deg=sigma_deg)
    manifest = simulated.drive.manifest.model_copy(update={"rough_poses": declared})
    return prior_trajectory(Drive(simulated.drive.root, manifest), GnssConfig(), use_gnss=False)


def test_the_prior_carries_the_sigmas_of_its_source() -> None:
    known = rough(0.2, 0.5)
    assert known.sigma is not None
    np.testing.assert_allclose(known.sigma, np.tile([np.radians(0.5)] * 3 + [0.2] * 3, (UNITS, 1)))
    good, poor = (prior_of(receiver(sigma_m=sigma_m)) for sigma_m in (0.02, 0.5))
    assert good.sigma is not None
    assert poor.sigma is not None
    assert (np.degrees(good.sigma[:, 2]) < 5.0).all()
    assert (good.sigma[:, 2] < poor.sigma[:, 2]).all()
    # Where the speed changes, at the first unit, no line fits the positions.
    assert ((good.sigma[:, 3:] >= 0.02) & (good.sigma[:, 3:] < 0.4)).all()
    assert (good.sigma[8:, 3:] < 0.1).all()
    # Errors are as the sigmas say.
    true = simulated_drive().world_from_rig
    assert good.world_from_rig is not None
    off = se3.log_so3(good.world_from_rig[:, :3, :3] @ true[:, :3, :3].swapaxes(1, 2))
    assert (np.abs(off - np.median(off, axis=0)) < 3 * good.sigma[:, :3]).all()


@pytest.mark.parametrize("sigma_m", [0.05, 5.0])
def test_a_prior_worse_than_the_step_between_units_predicts_nothing(sigma_m: float) -> None:
    simulated, config = simulated_drive(), MatchConfig()
    pairs = pairs_without_selection(simulated.drive, PairConfig(window_units=1))
    result = match_pairs(
        simulated.drive, simulated.features, pairs, NearestNeighbourMatcher(config), config, BundleAdjustmentConfig(),
        threads=1, prior=rough(sigma_m, 0.5),
    )  # fmt: skip
    assert (result.prior.predicted > 0) == (sigma_m < 1.0)
