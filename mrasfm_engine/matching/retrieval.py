"""Units that may show the same place again, found by the similarity of images alone."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mrasfm_engine.config import PairConfig
from mrasfm_engine.features.extraction import DESCRIPTOR_SCALE
from mrasfm_engine.matching.image_motion import Motion
from mrasfm_engine.matching.pair_selection import REVISIT_PATH_M, units_ahead
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Bytes, Floats32, Ints

WORDS = 64
TRAINING_DESCRIPTORS = 30_000
KEYPOINTS_PER_IMAGE = 1000
MIN_LIKENESS = 0.5  # of what images at the edge of the window have with each other


def revisit_pairs(drive: Drive, features: Sequence[ImageFeatures], config: PairConfig, motion: Motion) -> Ints:
    """Image pairs (n, 2) of units far apart along the path that look alike: candidates, to be matched and verified.

    Units nearer than `REVISIT_PATH_M`, or in each other's window, are alike because they are neighbours.

    Images are compared by VLAD (Jegou et al., CVPR 2010) over a vocabulary learned from the drive itself. Of every unit
    the most alike images are kept; where two units have a pair, their images of one camera are paired as well.
    """
    unit = np.array([image.unit for image in drive.images], dtype=np.int64)
    camera = np.array([image.camera for image in drive.images], dtype=np.int64)
    travelled_m = motion.travelled_m[unit]
    ahead = units_ahead(motion, config)
    if config.revisit_pairs_per_unit == 0 or np.ptp(travelled_m) <= REVISIT_PATH_M:
        return np.zeros((0, 2), dtype=np.int64)
    vectors = _vlad(features)
    likeness = vectors @ vectors.T
    last = np.array([units[-1] if len(units) else -1 for units in ahead], dtype=np.int64)
    edge = (last[unit][:, None] == unit[None, :]) & (camera[:, None] == camera[None, :])
    if not edge.any():
        return np.zeros((0, 2), dtype=np.int64)
    limit = MIN_LIKENESS * float(np.median(likeness[edge]))
    likeness[np.abs(travelled_m[:, None] - travelled_m[None, :]) <= REVISIT_PATH_M] = -1.0
    first = np.searchsorted(unit, np.arange(len(ahead) + 1))  # images are in the order of their units
    for u, units in enumerate(ahead):
        for v in units:
            here, there = slice(first[u], first[u + 1]), slice(first[v], first[v + 1])
            likeness[here, there] = likeness[there, here] = -1.0
    chosen: set[tuple[int, int]] = set()
    where = {(int(u), int(c)): i for i, (u, c) in enumerate(zip(unit, camera, strict=True))}
    for u in np.unique(unit):
        rows = np.flatnonzero(unit == u)
        best = np.argsort(-likeness[rows], axis=None, kind="stable")[: config.revisit_pairs_per_unit]
        for a, b in zip(*np.unravel_index(best, (len(rows), len(unit))), strict=True):
            i, j = int(rows[a]), int(b)
            if likeness[i, j] < limit:
                continue
            chosen.add((min(i, j), max(i, j)))
            if camera[i] == camera[j]:
                for c in range(len(drive.cameras)):
                    k, m = where.get((int(unit[i]), c)), where.get((int(unit[j]), c))
                    if k is not None and m is not None:
                        chosen.add((min(k, m), max(k, m)))
    return np.array(sorted(chosen), dtype=np.int64).reshape(-1, 2)


def _vlad(features: Sequence[ImageFeatures]) -> Floats32:
    """Unit-length VLAD vectors (images, WORDS * D) with intra-normalisation (Arandjelovic and Zisserman, 2013)."""
    strongest = [_unit_length(f.descriptors[:KEYPOINTS_PER_IMAGE]) for f in features]
    everything = np.concatenate(strongest)
    sample = everything[np.linspace(0, len(everything) - 1, min(len(everything), TRAINING_DESCRIPTORS)).astype(int)]
    words = min(WORDS, max(1, len(sample) // 10))
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 12, 1e-3)
    _, _, centres = cv2.kmeans(sample, words, np.empty(0), criteria, 1, cv2.KMEANS_PP_CENTERS)
    result = np.zeros((len(features), words, sample.shape[1]), np.float32)
    half_norms = 0.5 * (centres**2).sum(1)
    for row, d in zip(result, strongest, strict=True):
        if len(d):
            word = (d @ centres.T - half_norms).argmax(1)
            np.add.at(row, word, d - centres[word])
    result /= np.maximum(np.linalg.norm(result, axis=2, keepdims=True), 1e-6)
    flat = result.reshape(len(features), -1)
    normalised: Floats32 = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6)
    return normalised


def _unit_length(descriptors: Bytes | Floats32) -> Floats32:
    """Descriptors (n, D) as unit vectors: SIFT's are stored as 512 times that, networks give them so."""
    scale = np.float32(DESCRIPTOR_SCALE if descriptors.dtype == np.uint8 else 1.0)
    return descriptors.astype(np.float32) / scale
