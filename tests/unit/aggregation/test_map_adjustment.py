"""The map's last adjustment: which units vary, what becomes of their errors, and what becomes of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrasfm_engine.aggregation import calibrations, map_adjustment
from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.association import coarse_transform
from mrasfm_engine.aggregation.calibrations import calibration_priors, map_calibrations, scenes_of_told_length
from mrasfm_engine.aggregation.map_adjustment import AdjustedMap, MapModel, adjust_map, all_points
from mrasfm_engine.aggregation.positions import drive_positions
from mrasfm_engine.aggregation.vehicles import vehicles_of
from mrasfm_engine.bundle_adjustment.observation_sampling import solve_with_chosen_points
from mrasfm_engine.bundle_adjustment.priors import CameraPosePrior
from mrasfm_engine.bundle_adjustment.solver import Problem, Report
from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.state import State
from mrasfm_engine.synthetic.rigs import true_cameras
from tests.helpers.small_scenes import (
    CONFIG,
    PLACE,
    SIZE_PX,
    Driven,
    Street,
    configured,
    drive_along,
    in_assembly,
    make_street,
    shared_points,
)

BEND_M = 0.08
BIAS_M = ((0.5, -0.3, 0.2), (-0.4, 0.6, -0.3))
WAYS = np.arange(0.0, 14.0, 2.0), np.arange(5.0, 19.0, 2.0)  # they overlap by half


@pytest.fixture(scope="module")
def street() -> Street:
    return make_street(length_m=20.0, points=700)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("final")


@pytest.fixture(scope="module")
def two(street: Street, folder: Path) -> list[Driven]:
    """One is bent to one side, the other to the other."""
    return [
        drive_along(street, folder / str(k), WAYS[k], bend_m=(1 - 2 * k) * BEND_M, bias_m=BIAS_M[k], seed=k)
        for k in range(2)
    ]


def owner_of(drives: Sequence[Driven]) -> np.ndarray:
    """The joined point of all points of two scenes, as the street's tell it."""
    a, b = drives
    pairs = shared_points(a, b)
    owner = np.full(len(a.point_of_street) + len(b.point_of_street), -1)
    owner[pairs[:, 0]] = owner[pairs[:, 1] + len(a.point_of_street)] = np.arange(len(pairs))
    return owner


def adjusted(
    drives: Sequence[Driven],
    which: str,
    *,
    positions: bool = True,
    owner: np.ndarray | None = None,
    shared: bool = True,
    refine_focal: bool = False,
) -> AdjustedMap:
    """From where scenes truly lie; each as bent as it is."""
    config = configured(final_adjustment=which)
    bundle_adjustment = config.bundle_adjustment.model_copy(update={"refine_focal": refine_focal})
    config = config.model_copy(update={"bundle_adjustment": bundle_adjustment})
    assembly = Assembly(scenes=[d.source for d in drives])
    known = {}
    for k, driven in enumerate(drives):
        believed = se3.transform(np.eye(3), BIAS_M[k]) @ driven.street_from_scene
        if positions:
            found = drive_positions(driven.source, believed, int(assembly.first_unit[k]), config.gnss)
            assert found is not None
            known[k] = found
    poses = np.stack([d.street_from_scene for d in drives])
    vehicles = vehicles_of(assembly.scenes, config.bundle_adjustment) if shared else []
    owner = owner_of(drives) if owner is None else owner
    return adjust_map(assembly, poses, owner, known, config, vehicles=vehicles, cancel=lambda: False)


def errors_m(result: AdjustedMap, drives: Sequence[Driven]) -> list[np.ndarray]:
    """Distances between units and where they were, by drive, the whole map where it fits best.

    How the whole lies only receivers tell, to centimetres, before and after.
    """
    first = np.cumsum([0] + [len(d.street_from_rig) for d in drives])
    at, truth = result.model.state.unit_position_m, np.concatenate([d.street_from_rig[:, :3, 3] for d in drives])
    turn = Rotation.align_vectors(truth - truth.mean(0), at - at.mean(0))[0].as_matrix()
    at = (at - at.mean(0)) @ turn.T + truth.mean(0)
    return [
        np.linalg.norm(at[first[k] : first[k + 1]] - d.street_from_rig[:, :3, 3], axis=1) for k, d in enumerate(drives)
    ]


