"""Place of scenes that seams connect, by what their positions say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from mrasfm_engine.aggregation.map_placement import Placement, ScenePlace, agreed_value, placed
from mrasfm_engine.geometry import se3

BIAS_M = np.array([[0.9, -0.4, 0.3], [-0.8, 0.7, -0.5], [0.2, -0.6, 0.6]])
STREET_FROM_SCENE = np.stack(
    [se3.transform(se3.exp_so3([0.0, 0.0, turn]), [20.0 * turn, -5.0, 0.0]) for turn in (0.0, 1.2, -0.7)]
)
FIRST_FROM_STREET = se3.transform(se3.exp_so3([0.02, -0.01, 0.7]), np.array([31.0, -12.0, 44.0]))  # anywhere
MIDDLE_M = np.array([3.0, 1.0, 0.5])


def of_receivers(
    bias_m: np.ndarray,
    sigma_m: Sequence[float | Sequence[float]],
    *,
    spread_m: Sequence[float] = (10.0, 10.0, 10.0),
    turned_deg: Sequence[float] = (0.0, 0.0, 0.0),
) -> Placement:
    """Scenes of which is known how they lie to one another, and whose receivers are off; see `shift_m`."""
    believed, places = [], []
    for k, bias in enumerate(bias_m):
        middle_m = se3.apply(STREET_FROM_SCENE[k], MIDDLE_M[None])[0]
        turn = se3.exp_so3([0.0, 0.0, np.radians(turned_deg[k])])
        believed.append(se3.transform(turn, middle_m - turn @ middle_m + bias) @ STREET_FROM_SCENE[k])
        sigma = np.broadcast_to(np.asarray(sigma_m[k], dtype=np.float64), (3,))
        places.append(ScenePlace(middle_m=MIDDLE_M, sigma_m=sigma.copy(), spread_m=spread_m[k]))
    own = {k: FIRST_FROM_STREET @ STREET_FROM_SCENE[k] for k in range(len(bias_m))}
    return placed(own, np.stack(believed), places)


def shift_m(found: Placement, k: int = 0) -> np.ndarray:
    """Error (3,) of scene k's middle."""
    at = MIDDLE_M[None]
    lies = se3.apply(found.map_from_first @ FIRST_FROM_STREET @ STREET_FROM_SCENE[k], at)
    return np.asarray(lies - se3.apply(STREET_FROM_SCENE[k], at))[0]


def turn_deg(found: Placement) -> float:
    return float(se3.rotation_angle_deg((found.map_from_first @ FIRST_FROM_STREET)[:3, :3]))


@pytest.mark.parametrize("count", [2, 3])
def test_the_whole_is_put_in_the_middle_of_what_receivers_say(count: int) -> None:
    """How the scenes lie to one another is known; only what all receivers have in common remains in the place."""
    found = of_receivers(BIAS_M[:count], [0.5] * count)
    for k in range(count):
        if count == 2:
            np.testing.assert_allclose(shift_m(found, k), BIAS_M[:2].mean(0), atol=1e-3)
        else:  # the point with the smallest sum of distances to all
            directions = (BIAS_M - shift_m(found, k)) / np.linalg.norm(BIAS_M - shift_m(found, k), axis=1)[:, None]
            assert np.linalg.norm(directions.sum(0)) < 0.05
        assert found.off_m[k] == pytest.approx(np.linalg.norm(BIAS_M[k] - shift_m(found)), abs=1e-3)
    assert turn_deg(found) < 1e-3


@pytest.mark.parametrize("sigma_m", [0.05, 1.0])
def test_one_receiver_that_is_far_off_moves_little(sigma_m: float) -> None:
    bias_m = np.array([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [8.0, -6.0, 3.0]])
    found = of_receivers(bias_m, [sigma_m] * 3)
    assert 0 < np.linalg.norm(shift_m(found)) < 0.3
    assert found.sigmas > 4.0


@pytest.mark.parametrize("certain", [0, 1])
def test_a_certain_receiver_is_not_moved_by_an_uncertain_one(certain: int) -> None:
    """The place of a scene known to centimetres was the mean of it and of a receiver that is off by its metres."""
    bias_m, sigma_m = np.zeros((2, 3)), [4.0, 4.0]
    bias_m[1 - certain], sigma_m[certain] = [3.0, 2.0, -3.0], 0.03
    found = of_receivers(bias_m, sigma_m)
    assert np.linalg.norm(shift_m(found)) < 3 * 0.03
    assert found.off_m[1 - certain] == pytest.approx(np.linalg.norm(bias_m), abs=0.1)
    assert found.sigmas < 2.0


def test_a_certain_receiver_among_uncertain_ones() -> None:
    bias_m = np.array([[3.0, 2.0, -3.0], [0.02, 0.0, 0.01], [2.0, 3.0, 1.0]])
    found = of_receivers(bias_m, [4.0, 0.03, 4.0])
    assert np.linalg.norm(shift_m(found)) < 3 * 0.03


def test_a_receiver_that_is_wrongly_certain_counts_no_more_than_others() -> None:
    """Where sigmas do not explain how far receivers are apart, they are no reason to follow one of them."""
    bias_m = np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 0.0], [0.1, 0.0, 0.0]])
    two = of_receivers(bias_m[:2], [0.4, 0.01])
    assert np.linalg.norm(shift_m(two) - bias_m[:2].mean(0)) < 0.2
    assert two.sigmas > 4.0
    three = of_receivers(bias_m, [0.4, 0.01, 0.4])
    assert np.linalg.norm(shift_m(three)) < 0.5


def test_each_direction_counts_by_its_own_sigma() -> None:
    found = of_receivers(np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 0.0]]), [[0.05, 0.05, 3.0], [2.0, 2.0, 0.1]])
    np.testing.assert_allclose(shift_m(found), 0.0, atol=0.03)


def test_a_long_scene_tells_the_direction_and_a_short_one_hardly() -> None:
    """A scene of four units was as much heard as one of a hundred: it could turn the map by its own six degrees."""
    for turned_deg, spread_m in (((0.0, 6.0), (60.0, 2.0)), ((6.0, 0.0), (2.0, 60.0))):
        found = of_receivers(np.zeros((2, 3)), [0.5, 0.5], spread_m=spread_m, turned_deg=turned_deg)
        assert turn_deg(found) < 0.1


def test_scenes_that_state_no_sigma_count_as_the_most_uncertain_one() -> None:
    bias_m = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    known = of_receivers(bias_m, [0.01, np.nan])
    np.testing.assert_allclose(shift_m(known), bias_m.mean(0), atol=1e-3)
    np.testing.assert_allclose(shift_m(of_receivers(bias_m, [np.nan, np.nan])), bias_m.mean(0), atol=1e-3)
    assert of_receivers(bias_m[:1], [np.nan]).sigmas == 0.0


def test_estimates_that_are_the_same_agree() -> None:
    same = np.tile([1.0, -2.0, 3.0], (4, 1))
    covariances = np.stack([np.eye(3) * s**2 for s in (0.01, 1.0, 2.0, 0.5)])
    np.testing.assert_allclose(agreed_value(same, covariances), same[0], atol=1e-9)
