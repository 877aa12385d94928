"""Format `geopackage`: the path and the positions of units and cameras in the system that the user names."""

from __future__ import annotations

from functools import partial

from mrasfm_engine.export import geopackage, geopackage_readback
from mrasfm_engine.export.check import Check
from mrasfm_engine.export.contract import ExportWork, Written
from mrasfm_engine.geometry.earth_system import named_system
from schemas.artifacts import TRAJECTORY_FILE


def write_geopackage_in_crs(work: ExportWork) -> Written:
    """Write `trajectory.gpkg`; the scene must be georeferenced."""
    source, crs = work.source, work.options.crs
    place = source.scene.georeference
    assert place is not None
    system = None if crs is None else named_system(crs, at=place.origin_deg)
    digest = geopackage.write_geopackage(source.scene, source.scene_of_unit, work.folder / TRAJECTORY_FILE, system)
    compare = partial(geopackage_readback.geopackage, source.scene, source.scene_of_unit, crs=crs)
    check = Check(TRAJECTORY_FILE, geopackage_readback.read_geopackage, compare)
    notes = [
        f"coordinates are in {'EPSG:4326' if system is None else system.name}",
        *(system.notes() if system else ()),
    ]
    return Written(checks=[check], digests={TRAJECTORY_FILE: digest}, notes=notes)
