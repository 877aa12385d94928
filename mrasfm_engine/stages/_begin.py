"""The beginning of a reconstruction: models, the check of the drive, its prior trajectory, a probe of calibration."""

from __future__ import annotations

from typing import Any

import numpy as np

from mrasfm_engine import __version__
from mrasfm_engine.errors import InputError
from mrasfm_engine.features.extraction import extract_features
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.io.stage_store import fingerprint
from mrasfm_engine.matching.calibration_check import require_calibration_direction
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory, prior_trajectory
from mrasfm_engine.preflight.drive_check import require_sound
from mrasfm_engine.preflight.image_content import inspect_drive
from mrasfm_engine.stages._run import Run
from schemas.artifacts import PLAN_CHECKPOINTS, Stage
from schemas.findings import Finding, as_json, warning

_CHECK = "preflight"
PROBE_UNITS = 5
USUAL_TIMES = 2.0  # the usual time between two positions, that a repeated one lasts


def load_models(run: Run) -> None:
    """Read the models that the settings name; refuse what does not go together before any work."""
    run.report["models"] = run.components.describe()


def preflight(run: Run) -> list[dict[str, Any]]:
    """Check manifest, files and a sample of the images; refuse what cannot work before any long work. The findings.

    Where the plan of a long drive has done that, its findings stand.
    """
    run.begin(Stage.PREFLIGHT)
    stored = None if run.content_sha256 is None else run.store.load(_CHECK, _check_key(run))
    if stored is not None:
        result = list[dict[str, Any]](stored[1]["findings"])
    else:
        findings = inspect_drive(
            run.drive,
            use_gnss=run.config.use_gnss,
            progress=run.step(Stage.PREFLIGHT),
            cancel=run.cancel,
            content_sha256=run.content_sha256,
        )
        result = [as_json(finding) for finding in findings]
        require_sound(findings)
    run.report["findings"] = list(result)
    run.progress(Stage.PREFLIGHT, 1, 1)
    return result


def keep_preflight(run: Run, findings: list[dict[str, Any]]) -> None:
    """Store that the drive is sound, and what was found: the check reads every file of it."""
    if run.content_sha256 is not None and not run.store.has(_CHECK, _check_key(run)):
        run.store.save(_CHECK, _check_key(run), {}, {"findings": findings})


def _check_key(run: Run) -> str:
    return fingerprint(run.drive_key, _CHECK, run.config.use_gnss, __version__)


def prior(run: Run) -> PriorTrajectory:
    """Read the prior trajectory of the units."""
    result = prior_trajectory(run.drive, run.config.gnss, use_gnss=run.config.use_gnss)
    counts = {"gnss_samples": 0, "gnss_gross_errors": 0, "gnss_held": 0}
    if (track := result.gnss) is not None:
        gross_errors, held = int((~track.good & ~track.held).sum()), int(track.held.sum())
        counts = {"gnss_samples": len(track.good), "gnss_gross_errors": gross_errors, "gnss_held": held}
        run.report["findings"] += [as_json(finding) for finding in held_findings(track)]
    run.report["prior"] = {"source": result.source, **counts}
    return result


def held_findings(track: GnssTrack) -> list[Finding]:
    """The finding that a receiver, or its log, repeats positions for longer than it usually does.

    A log that writes every position of a slow receiver several times is none.
    """
    own = np.flatnonzero(~track.held)
    if len(own) < 2 or not track.held.any():
        return []
    times_us = track.timestamps_us[own]
    until_us = np.append(times_us[1:], track.timestamps_us[-1])
    is_repeated = np.append(track.held, False)[own + 1]
    held_us = np.where(is_repeated, until_us - times_us, 0)
    is_long = held_us > USUAL_TIMES * np.median(np.diff(times_us))
    if not is_long.any():
        return []
    longest = int(np.argmax(held_us))
    times = "once" if is_long.sum() == 1 else f"{int(is_long.sum())} times"
    return [
        warning(
            "gnss-held",
            f"gnss.samples repeat one position while the vehicle drives on, {times}, for up to "
            f"{held_us[longest] / 1e6:.1f} s after {times_us[longest]} us",
            "Nothing needs to be done: repetitions are left out. The receiver had no fix there, or its log stopped.",
        )
    ]


def probe(run: Run) -> None:
    """Check on the first units that the calibration is the right way round; their features are those of the stage.

    What they say against it, units in the middle of the drive have to say as well: beside a vehicle that has just begun
    to move, all that moves may be the others.
    """
    known = run.store.has("features", run.next_key(Stage.FEATURES, run.feature_settings))
    if len(run.drive.cameras) < 2 or known:
        return
    try:
        try:
            _probe(run, 0)
        except InputError:
            middle = len(run.drive.manifest.frames) // 2
            if middle < PROBE_UNITS:
                raise
            _probe(run, middle)
    except InputError:
        run.store.forget(PLAN_CHECKPOINTS)  # the drive with another calibration is another one
        raise


def _probe(run: Run, first_unit: int) -> None:
    """Check the calibration's direction on some units, whose features are kept.

    Raises
    ------
    InputError
        See `require_calibration_direction`.
    """
    units = range(first_unit, min(first_unit + PROBE_UNITS, len(run.drive.manifest.frames)))
    images = [i for i, image in enumerate(run.drive.images) if image.unit in units]
    probed = run.drive.part(units)
    features = extract_features(
        probed,
        run.extractor,
        threads=run.config.threads,
        segmenter=run.components.segmenter,
        class_margin_px=run.config.features.class_margin_px,
        own_cars=run.own_cars,
        repeated=run.repeated,
        cancel=run.cancel,
    )
    kept = {image.file: found for image, found in zip(probed.images, features, strict=True) if not found.left_out}
    run.probed = {**run.probed, **kept}
    if not all(f.left_out for f in features):  # else the extraction says whether there are others
        require_calibration_direction(run.drive, images, features, run.components.matcher, run.config.matching)
