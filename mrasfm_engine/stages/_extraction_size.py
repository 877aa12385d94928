"""The size at which images are extracted, once for a whole drive: units that sub-maps share have the same keypoints."""

from __future__ import annotations

import time

import numpy as np

from mrasfm_engine.features.extraction_size import SizedExtractor, find_sides
from mrasfm_engine.io.stage_store import fingerprint
from mrasfm_engine.stages._run import EXTRACTION_SIZE_VERSION, Run
from schemas.artifacts import Stage

EXTRACTION_SIZE = "extraction-size"


def extraction_sizes(run: Run) -> None:
    """Find the size for the images of the drive, or take it from the store: `run.side_px` has it from here on.

    The own car is known by then.
    """
    extractor = run.components.extractor
    if run.config.features.max_side_px is not None or not isinstance(extractor, SizedExtractor):
        return
    key = fingerprint(run.key or run.drive_key, EXTRACTION_SIZE, run.feature_settings, EXTRACTION_SIZE_VERSION)
    stored = run.store.load(EXTRACTION_SIZE, key)
    if stored is None:
        run.require_unplanned()
        run.begin(Stage.FEATURES)
        started = time.perf_counter()
        found = find_sides(
            run.drive,
            extractor,
            max_keypoints=run.config.features.max_keypoints,
            threads=run.config.threads,
            segmenter=run.components.segmenter,
            own_cars=run.own_cars,
            cancel=run.cancel,
        )
        sizes = np.array([(*size, side) for size, side in sorted(found.items())], dtype=np.int64).reshape(-1, 3)
        stored = {"sizes": sizes}, {"seconds": round(time.perf_counter() - started, 3)}
        run.store.save(EXTRACTION_SIZE, key, *stored)
    run.side_px = {(width, height): side for width, height, side in stored[0]["sizes"].tolist()}
    run.report["extraction_size"] = {
        "images": [
            {"width": width, "height": height, "reduced_to_side_px": side}
            for (width, height), side in run.side_px.items()
        ],
        **stored[1],
    }
