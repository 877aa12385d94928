"""Routes whose descriptors lie on disk: matched and mapped as drives are, in one piece and in sub-maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.benchmark.mapping import simulated_run
from mrasfm_engine.benchmark.scaling import measure_growth
from mrasfm_engine.benchmark.side_by_side import Settings
from mrasfm_engine.benchmark.simulated_descriptors import SimulatedImages
from mrasfm_engine.benchmark.simulated_drive import drive_of_route
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.io.stage_store import StageStore
from mrasfm_engine.scene.submaps import Span
from mrasfm_engine.stages import SubmapRun
from mrasfm_engine.synthetic.long_route import simulate_long_route
from schemas.artifacts import Stage

KEYPOINTS = 600


def test_an_image_has_the_same_descriptors_at_every_use_and_its_points_look_alike_from_elsewhere() -> None:
    route = simulate_long_route("stereo", 3)
    images = SimulatedImages(route, keypoints=KEYPOINTS, seed=0)
    first, again, next_unit = images[0], images[0], images[2]
    assert len(first.xy_px) == KEYPOINTS
    np.testing.assert_array_equal(first.descriptors, again.descriptors)
    lengths = np.linalg.norm(first.descriptors.astype(float), axis=1)
    np.testing.assert_allclose(lengths, 512.0, atol=8.0)
    cosine = first.descriptors.astype(float) @ next_unit.descriptors.T.astype(float) / 512.0**2
    common = len(np.intersect1d(route.point[0], route.point[2]))
    assert common > 100
    best, second = -np.sort(-cosine, axis=1)[:, :2].T
    is_distinct = (1.0 - best) < 0.8**2 * (1.0 - second)
    assert abs(int(is_distinct.sum()) - common) < 0.05 * common


def test_sub_maps_of_a_route_need_no_files(tmp_path: Path) -> None:
    drive = drive_of_route("stereo", simulate_long_route("stereo", 12), tmp_path)
    run = simulated_run(lambda stage, done, total: None, drive, EngineConfig(), StageStore(tmp_path))
    part = SubmapRun(run, Span(number=1, first=0, last=6)).run
    assert part.repeated == run.repeated == frozenset()
    assert part.next_key(Stage.FEATURES, None) != run.next_key(Stage.FEATURES, None)


@pytest.mark.slow
@pytest.mark.parametrize(("units", "submaps"), [(10, 1), (20, 2)])
def test_a_route_is_matched_and_mapped_from_descriptors(tmp_path: Path, units: int, submaps: int) -> None:
    config = EngineConfig.model_validate(
        {
            "threads": 1,
            "features": {"max_keypoints": KEYPOINTS},
            "submaps": {"count": submaps, "overlap_units": 6},
        }
    )
    route = measure_growth("stereo", [units], 0, tmp_path, Settings(config=config), descriptors=True)[0]
    ours = route.rows[0].row
    assert ours.failure == ""
    assert (ours.submaps, ours.registered_units, route.keypoints) == (submaps, units, 2 * units * KEYPOINTS)
    assert ours.errors is not None
    assert 0 < ours.errors.metric_rmse_m < 0.02
    assert ours.matching_s is not None
    assert ours.matching_s > 0
    assert ours.verified_matches is not None
    assert ours.verified_matches > 50 * units


def test_baselines_and_repetitions_are_refused_with_descriptors(tmp_path: Path) -> None:
    for settings in (
        Settings(config=EngineConfig(), baselines=["colmap-global"]),
        Settings(config=EngineConfig(), repeat=2),
    ):
        with pytest.raises(InputError, match="--descriptors does not go with"):
            measure_growth("stereo", [10], 0, tmp_path, settings, descriptors=True)
