"""Scenes without positions: what they may have in common with others is found by the similarity of images.

A component of a drive without GNSS lies in a frame of its own, and nothing says where. Images of both scenes are
compared by their VLAD vectors (see `matching.retrieval`), and the most similar ones are relocalised as those that
positions propose.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from mrasfm_engine.aggregation.pairs import Probe, images_of, probe_units
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import AggregationConfig
from mrasfm_engine.matching.retrieval import ImageIndex
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Cancel, Floats, Ints
from schemas.artifacts import drive_of_scene

SHORTLIST = 64  # candidates of an image, whose whole vectors are compared
PAIRS_OF_IMAGE = 8


def similar_images(
    a: SourceScene, b: SourceScene, config: AggregationConfig, *, cancel: Cancel | None = None
) -> list[Probe]:
    """Units of b to look for in a by the images of a that look most like theirs, the most similar ones first.

    Raises
    ------
    CancelledError
        Where `cancel` answers True.
    """
    images_a, images_b = (images_of(s, units) for s, units in zip((a, b), probe_units(a, b, config), strict=True))
    if not len(images_a) or not len(images_b):
        return []
    index = ImageIndex.from_features([*_features(a, images_a), *_features(b, images_b)], cancel=cancel)
    column = np.arange(len(images_a))
    found: dict[int, list[tuple[float, Ints]]] = {}
    for row, image_b in enumerate(images_b.tolist(), start=len(images_a)):
        best = _best(index, row, column, PAIRS_OF_IMAGE)
        for k, value in best:
            pair = np.array([images_a[k], image_b], dtype=np.int64)
            found.setdefault(int(b.image_unit[image_b]), []).append((value, pair))
    ranked = sorted(found.items(), key=lambda item: (-max(value for value, _ in item[1]), item[0]))
    return [Probe(unit=unit, pairs=np.stack([pair for _, pair in rows])) for unit, rows in ranked]


def similar_scenes(
    scenes: Sequence[SourceScene], config: AggregationConfig, *, cancel: Cancel | None = None
) -> list[tuple[int, int]]:
    """Pairs of scenes to compare of which one at least has no positions, the smaller index first.

    Each scene without positions is compared with the `config.candidates` most similar scenes of other drives, and with
    as many of its own drive, whose images look like its own because they were taken under the same light.

    Raises
    ------
    CancelledError
        Where `cancel` answers True.
    """
    unplaced = [k for k, scene in enumerate(scenes) if not scene.is_placed]
    drives = [drive_of_scene(scene.name) for scene in scenes]
    pairs = [pair for pair in combinations(range(len(scenes)), 2) if not set(pair).isdisjoint(unplaced)]
    if not pairs:
        return []
    similarity = np.zeros((len(scenes), len(scenes)))
    if len(scenes) - 1 > config.candidates:  # else all are compared
        similarity = _similarity(scenes, unplaced, config, cancel)
    chosen: set[tuple[int, int]] = set()
    for k in unplaced:
        own = sorted((pair for pair in pairs if k in pair), key=lambda pair: -similarity[k, sum(pair) - k])
        for is_sibling in (False, True):
            kind = [pair for pair in own if (drives[pair[0]] == drives[pair[1]]) is is_sibling]
            chosen.update(kind[: config.candidates])
    return sorted(chosen)


def _similarity(
    scenes: Sequence[SourceScene], unplaced: Sequence[int], config: AggregationConfig, cancel: Cancel | None
) -> Floats:
    """Mean similarity (scenes, scenes) of each scene's images, in rows, to the most similar one of each other scene.

    Rows of scenes that have positions are zero.
    """
    result = np.zeros((len(scenes), len(scenes)))
    spacing = [probe_units(scene, scene, config)[0] for scene in scenes]
    images = [images_of(scene, units) for scene, units in zip(scenes, spacing, strict=True)]
    index = ImageIndex.from_features(
        [one for scene, rows in zip(scenes, images, strict=True) for one in _features(scene, rows)], cancel=cancel
    )
    first = np.concatenate([[0], np.cumsum([len(rows) for rows in images])])
    for k in unplaced:
        own = index.directions[first[k] : first[k + 1]]
        for other in range(len(scenes)):
            theirs = index.directions[first[other] : first[other + 1]]
            if other != k and len(own) and len(theirs):
                result[k, other] = float((own @ theirs.T).max(axis=1).mean())
    return result


def _best(index: ImageIndex, row: int, columns: Ints, count: int) -> list[tuple[int, float]]:
    """The most similar columns of an image, and how similar each is."""
    rough = index.directions[columns] @ index.directions[row]
    shortlist = columns[np.argsort(-rough, kind="stable")[:SHORTLIST]]
    exact = index.likeness(row, shortlist)
    order = np.argsort(-exact, kind="stable")[:count]
    return [(int(shortlist[k]), float(exact[k])) for k in order]


def _features(scene: SourceScene, images: Ints) -> list[ImageFeatures]:
    """Keypoints with points of some images, as retrieval takes them."""
    result = []
    for image in images.tolist():
        rows = scene.keypoints_with_points(image)
        result.append(
            ImageFeatures(
                xy_px=scene.keypoint_xy_px[rows],
                descriptors=scene.descriptors[scene.descriptor_row[rows]],
                colors=np.zeros((len(rows), 3), np.uint8),
            )
        )
    return result
