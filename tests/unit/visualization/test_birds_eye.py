"""Pictures that cannot be drawn say why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.visualization.agreement import Agreement, why_not_better
from mrasfm_engine.visualization.birds_eye import EMPTY, MIN_SECOND_SHARE, birds_eye, chequerboard
from mrasfm_engine.visualization.drawing import framed
from mrasfm_engine.visualization.mosaic import Grid, Mosaic
from mrasfm_engine.visualization.views import REFINED
from tests.helpers.export_example import make_scene

LENSES = {"PINHOLE": 0, "OPENCV": 4}  # number of parameters besides focal lengths and principal point


def test_a_scene_without_ground_is_not_drawn() -> None:
    drawn = birds_eye(make_scene())
    assert drawn.pictures == {}
    assert "ground" in drawn.report["not_drawn"]


def test_a_scene_without_units_is_not_drawn() -> None:
    scene = make_scene()
    scene.unit_registered[:] = False
    assert birds_eye(scene).report == {"not_drawn": "no unit is registered"}


def test_ground_that_no_image_shows_finely_is_not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras see it from 9 m on, as in small images that end a little below the horizon."""
    rng = np.random.default_rng(0)
    on_ground = np.column_stack([rng.uniform(-5, 20, 4000), rng.uniform(-6, 6, 4000), rng.normal(0, 0.01, 4000)])
    image = np.full((600, 960, 3), 90, np.uint8)
    monkeypatch.setattr("mrasfm_engine.visualization.birds_eye.read_view", lambda scene, index: (image, None))
    for focal_px, middle_px, drawn in ((800.0, 300.0, True), (200.0, 565.0, False)):
        models = {model: [focal_px, focal_px, 480.0, middle_px, *[0.0] * extra] for model, extra in LENSES.items()}
        report = birds_eye(replace(make_scene(models=models), points_m=on_ground)).report
        assert ("not_drawn" not in report) == drawn
    assert "by 5 pixels a metre" in report["not_drawn"]


def test_the_frame_keeps_the_picture_and_draws_a_scale_of_the_right_length() -> None:
    picture = np.full((400, 1000, 3), 120, np.uint8)
    out = framed(picture, ["one", "two"], cell_m=0.025, arrows=[("drive", (1.0, 0.0))])
    np.testing.assert_array_equal(out.picture[out.top_px : out.top_px + 400, :1000], picture)
    below = out.picture[out.top_px + 400 :]
    longest = max((row.min(axis=1) < 60).sum() for row in below[:, :500])
    assert 198 <= longest <= 206  # 5 m: the longest round length within a quarter of the width


def test_the_frame_is_as_wide_as_the_longest_line_and_that_of_the_other_picture() -> None:
    picture = np.full((400, 700, 3), 120, np.uint8)
    long = "1 pixel = 0.01 m, " + "tiles of 2 m alternate between the two best cameras; " * 3 + "displacement 2.5 cm"
    out = framed(picture, ["title", long], cell_m=0.01, arrows=[("drive", (1.0, 0.0))])
    assert out.picture.shape[1] > 1000
    heading = out.picture[: out.top_px]
    assert (heading[:, -9:] == 255).all(), "no line reaches the edge"
    assert (heading[:, -40:] < 128).any(), "and the longest ends near it"
    np.testing.assert_array_equal(out.picture[out.top_px : out.top_px + 400, :700], picture)
    other = framed(picture, ["title", "short"], cell_m=0.01, arrows=[], lines_of_other=["title", long])
    assert (other.picture.shape, other.top_px) == (out.picture.shape, out.top_px)


def test_tiles_alternate_between_the_two_best_cameras_and_are_equally_bright() -> None:
    grid = Grid(left_m=0.0, top_m=0.0, cell_m=0.5, rows=40, columns=50)  # tiles of 16 cells
    owner = np.zeros((2, 40, 50), np.uint8)
    owner[0, 3:, :45], owner[1, 3:, :45] = 1, 2
    owner[1, :, 33:] = 0  # only one camera sees the ground there
    score = np.zeros((2, 40, 50), np.float32)
    score[0], score[1] = 40.0, 20.0
    score[1, 32:] = 0.9 * MIN_SECOND_SHARE * 40.0  # too coarse beside the best
    color = np.zeros((2, 2, 40, 50, 3), np.uint8)
    color[REFINED, 0], color[REFINED, 1] = (60, 80, 100), (30, 40, 200)
    mosaic = Mosaic(grid=grid, owner=owner, score=score, color=color, images_used=2)
    owner[0, 20, 20] = owner[1, 20, 20] = 0
    shown = chequerboard(mosaic, REFINED, np.array([1.0, 1.5]))
    first, second = (60, 80, 100), (45, 60, 255)
    assert shown.shape == (37, 45, 3), "cut to what is seen"
    tiles = {(0, 0): first, (0, 16): second, (13, 0): second, (13, 16): first, (13, 33): first, (29, 16): first}
    for (row, column), seen in tiles.items():
        assert (shown[row : row + 3, column : column + 4] == seen).all(), (row, column)
    assert tuple(shown[17, 20]) == EMPTY
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) == 3


def agreement_of(correlations: np.ndarray) -> Agreement:
    return Agreement(correlations=correlations, displaced_blocks=0, displacement_m=float("nan"))


def test_the_report_says_why_the_views_do_not_agree_better() -> None:
    rng = np.random.default_rng(1)
    poor, good = rng.normal(0.7, 0.05, 200), rng.normal(0.95, 0.02, 200)

    def reason(given: np.ndarray, refined: np.ndarray, *, changed: bool = True) -> str | None:
        return why_not_better(agreement_of(given), agreement_of(refined), changed=changed)

    assert reason(poor, poor + 0.2) is None
    assert reason(good, good + 0.01) is None  # pieces of ground are paired: a small difference is seen
    assert reason(poor, poor, changed=False) == "the calibration was held"
    assert "standard errors" in str(reason(poor, rng.permutation(poor)))
    assert "fits the points of the scene" in str(reason(good, poor))
    assert "agree well with both" in str(reason(good, good - 0.02))
    moving = np.where(np.arange(200) % 2 == 0, 0.1, poor)
    assert "moves or stands" in str(reason(moving, moving - 0.2))