def mean_error_m(result: AdjustedMap, drives: Sequence[Driven]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(errors_m(result, drives)) ** 2)))


@pytest.fixture(scope="module")
def untouched(two: list[Driven]) -> AdjustedMap:
    return adjusted(two, "none")


def test_none_leaves_everything_where_it_is(two: list[Driven], untouched: AdjustedMap) -> None:
    assert untouched.free_units == 0
    assert untouched.reports == ()
    expected = np.concatenate([d.street_from_scene @ d.source.world_from_rig for d in two])
    np.testing.assert_allclose(untouched.model.state.world_from_rig, expected, atol=1e-12)
    assert BEND_M * 0.4 < max(e.max() for e in errors_m(untouched, two)) < BEND_M * 1.3


@pytest.mark.parametrize("which", ["overlap", "all"])
def test_bent_scenes_come_nearer_to_the_truth(two: list[Driven], untouched: AdjustedMap, which: str) -> None:
    result = adjusted(two, which)
    before, after = mean_error_m(untouched, two), mean_error_m(result, two)
    assert 0.0005 < after < 0.7 * before
    moved = result.model.state.unit_position_m - untouched.model.state.unit_position_m
    assert 0 < np.linalg.norm(moved.mean(0)) < 0.05
    assert len(result.reports) == 2
    # And so do the points of both scenes.
    assert np.median(result.model.errors_px) < np.median(untouched.model.errors_px)
    units = sum(len(d.street_from_rig) for d in two)
    assert result.free_units == units if which == "all" else 8 <= result.free_units <= units
    # Receivers' constant errors are told apart, but for what they have in common.
    told = result.positions[0].bias_m - result.positions[1].bias_m
    assert 0 < np.abs(told - (np.array(BIAS_M[0]) - BIAS_M[1])).max() < 0.2


def test_units_out_of_the_overlap_stay_with_overlap_only(street: Street, folder: Path) -> None:
    """The second drive sees nothing of what the first units of the first one see."""
    long = make_street(length_m=120.0, points=2500, seed=3)
    drives = [
        drive_along(long, folder / f"long{k}", np.arange(s, s + 48.0, 4.0), bend_m=0.05 * k, bias_m=BIAS_M[k], seed=k)
        for k, s in enumerate((0.0, 76.0))
    ]
    result = adjusted(drives, "overlap")
    assembly = Assembly(scenes=[d.source for d in drives])
    before = assembly.state(np.stack([d.street_from_scene for d in drives])).unit_position_m
    moved = np.linalg.norm(result.model.state.unit_position_m - before, axis=1)
    assert 0 < result.free_units == (moved > 0).sum() < len(moved)
    assert moved[0] == 0
    assert moved.max() < 0.2
    everything = adjusted(drives, "all")
    moved = np.linalg.norm(everything.model.state.unit_position_m - before, axis=1)
    assert (moved > 0).all()
    assert moved.max() < 0.5


def test_all_without_any_positions(two: list[Driven], untouched: AdjustedMap) -> None:
    """Nothing holds the whole then, and it stays about where it is."""
    result = adjusted(two, "all", positions=False)
    assert result.positions == {}
    assert np.isfinite(result.model.state.unit_position_m).all()
    assert 0 < mean_error_m(result, two) < 1.5 * mean_error_m(untouched, two)


