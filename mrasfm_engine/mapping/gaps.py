"""Gaps of a mapped drive: units without a pose, and parts that no image links to the others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.mapping.components import Component, LinkedBy
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.types import Bools, Ints
from schemas.findings import Finding, error, listed, warning


def describe(parts: Sequence[Component]) -> dict[str, Any]:
    """Components of a drive, the scene's own first, and how parts of each were put together, in plain values."""
    return {
        "components": [
            {
                "units": part.size,
                "spans": [list(span) for span in spans(part.mapper.registered)],
                "links": [{"by": str(link.by), "spans": [list(s) for s in spans(link.units)]} for link in part.links],
            }
            for part in parts
        ]
    }


def findings(parts: Sequence[Component]) -> list[Finding]:
    """Errors for components and for parts that no image links, and a warning for other units without a pose."""
    result = []
    drive, whole = parts[0].mapper.drive, parts[0].mapper
    if len(parts) > 1:
        others = [f"{part.size} ({in_words(drive, spans(part.mapper.registered))})" for part in parts[1:]]
        result.append(
            error(
                "drive-in-components",
                f"nothing links all parts of the drive: besides the scene's {parts[0].size} units there are components "
                f"of {listed(others)} in frames of their own",
                "Look at the images between them (dark, covered, or missing?). GNSS or rough poses put parts together "
                "that share no view. The others lie in components/N.",
            )
        )
    apart = [link for link in parts[0].links if link.by != LinkedBy.IMAGES]
    if apart:
        linked = [f"{in_words(drive, spans(link.units))} by {link.by}" for link in apart]
        result.append(
            error(
                "gap-without-images",
                f"no image links {listed(linked)} to the rest of the drive",
                "Where parts lie to one another is as certain as these are: see sigma_position_m in poses.json. Look "
                "at the images between the parts (dark, covered, or missing?).",
            )
        )
    lost = whole.keyframe & ~np.any([part.mapper.registered for part in parts], axis=0)
    if lost.any():
        result.append(
            warning(
                "units-without-pose",
                f"{int(lost.sum())} of {len(lost)} units have no pose: {in_words(drive, spans(lost))}",
                "units_not_registered in report.json has the reason of each. Look at their images (dark, covered, "
                "without texture, left out?).",
            )
        )
    return result


def lost(mapper: Mapper, problem: ReconstructionError) -> Finding:
    """A component that could not be refined."""
    where = in_words(mapper.drive, spans(mapper.registered))
    return error(
        "component-lost",
        f"a component of {int(mapper.registered.sum())} units ({where}) has no scene: {problem}",
        problem.remedy,
    )


def spans(units: Bools) -> list[tuple[int, int]]:
    """First and last unit of each run of units (u,)."""
    rows: Ints = np.flatnonzero(units)
    if not len(rows):
        return []
    ends = np.flatnonzero(np.diff(rows) > 1)
    first, last = np.concatenate([[0], ends + 1]), np.concatenate([ends, [len(rows) - 1]])
    return [(int(rows[a]), int(rows[b])) for a, b in zip(first, last, strict=True)]


def in_words(drive: Drive, runs: Sequence[tuple[int, int]]) -> str:
    """Frames and times of runs of units, as `spans` gives them."""
    frames = drive.manifest.frames
    start_us = frames[0].timestamp_us

    def one(first: int, last: int) -> str:
        at_s = [f"{(frames[unit].timestamp_us - start_us) / 1e6:.1f}" for unit in (first, last)]
        if first == last:
            return f"frame {frames[first].source_frame} at {at_s[0]} s"
        return f"frames {frames[first].source_frame} to {frames[last].source_frame} at {at_s[0]} to {at_s[1]} s"

    return listed([one(*run) for run in runs])
