from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from mrasfm_engine.scene.submaps import count_for_memory, count_for_workers, count_in_rounds, cut, share_a_submap
from tests.helpers.simulated_drive import make_simulated_drive


@pytest.mark.parametrize(("units", "count", "overlap"), [(150, 4, 10), (151, 7, 10), (6000, 12, 10), (20, 3, 4)])
def test_sub_maps_cover_the_drive_and_share_units_with_their_neighbours(units: int, count: int, overlap: int) -> None:
    spans = cut(units, count, overlap)
    assert [span.number for span in spans] == list(range(1, count + 1))
    assert (spans[0].first, spans[-1].last) == (0, units - 1)
    lengths = {len(span.units) for span in spans}
    assert max(lengths) - min(lengths) <= 1
    for before, after in pairwise(spans):
        assert before.last - after.first + 1 == before.shared_after == after.shared_before == overlap
    for span in spans:
        shared = span.units[span.is_shared].tolist()
        others = [unit for other in spans if other is not span for unit in other.units.tolist()]
        assert shared == sorted(set(others) & set(span.units.tolist()))


def test_no_unit_is_in_three_sub_maps() -> None:
    spans = cut(50, 100, 10)
    assert len(spans) == 4
    assert max(np.bincount(np.concatenate([span.units for span in spans]))) == 2


@pytest.mark.parametrize("units", [0, 1, 9, 10, 11, 19, 29])
def test_a_drive_too_short_for_two_is_one_piece(units: int) -> None:
    (span,) = cut(units, 5, 10)
    assert len(span.units) == units


@pytest.mark.parametrize(
    ("units", "workers", "count"),
    [
        (600, 2, 2),
        (600, 100, 14),  # of at least 250 images
        (600, 0, 1),
        (69, 8, 1),
        (190, 8, 4),
    ],
)
def test_workers_get_sub_maps_that_are_worth_it(units: int, workers: int, count: int) -> None:
    drive = make_simulated_drive(units=units, cameras=6, points=50).drive
    assert count_for_workers(drive, workers, overlap=10) == count


@pytest.mark.parametrize(
    ("for_memory", "for_workers", "count"), [(5, 1, 5), (1, 4, 4), (4, 4, 4), (5, 4, 8), (9, 4, 12), (3, 14, 14)]
)
def test_no_worker_waits_for_a_last_round_of_few_sub_maps(for_memory: int, for_workers: int, count: int) -> None:
    assert count_in_rounds(for_memory, for_workers) == count


def test_memory_decides_in_how_many_parts_a_drive_is_cut() -> None:
    drive = make_simulated_drive(units=10, cameras=4, points=50).drive
    one = count_for_memory(drive, keypoints_per_image=2048, memory_bytes=1e9)
    half = count_for_memory(drive, keypoints_per_image=2048, memory_bytes=40 * 2048 * 100 / 2)
    assert (one, half) == (1, 2)


def test_pairs_of_units_that_a_sub_map_has_both_of() -> None:
    spans = cut(20, 2, 4)  # 0 to 11 and 8 to 19
    a, b = np.array([0, 11, 7, 8, 12, 19, 3]), np.array([11, 0, 12, 12, 7, 8, 3])
    assert share_a_submap(spans, a, b).tolist() == [True, True, False, True, False, True, True]
