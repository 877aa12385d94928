"""Tracks: keypoints of different images that are one point, joined from verified matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.jit import njit
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.row_bands import RowBands
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.scene.semantics import UNKNOWN, majority_class
from mrasfm_engine.types import Bools, Bytes, Floats, Ints, Ints32


@dataclass(frozen=True, kw_only=True)
class Keypoints:
    """Keypoints of all images in one row of arrays: those of image i are at `first[i]` to `first[i + 1]`."""

    first: Ints  # (images + 1,)
    number: Ints  # (n,) of a keypoint among the features of its image, ascending in every image
    image: Ints  # (n,)
    unit: Ints  # (n,)
    camera: Ints  # (n,)
    band: Ints  # (n,) index into the drive's row bands, see `scene.row_bands`
    xy_px: Floats  # (n, 2)
    rays: Floats  # (n, 3) unit viewing rays in camera axes, by the intrinsics as given or see `seen_through`
    # (n,) as `semantics.CLASS_CODES` numbers them; all unknown where not given
    classes: Bytes = field(default_factory=lambda: np.zeros(0, np.uint8))
    # (images,) which have a feature of a known class, here or among those that are not lined up; by default none
    is_masked: Bools = field(default_factory=lambda: np.zeros(0, np.bool_))

    def __post_init__(self) -> None:
        if not len(self.classes):
            object.__setattr__(self, "classes", np.zeros(len(self.image), np.uint8))
        if not len(self.is_masked):
            object.__setattr__(self, "is_masked", np.zeros(len(self.first) - 1, np.bool_))

    def seen_through(self, kinds: Ints, params: Floats) -> Keypoints:
        """The same with the rays of cameras of these kinds (c,) and parameters (c, PARAMETERS)."""
        return replace(self, rays=_rays_of(self.xy_px, self.camera, kinds, params))

    @staticmethod
    def from_features(drive: Drive, features: Sequence[ImageFeatures], bands: RowBands | None = None) -> Keypoints:
        """Line up all features of a drive's images; by default every image is one instant."""
        return Keypoints._of_numbers(drive, features, [np.arange(len(f.xy_px)) for f in features], bands)

    @staticmethod
    def from_matches(
        drive: Drive, features: Sequence[ImageFeatures], pairs: Sequence[PairMatches], bands: RowBands | None = None
    ) -> tuple[Keypoints, list[PairMatches]]:
        """Line up the features that can be part of a track, and number the pairs' matches by them.

        Most keypoints of an image match nothing: of a long drive, they would take most of the memory. All matches stay
        of the images of one unit, as they are judged again when the calibration is corrected; of others the inliers.
        """
        unit = np.array([image.unit for image in drive.images], dtype=np.int64)
        kept = [pair if unit[pair.image_a] == unit[pair.image_b] else _inliers_of(pair) for pair in pairs]
        matched: list[list[Ints32]] = [[np.zeros(0, dtype=np.int32)] for _ in features]
        for pair in kept:
            matched[pair.image_a].append(pair.matches[:, 0])
            matched[pair.image_b].append(pair.matches[:, 1])
        numbers: list[Ints] = []
        row_of: list[Ints32] = []
        for of_image in matched:
            is_matched = np.bincount(np.concatenate(of_image)) > 0
            numbers.append(np.flatnonzero(is_matched))
            row_of.append(np.cumsum(is_matched, dtype=np.int32) - np.int32(1))

        def numbered_anew(pair: PairMatches) -> PairMatches:
            rows = (row_of[pair.image_a][pair.matches[:, 0]], row_of[pair.image_b][pair.matches[:, 1]])
            return replace(pair, matches=np.stack(rows, axis=1).astype(np.int32, copy=False))

        return Keypoints._of_numbers(drive, features, numbers, bands), [numbered_anew(pair) for pair in kept]

    @staticmethod
    def _of_numbers(
        drive: Drive, features: Sequence[ImageFeatures], numbers: Sequence[Ints], bands: RowBands | None
    ) -> Keypoints:
        """Line up the features of every image that have some numbers, ascending."""
        counts = np.array([len(of_image) for of_image in numbers], dtype=np.int64)
        image = np.repeat(np.arange(len(features), dtype=np.int64), counts)
        unit_of_image = np.array([i.unit for i in drive.images], dtype=np.int64)
        camera_of_image = np.array([i.camera for i in drive.images], dtype=np.int64)
        positions, classes, is_masked = [], [], []
        for found, rows in zip(features, numbers, strict=True):
            known = found.classes  # which, as all arrays of an image, may be read from a file at every use
            positions.append(found.xy_px[rows])
            classes.append(known[rows])
            is_masked.append(bool((known != UNKNOWN).any()))
        xy = np.concatenate(positions).astype(np.float64).reshape(-1, 2)
        camera = camera_of_image[image]
        return Keypoints(
            first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            number=np.concatenate(numbers).astype(np.int64),
            image=image,
            unit=unit_of_image[image],
            camera=camera,
            band=image if bands is None else bands.of_pixels(image, xy),
            xy_px=xy,
            rays=_rays_of(xy, camera, *pack_cameras(drive.cameras)),
            classes=np.concatenate(classes),
            is_masked=np.array(is_masked),
        )