@pytest.mark.parametrize("which", ["none", "overlap", "all"])
def test_every_drive_has_its_calibration_and_points_that_are_one_become_one(
    two: list[Driven], untouched: AdjustedMap, which: str
) -> None:
    result = untouched if which == "none" else adjusted(two, which)
    state, model = result.model.state, result.model
    rigs = [d.source.drive.rig_from_cam for d in two]
    assert np.abs(rigs[0] - rigs[1]).max() > 1e-3
    np.testing.assert_array_equal(state.rig_from_cam, np.concatenate(rigs))
    a, b = two
    pairs = in_assembly(shared_points(a, b), a)
    one = model.owner[pairs]
    kept = (one >= 0).all(1)
    assert kept.mean() > 0.9
    np.testing.assert_array_equal(one[kept, 0], one[kept, 1])
    assert len(np.unique(one[kept, 0])) == kept.sum()
    # What a point's observations are of, and how far they are off, is said of the very point.
    source = Assembly(scenes=[a.source, b.source]).keypoint_point
    np.testing.assert_array_equal(model.owner[source[model.rows]], model.point)
    assert (np.diff(model.point) >= 0).all()
    assert np.bincount(model.point).min() >= 2
    assert 0 < model.errors_px.max() < CONFIG.mapping.filter_error_px
    truth = np.concatenate([d.point_of_street for d in two])
    where = np.full(len(state.points_m), -1)
    where[model.owner[model.owner >= 0]] = truth[model.owner >= 0]
    assert (where >= 0).all()


def test_a_point_whose_other_scene_does_not_fit_is_no_joined_one(two: list[Driven]) -> None:
    """Joined are points that two scenes see in the map, not those that were meant to be."""
    a, b = two
    pairs = shared_points(a, b)
    wrong = pairs[:30, 1]
    xy = b.source.keypoint_xy_px.copy()
    xy[np.isin(b.source.keypoint_point, wrong)] += np.float32(60.0)
    result = adjusted([a, replace(b, source=replace(b.source, keypoint_xy_px=xy))], "none", owner=owner_of(two))
    scene = (result.model.rows >= len(a.source.keypoint_point)).astype(int)
    count = len(result.model.state.points_m)
    seen = np.stack([np.bincount(result.model.point[scene == s], minlength=count) for s in (0, 1)])
    np.testing.assert_array_equal(result.model.joined, (seen > 0).all(0))
    left = result.model.owner[pairs[:30, 0]]
    assert not result.model.joined[left[left >= 0]].any()
    assert result.dropped_observations >= 60


def test_images_that_are_not_simultaneous_stay_where_they_are_in_their_units(
    street: Street, folder: Path, untouched: AdjustedMap, two: list[Driven]
) -> None:
    moving = drive_along(
        street, folder / "moving", WAYS[1], bend_m=-BEND_M, bias_m=BIAS_M[1], offset_ms=[0, 12, -15, 30], seed=7
    )
    drives = [two[0], moving]
    assert len(moving.source.unit_from_image) == len(moving.source.image_unit)
    before = mean_error_m(adjusted(drives, "none"), drives)
    for which in ("overlap", "all"):
        result = adjusted(drives, which)
        assert 0.0005 < mean_error_m(result, drives) < 0.8 * before
        bands = result.model.state.unit_from_band
        np.testing.assert_allclose(bands[: len(two[0].source.image_unit)], np.tile(np.eye(4), (28, 1, 1)), atol=1e-12)
        np.testing.assert_allclose(bands[28:], moving.source.unit_from_image, atol=1e-12)


def camera_errors_deg(result: AdjustedMap, drives: Sequence[Driven]) -> np.ndarray:
    """How far every camera is turned from its true pose, all of a drive together where they fit best."""
    found, errors = result.model.state.camera_rotation.reshape(len(drives), -1, 3, 3), []
    for k in range(len(drives)):
        rig = true_cameras(4, width=SIZE_PX[0], height=SIZE_PX[1], rng=np.random.default_rng(1000 + drives[k].seed))
        truth = np.stack([camera.rig_from_cam[:3, :3] for camera in rig])
        turn = se3.log_so3(found[k] @ np.swapaxes(truth, 1, 2))
        errors.append(np.degrees(np.linalg.norm(turn - turn.mean(0), axis=1)))
    return np.concatenate(errors)


