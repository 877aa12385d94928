from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.observability_analysis import assess_directions

PLACES = np.array([[1.7, 0.0, 1.5], [1.5, 0.5, 1.5], [1.5, -0.5, 1.5], [0.0, 0.0, 1.6]])
SIGMA_RAD, SIGMA_M = np.full(4, np.radians(0.5)), np.full(4, 0.02)


def posterior(known: list[np.ndarray], *, sigma: float = 0.01, cameras: int = 4) -> np.ndarray:
    """Covariance of all corrections under the prior and the held mean, with measured functionals of whitened ones."""
    information = np.eye(6 * cameras) + 1e6 * np.kron(np.ones((cameras, cameras)), np.eye(6))
    for functional in known:
        information += np.outer(functional, functional) / sigma**2
    scale = np.concatenate([np.r_[[s] * 3, [t] * 3] for s, t in zip(SIGMA_RAD, SIGMA_M, strict=True)])[: 6 * cameras]
    return np.linalg.inv(information) * np.outer(scale, scale)


def growth(places: np.ndarray) -> np.ndarray:
    result = np.zeros((len(places), 6))
    result[:, 3:] = (places - places.mean(0)) / SIGMA_M[: len(places), None]
    return result.ravel()


def everything_but(*hidden: np.ndarray, cameras: int = 4) -> list[np.ndarray]:
    """All directions of the corrections that are orthogonal to the hidden ones, and to what all cameras share."""
    common = np.kron(np.ones((cameras, 1)), np.eye(6))
    q, _ = np.linalg.qr(np.column_stack([common, *hidden, np.eye(6 * cameras)]))
    return list(q[:, 6 + len(hidden) : 6 * cameras].T)


def axis(camera: int, direction: int) -> np.ndarray:
    result = np.zeros((4, 6))
    result[camera, direction] = 1.0
    return result.ravel()


def judge(covariance: np.ndarray, cameras: int = 4, *, placed: bool = True, left: np.ndarray | None = None):  # type: ignore[no-untyped-def]
    return assess_directions(
        covariance,
        position_m=PLACES[:cameras],
        sigma_rotation_rad=SIGMA_RAD[:cameras],
        sigma_translation_m=SIGMA_M[:cameras],
        placed=placed,
        sigma_left=left,
    )


def test_without_data_nothing_is_observed_though_the_mean_is_held() -> None:
    """The held mean alone makes the sigmas smaller than the prior's: that is no observation."""
    found = judge(posterior([]))
    np.testing.assert_allclose(found.ratio, 1.0, atol=1e-3)
    assert not found.observed.any()
    assert not found.scale_observed
    assert found.sigma_scale == pytest.approx(found.prior_sigma_scale, rel=1e-3)


def test_images_observe_all_but_the_scale() -> None:
    found = judge(posterior(everything_but(growth(PLACES))))
    assert found.observed.all()
    assert 0 < found.ratio.max() < 0.1
    assert not found.scale_observed
    # The last camera's place along x is the largest part of the scale: its own sigma is still far from zero.
    sigma = np.sqrt(np.diagonal(posterior(everything_but(growth(PLACES))))).reshape(4, 6)
    assert sigma[3, 3] > 0.5 * SIGMA_M[0]


def test_positions_that_know_the_scale_are_said_to() -> None:
    found = judge(posterior([*everything_but(growth(PLACES)), growth(PLACES) / np.linalg.norm(growth(PLACES))]))
    assert found.scale_observed
    assert found.observed.all()
    assert 0 < found.sigma_scale < 0.05 * found.prior_sigma_scale


def test_without_positions_nothing_but_the_prior_knows_the_scale() -> None:
    """A posterior of images that contradict the baselines may come out smaller than their prior."""
    found = judge(posterior([growth(PLACES) / np.linalg.norm(growth(PLACES))]), placed=False)
    assert not found.scale_observed
    assert found.scale_in_words == "only the prior"


@pytest.mark.parametrize(("camera", "direction"), [(1, 5), (2, 0), (0, 4)])
def test_the_one_direction_that_is_not_observed_is_named(camera: int, direction: int) -> None:
    found = judge(posterior(everything_but(growth(PLACES), axis(camera, direction))))
    expected = np.ones((4, 6), dtype=np.bool_)
    expected[camera, direction] = False
    np.testing.assert_array_equal(found.observed, expected)


@pytest.mark.parametrize(("sigma", "held"), [(10.0, True), (1.0, False)])
def test_only_what_the_drive_says_nothing_of_is_held(sigma: float, held: bool) -> None:
    """One camera's height, measured ten times worse than the prior knows it, or as well; neither is observed."""
    information = np.linalg.inv(posterior(everything_but(growth(PLACES), axis(1, 5))))
    direction = axis(1, 5) / np.tile(np.r_[[SIGMA_RAD[0]] * 3, [SIGMA_M[0]] * 3], 4)
    found = judge(np.linalg.inv(information + np.outer(direction, direction) / sigma**2))
    assert not found.observed[1, 5]
    expected = np.zeros((4, 6), dtype=np.bool_)
    expected[1, 5] = held
    np.testing.assert_array_equal(found.to_hold, expected)


def test_the_baseline_of_two_cameras_is_their_scale() -> None:
    hidden = growth(PLACES[[1, 2]])
    covariance = posterior(everything_but(hidden, cameras=2), cameras=2)
    found = assess_directions(
        covariance,
        position_m=PLACES[[1, 2]],
        sigma_rotation_rad=SIGMA_RAD[:2],
        sigma_translation_m=SIGMA_M[:2],
        placed=True,
    )
    expected = np.ones((2, 6), dtype=np.bool_)
    expected[:, 4] = False
    np.testing.assert_array_equal(found.observed, expected)
    assert np.isnan(found.ratio[:, 4]).all()


def test_baselines_that_their_prior_let_go_of_are_not_as_long_as_given() -> None:
    """Positions tell the scale here, to less than the prior of baselines that are far longer than given says it."""
    covariance = posterior(everything_but(growth(PLACES[[1, 2]]), cameras=2), cameras=2)

    def only_prior(weight: float) -> bool:
        return assess_directions(
            covariance,
            position_m=PLACES[[1, 2]],
            sigma_rotation_rad=SIGMA_RAD[:2],
            sigma_translation_m=SIGMA_M[:2],
            placed=True,
            weight=np.full(2, weight),
        ).scale_only_prior

    assert only_prior(1.0)
    assert not only_prior(1e-3)


@pytest.mark.parametrize(("times", "observed"), [(1.0, False), (10.0, True)])
def test_what_the_loss_has_let_go_is_not_what_the_prior_says(times: float, observed: bool) -> None:
    """One camera's place as uncertain as declared: observed, where the loss has left ten times that."""
    left = np.tile([*[SIGMA_RAD[0]] * 3, *[SIGMA_M[0]] * 3], (4, 1))
    left[1] *= times
    found = judge(posterior(everything_but(growth(PLACES), axis(1, 5))), left=left)
    assert found.observed[1, 5] == observed
    assert found.to_hold[1, 5] == (not observed)
    np.testing.assert_array_equal(found.prior_sigma, left)


def test_what_nothing_determines_is_not_observed() -> None:
    covariance = posterior([])
    covariance[5, 5] = np.inf
    assert not judge(covariance).observed.any()
