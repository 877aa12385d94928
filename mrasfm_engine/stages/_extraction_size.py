"""The size at which images are extracted, once for a whole drive: units that sub-maps share have the same keypoints."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from mrasfm_engine.features.extraction_size import SizedExtractor, find_sides
from mrasfm_engine.io.stage_store import Arrays
from mrasfm_engine.stages._run import EXTRACTION_SIZE_VERSION, Run

EXTRACTION_SIZE = "extraction-size"


def extraction_sizes(run: Run) -> None:
    """Find the size for the images of the drive, or take it from the store: `run.side_px` has it from here on.

    The own car is known by then.
    """
    extractor = run.components.extractor
    if run.config.features.max_side_px is not None or not isinstance(extractor, SizedExtractor):
        return

    def find() -> tuple[Arrays, dict[str, Any]]:
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
        return {"sizes": sizes}, {"seconds": round(time.perf_counter() - started, 3)}

    stored, report = run.once(EXTRACTION_SIZE, run.feature_settings, EXTRACTION_SIZE_VERSION, find=find)
    run.side_px = {(width, height): side for width, height, side in stored["sizes"].tolist()}
    run.report["extraction_size"] = {
        "images": [
            {"width": width, "height": height, "reduced_to_side_px": side}
            for (width, height), side in run.side_px.items()
        ],
        **report,
    }
