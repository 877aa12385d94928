from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import PairConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.matching import retrieval
from mrasfm_engine.matching.image_motion import Motion
from mrasfm_engine.matching.pair_selection import REVISIT_PATH_M
from mrasfm_engine.matching.retrieval import revisit_pairs as revisits_of_motion
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures
from tests.helpers.simulated_drive import make_drive, random_descriptors

UNITS, WORDS = 40, 60
STEP_M = 1.7
MIN_GAP_UNITS = 12  # so many steps are more than REVISIT_PATH_M


def revisit_pairs(
    drive: Drive, features: list[ImageFeatures], config: PairConfig, step_m: float = STEP_M
) -> np.ndarray:
    motion = Motion.from_travelled(drive, step_m * np.arange(len(drive.timestamps_us)))
    return revisits_of_motion(drive, features, config, motion)


def drive_of(cameras: int, units: int = UNITS) -> Drive:
    pose = np.tile(np.eye(4), (cameras, 1, 1))
    return make_drive(pose, np.tile([500.0, 500.0, 480.0, 270.0], (cameras, 1)), units=units)


def features_of(places: list[int], cameras: int, *, seed: int = 0, empty: int | None = None) -> list[ImageFeatures]:
    """Views of places along a street: neighbours share most of what they see, the cameras see different sides."""
    rng = np.random.default_rng(seed)
    street = {c: random_descriptors((max(places) + 1) * 12 + WORDS, rng) for c in range(cameras)}
    result = []
    for place in places:
        for c in range(cameras):
            d = street[c][place * 12 : place * 12 + WORDS]
            d = np.clip(d.astype(int) + rng.integers(-8, 9, d.shape), 0, 255).astype(np.uint8)
            if empty == len(result):
                d = d[:0]
            result.append(
                ImageFeatures(
                    xy_px=np.zeros((len(d), 2), np.float32), descriptors=d, colors=np.zeros((len(d), 3), np.uint8)
                )
            )
    return result


def places_of_a_loop() -> list[int]:
    """The last ten units are where the first ten were."""
    return [*range(30), *range(10)]


@pytest.mark.parametrize("cameras", [1, 2])
def test_a_place_seen_again_is_found(cameras: int) -> None:
    drive = drive_of(cameras)
    pairs = revisit_pairs(drive, features_of(places_of_a_loop(), cameras), PairConfig(revisit_pairs_per_unit=2))
    unit = np.array([i.unit for i in drive.images])[pairs]
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert ((unit[:, 1] - unit[:, 0]) >= MIN_GAP_UNITS).all()
    exact = {(a, a + 30) for a in range(10)}
    assert exact <= set(map(tuple, unit.tolist()))
    near = np.abs(unit[:, 1] - 30 - unit[:, 0]) <= 3
    assert near.mean() > 0.6
    assert len(pairs) <= UNITS * 2 * (1 + cameras)


def test_where_units_pair_all_their_cameras_do() -> None:
    drive = drive_of(3)
    pairs = revisit_pairs(drive, features_of(places_of_a_loop(), 3), PairConfig(revisit_pairs_per_unit=1))
    images = drive.images
    found = {
        (images[a].unit, images[b].unit, images[a].camera) for a, b in pairs if images[a].camera == images[b].camera
    }
    assert all((5, 35, c) in found for c in range(3))


def test_a_drive_that_never_returns_has_few_candidates() -> None:
    drive = drive_of(1)
    config = PairConfig(revisit_pairs_per_unit=3)
    loop = revisit_pairs(drive, features_of(places_of_a_loop(), 1), config)
    straight = revisit_pairs(drive, features_of(list(range(UNITS)), 1), config)
    assert len(straight) < 0.5 * len(loop)


def test_switched_off_or_too_short() -> None:
    assert revisit_pairs(
        drive_of(1), features_of(places_of_a_loop(), 1), PairConfig(revisit_pairs_per_unit=0)
    ).shape == (
        0,
        2,
    )
    short = drive_of(1, MIN_GAP_UNITS)
    assert revisit_pairs(short, features_of(list(range(MIN_GAP_UNITS)), 1), PairConfig()).shape == (0, 2)


