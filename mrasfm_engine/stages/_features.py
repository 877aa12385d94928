"""Keypoints and descriptors of all images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np

from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.features.extraction import features_by_image
from mrasfm_engine.features.stored_features import FeaturesOnDisk, FeatureWriter, StoredFeatures
from mrasfm_engine.io import left_out_images
from mrasfm_engine.io.stage_store import StageWriter
from mrasfm_engine.scene.drive import Drive, LeftOut
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.scene.semantics import CLASS_NAMES, count_classes
from mrasfm_engine.stages._own_car import own_cars
from mrasfm_engine.stages._run import Run
from mrasfm_engine.types import Ints
from schemas.artifacts import Stage
from schemas.findings import as_json


def features(run: Run) -> Sequence[ImageFeatures]:
    """Keypoints and descriptors of all images; they stay on disk.

    Raises
    ------
    InputError, ReconstructionError
        Where no image can be read, or none has a keypoint.
    """
    own_cars(run)
    found, report = extract(run)
    require_features(run, found, left_out_of(report))
    return found


def extract(run: Run) -> tuple[StoredFeatures, dict[str, Any]]:
    """The stage of the features and its report, whatever the images show."""
    return store_features(
        run,
        lambda: features_by_image(
            run.drive,
            run.extractor,
            threads=run.config.threads,
            segmenter=run.components.segmenter,
            class_margin_px=run.config.features.class_margin_px,
            own_cars=run.own_cars,
            repeated=run.repeated,
            known=run.probed,
            progress=run.step(Stage.FEATURES),
            cancel=run.cancel,
        ),
    )


def store_features(
    run: Run, extracted: Callable[[], Generator[ImageFeatures | LeftOut, None, None]]
) -> tuple[StoredFeatures, dict[str, Any]]:
    """The stage and its report, of features in the order of the run's images, which are asked for where it is not done
    already."""

    def work(stage: StageWriter) -> dict[str, Any]:
        writer = FeatureWriter(stage)
        by_class: Counter[str] = Counter()
        left_out: dict[str, LeftOut] = {}
        with closing(extracted()) as every:
            for image, found in zip(run.drive.images, every, strict=True):
                writer.add(found)
                if isinstance(found, LeftOut):
                    left_out[image.file] = found
                else:
                    by_class.update(count_classes([found.classes]))
        writer.finish()
        return describe_features(run.drive, writer.counts, by_class, writer.made_masks, left_out)

    stage, report = run.large_stage(Stage.FEATURES, run.feature_settings, work)
    left_out = left_out_of(report)
    return StoredFeatures(stage, [left_out.get(image.file) for image in run.drive.images]), report


def describe_features(
    drive: Drive, counts: Ints, by_class: Mapping[str, int], made_masks: int, left_out: Mapping[str, LeftOut]
) -> dict[str, Any]:
    """The report of the stage: keypoints by image (images,) and by class, masks, and files that were left out."""
    few = [drive.images[i].file for i in np.flatnonzero(counts < 100)]
    return {
        "images": len(drive.images),
        "keypoints": int(counts.sum()),
        "keypoints_by_class": {name: by_class[name] for name in CLASS_NAMES.values() if by_class.get(name)},
        "images_with_mask": {
            "given": sum(image.mask is not None for image in drive.images),
            "made_by_model": made_masks,
        },
        "images_with_under_100_keypoints": [file for file in few if file not in left_out],
        "images_left_out": [{"file": file, "reason": str(reason)} for file, reason in left_out.items()],
    }


def left_out_of(report: Mapping[str, Any]) -> dict[str, LeftOut]:
    """Files of images that were left out, with the reasons, from the stage's report."""
    return {image["file"]: LeftOut(image["reason"]) for image in report["images_left_out"]}


def require_features(run: Run, found: FeaturesOnDisk, left_out: Mapping[str, LeftOut]) -> None:
    """Say what was left out, and refuse a drive that shows nothing.

    Raises
    ------
    InputError, ReconstructionError
        Where no image can be read, or none has a keypoint.
    """
    # The preflight's findings are of a sample, these are of all images: they take their place.
    findings = [finding for finding in run.report.get("findings", []) if finding["code"] not in left_out_images.CODES]
    of_all = left_out_images.left_out_findings(left_out, len(run.drive.images))
    run.report["findings"] = findings + [as_json(finding) for finding in of_all]
    if len(left_out) == len(run.drive.images):
        raise left_out_images.nothing_left(left_out)
    if not found.counts.sum():
        raise ReconstructionError(
            "no image of the drive has a keypoint",
            remedy="Check that the images are not empty, and that masks do not cover everything.",
            code="no-features",
        )
