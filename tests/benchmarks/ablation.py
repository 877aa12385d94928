"""Line 10: what every part of the method is worth, with everything else the same."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.benchmarks.commands import mrasfm
from tests.benchmarks.real_drives import imported
from tests.benchmarks.recalibration import AS_DECLARED, CAMERAS, SIZE, UNITS
from tests.benchmarks.table import Figure, exactly

SEED = 1
FULL, CSBA = "full", "bundle_adjustment.camera_set_adjustment"
TIMEOUT_S = 3600.0
WORSE = 1.0  # without a part, an error is more than this many times as large,
FAR_WORSE = 1000.0  # and not so large that something else must have gone wrong


def ablation(data: Path, work: Path) -> Iterator[Figure]:
    """Line 10."""
    kitti = imported(data, "kitti06", work)
    yield from _rows("kitti06 without GNSS", kitti, 2, 102, "--no-gnss")
    # With GNSS the calibration varies, and the true one is not known to a tenth of a degree.
    yield from _rows("kitti06 with GNSS", kitti, 2, 102, rotation_known=False)
    title = f"{CAMERAS} cameras, {UNITS} units, rendered"
    yield from _rows(title, _surround(work / "surround as declared"), CAMERAS, CAMERAS * UNITS)


def _surround(drive: Path) -> Path:
    """A rendered drive whose calibration is as good as it is declared to be.

    Scale rests on GNSS and on the calibration, and only camera set adjustment has it from both: with a calibration that
    is worse than declared, this would measure chance.
    """
    mrasfm("synth", "--cameras", CAMERAS, "--units", UNITS, "--seed", SEED, *SIZE, *AS_DECLARED, "--out", drive)
    return drive


def _rows(
    title: str, drive: Path, cameras: int, images: int, *options: str, rotation_known: bool = True
) -> Iterator[Figure]:
    said = mrasfm("ablate", drive, "--truth", drive / "truth.tum", "--json", *options, timeout_s=TIMEOUT_S)
    rows = {row["name"]: row for row in json.loads(said)["rows"]}
    yield exactly("10", f"{title}: images registered by the full method", rows[FULL]["registered_images"], images)
    yield from _without_csba(title, rows[FULL], rows[CSBA], cameras, rotation_known=rotation_known)
    for row in rows.values():
        yield from _as_measured(f"{title}, {row['title']}", row)


def _without_csba(
    title: str, full: dict[str, Any], without: dict[str, Any], cameras: int, *, rotation_known: bool
) -> Iterator[Figure]:
    """Camera set adjustment has fewer unknowns and smaller errors than images that are adjusted on their own."""
    for what, key, known in (
        ("metric RMSE of images", "metric_rmse_m", True),
        ("rotation of images", "rotation_median_deg", rotation_known),
    ):
        yield Figure(
            line="10",
            what=f"{title}: {what}, without CSBA to with",
            value=without["errors"]["images"][key] / full["errors"]["images"][key],
            above=WORSE,
            most=FAR_WORSE if known else None,
        )
    yield Figure(
        line="10",
        what=f"{title}: pose parameters, without CSBA to with",
        value=without["pose_parameters"] / full["pose_parameters"],
        above=WORSE,
        most=cameras + 0.5,  # images of the unit that holds the frame are no unknowns
    )
    yield Figure(
        line="10", what=f"{title}: mapping time, without CSBA to with", value=without["mapping_s"] / full["mapping_s"]
    )


def _as_measured(title: str, row: dict[str, Any]) -> Iterator[Figure]:
    yield Figure(line="10", what=f"{title}: images registered", value=row["registered_images"], remark=row["remark"])
    yield Figure(line="10", what=f"{title}: parameters of poses", value=row["pose_parameters"])
    yield Figure(line="10", what=f"{title}: parameters in all", value=row["parameters"])
    yield Figure(line="10", what=f"{title}: iterations of the last adjustment", value=row["iterations"])
    yield Figure(line="10", what=f"{title}: mapping and refinement", value=row["mapping_s"], unit="s")
    if row["errors"] is None:
        return
    for of in ("units", "images"):
        errors = row["errors"][of]
        yield Figure(line="10", what=f"{title}: {of}, metric RMSE", value=errors["metric_rmse_m"], unit="m")
        yield Figure(line="10", what=f"{title}: {of}, similarity RMSE", value=errors["similarity_rmse_m"], unit="m")
        yield Figure(line="10", what=f"{title}: {of}, rotation", value=errors["rotation_median_deg"], unit="deg")
