"""Line 35: the whole command, from files to scene, beside COLMAP's extraction, matching and global mapper."""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pycolmap

from mrasfm_engine.benchmark.baselines import Baseline, run_baseline
from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.preflight.drive_reader import read_drive
from tests.benchmarks.colmap import verified_pairs
from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.real_drives import DRIVES, imported
from tests.benchmarks.table import Figure

KEYPOINTS = 2048
THREADS = os.cpu_count() or 1
# Times as fast as COLMAP at our size and number of keypoints, and as COLMAP's defaults.
TIMES_AS_FAST = {"kitti06": (5.0, 9.0), "pandaset_002": (4.0, 6.0)}


@dataclass(frozen=True, kw_only=True)
class Peer:
    """Seconds of COLMAP's steps, and the error of its model; NaN where it finds none."""

    extraction_s: float
    matching_s: float
    mapping_s: float
    similarity_rmse_m: float

    @property
    def seconds(self) -> float:
        return self.extraction_s + self.matching_s + self.mapping_s


def whole_command(data: Path, work: Path) -> Iterator[Figure]:
    """Line 35. Both know the same: images, calibration and the pairs that ours chose, no positions."""
    for name, (at_our_size, at_defaults) in TIMES_AS_FAST.items():
        real = next(real for real in DRIVES if real.name == name)
        drive, scene = imported(data, name, work, *real.options), work / f"{name} whole command"
        figure = partial(Figure, line="35")
        # The first run after an update compiles kernels, as the peer's were before it was installed.
        first_s = _timed_s("reconstruct", drive, "--out", work / f"{name} first run", "--no-gnss")
        yield figure(what=f"{name}: ours, the run before, which compiles what is not compiled", value=first_s, unit="s")
        ours_s = _timed_s("reconstruct", drive, "--out", scene, "--no-gnss")
        similarity_m = evaluate(scene, drive)["similarity"]["rmse_m"]
        yield figure(what=f"{name}: ours, from files to scene with pictures", value=ours_s, unit="s")
        yield figure(what=f"{name}: ours, similarity RMSE", value=similarity_m, unit="m")
        sizes = read_report(scene)["extraction_size"]["images"]
        side_px = max(each["reduced_to_side_px"] or max(each["width"], each["height"]) for each in sizes)
        for title, side, keypoints, bound in (
            ("at our size and keypoints", side_px, KEYPOINTS, at_our_size),
            ("with its defaults", -1, None, at_defaults),
        ):
            peer = _colmap(drive, scene, work / f"{name} peer.db", max_side_px=side, keypoints=keypoints)
            steps = f"{peer.extraction_s:.1f} + {peer.matching_s:.1f} + {peer.mapping_s:.1f} s"
            peer_title = f"{name}: COLMAP {title}"
            yield figure(what=peer_title, value=peer.seconds, unit="s", remark=steps)
            yield figure(what=f"{peer_title}, similarity RMSE", value=peer.similarity_rmse_m, unit="m")
            ratio = peer.seconds / ours_s
            yield figure(what=f"{name}: times as fast as COLMAP {title}", value=ratio, above=bound, most=100.0)


def _timed_s(*arguments: object) -> float:
    """Seconds of a command."""
    started = time.perf_counter()
    mrasfm(*arguments)
    return time.perf_counter() - started


def _colmap(drive: Path, scene: Path, database: Path, *, max_side_px: int, keypoints: int | None) -> Peer:
    """Extract, match, verify and map the pairs of a scene with its cameras and rig as given."""
    shutil.copyfile(scene / "features.db", database)
    pairs = database.with_suffix(".txt")
    names = _prepare(database, pairs)
    pycolmap.logging.minloglevel = 2
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.max_image_size = THREADS, max_side_px
    if keypoints is not None:
        extraction.sift.max_num_features = keypoints
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = THREADS
    started = time.perf_counter()
    pycolmap.extract_features(
        database, drive, image_names=names, extraction_options=extraction, device=pycolmap.Device.cpu
    )
    extraction_s = time.perf_counter() - started
    started = time.perf_counter()
    pycolmap.match_image_pairs(
        database,
        matching_options=matching,
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=pairs),
        device=pycolmap.Device.cpu,
    )
    matching_s = time.perf_counter() - started
    units = {image.file: image.unit for image in read_drive(drive).images}
    mapped = run_baseline(database, Baseline.GLOBAL, threads=THREADS, unit_of_image=units)
    errors = mapped.errors(read_tum(drive / "truth.tum").world_from_rig)
    return Peer(
        extraction_s=extraction_s,
        matching_s=matching_s,
        mapping_s=0.0 if math.isnan(mapped.seconds) else mapped.seconds,
        similarity_rmse_m=math.nan if errors is None else errors.similarity_rmse_m,
    )


def _prepare(database: Path, pairs: Path) -> list[str]:
    """Write the pairs, leave the cameras, rigs and images only, and return the images' names."""
    pairs.write_text("".join(f"{a} {b}\n" for a, b in verified_pairs(database)), encoding="utf-8")
    opened = pycolmap.Database.open(str(database))
    names = [image.name for image in opened.read_all_images()]
    opened.clear_keypoints()
    opened.clear_descriptors()
    opened.clear_matches()
    opened.clear_two_view_geometries()
    opened.close()
    return names
