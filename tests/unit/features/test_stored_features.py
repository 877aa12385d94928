from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.features import stored_features
from mrasfm_engine.features.stored_features import FeatureWriter, JoinedFeatures, StoredFeatures
from mrasfm_engine.io.stage_store import StageStore
from mrasfm_engine.scene.drive import LeftOut
from mrasfm_engine.scene.scene import ImageFeatures

KINDS = ("xy_px", "descriptors", "colors", "classes", "scores", "made_mask")


def an_image(count: int, rng: np.random.Generator, *, network: bool, mask: bool) -> ImageFeatures:
    return ImageFeatures(
        xy_px=rng.random((count, 2), np.float32),
        descriptors=rng.random((count, 64), np.float32)
        if network
        else rng.integers(0, 256, (count, 128), dtype=np.uint8),
        colors=rng.integers(0, 256, (count, 3), dtype=np.uint8),
        classes=rng.integers(0, 9, count, dtype=np.uint8),
        scores=rng.random(count, np.float32) if network else None,
        made_mask=rng.integers(0, 256, int(rng.integers(1, 50)), dtype=np.uint8) if mask else None,
    )


@pytest.mark.parametrize("network", [False, True])
@pytest.mark.parametrize("window_bytes", [1, 20_000, 1 << 25])
def test_features_come_back_as_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, network: bool, window_bytes: int
) -> None:
    monkeypatch.setattr(stored_features, "WINDOW_BYTES", window_bytes)
    rng, store = np.random.default_rng(0), StageStore(tmp_path)
    counts = [None, 30, 0, 200, None, None, 1, 70, 0, None]
    given = [
        LeftOut.TRUNCATED if n is None else an_image(n, rng, network=network, mask=i % 3 == 0)
        for i, n in enumerate(counts)
    ]
    with store.writing("features", "key") as stage:
        writer = FeatureWriter(stage)
        for found in given:
            writer.add(found)
        writer.finish()
        stage.finish({})
    opened = store.open("features", "key")
    assert opened is not None
    read = StoredFeatures(opened, [LeftOut.TRUNCATED if n is None else None for n in counts])
    assert len(read) == len(given)
    assert read.counts.tolist() == [n or 0 for n in counts]
    width = 64 if network else 128
    for found, expected in zip(read, given, strict=True):
        if isinstance(expected, LeftOut):
            assert found.left_out == expected
            assert found.xy_px.shape == (0, 2)
            assert found.descriptors.shape == (0, width)
            assert found.descriptors.dtype == (np.float32 if network else np.uint8)
            assert found.made_mask is None
            continue
        assert found.left_out is None
        for kind in KINDS:
            a, b = getattr(found, kind), getattr(expected, kind)
            assert (a is None) == (b is None), kind
            if b is not None:
                np.testing.assert_array_equal(a, b)
                assert a.dtype == b.dtype
    np.testing.assert_array_equal(read[-3].xy_px, read[7].xy_px)
    assert [len(found.xy_px) for found in read[1:4]] == [30, 0, 200]
    rows = read.rows("descriptors", 3, 5)
    assert rows is not None
    np.testing.assert_array_equal(rows, read[3].descriptors[:5])
    with pytest.raises(IndexError):
        read[len(given)]


def test_all_images_left_out(tmp_path: Path) -> None:
    store = StageStore(tmp_path)
    with store.writing("features", "key") as stage:
        writer = FeatureWriter(stage)
        writer.add(LeftOut.CORRUPT)
        writer.finish()
        stage.finish({})
    opened = store.open("features", "key")
    assert opened is not None
    (found,) = StoredFeatures(opened, [LeftOut.CORRUPT])
    assert found.descriptors.shape == (0, 128)


def stored(folder: Path, given: list[ImageFeatures | LeftOut], name: str) -> StoredFeatures:
    store = StageStore(folder)
    with store.writing(name, "key") as stage:
        writer = FeatureWriter(stage)
        for found in given:
            writer.add(found)
        writer.finish()
        stage.finish({})
    opened = store.open(name, "key")
    assert opened is not None
    return StoredFeatures(opened, [found if isinstance(found, LeftOut) else None for found in given])


def test_features_of_sub_maps_are_those_of_the_drive(tmp_path: Path) -> None:
    """Images 3 and 4 are in both, image 7 was left out, and the third file has no keypoint at all."""
    rng = np.random.default_rng(1)
    images = [an_image(n, rng, network=True, mask=False) for n in (5, 0, 7, 9, 3, 8, 1)]
    first, second = images[:5], [*images[3:], LeftOut.CORRUPT]
    parts = [stored(tmp_path, first, "a"), stored(tmp_path, second, "b"), stored(tmp_path, [LeftOut.CORRUPT], "c")]
    joined = JoinedFeatures([(parts[0], np.arange(5)), (parts[1], np.arange(3, 8)), (parts[2], np.array([8]))])
    assert len(joined) == 9
    assert joined.counts.tolist() == [5, 0, 7, 9, 3, 8, 1, 0, 0]
    for found, expected in zip(joined[:7], images, strict=True):
        np.testing.assert_array_equal(found.xy_px, expected.xy_px)
        np.testing.assert_array_equal(found.descriptors, expected.descriptors)
    assert [found.left_out for found in joined][6:] == [None, LeftOut.CORRUPT, LeftOut.CORRUPT]
    assert {found.descriptors.shape[1] for found in joined} == {64}
    assert {found.descriptors.dtype for found in joined} == {np.dtype(np.float32)}
