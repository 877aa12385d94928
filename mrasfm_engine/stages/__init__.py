"""The stages of a reconstruction.

Each takes its input, leaves its result and a report in the store, and is skipped where both are there already.
"""

from __future__ import annotations

from mrasfm_engine.stages._begin import keep_preflight, load_models, preflight, prior, probe
from mrasfm_engine.stages._cut import count_of_submaps, cut_drive, is_cut
from mrasfm_engine.stages._extraction_size import extraction_sizes
from mrasfm_engine.stages._features import features, store_features
from mrasfm_engine.stages._mapping import MappedDrive, mapping
from mrasfm_engine.stages._matches import matches, pack_pairs, unpack_pairs
from mrasfm_engine.stages._own_car import own_cars
from mrasfm_engine.stages._refinement import refinement
from mrasfm_engine.stages._run import VERSIONS, Run, store_of
from mrasfm_engine.stages._scene import numbered_components, pictures, record_images
from mrasfm_engine.stages._standing import all_units, in_units, leave_out_standing
from mrasfm_engine.stages._submap_run import SubmapRun
from mrasfm_engine.stages._submaps import mapped

__all__ = [
    "VERSIONS",
    "MappedDrive",
    "Run",
    "SubmapRun",
    "all_units",
    "count_of_submaps",
    "cut_drive",
    "extraction_sizes",
    "features",
    "in_units",
    "is_cut",
    "keep_preflight",
    "leave_out_standing",
    "load_models",
    "mapped",
    "mapping",
    "matches",
    "numbered_components",
    "own_cars",
    "pack_pairs",
    "pictures",
    "preflight",
    "prior",
    "probe",
    "record_images",
    "refinement",
    "store_features",
    "store_of",
    "unpack_pairs",
]
