"""Steps of the change over time: of two surfaces, and of few images alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mrasfm_engine.features import static_outline
from mrasfm_engine.features.static_outline import StaticEdges

SHAPE = (120, 160)
DETAIL_PX = 2.0  # sigma: neighbours change alike, so that chance looks like surfaces


def edges(changes: np.ndarray, count: int) -> StaticEdges:
    """Edges where nothing but the changes (2, h, w) tells surfaces apart, on ground near everywhere."""
    return StaticEdges.from_sums(
        np.zeros((4, 2, *SHAPE, 3), np.float32),
        np.ones(SHAPE, np.float32),
        changes,
        count,
        fall=np.full(SHAPE, 0.3),
        flow=np.tile([0.0, 1.0], (*SHAPE, 1)),
    )


def seen(of_upper: float, of_lower: float, count: int) -> np.ndarray:
    """Changes (2, h, w) that halves of some images show of two surfaces, the upper 60 rows and what is below."""
    change = np.where(np.arange(SHAPE[0])[:, None] < 60, of_upper, of_lower)
    rng = np.random.default_rng(count)
    frames = [cv2.GaussianBlur(rng.normal(0.0, 1.0, SHAPE), (0, 0), DETAIL_PX) for _ in range(count)]
    frames = [change * frame / np.std(frame) for frame in frames]
    return np.asarray([np.std(frames[k::2], axis=0) for k in range(2)], dtype=np.float32)


@pytest.mark.parametrize("count", [12, 16, 30, 64])
def test_a_few_images_alone_make_no_step(count: int) -> None:
    assert (edges(seen(0.2, 0.2, count), count).step > 0).mean() < 0.01


def test_without_that_they_make_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(static_outline, "STEP_SIGMAS", 0.0)
    assert (edges(seen(0.2, 0.2, 12), 12).step > 0).mean() > 0.2


def test_pixels_that_never_change_tell_nothing_of_the_others() -> None:
    changes = seen(0.2, 0.2, 12)
    changes[:, :, :100] = 0.0
    assert (edges(changes, 12).step[:, 110:] > 0).mean() < 0.01


@pytest.mark.parametrize("count", [12, 16, 30, 64])
def test_a_surface_that_changes_by_a_quarter_makes_one(count: int) -> None:
    step = edges(seen(0.4, 0.1, count), count).step
    assert (step[58:62, 5:-5].max(0) > 0.3).mean() > 0.9
    assert (step[:50] > 0).mean() < 0.02


def test_with_many_images_half_of_the_change_is_a_step() -> None:
    step = edges(seen(0.2, 0.1, 64), 64).step
    assert (step[58:62, 5:-5].max(0) > 0).mean() > 0.95
