"""Format `copc`: the points as a cloud-optimised point cloud in the coordinate reference system that the user names."""

from __future__ import annotations

from functools import partial

from mrasfm_engine.errors import InputError
from mrasfm_engine.export import copc, copc_readback
from mrasfm_engine.export.check import Check
from mrasfm_engine.export.contract import ExportWork, Written
from mrasfm_engine.geometry.earth_system import EarthSystem, named_system, utm_system
from mrasfm_engine.scene.scene import Scene
from schemas.artifacts import COPC_FILE


def write_copc_in_crs(work: ExportWork) -> Written:
    """Write `points.copc.laz`; the scene must be georeferenced."""
    scene = work.source.scene
    if not copc.fits(scene):
        raise InputError(
            f"the points do not fit into a COPC: there are none, or one is over {copc.REACH_M / 1000:.0f} km from the "
            "origin",
            remedy="Leave the format out.",
            code="too-far",
        )
    system = _system(scene, work.options.crs)
    digest = copc.write_copc(scene, work.folder / COPC_FILE, system)
    compare = partial(copc_readback.copc, scene, text=system.well_known_text)
    check = Check(COPC_FILE, copc_readback.read_copc, compare)
    return Written(
        checks=[check], digests={COPC_FILE: digest}, notes=[f"coordinates are in {system.name}", *system.notes()]
    )


def _system(scene: Scene, crs: str | None) -> EarthSystem:
    place = scene.georeference
    assert place is not None
    return utm_system(*place.origin_deg) if crs is None else named_system(crs, at=place.origin_deg)
