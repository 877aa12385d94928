"""Units that may show the same place again, found by the similarity of images alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.config import PairConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.even_choice import even_choice
from mrasfm_engine.features.extraction import DESCRIPTOR_SCALE
from mrasfm_engine.matching.image_motion import Motion
from mrasfm_engine.matching.pair_selection import REVISIT_PATH_M, units_ahead
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Bytes, Cancel, Floats32, Ints

WORDS = 64
TRAINING_DESCRIPTORS = 30_000
KEYPOINTS_PER_IMAGE = 1000
DIRECTIONS = 256  # 1 KB of an image, where its vector has 32
SAMPLED_VECTORS = 4 * DIRECTIONS  # from which they are learned: more than span them, and 32 MB
SHORTLIST = 32  # candidates for each pair that is kept; of these the whole vectors are compared
ROUNDING = 1e-6  # of single precision: directions with less energy say nothing
BATCH = 64  # images of which numbers of single precision exist at one time
NO_CANDIDATE = -2.0  # less than any scalar product of unit vectors
MIN_LIKENESS = 0.5  # of what images at the edge of the window have with each other


def revisit_pairs(
    drive: Drive,
    features: Sequence[ImageFeatures],
    config: PairConfig,
    motion: Motion,
    *,
    cancel: Cancel | None = None,
) -> Ints:
    """Image pairs (n, 2) of units far apart along the path that look alike: candidates, to be matched and verified.

    Units nearer than `REVISIT_PATH_M`, or in each other's window, are alike because they are neighbours.

    Images are compared by VLAD (Jegou et al., CVPR 2010) over a vocabulary learned from the drive itself. An index of a
    few directions gives candidates (Jegou and Chum, ECCV 2012), which the whole vectors then rank: no matrix of all
    images by all images exists, and of an image 9 KB stay in memory. Of every unit the most alike images are kept;
    where two units have a pair, their images of one camera are paired as well.

    Raises
    ------
    CancelledError
        Where `cancel` answers True.
    """
    unit = np.array([image.unit for image in drive.images], dtype=np.int64)
    camera = np.array([image.camera for image in drive.images], dtype=np.int64)
    travelled_m = motion.travelled_m[unit]
    ahead = units_ahead(motion, config)
    if config.revisit_pairs_per_unit == 0 or np.ptp(travelled_m) <= REVISIT_PATH_M:
        return np.zeros((0, 2), dtype=np.int64)
    last = np.array([units[-1] if len(units) else -1 for units in ahead], dtype=np.int64)
    where = {(int(u), int(c)): i for i, (u, c) in enumerate(zip(unit, camera, strict=True))}
    edge = [(i, j) for i in range(len(unit)) if (j := where.get((int(last[unit[i]]), int(camera[i])))) is not None]
    if not edge:
        return np.zeros((0, 2), dtype=np.int64)
    index = ImageIndex.from_features(features, cancel=cancel)
    limit = MIN_LIKENESS * float(np.median([index.likeness(i, np.array([j]))[0] for i, j in edge]))
    first = np.searchsorted(unit, np.arange(len(ahead) + 1))  # images are in the order of their units
    behind: list[list[int]] = [[] for _ in ahead]
    for u, units in enumerate(ahead):
        for v in units.tolist():
            behind[v].append(u)
    chosen: set[tuple[int, int]] = set()
    for u in np.unique(unit).tolist():
        rows = np.arange(first[u], first[u + 1])
        likeness = index.directions[rows] @ index.directions.T
        likeness[:, np.abs(travelled_m - motion.travelled_m[u]) <= REVISIT_PATH_M] = NO_CANDIDATE
        for v in (*ahead[u].tolist(), *behind[u]):
            likeness[:, first[v] : first[v + 1]] = NO_CANDIDATE
        row, column = _largest(likeness, SHORTLIST * config.revisit_pairs_per_unit, above=NO_CANDIDATE)
        exact = np.full(likeness.shape, NO_CANDIDATE, np.float32)
        for k in np.unique(row).tolist():
            mine = column[row == k]
            exact[k, mine] = index.likeness(int(rows[k]), mine)
        row, column = _largest(exact, config.revisit_pairs_per_unit, above=limit)
        for i, j in zip((row + first[u]).tolist(), column.tolist(), strict=True):
            chosen.add((min(i, j), max(i, j)))
            if camera[i] == camera[j]:
                for c in range(len(drive.cameras)):
                    k, m = where.get((int(unit[i]), c)), where.get((int(unit[j]), c))
                    if k is not None and m is not None:
                        chosen.add((min(k, m), max(k, m)))
    return np.array(sorted(chosen), dtype=np.int64).reshape(-1, 2)


def _largest(values: Floats32, count: int, *, above: float) -> tuple[Ints, Ints]:
    """Rows and columns (n,) of the `count` largest values, the first ones of equals, and none that is not `above`."""
    flat = values.ravel()
    least = np.partition(flat, -count)[-count] if count < len(flat) else flat.min()
    candidates = np.flatnonzero((flat >= least) & (flat > above))
    best = candidates[np.argsort(-flat[candidates], kind="stable")[:count]]
    row, column = np.unravel_index(best, values.shape)
    return row.astype(np.int64), column.astype(np.int64)


@dataclass(frozen=True, kw_only=True)
class ImageIndex:
    """VLAD vectors of images: in few directions to find candidates, in bytes to compare these with.

    Attributes
    ----------
    directions
        (images, k) unit-length vectors in the directions that the vectors of evenly chosen images span best.
    codes
        (images, WORDS * D) int8 the vectors in steps of their own largest number, which makes errors of 1e-4.
    steps
        (images,)
    """

    directions: Floats32
    codes: NDArray[np.int8]
    steps: Floats32

    @staticmethod
    def from_features(features: Sequence[ImageFeatures], *, cancel: Cancel | None = None) -> ImageIndex:
        """Index of some images, with a vocabulary of their own.

        Raises
        ------
        CancelledError
            Where `cancel` answers True.
        """
        centres, count = _vocabulary(features), len(features)
        codes, steps = np.zeros((count, centres.size), np.int8), np.zeros(count, np.float32)
        for image, found in enumerate(features):
            if cancel is not None and cancel():
                raise CancelledError
            vector = _vlad(found, centres)
            steps[image] = max(float(np.abs(vector).max()), 1e-6) / np.iinfo(np.int8).max
            codes[image] = np.round(vector / steps[image])
        sample = even_choice(count, SAMPLED_VECTORS)
        sampled = codes[sample] * steps[sample, None]
        energy, directions = np.linalg.eigh(sampled @ sampled.T)  # smaller than the vectors' own covariance
        keep = np.flatnonzero(energy > energy[-1] * ROUNDING)[-DIRECTIONS:]
        basis = (sampled.T @ directions[:, keep]) / np.sqrt(energy[keep])
        del sampled
        result = np.zeros((count, len(keep)), np.float32)
        for begin in range(0, count, BATCH):
            batch = slice(begin, begin + BATCH)
            result[batch] = (codes[batch] * steps[batch, None]) @ basis
        result /= np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-6)
        return ImageIndex(directions=result, codes=codes, steps=steps)

    def likeness(self, image: int, others: Ints) -> Floats32:
        """Scalar products (n,) of an image's vector with others'."""
        own = self.codes[image].astype(np.float32) * self.steps[image]
        result: Floats32 = (self.codes[others].astype(np.float32) @ own) * self.steps[others]
        return result


def _vocabulary(features: Sequence[ImageFeatures]) -> Floats32:
    """Words (w, D) from descriptors that are taken evenly from the whole drive."""
    stops = np.cumsum([min(len(found.xy_px), KEYPOINTS_PER_IMAGE) for found in features])
    total = int(stops[-1])
    sample = even_choice(total, TRAINING_DESCRIPTORS)
    image = np.searchsorted(stops, sample, side="right")
    parts = []
    for i in np.unique(image).tolist():
        rows = sample[image == i] - (stops[i - 1] if i else 0)
        parts.append(_unit_length(features[i].descriptors[rows]))
    chosen = np.concatenate(parts)
    words = min(WORDS, max(1, len(chosen) // 10))
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 12, 1e-3)
    _, _, centres = cv2.kmeans(chosen, words, np.empty(0), criteria, 1, cv2.KMEANS_PP_CENTERS)
    result: Floats32 = centres
    return result


def _vlad(found: ImageFeatures, centres: Floats32) -> Floats32:
    """Unit-length VLAD vector (WORDS * D,) with intra-normalisation (Arandjelovic and Zisserman, 2013)."""
    strongest = _unit_length(found.descriptors[:KEYPOINTS_PER_IMAGE])
    nearest = (strongest @ centres.T - 0.5 * (centres**2).sum(1)).argmax(1)
    is_of = (np.arange(len(centres))[:, None] == nearest).astype(np.float32)
    result: Floats32 = is_of @ strongest - is_of.sum(1, keepdims=True) * centres
    result /= np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-6)
    flat = result.ravel()
    normalised: Floats32 = flat / np.maximum(np.linalg.norm(flat), 1e-6)
    return normalised


def _unit_length(descriptors: Bytes | Floats32) -> Floats32:
    """Descriptors (n, D) as unit vectors: SIFT's are stored as 512 times that, networks give them so."""
    scale = np.float32(DESCRIPTOR_SCALE if descriptors.dtype == np.uint8 else 1.0)
    return descriptors.astype(np.float32) / scale
