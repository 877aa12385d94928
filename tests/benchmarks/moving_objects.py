"""Line 26: traffic without masks. Tracks on vehicles that move give no points, and those of the street stay.

Rendered drives with vehicles ahead, beside and oncoming, at 10 and 30 Hz, small and large. Each is reconstructed three
times: with the masks of the renderer, and without masks with and without the motion test. A track is on a vehicle if
most of its keypoints are, by the renderer's exact masks of what moves; it is static if none is.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.occlusion import without_masks
from tests.benchmarks.table import Figure

OFF = "[mapping]\ndrop_moving = false\n"
FLOOR_M = 0.005  # of the error with masks: one sigma of the scale, 0.08 %, makes so much of 22 m of way
MOST_LEFT, MOST_LOST, MOST_WORSE = 0.1, 0.02, 1.1


@dataclass(frozen=True, kw_only=True)
class Traffic:
    """A rendered drive and its options."""

    title: str
    options: tuple[object, ...]


SMALL, LARGE = ("--width", 640, "--height", 360), ("--width", 1920, "--height", 1080)
MIXED, ALONG = ("--moving-cars", 3, "--same-way-cars", 2), ("--moving-cars", 0, "--same-way-cars", 4)
DRIVES = (
    Traffic(title="10 Hz, 640x360, cars along", options=("--cameras", 6, "--units", 40, *SMALL, *ALONG)),
    Traffic(
        title="30 Hz, 640x360",
        options=("--cameras", 3, "--units", 60, "--rate-hz", 30, "--spacing-m", 0.37, *SMALL, *MIXED),
    ),
    Traffic(title="10 Hz, 1920x1080", options=("--cameras", 3, "--units", 20, *LARGE, *MIXED)),
)


def moving_objects(work: Path, seed: int) -> Iterator[Figure]:
    """Line 26."""
    for traffic in DRIVES:
        rendered = work / "traffic"
        mrasfm("synth", *traffic.options, "--tight", "--moving-masks", "--seed", seed, "--out", rendered)
        yield from _traffic(rendered, work, f"seed {seed}, {traffic.title}")
        for folder in work.glob("traffic*"):
            shutil.rmtree(folder)


def _traffic(rendered: Path, work: Path, title: str) -> Iterator[Figure]:
    masked, with_it, without = (work / f"traffic, scene {name}" for name in ("masked", "on", "off"))
    drive = without_masks(rendered, work / "traffic, without masks")
    mrasfm("reconstruct", rendered, "--out", masked, "--no-gnss")
    mrasfm("reconstruct", drive, "--out", with_it, "--no-gnss")
    (without / ".stages").mkdir(parents=True)
    for name in ("features.npz", "matches.npz"):
        os.link(with_it / ".stages" / name, without / ".stages" / name)
    settings = work / "off.toml"
    settings.write_text(OFF, encoding="utf-8")
    mrasfm("reconstruct", drive, "--out", without, "--config", settings, "--no-gnss")
    settings.unlink()
    tracks, before, after = VerifiedTracks.read(with_it, rendered), observed(without), observed(with_it)
    moving, static = tracks.moving, tracks.static
    yield Figure(line="26", what=f"{title}: tracks on vehicles", value=int(moving.sum()))
    yield Figure(line="26", what=f"{title}: of them with a point, without the test", value=tracks.share(moving, before))
    yield Figure(
        line="26", what=f"{title}: the same with it", value=tracks.share(moving, after), above=-1e-9, most=MOST_LEFT
    )
    had_point = static & tracks.have_point(before)
    yield Figure(
        line="26",
        what=f"{title}: static tracks that lose their point",
        value=1.0 - tracks.share(had_point, after),
        above=-1e-9,
        most=MOST_LOST,
    )
    error_m, masked_m = (evaluate(scene, rendered)["metric"]["rmse_m"] for scene in (with_it, masked))
    yield Figure(line="26", what=f"{title}: metric RMSE with exact masks", value=masked_m, unit="m")
    yield Figure(
        line="26",
        what=f"{title}: the same without masks",
        value=error_m,
        unit="m",
        most=MOST_WORSE * max(masked_m, FLOOR_M),
    )
    report = read_report(with_it)["by_stage"]["refinement"]["moving_objects"]
    yield Figure(line="26", what=f"{title}: tracks that the report counts", value=report["tracks_dropped"])


Keypoint = tuple[int, int]  # image and keypoint, numbered from 0


@dataclass(frozen=True, kw_only=True)
class VerifiedTracks:
    """Connected keypoints of verified matches, and whether they show something that moves."""

    members: list[list[Keypoint]]
    moving: np.ndarray  # (n,) more than half of a track's keypoints are on what moves
    static: np.ndarray  # (n,) none is

    @staticmethod
    def read(scene: Path, rendered: Path) -> VerifiedTracks:
        with closing(sqlite3.connect(f"file:{scene / 'features.db'}?mode=ro", uri=True)) as db:
            rows = db.execute(
                "SELECT name, IFNULL(rows, 0), data FROM images LEFT JOIN keypoints USING (image_id) ORDER BY image_id"
            )
            moves = [_moves(rendered, *row) for row in rows.fetchall()]
            pairs = db.execute("SELECT pair_id, rows, data FROM two_view_geometries").fetchall()
        first = np.concatenate([[0], np.cumsum([len(m) for m in moves])])
        parent = np.arange(first[-1])

        def root(k: int) -> int:
            while parent[k] != k:
                parent[k] = parent[parent[k]]
                k = int(parent[k])
            return k

        for pair_id, count, data in pairs:
            a, b = (int(i) - 1 for i in divmod(pair_id, 2**31 - 1))
            for i, j in np.frombuffer(data or b"", "<u4").reshape(count, 2).tolist():
                parent[root(int(first[a]) + i)] = root(int(first[b]) + j)
        groups: dict[int, list[int]] = {}
        for k in range(int(first[-1])):
            groups.setdefault(root(k), []).append(k)
        tracks = [group for group in groups.values() if len(group) > 1]
        on_vehicle = np.concatenate(moves)
        share = np.array([on_vehicle[group].mean() for group in tracks])
        image = np.searchsorted(first, np.arange(first[-1]), side="right") - 1
        return VerifiedTracks(
            members=[[(int(image[k]), int(k - first[image[k]])) for k in group] for group in tracks],
            moving=share > 0.5,
            static=share == 0.0,
        )

    def have_point(self, seen: set[Keypoint]) -> np.ndarray:
        """Whether (n,) any keypoint of a track observes a point."""
        return np.array([any(member in seen for member in group) for group in self.members])

    def share(self, which: np.ndarray, seen: set[Keypoint]) -> float:
        """Of some tracks, those with a point."""
        return float(self.have_point(seen)[which].mean())


def _moves(rendered: Path, name: str, count: int, data: bytes | None) -> np.ndarray:
    """Whether (n,) the keypoints of an image are on something that moves."""
    xy = np.frombuffer(data or b"", "<f4").reshape(count, -1)[:, :2].astype(int)
    file = Path(*Path(name).parts[-2:]).with_suffix(".png")
    mask = cv2.imread(str(rendered / "truth_moving" / file), cv2.IMREAD_UNCHANGED)
    height, width = mask.shape
    result: np.ndarray = mask[xy[:, 1].clip(0, height - 1), xy[:, 0].clip(0, width - 1)] > 0
    return result


def observed(scene: Path) -> set[Keypoint]:
    """Keypoints that observe a point of a scene."""
    model = pycolmap.Reconstruction(str(scene / "model"))
    return {
        (element.image_id - 1, element.point2D_idx)
        for point in model.points3D.values()
        for element in point.track.elements
    }
