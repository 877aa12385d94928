"""Several scenes in one frame: units, cameras, images and keypoints numbered through, as adjustments take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.bundle_adjustment.problem import Observations, RowBandMotion
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.scene.row_bands import readout_share
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools, Floats, Ints


def _offsets(counts: Sequence[int]) -> Ints:
    return np.concatenate([[0], np.cumsum(np.array(counts, dtype=np.int64))]).astype(np.int64)


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """Scenes side by side. Units, cameras, images, keypoints and points of scene k follow those of scene k - 1."""

    scenes: Sequence[SourceScene]

    @cached_property
    def first_unit(self) -> Ints:
        """(scenes + 1,)."""
        return _offsets([len(s.unit_registered) for s in self.scenes])

    @cached_property
    def first_camera(self) -> Ints:
        """(scenes + 1,)."""
        return _offsets([len(s.drive.cameras) for s in self.scenes])

    @cached_property
    def first_image(self) -> Ints:
        """(scenes + 1,)."""
        return _offsets([len(s.image_unit) for s in self.scenes])

    @cached_property
    def first_keypoint(self) -> Ints:
        """(scenes + 1,)."""
        return _offsets([len(s.keypoint_point) for s in self.scenes])

    @cached_property
    def first_point(self) -> Ints:
        """(scenes + 1,)."""
        return _offsets([len(s.points_m) for s in self.scenes])

    @cached_property
    def scene_of_unit(self) -> Ints:
        """(u,)."""
        return np.repeat(np.arange(len(self.scenes)), np.diff(self.first_unit))

    @cached_property
    def scene_of_point(self) -> Ints:
        """(p,)."""
        return np.repeat(np.arange(len(self.scenes)), np.diff(self.first_point))

    @cached_property
    def registered(self) -> Bools:
        """(u,)."""
        return np.concatenate([s.unit_registered for s in self.scenes])

    @cached_property
    def image_size_px(self) -> Floats:
        """Width and height of every camera's images (cameras, 2)."""
        sizes = [(camera.width, camera.height) for scene in self.scenes for camera in scene.drive.cameras]
        return np.array(sizes, dtype=np.float64)

    @cached_property
    def image_unit(self) -> Ints:
        """(i,)."""
        return np.concatenate([s.image_unit + f for s, f in zip(self.scenes, self.first_unit, strict=False)])

    @cached_property
    def image_camera(self) -> Ints:
        """(i,)."""
        return np.concatenate([s.image_camera + f for s, f in zip(self.scenes, self.first_camera, strict=False)])

    @cached_property
    def keypoint_image(self) -> Ints:
        """(n,)."""
        return np.concatenate([s.keypoint_image + f for s, f in zip(self.scenes, self.first_image, strict=False)])

    @cached_property
    def keypoint_point(self) -> Ints:
        """(n,) point of the scene that each keypoint observes, numbered through; -1 for none."""
        parts = [
            np.where(s.keypoint_point >= 0, s.keypoint_point + f, -1)
            for s, f in zip(self.scenes, self.first_point, strict=False)
        ]
        return np.concatenate(parts)

    @cached_property
    def keypoint_xy_px(self) -> Floats:
        """(n, 2)."""
        return np.concatenate([s.keypoint_xy_px for s in self.scenes]).astype(np.float64)

    @cached_property
    def camera_kind(self) -> Ints:
        """(c,)."""
        return np.concatenate([pack_cameras(s.drive.cameras)[0] for s in self.scenes])

    @property
    def simultaneous(self) -> bool:
        """All images are taken at their unit's timestamp."""
        return not any(len(s.unit_from_image) for s in self.scenes)

    def state(self, world_from_scene: Floats) -> State:
        """Poses and points of all scenes in a frame where they lie at `world_from_scene` (scenes, 4, 4).

        Units that are not registered are at the origin: nothing may observe anything from there.
        """
        poses = np.concatenate(
            [w @ np.nan_to_num(s.world_from_rig) for w, s in zip(world_from_scene, self.scenes, strict=True)]
        )
        poses[~self.registered] = np.eye(4)
        cameras = np.concatenate([s.drive.rig_from_cam for s in self.scenes])
        points = [se3.apply(w, s.points_m) for w, s in zip(world_from_scene, self.scenes, strict=True)]
        state = State(
            unit_rotation=np.ascontiguousarray(poses[:, :3, :3]),
            unit_position_m=np.ascontiguousarray(poses[:, :3, 3]),
            camera_rotation=np.ascontiguousarray(cameras[:, :3, :3]),
            camera_position_m=np.ascontiguousarray(cameras[:, :3, 3]),
            camera_params=np.concatenate([pack_cameras(s.drive.cameras)[1] for s in self.scenes]),
            points_m=np.concatenate(points),
            camera_time_offset_s=np.zeros(len(cameras)),
        )
        if self.simultaneous:
            return state
        bands = [
            s.unit_from_image if len(s.unit_from_image) else np.tile(np.eye(4), (len(s.image_unit), 1, 1))
            for s in self.scenes
        ]
        unit_from_band = np.concatenate(bands)
        return replace(
            state,
            band_rotation=np.ascontiguousarray(unit_from_band[:, :3, :3]),
            band_position_m=np.ascontiguousarray(unit_from_band[:, :3, 3]),
        )

    @property
    def motion(self) -> RowBandMotion | None:
        """Images at times of their own stay where they are relative to their units."""
        if self.simultaneous:
            return None
        readout = np.stack([readout_share(camera) for scene in self.scenes for camera in scene.drive.cameras])
        return RowBandMotion.held(self.image_unit, readout)

    def observations(self, rows: Ints, point: Ints, num_points: int) -> Observations:
        """Keypoints `rows` (n,) as observations of points `point` (n,), which ascend."""
        image = self.keypoint_image[rows]
        return Observations(
            unit=self.image_unit[image],
            camera=self.image_camera[image],
            point=point,
            xy_px=self.keypoint_xy_px[rows],
            num_points=num_points,
            band=None if self.simultaneous else image,
        )
