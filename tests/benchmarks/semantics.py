"""Line 6: the road with and without semantic-aided triangulation, against the truth and on held-out images.

Rendered drives (the worst seed counts): a street with traffic, level for one seed and on a hill with a ramp of 6 %
for all, over which shadows move so that more than a quarter of the verified matches between keypoints on the road are
wrong. A point of the road is bad where it is farther than 5 cm from the true surface, in the frame of the truth after a
rigid alignment of the vehicle's poses. A true point stays where any of its observations observes a point of the scene
that was made with semantics.

Real drive (kitti02, masks of a network): the surface is fitted to points that only units of even number see, and points
are judged by what those units see of them. What is measured are points of the same tracks, triangulated from units of
odd number only: none of them is left out for its own distance to the surface. Poses are those of the whole drive.
"""

from __future__ import annotations

import copy
import json
import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from mrasfm_engine import stages
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_rigid
from mrasfm_engine.geometry.camera_model import pack_cameras, project_points, unproject_pixels
from mrasfm_engine.io.read_scene import read_calibration, read_poses
from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.road import RoadAssessment, assess_road
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.road import Thickness
from mrasfm_engine.scene.semantics import ROAD
from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.real_drives import imported
from tests.benchmarks.table import Figure

SIZE = ("--cameras", 6, "--units", 20, "--width", 640, "--height", 360, "--spacing-m", 1.6)
RAMP_PERCENT = 6
LEVEL_SEED = 1  # its street is measured without the ramp as well
HARD = ("--moving-shadows", 150, "--tight")
OFF = "[mapping]\nsemantic_triangulation = false\n"
BAD_M = 0.05
WRONG_PX = 3.0  # a match is wrong where the true road point of one end is farther from the other
ARMS = np.concatenate([np.zeros((1, 3)), 10 * np.eye(3)])  # points fixed to the vehicle: poses align, not only places


