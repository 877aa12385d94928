"""Poses of units that stood, in the scene of all units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.export.scene import check_scene
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.scene.standing_units import with_standing_units, without_units
from tests.helpers.export_example import make_scene

AT, BETWEEN = 2, 3  # the unit of the scene where the car stops, and units of the stop between it and the next
STOP = slice(AT + 1, AT + 1 + BETWEEN)


def with_stop(scene: Scene) -> tuple[Drive, np.ndarray, np.ndarray]:
    """The drive of a scene with a stop in it, which units are the scene's, and how far the images moved."""
    frames = scene.drive.manifest.frames
    step_us = (frames[AT + 1].timestamp_us - frames[AT].timestamp_us) // (BETWEEN + 1)
    stop = [
        frames[AT].model_copy(
            update={"timestamp_us": frames[AT].timestamp_us + step_us * (k + 1), "source_frame": 90 + k}
        )
        for k in range(BETWEEN)
    ]
    drive = Drive(
        scene.drive.root,
        scene.drive.manifest.model_copy(update={"frames": [*frames[: AT + 1], *stop, *frames[AT + 1 :]]}),
    )
    kept = np.array([*[True] * (AT + 1), *[False] * BETWEEN, *[True] * (len(frames) - AT - 1)])
    return drive, kept, np.where(kept, np.nan, 0.5)


@pytest.mark.parametrize("moving", [False, True])
def test_all_units_are_in_the_scene(moving: bool) -> None:
    scene = make_scene(moving=moving)
    scene.sigma_position_m[:] = 0.02
    drive, kept, moved_px = with_stop(scene)
    result, (stop,) = with_standing_units(scene, drive, kept, moved_px)
    check_scene(result)
    assert (stop.first, stop.last) == (AT, AT + 1 + BETWEEN)
    np.testing.assert_array_equal(result.world_from_rig[kept], scene.world_from_rig)
    np.testing.assert_array_equal(result.unit_registered[kept], scene.unit_registered)
    files = [[d.images[i].file for i in s.observation_image] for d, s in ((scene.drive, scene), (drive, result))]
    assert files[0] == files[1]
    of_kept = [i for i, image in enumerate(drive.images) if kept[image.unit]]
    np.testing.assert_array_equal(result.image_registered[of_kept], scene.image_registered)
    assert [(drive.images[p.image_a].file, drive.images[p.image_b].file) for p in result.pairs] == [
        (scene.drive.images[p.image_a].file, scene.drive.images[p.image_b].file) for p in scene.pairs
    ]
    assert [len(found.xy_px) > 0 for found in result.features] == [bool(kept[image.unit]) for image in drive.images]


def test_a_unit_between_is_posed_and_as_uncertain_as_its_images_allow() -> None:
    scene = make_scene()
    scene.sigma_position_m[:] = 0.02
    drive, kept, moved_px = with_stop(scene)
    ends = scene.world_from_rig[[AT, AT + 1], :3, 3]
    result, (stop,) = with_standing_units(scene, drive, kept, moved_px)
    between = result.world_from_rig[STOP, :3, 3]
    np.testing.assert_allclose(between[1], ends.mean(0), atol=0.01)
    assert result.unit_registered[STOP].all()
    way_m = np.linalg.norm(ends[1] - ends[0])
    assert (stop.sigma_m >= np.hypot(0.02, way_m / np.sqrt(12))).all()
    more, _ = with_standing_units(scene, drive, kept, 10 * moved_px)
    assert (more.sigma_position_m[STOP] > result.sigma_position_m[STOP]).all()


def test_one_end_is_enough_and_none_is_said() -> None:
    scene = make_scene()
    drive, kept, moved_px = with_stop(scene)
    for lost in ([AT + 1], [AT, AT + 1]):
        registered = np.ones(len(scene.unit_registered), dtype=np.bool_)
        registered[lost] = False
        image = np.array([registered[image.unit] for image in scene.drive.images])
        poses = np.where(registered[:, None, None], np.nan_to_num(scene.world_from_rig), np.nan)
        half = replace(scene, unit_registered=registered, image_registered=image, world_from_rig=poses)
        result, (stop,) = with_standing_units(half, drive, kept, moved_px)
        assert result.unit_registered[STOP].all() == (lost == [AT + 1])
        if lost == [AT + 1]:
            np.testing.assert_allclose(result.world_from_rig[STOP, :3, 3], np.tile(poses[AT, :3, 3], (BETWEEN, 1)))
        else:
            assert np.isnan(stop.sigma_m).all()
            assert not result.image_registered[[not kept[i.unit] for i in drive.images]].any()


def test_a_stop_between_two_parts_has_its_pose_in_one_of_them() -> None:
    scene = make_scene()
    drive, kept, moved_px = with_stop(scene)
    result, _ = with_standing_units(scene, drive, kept, moved_px)
    without = without_units(result, ~kept)
    check_scene(without)
    assert not without.unit_registered[~kept].any()
    assert np.isnan(without.world_from_rig[~kept]).all()
    np.testing.assert_array_equal(without.unit_registered[kept], scene.unit_registered)
