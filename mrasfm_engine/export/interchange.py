"""The files of a scene or map in formats of other programs: what is written, and how it is read back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mrasfm_engine.export import (
    autoware,
    autoware_readback,
    copc,
    copc_readback,
    geopackage,
    geopackage_readback,
    rig_files,
    rig_files_readback,
)
from mrasfm_engine.export.check import Check
from mrasfm_engine.scene.scene import Scene
from schemas.artifacts import AUTOWARE_FOLDER, COPC_FILE, TRAJECTORY_FILE

OPTIONAL = (COPC_FILE, AUTOWARE_FOLDER)  # not of every scene


@dataclass(frozen=True, kw_only=True)
class Interchange:
    """Content of the files."""

    scene: Scene
    scene_of_unit: Sequence[str]  # name of the scene that each unit is of
    rigs: Mapping[str, str]  # folders, and what the names of their cameras begin with

    def write(self, folder: Path) -> list[str]:
        """Write the files into a scene's or map's folder; which are withheld, and why."""
        geopackage.write_geopackage(self.scene, self.scene_of_unit, folder / TRAJECTORY_FILE)
        notes = []
        for rig, prefix in self.rigs.items():
            lacking = rig_files.write_rig(rig_files.rig_cameras(self.scene, prefix), folder / rig)
            notes += [f"{rig}/{what}" for what in lacking]
        if autoware.fits(self.scene):
            autoware.write_autoware(self.scene, folder / AUTOWARE_FOLDER)
        if copc.fits(self.scene):
            copc.write_copc(self.scene, folder / COPC_FILE)
        else:
            notes += [f"{COPC_FILE} is withheld: it holds points up to {copc.REACH_M / 1000:.0f} km from the origin"]
        return notes

    def checks(self) -> list[Check]:
        """Checks of what `write` writes."""
        scene = self.scene
        points = Check(COPC_FILE, copc_readback.read_copc, partial(copc_readback.copc, scene))
        trajectory = partial(geopackage_readback.geopackage, scene, self.scene_of_unit)
        return [
            *([points] if copc.fits(scene) else []),
            Check(TRAJECTORY_FILE, geopackage_readback.read_geopackage, trajectory),
            *(check for rig, prefix in self.rigs.items() for check in _rig_checks(scene, rig, prefix)),
            *(_autoware_checks(scene) if autoware.fits(scene) else []),
        ]


def _rig_checks(scene: Scene, folder: str, prefix: str) -> Iterator[Check]:
    read, cameras = rig_files_readback.read_text, rig_files.rig_cameras(scene, prefix)
    if any(map(rig_files.known_to_kalibr, cameras)):
        yield Check(f"{folder}/{rig_files.CAMCHAIN}", read, partial(rig_files_readback.camchain, scene, prefix))
    yield Check(f"{folder}/{rig_files.DESCRIPTION}", read, partial(rig_files_readback.description, scene, prefix))
    for camera in filter(rig_files.known_to_ros, cameras):
        file = f"{folder}/{rig_files.CAMERA_INFO}/{camera.name}.yaml"
        yield Check(file, read, partial(rig_files_readback.camera_info, scene, prefix, camera.name))


def _autoware_checks(scene: Scene) -> Iterator[Check]:
    points, projection = (f"{AUTOWARE_FOLDER}/{name}" for name in (autoware.POINTS, autoware.PROJECTOR))
    yield Check(projection, rig_files_readback.read_text, partial(autoware_readback.projector, scene))
    yield Check(points, autoware_readback.read_pcd, partial(autoware_readback.pcd, scene))