@dataclass(frozen=True, kw_only=True)
class Ground:
    """The true surface of a rendered world."""

    direction: np.ndarray
    at_m: np.ndarray
    heights_m: np.ndarray

    @staticmethod
    def of(drive: Path) -> Ground:
        ground = json.loads((drive / "truth_world.json").read_text(encoding="utf-8"))["ground"]
        heights = np.array(ground["heights_m"])
        return Ground(
            direction=np.array(ground["direction"]),
            at_m=ground["first_m"] + ground["step_m"] * np.arange(len(heights)),
            heights_m=heights,
        )

    def height(self, xy: np.ndarray) -> np.ndarray:
        return np.interp(xy @ self.direction, self.at_m, self.heights_m)

    def hit(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Where rays (n, 3) from a point meet the ground; NaN where they go up."""
        steps = np.where(rays[:, 2] < -1e-3, 5.0, np.nan)
        for _ in range(40):
            points = origin + steps[:, None] * rays
            steps = steps + 0.9 * (points[:, 2] - self.height(points[:, :2])) / np.maximum(-rays[:, 2], 1e-3)
        return origin + steps[:, None] * rays


def shadowed_road(work: Path, seed: int) -> Iterator[Figure]:
    """Line 6a: the road of a rendered street."""
    for ramp_percent in (0, RAMP_PERCENT) if seed == LEVEL_SEED else (RAMP_PERCENT,):
        drive = work / f"shadows {seed} {ramp_percent}"
        mrasfm("synth", *SIZE, *HARD, "--ramp", ramp_percent, "--seed", seed, "--out", drive)
        yield from moving_shadows(drive, work, f"seed {seed}, moving shadows, ramp {ramp_percent} %")
        for folder in work.glob("shadows *"):
            shutil.rmtree(folder)


def real_road(data: Path, work: Path) -> Iterator[Figure]:
    """Line 6b: the road of a real drive."""
    yield from held_out(imported(data, "kitti02", work), work)


def moving_shadows(drive: Path, work: Path, title: str) -> Iterator[Figure]:
    """Line 6a: one rendered drive."""
    with_it, without = work / "shadows on", work / "shadows off"
    mrasfm("reconstruct", drive, "--out", with_it)
    _reconstruct_without(drive, without, like=with_it)
    share = wrong_share(drive, without)
    yield Figure(line="6a", what=f"{title}: wrong among verified road matches", value=share, above=0.25, most=0.7)
    before, after = road_errors_m(drive, without), road_errors_m(drive, with_it)
    bad_before, bad_after = int((before.error_m > BAD_M).sum()), int((after.error_m > BAD_M).sum())
    good = before.error_m <= BAD_M
    stayed = np.array([bool(before.observations[k] & after.all_observations) for k in np.flatnonzero(good)])
    yield Figure(line="6a", what=f"{title}: road points over 5 cm off, without", value=bad_before)
    yield Figure(line="6a", what=f"{title}: the same with semantics", value=bad_after)
    yield Figure(
        line="6a",
        what=f"{title}: road points over 5 cm off that remain",
        value=bad_after / bad_before,
        above=-1e-9,
        most=0.2,
    )
    yield Figure(line="6a", what=f"{title}: true road points that stay", value=stayed.mean(), above=0.9, most=1.0)
    errors = [evaluate(scene, drive)["metric"]["rmse_m"] for scene in (without, with_it)]
    yield Figure(line="6a", what=f"{title}: metric RMSE of the vehicle without", value=errors[0], unit="m")
    yield Figure(line="6a", what=f"{title}: the same with semantics", value=errors[1], unit="m", most=0.05)


@dataclass(frozen=True, kw_only=True)
class RoadErrors:
    """Points of the road's class in a scene."""

    error_m: np.ndarray  # (n,) distance to the true surface
    observations: list[frozenset[tuple[int, int]]]  # image and keypoint

    @property
    def all_observations(self) -> set[tuple[int, int]]:
        return set().union(*self.observations)


def road_errors_m(drive: Path, scene: Path) -> RoadErrors:
    """Distances of a scene's road points to the truth, in the frame of the truth."""
    poses, truth = read_poses(scene).trajectory, read_tum(drive / "truth.tum")
    rows = np.searchsorted(truth.timestamps_us, poses.timestamps_us)
    truth_from_scene = align_rigid(_arms(truth.world_from_rig[rows]), _arms(poses.world_from_rig)).a_from_b
    points = read_ply(scene / "points.ply")
    road = np.flatnonzero(points["class"] == ROAD)
    xyz = se3.apply(truth_from_scene, np.stack([points[name][road] for name in "xyz"], -1).astype(np.float64))
    mapper = pycolmap.Reconstruction(str(scene / "model"))
    observations = [
        frozenset((e.image_id, e.point2D_idx) for e in mapper.points3D[int(p) + 1].track.elements) for p in road
    ]
    ground = Ground.of(drive)
    slope = np.gradient(ground.heights_m, ground.at_m)
    steep = np.interp(xyz[:, :2] @ ground.direction, ground.at_m, slope)
    error = np.abs(xyz[:, 2] - ground.height(xyz[:, :2])) / np.hypot(1.0, steep)
    return RoadErrors(error_m=error, observations=observations)


def read_ply(path: Path) -> np.ndarray:
    """The vertices of a binary PLY as a structured array."""
    types = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}
    head, _, body = path.read_bytes().partition(b"end_header\n")
    properties = [line.split()[1:] for line in head.decode("ascii").splitlines() if line.startswith("property")]
    return np.frombuffer(body, dtype=[(name, types[kind]) for kind, name in properties])


def wrong_share(drive_folder: Path, scene: Path) -> float:
    """Share of verified matches between two keypoints on the road that do not show one point of the true road."""
    drive = read_drive(drive_folder)
    truth = read_tum(drive_folder / "truth.tum").world_from_rig
    calibration = read_calibration(drive_folder / "truth_calibration.json")
    kinds, params = pack_cameras(drive.cameras)
    ground, on_road, world_from_cam = Ground.of(drive_folder), [], []
    wrong = total = 0
    with closing(sqlite3.connect(f"file:{scene / 'features.db'}?mode=ro", uri=True)) as db:
        blobs = db.execute("SELECT rows, data FROM keypoints ORDER BY image_id").fetchall()
        keypoints = [np.frombuffer(data or b"", "<f4").reshape(rows, -1)[:, :2].astype(float) for rows, data in blobs]
        for image, xy in zip(drive.images, keypoints, strict=True):
            assert image.mask is not None
            mask = cv2.imread(str(drive_folder / image.mask), cv2.IMREAD_UNCHANGED)
            on_road.append(mask[xy[:, 1].astype(int), xy[:, 0].astype(int)] == 0)
            world_from_cam.append(truth[image.unit] @ calibration[drive.cameras[image.camera].name])
        for pair_id, rows, data in db.execute("SELECT pair_id, rows, data FROM two_view_geometries"):
            a, b = (int(i) - 1 for i in divmod(pair_id, 2**31 - 1))
            matches = np.frombuffer(data or b"", "<u4").reshape(rows, 2)
            matches = matches[on_road[a][matches[:, 0]] & on_road[b][matches[:, 1]]]
            camera_a, camera_b = drive.images[a].camera, drive.images[b].camera
            rays = unproject_pixels(int(kinds[camera_a]), params[camera_a], keypoints[a][matches[:, 0]])
            points = ground.hit(world_from_cam[a][:3, 3], rays @ world_from_cam[a][:3, :3].T)
            seen = project_points(
                int(kinds[camera_b]), params[camera_b], se3.apply(se3.inverse(world_from_cam[b]), points)
            )
            error = np.linalg.norm(seen - keypoints[b][matches[:, 1]], axis=1)
            wrong += int((~(error < WRONG_PX)).sum())
            total += len(matches)
    return wrong / total


