"""The files of a scene or map in formats of other programs: what is written, and how it is read back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mrasfm_engine.export import copc, copc_readback, geopackage, geopackage_readback
from mrasfm_engine.export.check import Check
from mrasfm_engine.scene.scene import Scene
from schemas.artifacts import COPC_FILE, TRAJECTORY_FILE

FILES = (COPC_FILE, TRAJECTORY_FILE)  # some are not there where the scene has no place on the earth, or no points


@dataclass(frozen=True, kw_only=True)
class Interchange:
    """Content of the files."""

    scene: Scene
    scene_of_unit: Sequence[str]  # name of the scene that each unit is of

    def write(self, folder: Path) -> list[str]:
        """Write the files into a scene's or map's folder; which are withheld, and why."""
        geopackage.write_geopackage(self.scene, self.scene_of_unit, folder / TRAJECTORY_FILE)
        if not copc.fits(self.scene):
            return [f"{COPC_FILE} is withheld: it holds points up to {copc.REACH_M / 1000:.0f} km from the origin"]
        copc.write_copc(self.scene, folder / COPC_FILE)
        return []

    def checks(self) -> list[Check]:
        """Checks of what `write` writes."""
        scene = self.scene
        points = Check(COPC_FILE, copc_readback.read_copc, partial(copc_readback.copc, scene))
        trajectory = partial(geopackage_readback.geopackage, scene, self.scene_of_unit)
        return [
            *([points] if copc.fits(scene) else []),
            Check(TRAJECTORY_FILE, geopackage_readback.read_geopackage, trajectory),
        ]
