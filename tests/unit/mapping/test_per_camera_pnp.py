from __future__ import annotations

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.per_camera_pnp import Vote, agree, largest_agreement

TRUE = se3.transform(se3.exp_so3([0.1, -0.2, 1.3]), [12.0, -4.0, 0.5])


def vote(camera: int, *, turned_deg: float = 0.0, moved_m: float = 0.0, inliers: int = 100) -> Vote:
    off = se3.transform(se3.exp_so3(np.radians([0.0, 0.0, turned_deg])), [moved_m, 0.0, 0.0])
    return Vote(camera=camera, world_from_rig=TRUE @ off, inliers=inliers)


def errors(pose: np.ndarray) -> tuple[float, float]:
    return (
        float(np.linalg.norm(pose[:3, 3] - TRUE[:3, 3])),
        float(se3.rotation_angle_deg(pose[:3, :3] @ TRUE[:3, :3].T)),
    )


def test_nobody_agrees_on_nothing() -> None:
    assert largest_agreement([]) is None


def test_one_wrong_camera_among_six_moves_nothing() -> None:
    votes = [vote(c, turned_deg=0.02 * (-1) ** c, moved_m=0.01 * (-1) ** c) for c in range(5)]
    found = largest_agreement([*votes, vote(5, turned_deg=4.0, moved_m=2.0, inliers=1000)])
    assert found is not None
    np.testing.assert_array_equal(found.agreeing, [True] * 5 + [False])
    position_m, rotation_deg = errors(found.world_from_rig)
    assert 0 < position_m < 0.005
    assert 0 < rotation_deg < 0.01


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


def test_cameras_with_more_inliers_count_for_more() -> None:
    found = largest_agreement([vote(0, inliers=300), vote(1, moved_m=0.2, inliers=100)])
    assert found is not None
    assert found.agreeing.all()
    np.testing.assert_allclose(errors(found.world_from_rig)[0], 0.05, atol=1e-9)


def test_agreement_has_limits_in_angle_and_in_distance() -> None:
    poses = np.stack(
        [v.world_from_rig for v in (vote(0), vote(1, turned_deg=0.9), vote(2, turned_deg=1.1), vote(3, moved_m=0.6))]
    )
    np.testing.assert_array_equal(agree(poses, TRUE), [True, True, False, False])
