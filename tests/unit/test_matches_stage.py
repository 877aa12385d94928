"""The stage of the matches: what it stores, and findings that it leaves in its report."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.stages._matches import pack_pairs, require_matches, unpack_pairs

FOUND = {"code": "cameras-backwards"}


@pytest.mark.parametrize(
    ("stored", "findings"),
    [({}, []), ({"exchanged_cameras": None}, []), ({"exchanged_cameras": FOUND}, [FOUND])],
    ids=["of an earlier installation", "none", "one"],
)
def test_exchanged_cameras_are_among_the_findings(stored: dict[str, Any], findings: list[Any]) -> None:
    run: Any = SimpleNamespace(report={"findings": []})
    require_matches(run, {"contradiction": None, "verified_pairs": 1, **stored})
    assert run.report["findings"] == findings


def test_pairs_are_stored_whole() -> None:
    rng = np.random.default_rng(0)
    pairs = [
        PairMatches(
            image_a=a,
            image_b=b,
            matches=rng.integers(0, 99, (n, 2)).astype(np.int32),
            inliers=rng.random(n) < 0.5,
            is_revisit=is_revisit,
            essential=essential,
        )
        for a, b, n, is_revisit, essential in ((0, 1, 20, False, rng.random((3, 3))), (0, 7, 0, True, None))
    ]
    for stored, pair in zip(unpack_pairs(pack_pairs(pairs)), pairs, strict=True):
        assert (stored.image_a, stored.image_b, stored.is_revisit) == (pair.image_a, pair.image_b, pair.is_revisit)
        np.testing.assert_array_equal(stored.matches, pair.matches)
        np.testing.assert_array_equal(stored.inliers, pair.inliers)
        np.testing.assert_array_equal(stored.essential, pair.essential)
    assert unpack_pairs(pack_pairs([])) == []