def test_an_image_without_keypoints_is_no_trouble() -> None:
    drive = drive_of(1)
    pairs = revisit_pairs(drive, features_of(places_of_a_loop(), 1, empty=35), PairConfig())
    assert not (pairs == 35).any()
    assert len(pairs) > 5


def test_the_same_drive_gives_the_same_pairs() -> None:
    drive, features = drive_of(1), features_of(places_of_a_loop(), 1)
    a, b = (revisit_pairs(drive, features, PairConfig()) for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_a_networks_descriptors_find_the_place_again_too() -> None:
    drive, unit_pairs = drive_of(1), {(a, a + 30) for a in range(10)}
    features = [
        replace(f, descriptors=(f.descriptors / 512.0).astype(np.float32)) for f in features_of(places_of_a_loop(), 1)
    ]
    pairs = revisit_pairs(drive, features, PairConfig(revisit_pairs_per_unit=2))
    assert unit_pairs <= set(map(tuple, pairs.tolist()))


def test_neighbours_along_the_path_are_no_revisits_at_any_rate() -> None:
    """The same drive at a tenth of the step is near itself everywhere, at ten times the step nowhere but in windows."""
    drive, features = drive_of(1), features_of(places_of_a_loop(), 1)
    assert UNITS * 0.17 < REVISIT_PATH_M
    assert len(revisit_pairs(drive, features, PairConfig(), step_m=0.17)) == 0
    unit = np.array([i.unit for i in drive.images])[revisit_pairs(drive, features, PairConfig(), step_m=17.0)]
    assert (unit[:, 1] - unit[:, 0]).min() > PairConfig().window_units
    assert {(a, a + 30) for a in range(10)} <= set(map(tuple, unit.tolist()))


@pytest.mark.parametrize("cameras", [1, 2])
def test_few_directions_find_what_all_do(cameras: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A long drive has more images than directions: the candidates they give have to hold the most alike images."""
    drive, features = drive_of(cameras), features_of(places_of_a_loop(), cameras)
    exact = revisit_pairs(drive, features, PairConfig(revisit_pairs_per_unit=2))
    monkeypatch.setattr(retrieval, "DIRECTIONS", 8)
    monkeypatch.setattr(retrieval, "SAMPLED_VECTORS", 16)
    monkeypatch.setattr(retrieval, "SHORTLIST", 4)
    few = revisit_pairs(drive, features, PairConfig(revisit_pairs_per_unit=2))
    unit = np.array([i.unit for i in drive.images])
    assert {(a, a + 30) for a in range(10)} <= set(map(tuple, unit[few].tolist()))
    common = set(map(tuple, few.tolist())) & set(map(tuple, exact.tolist()))
    assert len(common) > 0.9 * len(exact)


def test_memory_of_an_image_is_a_quarter_of_its_vector() -> None:
    features = features_of(places_of_a_loop(), 1)
    index = retrieval.ImageIndex.from_features(features)
    centres = retrieval._vocabulary(features)
    vectors = np.stack([retrieval._vlad(found, centres) for found in features])
    assert index.codes.nbytes == vectors.nbytes // 4
    everything = np.arange(len(features))
    likeness = np.stack([index.likeness(i, everything) for i in everything.tolist()])
    np.testing.assert_allclose(likeness, vectors @ vectors.T, atol=2e-3)
    np.testing.assert_allclose(index.directions @ index.directions.T, vectors @ vectors.T, atol=2e-3)


def test_the_index_is_made_until_it_is_cancelled() -> None:
    asked = iter([False, False, True])
    with pytest.raises(CancelledError):
        retrieval.ImageIndex.from_features(features_of(places_of_a_loop(), 1), cancel=lambda: next(asked))
    assert next(asked, None) is None