@pytest.mark.parametrize("which", ["overlap", "all"])
def test_calibrations_move_as_far_as_scenes_left_them_uncertain(street: Street, folder: Path, which: str) -> None:
    """What short drives say of their cameras is wrong in each its own way; held, it would bend and scale the map."""
    drives = [
        drive_along(street, folder / f"{which}{k}", WAYS[k], cameras_off_deg=0.15, bias_m=BIAS_M[k], seed=20 + k)
        for k in range(2)
    ]
    before, after = adjusted(drives, "none"), adjusted(drives, which)
    assert (before.free_cameras, after.free_cameras) == (0, 8)
    assert np.median(camera_errors_deg(before, drives)) > 0.1
    assert 0 < np.median(camera_errors_deg(after, drives)) < 0.4 * np.median(camera_errors_deg(before, drives))
    moved = after.model.state.camera_position_m - before.model.state.camera_position_m
    assert 0 < np.abs(moved).max() < 0.003  # nothing was observed of where cameras sit
    certain = [
        replace(d, source=replace(d.source, calibration=d.source.calibration | {"adjusted": False})) for d in drives
    ]
    held = adjusted(certain, which)
    np.testing.assert_array_equal(held.model.state.rig_from_cam, before.model.state.rig_from_cam)
    assert 0 < mean_error_m(after, drives) < 0.7 * mean_error_m(held, drives)
    assert np.median(after.model.errors_px) < np.median(held.model.errors_px)


def of_vehicles(street: Street, folder: Path, *names: str | None, title: str) -> list[Driven]:
    """A drive whose scene found its calibration well, and one whose scene held what was given, 0.3 deg off."""
    well = drive_along(street, folder / f"{title} well", WAYS[0], cameras_off_deg=0.02, bias_m=BIAS_M[0],
                       vehicle=names[0], rig_seed=50, seed=50)  # fmt: skip
    held = drive_along(street, folder / f"{title} held", WAYS[1], cameras_off_deg=0.3, bias_m=BIAS_M[1],
                       vehicle=names[1], rig_seed=50, seed=51)  # fmt: skip
    calibration = held.source.calibration | {"adjusted": False}
    return [well, replace(held, source=replace(held.source, calibration=calibration))]


@pytest.mark.parametrize("which", ["overlap", "all"])
def test_a_drive_takes_what_another_of_its_vehicle_observed(street: Street, folder: Path, which: str) -> None:
    drives = of_vehicles(street, folder, "van-7", "van-7", title=f"one {which}")
    alone, shared = adjusted(drives, which, shared=False), adjusted(drives, which)
    own, other = np.split(camera_errors_deg(alone, drives), 2)
    assert np.median(other) > 0.2
    own_shared, learned = np.split(camera_errors_deg(shared, drives), 2)
    assert 0 < np.median(learned) < 0.2 * np.median(other)
    assert 0 < np.median(own_shared) < 1.5 * np.median(own)
    assert 0 < mean_error_m(shared, drives) < 0.8 * mean_error_m(alone, drives)
    assert np.median(shared.model.errors_px) < np.median(alone.model.errors_px)
    assert (alone.learning, shared.learning) == ((), (1,))
    assert adjusted(drives, "none").learning == ()
    assert shared.free_cameras == 8
    assert shared.free_units >= alone.free_units


def test_a_drive_that_shares_no_place_learns_as_well(street: Street, folder: Path) -> None:
    """All of its units vary with its cameras, by its own observations."""
    north = make_street(length_m=20.0, points=700, place=(PLACE[0] + 0.01, *PLACE[1:]), seed=6)
    well = of_vehicles(street, folder, "van-7", "van-7", title="here")[0]
    held = of_vehicles(north, folder, "van-7", "van-7", title="there")[1]
    owner = np.full(len(well.source.points_m) + len(held.source.points_m), -1)
    alone, shared = (adjusted([well, held], "overlap", owner=owner, shared=shared) for shared in (False, True))
    assert alone.free_units == 0
    assert shared.free_units == len(WAYS[1])
    before, after = (camera_errors_deg(result, [well, held])[4:] for result in (alone, shared))
    assert 0 < np.median(after) < 0.2 * np.median(before)
    assert np.median(shared.model.errors_px) < 0.7 * np.median(alone.model.errors_px)
    # The other one stays as it was.
    units, cameras = len(WAYS[0]), 4
    np.testing.assert_array_equal(shared.model.state.world_from_rig[:units], alone.model.state.world_from_rig[:units])
    np.testing.assert_array_equal(shared.model.state.rig_from_cam[:cameras], alone.model.state.rig_from_cam[:cameras])


