"""Drives that no image holds together: every part is mapped, and put together by what there is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.mapping import gaps
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.components import Component, LinkedBy, map_drive
from mrasfm_engine.mapping.mapping_report import describe
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.scene.scene import PairMatches
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    keypoints_of,
    make_simulated_drive,
    metric_errors_m,
    rmse,
    true_matches,
)

UNITS, DARK = 24, range(13, 16)  # units 0 to 12 and 16 to 23 see something
ARM_M = np.array([0.3, 0.0, 1.4])
CONFIG = EngineConfig(threads=1)


@pytest.fixture(scope="module")
def simulated() -> SimulatedDrive:
    return make_simulated_drive(units=UNITS, cameras=4, points=2500)


def without_dark(simulated: SimulatedDrive, pairs: list[PairMatches]) -> list[PairMatches]:
    """The pairs of which neither image is dark, and which do not reach over the dark ones."""

    def is_cut(pair: PairMatches) -> bool:
        units = sorted(simulated.drive.images[i].unit for i in (pair.image_a, pair.image_b))
        return any(unit in DARK for unit in units) or units[0] < DARK.start <= units[1]

    return [pair for pair in pairs if not is_cut(pair)]


def mapped(
    simulated: SimulatedDrive, pairs: list[PairMatches], absolute: AbsolutePriors | None = None
) -> list[Component]:
    keypoints = keypoints_of(simulated, CONFIG)
    return map_drive(simulated.drive, keypoints, pairs, None, CONFIG, absolute=absolute)


def received(simulated: SimulatedDrive, sigma_m: float, *, moved_m: float = 0.0) -> AbsolutePriors:
    """A receiver, whose positions after the dark units are `moved_m` to the side of where they are."""
    rng = np.random.default_rng(3)
    pose = simulated.world_from_rig
    place_m = pose[:, :3, 3] + pose[:, :3, :3] @ ARM_M + rng.normal(0, sigma_m, (len(pose), 3))
    place_m[DARK.stop :, :2] *= 1.0 + moved_m
    track = GnssTrack(
        timestamps_us=simulated.drive.timestamps_us,
        position_m=place_m,
        sigma_m=np.full(place_m.shape, sigma_m),
        good=np.ones(len(place_m), dtype=np.bool_),
    )
    return AbsolutePriors(gnss=track, antenna_in_rig_m=ARM_M)


def registered(part: Component) -> list[int]:
    return np.flatnonzero(part.mapper.registered).tolist()


def test_parts_that_nothing_links_are_components_of_their_own(simulated: SimulatedDrive) -> None:
    parts = mapped(simulated, without_dark(simulated, true_matches(simulated)))
    assert [registered(part) for part in parts] == [list(range(DARK.start)), list(range(DARK.stop, UNITS))]
    for part in parts:
        assert rmse(metric_errors_m(part.mapper, simulated)) < 0.02
    found = {finding.code: finding for finding in gaps.findings(parts)}
    assert found["drive-in-components"].severity == "error"
    assert "8 (frames 16 to 23 at 1.6 to 2.3 s)" in found["drive-in-components"].what
    assert "3 of 24 units have no pose: frames 13 to 15" in found["units-without-pose"].what
    report = gaps.describe(parts)["components"]
    assert [one["spans"] for one in report] == [[[0, 12]], [[16, 23]]]
    missing = describe(parts[0].mapper, parts[0].log, [parts[1].mapper])["units_not_registered"]
    assert [one["unit"] for one in missing] == list(DARK)


def test_a_component_takes_the_calibration_of_the_largest(simulated: SimulatedDrive) -> None:
    whole, part = mapped(simulated, without_dark(simulated, true_matches(simulated)))
    refine(whole.mapper)
    rng = np.random.default_rng(0)
    part.mapper.state.camera_position_m[:] *= 1.05  # as if a few units had stretched it
    part.mapper.state.camera_position_m[:] += rng.normal(0, 1e-3, part.mapper.state.camera_position_m.shape)
    result = refine(part.mapper, calibrated=whole.mapper)
    assert not result.calibration.free
    np.testing.assert_array_equal(part.mapper.state.rig_from_cam, whole.mapper.state.rig_from_cam)
    assert rmse(metric_errors_m(part.mapper, simulated)) < 0.02


def test_positions_put_parts_into_one_frame(simulated: SimulatedDrive) -> None:
    sigma_m = 0.1
    pairs = without_dark(simulated, true_matches(simulated))
    parts = mapped(simulated, pairs, received(simulated, sigma_m))
    assert len(parts) == 1
    assert [link.by for link in parts[0].links] == [LinkedBy.POSITIONS]
    refinement = refine(parts[0].mapper, received(simulated, sigma_m))
    assert refinement.certainty is not None
    units = registered(parts[0])
    off_m = (parts[0].mapper.state.unit_position_m - simulated.world_from_rig[:, :3, 3])[units]
    assert len(units) == UNITS - len(DARK)
    assert rmse(np.linalg.norm(off_m, axis=1)) < sigma_m
    # Where one part lies to the other is no better than the receiver, and is said to be.
    sigmas = refinement.certainty.sigma_unit_position_m[units]
    assert (np.abs(off_m) < 4 * sigmas).all()
    found = {finding.code: finding for finding in gaps.findings(parts)}
    assert found["gap-without-images"].severity == "error"
    assert "frames 16 to 23 at 1.6 to 2.3 s by GNSS positions" in found["gap-without-images"].what


def test_positions_of_another_shape_link_nothing(simulated: SimulatedDrive) -> None:
    pairs = without_dark(simulated, true_matches(simulated))
    parts = mapped(simulated, pairs, received(simulated, 0.02, moved_m=0.5))
    assert len(parts) == 2


def test_images_that_see_a_place_again_link_parts(simulated: SimulatedDrive) -> None:
    pairs = true_matches(simulated, window=8)
    near = without_dark(simulated, [pair for pair in pairs if within(simulated, pair, 3)])
    # A few pairs that reach across are all there is, as of a street that is driven again.
    across = [
        replace(pair, is_revisit=True)
        for pair in pairs
        if {10, 11, 12} & units_of(simulated, pair) and {16, 17, 18} & units_of(simulated, pair)
    ]
    parts = mapped(simulated, [*near, *across])
    assert len(parts) == 1
    assert [link.by for link in parts[0].links] == [LinkedBy.IMAGES]
    assert parts[0].size == UNITS - len(DARK)
    assert rmse(metric_errors_m(parts[0].mapper, simulated)) < 0.05
    assert {finding.code for finding in gaps.findings(parts)} == {"units-without-pose"}
    # Wrong ones that agree with no other link nothing.
    rng = np.random.default_rng(0)
    shuffled = [
        replace(pair, matches=np.stack([pair.matches[:, 0], rng.permutation(pair.matches[:, 1])], 1)) for pair in across
    ]
    assert len(mapped(simulated, [*near, *shuffled])) == 2


def units_of(simulated: SimulatedDrive, pair: PairMatches) -> set[int]:
    return {simulated.drive.images[i].unit for i in (pair.image_a, pair.image_b)}


def within(simulated: SimulatedDrive, pair: PairMatches, window: int) -> bool:
    units = units_of(simulated, pair)
    return max(units) - min(units) <= window


def test_a_drive_in_one_piece_has_no_finding(simulated: SimulatedDrive) -> None:
    parts = mapped(simulated, true_matches(simulated))
    assert [part.size for part in parts] == [UNITS]
    assert not parts[0].links
    assert gaps.findings(parts) == []


def test_spans_of_units() -> None:
    assert gaps.spans(np.array([1, 1, 0, 1, 0, 0, 1], dtype=np.bool_)) == [(0, 1), (3, 3), (6, 6)]
    assert gaps.spans(np.zeros(3, dtype=np.bool_)) == []


@pytest.mark.slow
def test_a_group_without_a_scene_does_not_keep_others_from_growing(simulated: SimulatedDrive) -> None:
    """Units 2 to 5 match one another alone, and in a way that no pose explains."""
    pairs = without_dark(simulated, true_matches(simulated))
    rng = np.random.default_rng(0)
    nonsense = [
        replace(pair, matches=np.stack([pair.matches[:, 0], rng.permutation(pair.matches[:, 1])], 1))
        for pair in true_matches(simulated, window=8)
        if units_of(simulated, pair) <= set(range(2, 6))
    ]
    kept = [pair for pair in pairs if not units_of(simulated, pair) & set(range(2, 6))]
    parts = mapped(simulated, [*kept, *nonsense])
    assert [registered(part) for part in parts] == [list(range(DARK.stop, UNITS)), list(range(6, DARK.start))]
