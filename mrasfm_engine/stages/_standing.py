"""Units of a standing car: left out before the long work, and given their poses in the finished scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mrasfm_engine.io.stage_store import fingerprint
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory, prior_trajectory
from mrasfm_engine.matching.standing import Standing, find_standing
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.scene.standing_units import with_standing_units, without_units
from mrasfm_engine.stages._run import Run
from mrasfm_engine.types import Ints

STANDING, STANDING_VERSION = "standing", 6


def leave_out_standing(run: Run, known: PriorTrajectory) -> PriorTrajectory:
    """Leave out units between the first and the last of each stop; the prior trajectory of all others.

    The run goes on with the drive of these, until `all_units`.
    """
    if not run.config.mapping.keyframe_motion_px or len(run.drive.timestamps_us) < 3:
        return known
    of_prior = [run.config.gnss.model_dump(), run.config.use_gnss]
    key = fingerprint(run.drive_key, STANDING, run.config.mapping.keyframe_motion_px, of_prior, STANDING_VERSION)
    if (stored := run.store.load(STANDING, key)) is not None:
        included, moved_px, compared = (stored[0][name] for name in ("included", "moved_px", "compared"))
        standing = Standing(included=included, moved_px=moved_px, compared=int(compared))
    else:
        run.require_unplanned()
        standing = find_standing(
            run.drive,
            known,
            min_motion_px=run.config.mapping.keyframe_motion_px,
            repeated=run.repeated,
            threads=run.config.threads,
            cancel=run.cancel,
        )
        arrays = {"included": standing.included, "moved_px": standing.moved_px, "compared": np.array(standing.compared)}
        if standing.included.all():
            run.nothing_left_out = (key, arrays)
        else:
            run.store.save(STANDING, key, arrays, {})
    if standing.included.all():
        return known
    run.standing, run.whole_drive = standing, run.drive
    run.key = fingerprint(run.drive_key, standing.included.tolist())
    run.drive = run.drive.restricted_to(standing.included)
    return prior_trajectory(run.drive, run.config.gnss, use_gnss=run.config.use_gnss)


def keep_nothing_left_out(run: Run) -> None:
    """Store that a search left out no unit: only sub-maps need to know that, which see a part of the drive."""
    if run.nothing_left_out is not None:
        run.store.save(STANDING, *run.nothing_left_out, {})


def all_units(
    run: Run, result: Scene, components: Sequence[tuple[Scene, dict[str, Any]]] = ()
) -> tuple[Scene, list[tuple[Scene, dict[str, Any]]]]:
    """The scenes with the units that `leave_out_standing` left out, and the reports in the drive's own units."""
    standing, drive = run.standing, run.whole_drive
    if standing is None or drive is None:
        return result, list(components)
    result, stops = with_standing_units(result, drive, standing.included, standing.moved_px)
    unit_of = np.flatnonzero(standing.included)
    parts, taken = list[tuple[Scene, dict[str, Any]]](), result.unit_registered.copy()
    for part, report in components:
        whole = with_standing_units(part, drive, standing.included, standing.moved_px)[0]
        # A stop between two parts has its pose in the larger one.
        parts.append((without_units(whole, taken), in_units(report, unit_of)))
        taken |= whole.unit_registered
    run.drive = drive
    for name in ("stages", "submaps"):
        if name in run.report:
            run.report[name] = in_units(run.report[name], unit_of)
    frames = drive.manifest.frames
    run.report["standing"] = {
        "units": int((~standing.included).sum()),
        "units_compared": standing.compared,
        "stops": [
            {
                "first_unit": stop.first,
                "last_unit": stop.last,
                "first_source_frame": frames[stop.first].source_frame,
                "last_source_frame": frames[stop.last].source_frame,
                "units_between": stop.last - stop.first - 1,
                "images_moved_at_most_px": round(float(standing.moved_px[stop.first + 1 : stop.last].max()), 3),
                "posed": bool(result.unit_registered[stop.first + 1]),
                "sigma_at_most_m": float(stop.sigma_m.max()) if np.isfinite(stop.sigma_m).all() else None,
            }
            for stop in stops
        ],
    }
    return result, parts


def in_units(report: Any, unit_of: Ints) -> Any:
    """A report with other numbers of its units: unit k of it becomes `unit_of[k]`."""
    if isinstance(report, list):
        return [in_units(part, unit_of) for part in report]
    if not isinstance(report, dict):
        return report
    result = {name: in_units(value, unit_of) for name, value in report.items()}
    if isinstance(report.get("unit"), int):
        result["unit"] = int(unit_of[report["unit"]])
    if "spans" in report:
        result["spans"] = [[int(unit_of[unit]) for unit in span] for span in report["spans"]]
    if report.get("initial_units") is not None:
        result["initial_units"] = [int(unit_of[unit]) for unit in report["initial_units"]]
    return result