def with_focal(driven: Driven, longer: float, *, observed: bool) -> Driven:
    """A drive whose scene has focal lengths so much too long, which it observed or held."""
    source, cameras, entries = driven.source, [], {}
    for camera in source.drive.cameras:
        entry, (fx, fy, *rest) = source.calibration["cameras"][camera.name], camera.params
        cameras.append(camera.model_copy(update={"params": [fx * (1 + longer), fy * (1 + longer), *rest]}))
        sigma, seen = {"focal_px": 0.0002 * fx}, {"focal": observed}
        entries[camera.name] = {**entry, "sigma": entry["sigma"] | sigma, "observed": entry["observed"] | seen}
    rig = source.manifest.rig.model_copy(update={"cameras": cameras})
    manifest = source.manifest.model_copy(update={"rig": rig})
    calibration = {**source.calibration, "cameras": entries}
    return replace(driven, source=replace(source, manifest=manifest, calibration=calibration))


def test_focal_lengths_that_another_drive_observed(street: Street, folder: Path) -> None:
    well, held = of_vehicles(street, folder, "van-7", "van-7", title="focal")
    drives = [with_focal(well, 0.0, observed=True), with_focal(held, 0.006, observed=False)]
    true_px = np.array([camera.params[0] for driven in (well, held) for camera in driven.source.drive.cameras])
    asked, not_asked = (adjusted(drives, "overlap", refine_focal=refine_focal) for refine_focal in (True, False))
    off = np.abs(asked.model.state.camera_params[:, 0] / true_px - 1.0)
    assert (off[:4] < 1e-12).all()  # nobody told the first one anything
    assert 0 < off[4:].max() < 0.002
    np.testing.assert_allclose(not_asked.model.state.camera_params[4:, 0], 1.006 * true_px[4:])
    assert np.median(asked.model.errors_px) < np.median(not_asked.model.errors_px)


