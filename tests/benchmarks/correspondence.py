"""Line 16: extraction and matching beside COLMAP's, with as many keypoints, on the same pairs."""

from __future__ import annotations

import os
import shutil
import statistics
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap

from mrasfm_engine.features.extraction_size import LARGEST_SIDE_PX
from mrasfm_engine.preflight.drive_reader import read_drive
from tests.benchmarks.colmap import verified_pairs
from tests.benchmarks.commands import mrasfm, read_report
from tests.benchmarks.real_drives import imported
from tests.benchmarks.table import Figure

KEYPOINTS = 2048
MAX_ERROR_PX = 2.0
TIMES_AS_FAST = 2.0
THREADS = os.cpu_count() or 1


def correspondence(data: Path, work: Path, repeat: int) -> Iterator[Figure]:
    """Line 16. Inliers of both are those that COLMAP's verification finds among the matches of either.

    Images are extracted at a size at which they have three quarters of the keypoints, so that inliers are fewer. At
    full size they have more keypoints than are wanted: the strongest ones, as COLMAP's, have as many inliers. Those
    that cover the image, which are taken by default, have fewer.
    """
    drive = imported(data, "kitti06", work)
    out = work / "correspondence"
    ours, theirs = [], []
    for repetition in range(repeat):
        scene = out / str(repetition)
        mrasfm("reconstruct", drive, "--out", scene)
        stages = read_report(scene)["by_stage"]
        ours.append(stages["features"]["seconds"] + stages["matches"]["seconds"])
        database, pairs = scene / "features.db", scene / "pairs.txt"
        pairs.write_text("".join(f"{a} {b}\n" for a, b in verified_pairs(database)), encoding="utf-8")
        theirs.append(_colmap(drive, out / f"colmap {repetition}.db", pairs))
    figure = partial(Figure, line="16")
    count = len(pairs.read_text(encoding="utf-8").splitlines())
    yield figure(
        what=f"kitti06, {KEYPOINTS} keypoints an image, {count} pairs: ours", value=statistics.median(ours), unit="s"
    )
    yield figure(what="COLMAP's SIFT and matcher on the CPU", value=statistics.median(theirs), unit="s")
    ratio = statistics.median(theirs) / statistics.median(ours)
    yield figure(what="times as fast", value=ratio, above=TIMES_AS_FAST, most=100.0)
    of_colmap = _inliers(out / "colmap 0.db", pairs)
    yield figure(what="COLMAP: inliers of all pairs", value=of_colmap)
    inliers = _inliers(database, pairs)
    yield figure(
        what="ours, at the size that we extract at: inliers to COLMAP's",
        value=inliers / of_colmap,
        above=0.75,
        most=10.0,
    )
    full, settings = out / "full size", out / "full size.toml"
    strongest = f"[features]\nmax_side_px = {LARGEST_SIDE_PX}\nspread = false\n[output]\npictures = false\n"
    settings.write_text(strongest, encoding="utf-8")
    mrasfm("reconstruct", drive, "--out", full, "--config", settings)
    ratio = _inliers(full / "features.db", pairs) / of_colmap
    yield figure(what="ours, the strongest at full size: inliers to COLMAP's", value=ratio, above=1.0, most=10.0)


def _colmap(drive: Path, database: Path, pairs: Path) -> float:
    """Extract, match and verify the pairs into a database; seconds."""
    manifest = read_drive(drive)
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    reader.camera_params = ",".join(f"{p:.9f}" for p in manifest.cameras[0].params)  # rectified: all are alike
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.sift.max_num_features = THREADS, KEYPOINTS
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = THREADS
    pycolmap.logging.minloglevel = 2
    started = time.perf_counter()
    pycolmap.extract_features(
        database,
        drive,
        image_names=[image.file for image in manifest.images],
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    extracted_s = time.perf_counter() - started
    _limit_keypoints(database)
    started = time.perf_counter()
    pycolmap.match_image_pairs(
        database,
        matching_options=matching,
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=pairs),
        verification_options=_verification(),
        device=pycolmap.Device.cpu,
    )
    return extracted_s + time.perf_counter() - started


def _limit_keypoints(database: Path) -> None:
    """Keep as many as were asked for: COLMAP takes the largest scales first, but whole ones."""
    opened = pycolmap.Database.open(str(database))
    ids = [image.image_id for image in opened.read_all_images()]
    every = [(i, opened.read_keypoints(i), opened.read_descriptors(i)) for i in ids]
    opened.clear_keypoints()
    opened.clear_descriptors()
    for i, keypoints, descriptors in every:
        area = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
        kept = np.sort(np.argsort(-area, kind="stable")[:KEYPOINTS])
        opened.write_keypoints(i, keypoints[kept])
        opened.write_descriptors(i, pycolmap.FeatureDescriptors(type=descriptors.type, data=descriptors.data[kept]))
    opened.close()


def _verification() -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error, options.ransac.random_seed = MAX_ERROR_PX, 0
    return options


def _inliers(database: Path, pairs: Path) -> int:
    """Inliers of all pairs, verified anew."""
    copy = database.with_suffix(".verified.db")
    shutil.copyfile(database, copy)
    opened = pycolmap.Database.open(str(copy))
    opened.clear_two_view_geometries()
    opened.close()
    pycolmap.verify_matches(copy, pairs, options=_verification())
    opened = pycolmap.Database.open(str(copy))
    _, counts = opened.read_two_view_geometry_num_inliers()
    opened.close()
    return int(sum(counts))
