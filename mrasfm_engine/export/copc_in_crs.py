"""Format `copc`: the points as a cloud-optimised point cloud in the coordinate reference system that the user names."""

from __future__ import annotations

from functools import partial

from mrasfm_engine.errors import InputError
from mrasfm_engine.export import copc, copc_readback
from mrasfm_engine.export.check import Check
from mrasfm_engine.export.contract import ExportOptions, ExportSource, ExportWork, Written
from mrasfm_engine.geometry.earth_system import EarthSystem, named_system, utm_system
from schemas.artifacts import COPC_FILE


def write_copc_in_crs(work: ExportWork) -> Written:
    """Write `points.copc.laz`; the scene must be georeferenced, and may be refused as `system_of_points` does."""
    scene = work.source.scene
    system = system_of_points(work.source, work.options)
    digest = copc.write_copc(scene, work.folder / COPC_FILE, system)
    compare = partial(copc_readback.copc, scene, text=system.well_known_text)
    check = Check(COPC_FILE, copc_readback.read_copc, compare)
    return Written(
        checks=[check], digests={COPC_FILE: digest}, notes=[f"coordinates are in {system.name}", *system.notes()]
    )


def system_of_points(source: ExportSource, options: ExportOptions) -> EarthSystem:
    """The system that the points of a georeferenced scene are written in, by default UTM.

    Raises
    ------
    InputError
        Where the points do not fit into the format, or the system does not fit the scene.
    """
    if not copc.fits(source.scene):
        raise InputError(
            f"the points do not fit into a COPC: there are none, or one is over {copc.REACH_M / 1000:.0f} km from the "
            "origin",
            remedy="Leave the format out.",
            code="too-far",
        )
    place, crs = source.scene.georeference, options.crs
    assert place is not None
    return utm_system(*place.origin_deg) if crs is None else named_system(crs, at=place.origin_deg)
