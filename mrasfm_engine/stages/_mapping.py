"""Units registered, points triangulated, everything adjusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrasfm_engine.io.stage_store import Arrays
from mrasfm_engine.mapping import gaps, mapping_report
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.components import Component, DriveMapping, begin_mapping
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.scene.row_bands import RowBands
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.stages._run import Run
from mrasfm_engine.triangulation.tracks import Keypoints
from schemas.artifacts import Stage
from schemas.findings import as_json

MappingWork = Callable[[Keypoints, list[PairMatches]], tuple[Arrays, dict[str, Any]]]  # arrays and report of the stage


@dataclass(frozen=True, kw_only=True)
class MappedDrive:
    """Features and matches of a drive, and what was mapped of them.

    Attributes
    ----------
    mappers
        Makes a mapper of every component, the largest first; once, as they change the arrays that they are made of.
        Mappers of a long drive are most of what stands in memory, and a refined scene in the store needs none.
    """

    features: Sequence[ImageFeatures]
    pairs: Sequence[PairMatches]
    mappers: Callable[[], list[Mapper]]


def mapping(
    run: Run, found: Sequence[ImageFeatures], pairs: Sequence[PairMatches], known: PriorTrajectory
) -> MappedDrive:
    """Units registered one by one, points triangulated, everything adjusted."""

    def work(keypoints: Keypoints, numbered_pairs: list[PairMatches]) -> tuple[Arrays, dict[str, Any]]:
        begun = mapping_of(run, keypoints, numbered_pairs, known)
        begun.map_from_seeds()
        return packed(begun.finish(), found)

    return map_once(run, found, pairs, known, work)


def keypoints_of(
    run: Run, found: Sequence[ImageFeatures], pairs: Sequence[PairMatches]
) -> tuple[Keypoints, list[PairMatches]]:
    """The keypoints that can be part of a track in one row of arrays, and the pairs with matches numbered by them."""
    bands = RowBands.from_drive(run.drive, compensate=run.config.mapping.motion_compensation)
    return Keypoints.from_matches(run.drive, found, pairs, bands)


def mapping_of(run: Run, keypoints: Keypoints, pairs: Sequence[PairMatches], known: PriorTrajectory) -> DriveMapping:
    """Mapping of the run's drive, of which nothing has a pose yet, from what `keypoints_of` gives."""
    return begin_mapping(
        run.drive,
        keypoints,
        pairs,
        known.world_from_rig,
        run.config,
        absolute=AbsolutePriors.from_trajectory(known),
        progress=run.step(Stage.MAPPING),
        cancel=run.cancel,
    )


def packed(parts: Sequence[Component], found: Sequence[ImageFeatures]) -> tuple[Arrays, dict[str, Any]]:
    """Components as arrays, and the report of the stage."""
    leave_out_images(parts, found)
    arrays = {
        f"{number}.{name}": array
        for number, part in enumerate(parts)
        for name, array in part.mapper.to_arrays().items()
    }
    return arrays, described(parts)


def leave_out_images(parts: Sequence[Component], found: Sequence[ImageFeatures]) -> None:
    """Take their poses from the images that were left out."""
    left_out = np.array([features.left_out is not None for features in found])
    for part in parts:
        part.mapper.missing |= left_out


def described(parts: Sequence[Component]) -> dict[str, Any]:
    """The report of the stage."""
    return {
        **mapping_report.describe(parts[0].mapper, parts[0].log, [part.mapper for part in parts[1:]]),
        **gaps.describe(parts),
        "findings": [
            as_json(finding)
            for finding in [
                *([] if parts[0].log.contradiction is None else [parts[0].log.contradiction]),
                *gaps.findings(parts),
                *mapping_report.places_alike_findings(parts[0].mapper, parts[0].log),
                *mapping_report.covered_camera_findings(parts[0].mapper, parts[0].log),
            ]
        ],
    }


def mapping_settings(run: Run) -> object:
    """Dependencies of mapping besides the matches."""
    sections = (run.config.mapping, run.config.bundle_adjustment, run.config.gnss)
    return [*(section.model_dump() for section in sections), run.config.seed, run.config.use_gnss]


def map_once(
    run: Run, found: Sequence[ImageFeatures], pairs: Sequence[PairMatches], known: PriorTrajectory, work: MappingWork
) -> MappedDrive:
    """The stage of mapping by some work on what `keypoints_of` gives, or from the store."""
    keypoints, arrays, report = _mapped_once(run, found, pairs, work)
    run.report["findings"] += report["findings"]

    def mappers() -> list[Mapper]:
        in_row = keypoints_of(run, found, pairs)[0] if keypoints is None else keypoints
        mapped = dict(arrays)
        arrays.clear()
        return [
            Mapper.from_arrays(run.drive, in_row, run.config, known.world_from_rig, numbered(mapped, number))
            for number in range(len(report["components"]))
        ]

    return MappedDrive(features=found, pairs=pairs, mappers=mappers)


def _mapped_once(
    run: Run, found: Sequence[ImageFeatures], pairs: Sequence[PairMatches], work: MappingWork
) -> tuple[Keypoints | None, Arrays, dict[str, Any]]:
    """Arrays and report of the stage, and the keypoints where it was done now; nobody needs its matches any more."""
    settings = mapping_settings(run)
    # No part of what the stage takes.
    given = None if run.is_done(Stage.MAPPING, settings) else keypoints_of(run, found, pairs)
    arrays, report = run.stage(Stage.MAPPING, settings, lambda: work(*(given or keypoints_of(run, found, pairs))))
    return None if given is None else given[0], arrays, report


def numbered(arrays: Arrays, number: int) -> Arrays:
    """The arrays of one of several parts, by their names in it."""
    return {name.partition(".")[2]: array for name, array in arrays.items() if name.startswith(f"{number}.")}
