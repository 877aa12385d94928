"""Line 12: learned keypoints and matches on a real drive, and where light changes from one instant to the next."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.features.extraction import extract_features
from mrasfm_engine.learned.model_folder import ModelFolder
from mrasfm_engine.matching.pair_matching import match_pairs
from mrasfm_engine.matching.pair_selection import motion_unknown, pairs_from_window
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.registry import load_components
from tests.benchmarks.colmap import THREADS
from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.real_drives import imported, reconstructed
from tests.benchmarks.table import Figure, exactly

IMAGES = 102
DARK_FRAMES = "0:8"  # more would show the same
GAMMA, NOISE, BLUR_PX = 3.0, 8 / 255, 1.0
SEED = 0
WEIGHTS = ("xfeat_2048_640x360.onnx", "lighterglue_L3.onnx")
LEARNED = {"features": {"extractor": "xfeat"}, "matching": {"matcher": "lighterglue"}}


def learned(data: Path, work: Path) -> Iterator[Figure]:
    """Line 12."""
    models = work / "models"
    for name in WEIGHTS:
        ModelFolder(models).add(data.parent / "weights" / "xfeat" / name)
    yield from accuracy(data, work, models)
    yield from changing_light(data, work, models)


def accuracy(data: Path, work: Path, models: Path) -> Iterator[Figure]:
    """Line 12a: a reconstruction from XFeat's keypoints and LighterGlue's matches."""
    drive = imported(data, "kitti06", work)
    config = work / "learned.toml"
    config.write_text(_toml(LEARNED | {"models": {"folder": str(models)}}), encoding="utf-8")
    for title, options in (("without GNSS", ["--no-gnss"]), ("with GNSS", [])):
        scene = reconstructed(drive, work / f"learned scene {title}", "--config", str(config), *options)
        errors = evaluate(scene, drive)
        what = f"kitti06, XFeat and LighterGlue, {title}"
        yield exactly("12a", f"{what}: images registered", errors["registered_images"], IMAGES)
        rmse_m = errors["metric"]["rmse_m"]
        yield Figure(line="12a", what=f"{what}: metric RMSE", value=rmse_m, unit="m", most=0.15)
        similarity_m = errors["similarity"]["rmse_m"]
        yield Figure(line="12a", what=f"{what}: RMSE after similarity", value=similarity_m, unit="m", most=0.05)
        stages = read_report(scene)["by_stage"]
        for stage in ("features", "matches"):
            yield Figure(line="12a", what=f"{what}: time of {stage}", value=stages[stage]["seconds"], unit="s")


def changing_light(data: Path, work: Path, models: Path) -> Iterator[Figure]:
    """Line 12b: every second unit is dark and noisy. What matches, whichever is better, is reported as measured."""
    folder = work / "kitti06 in changing light"
    mrasfm("import", data / "kitti06", "--out", folder, "--frames", DARK_FRAMES, "--copy")
    drive = read_drive(folder)
    rng = np.random.default_rng(SEED)
    for image in drive.images:
        if image.unit % 2:
            path = str(folder / image.file)
            assert cv2.imwrite(path, darkened(cv2.imread(path, cv2.IMREAD_GRAYSCALE), rng))
    units = np.array([image.unit for image in drive.images])
    for name, settings in (("SIFT and nearest neighbours", {}), ("XFeat and LighterGlue", LEARNED)):
        config = EngineConfig.model_validate({**settings, "models": {"folder": models}})
        components = load_components(config, None)
        features = extract_features(drive, components.extractor, threads=THREADS)
        pairs = pairs_from_window(drive, config.pairs, motion_unknown(drive, config.pairs))
        found = match_pairs(
            drive, features, pairs, components.matcher, config.matching, config.bundle_adjustment, threads=THREADS
        )
        inliers = {(p.image_a, p.image_b): int(p.inliers.sum()) for p in found.pairs}
        for kind, parity in (("bright with dark", 1), ("dark with dark, bright with bright", 0)):
            of_kind = [(int(a), int(b)) for a, b in pairs if (units[a] - units[b]) % 2 == parity]
            mean = float(np.mean([inliers.get(pair, 0) for pair in of_kind]))
            what = f"changing light, {kind}, {name}: verified matches a pair"
            # What is measured decides who wins; that there is something to match is what must hold.
            yield Figure(line="12b", what=what, value=mean, above=75.0, most=1000.0)


def darkened(gray: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An image (h, w) as at dusk: dark, noisy, and a little out of focus."""
    dark = (cv2.GaussianBlur(gray, (0, 0), BLUR_PX) / 255.0) ** GAMMA + rng.normal(0.0, NOISE, gray.shape)
    result: np.ndarray = np.clip(np.round(255 * dark), 0, 255).astype(np.uint8)
    return result


def _toml(settings: dict[str, dict[str, str]]) -> str:
    lines = []
    for section, values in settings.items():
        lines += [f"[{section}]", *(f"{name} = {json.dumps(value)}" for name, value in values.items())]
    return "\n".join(lines) + "\n"
