"""One sub-map of a long drive: extracted, matched and mapped by itself."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import cached_property
from typing import Any

import numpy as np

from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.features.stored_features import StoredFeatures
from mrasfm_engine.io.stage_store import Arrays, StoredStage, fingerprint
from mrasfm_engine.mapping.submaps import Part, part_arrays, part_from_arrays
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.scene.submaps import Span
from mrasfm_engine.stages._begin import prior
from mrasfm_engine.stages._cut import SUBMAPS
from mrasfm_engine.stages._features import extract
from mrasfm_engine.stages._mapping import (
    described,
    keypoints_of,
    leave_out_images,
    mapping_of,
    mapping_settings,
    numbered,
)
from mrasfm_engine.stages._matches import match, match_settings, read_pairs
from mrasfm_engine.stages._run import Run
from mrasfm_engine.stages._standing import in_units
from schemas.artifacts import Stage, submap_checkpoint


class SubmapRun:
    """The stages of one sub-map: done, or found in the store, as soon as their results are asked for.

    Parameters
    ----------
    run
        The whole drive's, whose own car and sizes of extraction are known.
    """

    def __init__(self, run: Run, span: Span) -> None:
        self.span = span
        units = np.zeros(len(run.drive.manifest.frames), dtype=np.bool_)
        units[span.units] = True
        self.images = span.images_of(run.drive)
        self.run = Run(
            run.drive.restricted_to(units),
            run.config,
            run.store.with_prefix(submap_checkpoint(span.number, "")),
            run.progress,
            run.cancel,
            own_cars=run.own_cars,
            side_px=run.side_px,
            key=fingerprint(run.key or run.drive_key, SUBMAPS, asdict(span)),
        )
        self.run.share(run)

    @cached_property
    def is_finished(self) -> bool:
        """True where its last stage is in the store."""
        last = replace(self.run)
        last.share(self.run)
        last.key = last.next_key(Stage.FEATURES, last.feature_settings)
        last.key = last.next_key(Stage.MATCHES, match_settings(last))
        return last.store.has(Stage.MAPPING, last.next_key(Stage.MAPPING, mapping_settings(last)))

    @cached_property
    def known(self) -> PriorTrajectory:
        """The prior trajectory of its units."""
        return prior(self.run)

    @cached_property
    def features(self) -> StoredFeatures:
        """Features of its images."""
        return extract(self.run)[0]

    @cached_property
    def matches(self) -> StoredStage:
        """Matches among its images."""
        return match(self.run, self.features, self.known)[0]

    @cached_property
    def mapped(self) -> Arrays:
        """Its components as arrays, see `part_arrays`, and its keyframes."""
        features, matches = self.features, self.matches  # in their order

        def work() -> tuple[Arrays, dict[str, Any]]:
            begun = mapping_of(self.run, *keypoints_of(self.run, features, read_pairs(matches)), self.known)
            arrays: Arrays = {"keyframe": begun.mapper.keyframe.copy()}
            begun.mapper.keyframe |= self.span.is_shared  # else creeping units might have no pose in common
            try:
                begun.map_from_seeds()
            except ReconstructionError as problem:
                return arrays, {"components": [], "reason": str(problem)}
            parts = begun.put_together()
            leave_out_images(parts, features)
            for number, part in enumerate(parts):
                arrays |= {f"{number}.{name}": array for name, array in part_arrays(part).items()}
            # What they find, the joined scene finds as well.
            return arrays, {**described(parts), "findings": []}

        return self.run.stage(Stage.MAPPING, mapping_settings(self.run), work)[0]

    def do(self, stage: Stage) -> None:
        """Do a stage and those before it, as far as they are not in the store."""
        match stage:
            case Stage.FEATURES:
                _ = self.features
            case Stage.MATCHES:
                _ = self.matches
            case _:
                _ = self.mapped

    def entry(self, stage: Stage) -> dict[str, Any]:
        """Its report of one of its stages."""
        return next(entry for entry in self.run.report["stages"] if entry["stage"] == stage)

    @property
    def report(self) -> dict[str, Any]:
        """Its entry in the drive's report, in the drive's units."""
        stages = in_units(self.run.report["stages"], self.span.units)
        return {"number": self.span.number, "spans": [[self.span.first, self.span.last]], "stages": stages}

    def parts(self) -> list[Part]:
        """Its components in the whole drive's units."""
        components = self.entry(Stage.MAPPING)["components"]
        return [
            part_from_arrays(numbered(self.mapped, number), self.span.units, self.images)
            for number in range(len(components))
        ]

    def pairs(self) -> list[PairMatches]:
        """Its pairs in the whole drive's images."""
        return [
            replace(pair, image_a=int(self.images[pair.image_a]), image_b=int(self.images[pair.image_b]))
            for pair in read_pairs(self.matches)
        ]
