"""The receiver of a drive as its scene found it: the clock, and where the antenna is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from schemas.drive import Gnss


def gnss_as_found(gnss: Gnss, found: Mapping[str, Any]) -> Gnss:
    """The positions at the times, and of the antenna at the place, that the entry `gnss` of a refinement's report has.

    Raises
    ------
    KeyError, TypeError, ValueError
        Where the entry is not as refinements write it.
    """
    changes: dict[str, Any] = {}
    if "antenna" in found:
        changes["antenna_in_rig_m"] = found["antenna"]["used_in_rig_m"]
    if "clock_offset_s" in found:
        late_us = round(float(found["clock_offset_s"]) * 1e6)
        samples = [dict(sample) | {"timestamp_us": sample.timestamp_us + late_us} for sample in gnss.samples]
        changes["samples"] = [sample for sample in samples if sample["timestamp_us"] >= 0]
    return Gnss(**dict(gnss) | changes) if changes else gnss