def _rays_of(xy_px: Floats, camera: Ints, kinds: Ints, params: Floats) -> Floats:
    """Viewing rays (n, 3) of pixels (n, 2) of cameras (n,)."""
    rays = np.empty((len(xy_px), 3))
    for c, (kind, of_camera) in enumerate(zip(kinds, params, strict=True)):
        rows = camera == c
        rays[rows] = unproject_pixels(int(kind), of_camera, xy_px[rows])
    return rays


def matching_keypoints(first: Ints, pairs: Sequence[PairMatches]) -> tuple[Ints, Ints]:
    """Keypoints (n, 2) of the inliers of some pairs, one pair after the other, and how many (pairs,) each has.

    `first` (images + 1,) is as in `Keypoints`.
    """
    if not pairs:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64)
    inliers = np.concatenate([pair.inliers for pair in pairs])
    begins = np.cumsum([0, *(len(pair.inliers) for pair in pairs)])
    counts = np.diff(np.concatenate([[0], np.cumsum(inliers)])[begins])
    images = np.array([(pair.image_a, pair.image_b) for pair in pairs])
    matches = np.concatenate([pair.matches for pair in pairs])[inliers]
    return np.repeat(first[images], counts, axis=0) + matches, counts


def _inliers_of(pair: PairMatches) -> PairMatches:
    """The pair without the matches that are no inliers."""
    matches = pair.matches[pair.inliers]
    return replace(pair, matches=matches, inliers=np.ones(len(matches), dtype=np.bool_))


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Keypoints that belong together. No track has two keypoints of one image."""

    of_keypoint: Ints  # (n,) -1 where a keypoint is in no track
    first: Ints  # (tracks + 1,)
    keypoints: Ints  # members of track t: keypoints[first[t]:first[t + 1]], ascending

    @staticmethod
    def from_labels(of_keypoint: Ints) -> Tracks:
        """Tracks of the keypoints' labels, -1 for none; labels with gaps are numbered anew."""
        is_member = of_keypoint >= 0
        members = np.flatnonzero(is_member)
        given = of_keypoint.take(members)
        sizes = np.bincount(given)  # labels are numbers of keypoints or less: counting sorts them
        if (sizes > 0).all():
            result, labels = of_keypoint, given
        else:
            labels = (np.cumsum(sizes > 0) - 1).take(given)
            result = np.full(len(of_keypoint), -1, dtype=np.int64)
            result[is_member] = labels
            sizes = sizes[sizes > 0]
        first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        keypoints = np.empty(len(members), dtype=np.int64)
        _put_by_label(members, labels, first[:-1].copy(), keypoints)
        return Tracks(of_keypoint=result, first=first, keypoints=keypoints)

    def classes(self, of_keypoints: Bytes) -> Bytes:
        """The semantic class (tracks,) of most keypoints of every track, given the keypoints' classes (n,)."""
        owner = np.repeat(np.arange(len(self), dtype=np.int64), np.diff(self.first))
        return majority_class(of_keypoints[self.keypoints], owner, len(self))

    def __len__(self) -> int:
        return len(self.first) - 1


