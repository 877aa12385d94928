"""A scene comes out of a stage's file as it went in."""

from __future__ import annotations

import zlib
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np

from mrasfm_engine.io.packed_scene import GIVEN, pack_scene, unpack_scene
from mrasfm_engine.io.stage_store import StageStore
from mrasfm_engine.scene.road import Road, RoadPoints, RoadSource, RoadSurface
from mrasfm_engine.scene.road_relief import Relief
from mrasfm_engine.scene.scene import CalibrationObservability, CameraCalibration, Georeference, Scene
from mrasfm_engine.stages import VERSIONS
from schemas.artifacts import Stage
from tests.helpers.export_example import make_scene


def through_a_file(scene: Scene, folder: Path) -> Scene:
    arrays, document = pack_scene(scene)
    store = StageStore(folder)
    store.save("scene", "key", arrays, document)
    stored = store.load("scene", "key")
    assert stored is not None
    return unpack_scene(*stored, **{name: getattr(scene, name) for name in GIVEN})


def assert_same(a: object, b: object, name: str) -> None:
    assert type(a) is type(b), name
    if is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{name}.{field.name}")
    elif isinstance(a, np.ndarray):
        assert isinstance(b, np.ndarray)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), name
    elif isinstance(a, list):
        assert isinstance(b, list)
        for number, pair in enumerate(zip(a, b, strict=True)):
            assert_same(*pair, f"{name}.{number}")
    else:
        assert a == b or (a != a and b != b), name


def test_a_stored_refinement_has_a_version_for_its_fields() -> None:
    """Raise `VERSIONS[Stage.REFINEMENT]` with every change of these: older files have others."""
    kinds = (Scene, CameraCalibration, CalibrationObservability, Georeference, Road, RoadSurface, RoadPoints, Relief)
    names = ",".join(f"{kind.__name__}.{field.name}" for kind in kinds for field in fields(kind))
    assert (VERSIONS[Stage.REFINEMENT], len(names), zlib.crc32(names.encode())) == (31, 1583, 3240927411)


def test_every_field(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    relief = Relief(node_m=rng.normal(size=(2, 3)), height_m=rng.normal(size=2), slope=np.eye(2), sigma_m=np.ones(2))
    surface = RoadSurface(axes=np.eye(3), centre_m=np.ones((1, 3)), normal=np.eye(3)[2:], radius_m=7.1, relief=relief)
    before = RoadPoints(
        points_m=rng.normal(size=(4, 3)), distance_m=np.array([0.1, np.nan, 0.2, 0.3]), is_inlier=np.arange(4) < 2
    )
    scene = make_scene()
    scene = replace(
        scene,
        calibration_observability=CalibrationObservability(
            adjusted=True, reason="it turns", scale_observed=False, scale_rests_on="what was given", sigma_scale=np.nan
        ),
        calibration=[
            replace(scene.calibration[0], focal_observed=None, time_offset_s=None),
            *(replace(one, focal_observed=True, time_offset_s=0.1 + 0.2) for one in scene.calibration[1:]),
        ],
        notes=["a note"],
        unit_from_image=np.tile(np.eye(4), (len(scene.drive.images), 1, 1)),
        road=Road(source=RoadSource.GEOMETRY, surface=surface, roughness_m=0.01, rig_height_m=1.7, before=before),
    )
    assert_same(through_a_file(scene, tmp_path), scene, "scene")
    assert scene.georeference is not None
    scene = replace(scene, georeference=None, rough_world_from_local=np.eye(4), road=None, unit_from_image=None)
    assert_same(through_a_file(scene, tmp_path), scene, "scene")