def held_out(drive: Path, work: Path) -> Iterator[Figure]:
    """Line 6b: a real drive with a network's masks, without GNSS."""
    with_it, without = work / "kitti02 road on", work / "kitti02 road off"
    mrasfm("reconstruct", drive, "--out", with_it, "--no-gnss")
    _reconstruct_without(drive, without, "--no-gnss", like=with_it)
    road = read_report(with_it)["by_stage"]["refinement"]["road"]
    stays = road["kept"] / road["points"]
    yield Figure(line="6b", what="kitti02: road points that stay", value=stays, above=0.7, most=1.0)
    errors = [evaluate(scene, drive)["metric"]["rmse_m"] for scene in (without, with_it)]
    yield Figure(
        line="6b",
        what="kitti02: metric RMSE of the vehicle with semantics, of that without",
        value=errors[1] / errors[0],
        above=0.5,
        most=1.05,
    )
    mapper = finished_model(drive, with_it)
    for title, parity in (("even units judge, odd are measured", 0), ("odd units judge, even are measured", 1)):
        everything, kept = held_out_thickness(mapper, parity)
        yield Figure(line="6b", what=f"kitti02, {title}: thickness, all", value=everything.range90_m, unit="m")
        yield Figure(line="6b", what=f"kitti02, {title}: thickness, kept", value=kept.range90_m, unit="m")
        yield Figure(
            line="6b",
            what=f"kitti02, {title}: thickness with semantics, of that without",
            value=kept.range90_m / everything.range90_m,
            most=0.7,
        )


def finished_model(drive: Path, scene: Path) -> Mapper:
    """The refined model of a scene, from its kept stages."""
    config = EngineConfig(use_gnss=False)
    run = stages.Run(read_drive(drive), config, stages.store_of(scene), lambda *_: None, lambda: False)
    run.report["findings"] = []
    prior = stages.prior(run)
    features = stages.features(run)
    matches = stages.matches(run, features, prior)
    mapper = stages.mapping(run, features, matches, prior).mappers()[0]
    refine(mapper, AbsolutePriors.from_trajectory(prior))
    assert all(stage["reused"] for stage in run.report["stages"][:3]), "the scene's stages were to be used again"
    return mapper


def held_out_thickness(mapper: Mapper, parity: int) -> tuple[Thickness, Thickness]:
    """Of road points that units of the other parity see: all that this parity judges too, and those that it keeps."""
    judging, measured = _seen_by(mapper, parity), _seen_by(mapper, 1 - parity)
    judgement = assess_road(judging, for_map=True)
    assert isinstance(judgement, RoadAssessment), judgement
    both = measured.triangulated[judgement.tracks]
    distance, _ = judgement.fitted.surface.locate(measured.state.points_m[judgement.tracks])
    return Thickness.from_distances(distance[both]), Thickness.from_distances(distance[both & judgement.is_inlier])


def _seen_by(mapper: Mapper, parity: int) -> Mapper:
    """The mapper with points from units of one parity only."""
    result = copy.copy(mapper)
    result.registered = mapper.registered & (np.arange(len(mapper.registered)) % 2 == parity)
    result.state = replace(mapper.state, points_m=np.zeros_like(mapper.state.points_m))
    for name in ("triangulated", "is_inlier", "rejected"):
        setattr(result, name, np.zeros_like(getattr(mapper, name)))
    result.triangulate()
    result.filter(mapper.config.mapping.filter_error_px)
    return result


def _reconstruct_without(drive: Path, out: Path, *options: str, like: Path) -> None:
    """The scene without semantic-aided triangulation, from the same features and matches."""
    (out / ".stages").mkdir(parents=True)
    for name in ("features.npz", "matches.npz"):
        os.link(like / ".stages" / name, out / ".stages" / name)
    settings = out.with_name(f"{out.name}.toml")
    settings.write_text(OFF, encoding="utf-8")
    mrasfm("reconstruct", drive, "--out", out, "--config", settings, *options)
    settings.unlink()


def _arms(world_from_rig: np.ndarray) -> np.ndarray:
    return (np.einsum("nij,kj->nki", world_from_rig[:, :3, :3], ARMS) + world_from_rig[:, None, :3, 3]).reshape(-1, 3)