def inlier_members(tracks: Tracks, which: Ints, is_inlier: Bools) -> Ints:
    """Keypoints (m,) of some tracks that are kept (keypoints,), track by track."""
    result: Ints = _inlier_members(tracks.first, tracks.keypoints, which, is_inlier)
    return result


def count_members(tracks: Tracks, which: Ints, more: Bools, unit: Ints, counts: Ints) -> None:
    """Count the keypoints of some tracks by their unit (keypoints,): in where `more` (tracks,), out where not."""
    _count_members(tracks.first, tracks.keypoints, which, more, unit, counts)


@njit(cache=True, nogil=True)
def _put_by_label(members: Any, labels: Any, following: Any, out: Any) -> None:
    """Members (n,) in the order of their labels, and of one label in their own; `following` is where each begins."""
    for n in range(len(members)):
        out[following[labels[n]]] = members[n]
        following[labels[n]] += 1


@njit(cache=True, nogil=True)
def _inlier_members(first: Any, members: Any, which: Any, is_inlier: Any) -> Any:
    total = 0
    for t in which:
        total += first[t + 1] - first[t]
    out = np.empty(total, np.int64)
    end = 0
    for t in which:
        for m in range(first[t], first[t + 1]):
            if is_inlier[members[m]]:
                out[end] = members[m]
                end += 1
    return out[:end].copy()


@njit(cache=True, nogil=True)
def _count_members(first: Any, members: Any, which: Any, more: Any, unit: Any, counts: Any) -> None:
    for t in which:
        step = 1 if more[t] else -1
        for m in range(first[t], first[t + 1]):
            counts[unit[members[m]]] += step


@njit(cache=True, nogil=True)
def _join(edges: Any, image: Any, parent: Any, following: Any, last: Any, stamp: Any) -> None:
    """Union-find over edges in the given order that never joins two keypoints of one image.

    Members of a set are a linked list from its root (`following`, `last`), so that images can be compared.
    """
    for n in range(len(edges)):
        a, b = edges[n, 0], edges[n, 1]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a == b:
            continue
        k = a
        while k >= 0:
            stamp[image[k]] = n
            k = following[k]
        conflict = False
        k = b
        while k >= 0 and not conflict:
            conflict = stamp[image[k]] == n
            k = following[k]
        if conflict:
            continue
        following[last[a]] = b
        last[a] = last[b]
        parent[b] = a


def build_tracks(keypoints: Keypoints, pairs: Sequence[PairMatches]) -> Tracks:
    """Join verified matches into tracks.

    Matches of pairs with many inliers come first; a match that would put two keypoints of one image into one track is
    left out, which keeps single wrong matches from growing tracks together.
    """
    n = len(keypoints.image)
    edges, _ = matching_keypoints(keypoints.first, sorted(pairs, key=lambda pair: -np.count_nonzero(pair.inliers)))
    parent = np.arange(n, dtype=np.int64)
    following, last = np.full(n, -1, dtype=np.int64), np.arange(n, dtype=np.int64)
    stamp = np.full(int(keypoints.image.max(initial=-1)) + 1, -1, dtype=np.int64)
    _join(edges, keypoints.image, parent, following, last, stamp)
    while True:
        up = parent[parent]
        if (up == parent).all():
            break
        parent = up
    sizes = np.bincount(parent, minlength=n)
    return Tracks.from_labels(np.where(sizes[parent] > 1, parent, -1))