def test_focal_lengths_of_scenes_that_take_no_part_stay(
    street: Street, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None of the second drive's units vary, and it knows its cameras as well as the first one does."""
    drives = [
        with_focal(
            drive_along(street, folder / f"no part {k}", WAYS[k], cameras_off_deg=0.02, vehicle="van-7", rig_seed=50,
                        seed=52 + k),
            0.001 * k,
            observed=True,
        )
        for k in range(2)
    ]  # fmt: skip
    assembly = Assembly(scenes=[d.source for d in drives])
    state = assembly.state(np.stack([d.street_from_scene for d in drives]))
    config = CONFIG.bundle_adjustment.model_copy(update={"refine_focal": True})
    vehicles, free = vehicles_of(assembly.scenes, config), assembly.registered & (assembly.scene_of_unit == 0)
    found = map_calibrations(assembly, state, free, vehicles, config)
    assert found.cameras.tolist() == found.free_intrinsics[:, 0].tolist() == [True] * 4 + [False] * 4
    moved = np.abs(found.at_priors(state).camera_params - state.camera_params).max(1)
    assert (moved[:4] > 1e-5).all()
    assert (moved[4:] == 0.0).all()
    assert not found.too_many
    monkeypatch.setattr(calibrations, "MAX_COUPLINGS", 10)
    found = map_calibrations(assembly, state, free, vehicles, config)
    assert found.too_many
    assert found.learning == ()
    assert not found.cameras.any()


@pytest.mark.parametrize("names", [("van-7", "van-8"), ("van-7", None), (None, None)])
def test_drives_of_unlike_vehicles_are_untouched(
    street: Street, folder: Path, names: tuple[str | None, str | None]
) -> None:
    drives = of_vehicles(street, folder, *names, title=f"unlike {names}")
    alone, shared = (adjusted(drives, "overlap", shared=shared).model.state for shared in (False, True))
    np.testing.assert_array_equal(shared.rig_from_cam, alone.rig_from_cam)
    np.testing.assert_array_equal(shared.world_from_rig, alone.world_from_rig)
    np.testing.assert_array_equal(shared.points_m, alone.points_m)


@pytest.mark.slow
def test_points_that_only_fixed_units_see_follow_their_calibration(folder: Path) -> None:
    """Only the first drive's calibration was refined: points of the second one stay where none of its units vary."""
    long = make_street(length_m=260.0, points=4000, seed=4)
    drives = [
        drive_along(long, folder / f"ends{k}", np.arange(s, s + 100.0, 4.0), bias_m=BIAS_M[k], seed=40 + k, **extra)
        for k, (s, extra) in enumerate(((0.0, {"cameras_off_deg": 0.15}), (120.0, {})))
    ]
    assembly = Assembly(scenes=[d.source for d in drives])
    before, after = adjusted(drives, "none").model, adjusted(drives, "overlap").model
    fixed = (before.state.unit_position_m == after.state.unit_position_m).all(1)
    assert fixed[[0, -1]].all()
    assert 4 < fixed.sum() < len(fixed) - 4
    unit = assembly.image_unit[assembly.keypoint_image]

    def seen_by_fixed(model: MapModel, scene: int) -> np.ndarray:
        """Points (of all scenes') of a scene in the model that no unit sees that varies."""
        varied = np.unique(model.point[~fixed[unit[model.rows]]])
        mine = np.flatnonzero((assembly.scene_of_point == scene) & (model.owner >= 0))
        return mine[~np.isin(model.owner[mine], varied)]

    for scene in range(2):
        points = np.intersect1d(seen_by_fixed(before, scene), seen_by_fixed(after, scene))
        assert len(points) > 50
        moved = [model.state.points_m[model.owner[points]] for model in (before, after)]
        assert (np.abs(moved[1] - moved[0]).max(1) > 0).mean() == (1.0 if scene == 0 else 0.0)
        rows = [np.isin(model.point, model.owner[points]) for model in (before, after)]
        errors = [np.median(model.errors_px[row]) for model, row in zip((before, after), rows, strict=True)]
        assert errors[1] < 0.9 * errors[0] if scene == 0 else errors[1] == pytest.approx(errors[0], abs=0.01)


def test_the_more_units_vary_the_less_counts_what_the_scene_said_of_its_cameras(
    street: Street, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drives = [drive_along(street, folder / f"said{k}", WAYS[k], cameras_off_deg=0.1, seed=30 + k) for k in range(2)]
    assembly = Assembly(scenes=[d.source for d in drives])
    state = assembly.state(np.stack([d.street_from_scene for d in drives]))
    first = np.arange(len(assembly.registered)) < 3  # of the first drive's 7 units

    def sigmas(free: np.ndarray) -> list[np.ndarray]:
        found = calibration_priors(assembly, state, free, CONFIG.bundle_adjustment)
        assert [prior.camera.tolist() for prior in found] == [[0, 1, 2, 3], [4, 5, 6, 7]][: len(found)]
        assert all((prior.held == np.repeat([False, True], 3)).all() for prior in found)
        return [prior.sigma for prior in found]

    (some,), every = sigmas(first), sigmas(assembly.registered)
    np.testing.assert_allclose(some[:, :3], np.radians(0.1) * np.sqrt(7 / 4), rtol=1e-6)
    for sigma in every:
        np.testing.assert_allclose(sigma[:, :3], np.radians(CONFIG.bundle_adjustment.sigma_rotation_deg))
        np.testing.assert_allclose(sigma[:, 3:], CONFIG.bundle_adjustment.sigma_translation_m)
    assert len(every) == 2
    component = replace(drives[0].source, calibration=drives[0].source.calibration | {"from_component": 0})
    of_component = Assembly(scenes=[component, drives[1].source])
    prior = calibration_priors(of_component, state, assembly.registered, CONFIG.bundle_adjustment)[0]
    np.testing.assert_allclose(prior.sigma[:, :3], np.radians(0.1), rtol=1e-6)  # of the largest one's units, not of its
    assert sigmas(~assembly.registered) == []
    monkeypatch.setattr(calibrations, "MAX_COUPLINGS", 8 * (14 + 8))
    assert len(sigmas(assembly.registered)) == 2
    monkeypatch.setattr(calibrations, "MAX_COUPLINGS", 8 * (14 + 8) - 1)
    assert sigmas(assembly.registered) == []
    held = CONFIG.bundle_adjustment.model_copy(update={"refine_calibration": False})
    monkeypatch.undo()
    assert calibration_priors(assembly, state, assembly.registered, held) == []


@pytest.mark.parametrize("only_held", [True, False])
def test_a_map_that_gets_longer_than_its_scenes_may_be_lets_go_of_baselines(
    street: Street, folder: Path, monkeypatch: pytest.MonkeyPatch, only_held: bool
) -> None:
    """The longer a map, the less images see of held baselines that are wrong: rendered ones got 24 % longer by that."""
    drives = [
        drive_along(street, folder / f"long{only_held}{k}", WAYS[k], cameras_off_deg=0.15, bias_m=BIAS_M[k], seed=k)
        for k in range(2)
    ]
    tried: list[bool] = []

    def longer(problem: Problem, *rest: Any, **options: Any) -> tuple[State, Report]:
        state, report = solve_with_chosen_points(problem, *rest, **options)
        priors = [term for term in problem.terms if isinstance(term, CameraPosePrior)]
        tried.append(all(prior.held[:, 3:].all() for prior in priors))
        assert tried[-1] or not any(prior.held[:, 3:].any() for prior in priors)
        factor = 1.2 if len(tried) % 2 == 0 and (tried[-1] or not only_held) else 1.0  # what the last round finds
        return replace(state, unit_position_m=factor * state.unit_position_m), report

    monkeypatch.setattr(map_adjustment, "solve_with_chosen_points", longer)
    result = adjusted(drives, "all")
    # Two rounds each: as they are, with places that vary, and where that does not help with cameras as they were found.
    assert tried == [True, True, False, False] + [True, True] * (not only_held)
    first = adjusted(drives, "none").model.state.unit_position_m
    found = result.model.state.unit_position_m
    lengths = [np.linalg.norm(np.diff(at[[0, len(WAYS[0]) - 1]], axis=0)) for at in (first, found)]
    if only_held:
        assert lengths[1] == pytest.approx(lengths[0], rel=0.02)
        assert result.lengthened == {}
    else:
        assert {*result.lengthened} == {0, 1}
        assert result.lengthened[0] == pytest.approx(lengths[1] / lengths[0], rel=0.02)


def test_baselines_of_a_scene_without_positions_follow_the_other_scenes(street: Street, folder: Path) -> None:
    """Its own drive did not observe them, and the map's length is that of the others."""
    drives = [drive_along(street, folder / f"length{k}", WAYS[k], cameras_off_deg=0.1, seed=40 + k) for k in range(2)]
    scenes = [drives[0].source, replace(drives[1].source, is_placed=False)]
    assembly = Assembly(scenes=scenes)
    state = assembly.state(np.stack([d.street_from_scene for d in drives]))
    placed, unplaced = calibration_priors(assembly, state, assembly.registered, CONFIG.bundle_adjustment)
    assert placed.held[:, 3:].all()
    assert not unplaced.held.any()
    np.testing.assert_allclose(unplaced.sigma[:, 3:], CONFIG.bundle_adjustment.sigma_translation_m)


def with_sigma_scale(driven: Driven, sigma: float | None) -> Driven:
    report = driven.source.report | ({} if sigma is None else {"scale": {"sigma_relative": sigma}})
    return replace(driven, source=replace(driven.source, report=report))


def test_a_scene_that_hardly_knows_its_length_takes_it_from_another(street: Street, folder: Path) -> None:
    """Four units whose baselines were off by 1 % made 26 others longer that knew their length to 0.4 %."""
    long, rough = np.arange(0.0, 14.0, 1.0), np.arange(3.0, 17.0, 2.0)
    scales = 1.0, 1.04
    drives = [
        drive_along(
            street, folder / f"told{k}", way, cameras_off_deg=0.05, scale=scales[k], gnss_noise_m=noise_m, seed=k
        )
        for k, (way, noise_m) in enumerate(((long, 0.2), (rough, 2.0)))
    ]

    def length(sigmas: tuple[float | None, float | None]) -> float:
        known = [with_sigma_scale(driven, sigma) for driven, sigma in zip(drives, sigmas, strict=True)]
        at = adjusted(known, "all").model.state.unit_position_m[: len(long)]
        return float(np.linalg.norm(at[-1] - at[0]) / np.linalg.norm(long[-1] - long[0]))

    assert abs(length((0.004, 0.1)) - 1.0) < 0.005
    assert abs(length((0.004, 0.007)) - 1.0) > 0.008  # which of them is right is not known


def test_lengths_are_told_by_connected_scenes_with_positions(two: list[Driven]) -> None:
    def told(sigmas: tuple[float | None, float | None], *, joined: bool = True, placed: bool = True) -> set[int]:
        known = [with_sigma_scale(driven, sigma).source for driven, sigma in zip(two, sigmas, strict=True)]
        assembly = Assembly(scenes=[replace(known[0], is_placed=placed), known[1]])
        owner = owner_of(two) if joined else np.full(int(assembly.first_point[-1]), -1)
        return {*scenes_of_told_length(assembly, owner)}

    assert told((0.001, 0.1)) == {1}
    assert told((0.1, 0.001)) == {0}
    assert told((0.01, 0.019)) == told((0.01, None)) == told((None, None)) == set()
    assert told((0.001, 0.1), joined=False) == set()
    assert told((0.001, 0.1), placed=False) == set()


def test_a_far_scene_stays_upright_where_it_is(street: Street, folder: Path, two: list[Driven]) -> None:
    """Up is elsewhere at the other end of a degree: 110 km north, vehicles stand 1 deg inclined to the map's frame."""
    north = make_street(length_m=20.0, points=700, place=(PLACE[0] + 1.0, *PLACE[1:]), seed=5)
    far = drive_along(north, folder / "far", WAYS[0], seed=8)
    scenes = [two[0].source, far.source]
    map_from_scene = np.stack([np.eye(4), coarse_transform(*scenes)])
    config = configured(final_adjustment="all")
    assembly = Assembly(scenes=scenes)
    known = {
        k: found
        for k, scene in enumerate(scenes)
        if (found := drive_positions(scene, map_from_scene[k], int(assembly.first_unit[k]), config.gnss)) is not None
    }
    assert len(known) == 2
    owner = np.full(int(assembly.first_point[-1]), -1)
    result = adjust_map(assembly, map_from_scene, owner, known, config, cancel=lambda: False)
    poses = result.model.state.world_from_rig[int(assembly.first_unit[1]) :]
    turned = se3.inverse(map_from_scene[1] @ far.source.world_from_rig) @ poses
    assert 0.9 < se3.rotation_angle_deg(map_from_scene[1][:3, :3]) < 1.1
    # About the way, where nothing but the prior holds it; how it is turned otherwise, receivers say within their noise.
    assert 0 < np.degrees(np.abs(se3.log_so3(turned[:, :3, :3])[:, 0]).max()) < 0.2


def test_points_of_their_own_are_numbered_after_joined_ones() -> None:
    np.testing.assert_array_equal(all_points(np.array([-1, 1, 0, -1, 1])), [2, 1, 0, 3, 1])
    np.testing.assert_array_equal(all_points(np.array([-1, -1])), [0, 1])
    assert len(all_points(np.zeros(0, dtype=np.int64))) == 0
