"""Sub-maps are joined by the units they share, whatever their frames and scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import PARAMETERS
from mrasfm_engine.mapping.components import Component, DriveMapping, begin_mapping
from mrasfm_engine.mapping.submaps import Part, in_common_frames, join, part_arrays, part_from_arrays
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.scene.submaps import Span, cut
from mrasfm_engine.types import Floats
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    keypoints_of,
    make_simulated_drive,
    metric_errors_m,
    rmse,
    true_matches,
)

UNITS = 24
CONFIG = EngineConfig(threads=1)
ALL = np.ones(UNITS, dtype=np.bool_)


@pytest.fixture(scope="module")
def simulated() -> SimulatedDrive:
    return make_simulated_drive(units=UNITS, cameras=4, points=2500)


def a_part(simulated: SimulatedDrive, units: Sequence[int], *, observations: int = 1000) -> Part:
    rows = np.asarray(units)
    return Part(
        units=rows,
        world_from_rig=simulated.world_from_rig[rows],
        rig_from_cam=simulated.drive.rig_from_cam,
        camera_params=np.zeros((4, PARAMETERS)),
        camera_time_offset_s=np.zeros(4),
        missing=np.zeros(0, dtype=np.int64),
        own=np.zeros(0, dtype=np.int64),
        unit_from_image=np.zeros((0, 4, 4)),
        observations=observations,
    )


def elsewhere(part: Part, seed: int, factor: float = 1.0) -> Part:
    """The part in a frame of its own, with other lengths."""
    rng = np.random.default_rng(seed)
    return part.scaled(factor).moved(se3.transform(se3.exp_so3(rng.normal(size=3)), rng.normal(0, 50, 3)))


def off_m(part: Part, simulated: SimulatedDrive, frame: Floats) -> float:
    places = se3.apply(frame, part.world_from_rig[:, :3, 3])
    return float(np.abs(places - simulated.world_from_rig[part.units, :3, 3]).max())


def test_parts_come_into_one_frame_and_scale(simulated: SimulatedDrive) -> None:
    factors = (1.0, 1.02, 0.97)
    parts = [
        elsewhere(a_part(simulated, range(first, last)), seed, factor)
        for seed, (first, last, factor) in enumerate(zip((0, 6, 14), (10, 18, 24), factors, strict=True))
    ]
    (group,) = in_common_frames(parts)
    assert sorted(len(part.units) for part in group) == [10, 10, 12]
    # Of common scale, which is the mean of their own ones.
    mean = np.exp(np.average(np.log(factors), weights=[10, 12, 10]))
    largest = next(part for part in group if len(part.units) == 12)
    both = (largest.world_from_rig, simulated.world_from_rig[largest.units])
    ways = [poses[-1, :3, 3] - poses[0, :3, 3] for poses in both]
    lengths = np.linalg.norm(ways, axis=1)
    assert lengths[0] / lengths[1] == pytest.approx(mean, rel=1e-3)
    unscaled = [part.scaled(1.0 / mean) for part in group]
    truth = simulated.world_from_rig[unscaled[0].units[0]]
    frame = truth @ se3.inverse(unscaled[0].world_from_rig[0])
    assert max(off_m(part, simulated, frame) for part in unscaled) < 1e-6
    for part in unscaled:
        np.testing.assert_allclose(part.rig_from_cam, simulated.drive.rig_from_cam, atol=1e-9)


def test_lengths_change_no_image(simulated: SimulatedDrive) -> None:
    """Cameras and points scaled alike are seen alike, also where the rig's origin is not in their middle."""
    part = a_part(simulated, range(5))
    images = np.tile(np.eye(4), (2, 1, 1))
    images[:, :3, :3] = se3.exp_so3(np.array([[0.0, 0.0, 0.1], [0.02, 0.0, 0.0]]))
    images[:, :3, 3] = [[0.5, 0.1, 0.0], [0.2, 0.0, 0.1]]
    part = replace(part, own=np.array([0, 5]), unit_from_image=images)
    scaled = part.scaled(1.3)
    for unit, image in ((0, None), (3, None), (0, 0), (1, 1)):
        places = []
        for one in (part, scaled):
            extra = np.eye(4) if image is None else one.unit_from_image[image]
            places.append((one.world_from_rig[unit] @ extra @ one.rig_from_cam)[:, :3, 3])
        np.testing.assert_allclose(places[1], 1.3 * places[0], atol=1e-9)


def test_parts_that_share_too_few_units_stay_apart(simulated: SimulatedDrive) -> None:
    parts = [a_part(simulated, range(12)), a_part(simulated, range(10, 24))]
    assert [len(group) for group in in_common_frames(parts)] == [1, 1]


def test_shared_units_of_another_shape_link_nothing(simulated: SimulatedDrive) -> None:
    wrong = a_part(simulated, range(8, 24))
    wrong.world_from_rig[:5, :3, 3] = wrong.world_from_rig[4::-1, :3, 3]  # driven backwards
    assert len(in_common_frames([a_part(simulated, range(13)), wrong])) == 2


def test_one_wrong_unit_of_those_shared_changes_nothing(simulated: SimulatedDrive) -> None:
    wrong = a_part(simulated, range(8, 24))
    wrong.world_from_rig[2, :3, 3] += 0.3
    (group,) = in_common_frames([a_part(simulated, range(13)), wrong])
    last = next(part for part in group if part.units[0] == 0)
    frame = simulated.world_from_rig[last.units[0]] @ se3.inverse(last.world_from_rig[0])
    other = next(part for part in group if part.units[0] == 8)
    rows = np.delete(np.arange(len(other.units)), 2)
    right = replace(other, units=other.units[rows], world_from_rig=other.world_from_rig[rows])
    assert off_m(right, simulated, frame) < 0.2


def mapping_of(simulated: SimulatedDrive, pairs: Sequence[PairMatches]) -> DriveMapping:
    return begin_mapping(simulated.drive, keypoints_of(simulated, CONFIG), pairs, None, CONFIG)


def parts_of(simulated: SimulatedDrive, span: Span, pairs: Sequence[PairMatches], seed: int) -> list[Part]:
    """Components of a sub-map, each in a frame of its own."""
    unit = np.array([image.unit for image in simulated.drive.images])
    inside = [p for p in pairs if all(span.first <= unit[i] <= span.last for i in (p.image_a, p.image_b))]
    begun = mapping_of(simulated, inside)
    begun.mapper.keyframe = np.isin(np.arange(UNITS), span.units)
    begun.map_from_seeds()
    every = np.arange(UNITS), np.arange(len(unit))
    return [elsewhere(part_from_arrays(part_arrays(part), *every), seed) for part in begun.put_together()]


def joined(simulated: SimulatedDrive, pairs: Sequence[PairMatches], parts: Sequence[Part]) -> list[Component]:
    return join(mapping_of(simulated, pairs), parts, ALL.copy())


def test_joined_sub_maps_are_as_good_as_one_piece(simulated: SimulatedDrive) -> None:
    pairs = true_matches(simulated)
    whole = mapping_of(simulated, pairs)
    whole.map_from_seeds()
    (in_one,) = whole.finish()
    parts = [part for span in cut(UNITS, 3, 4) for part in parts_of(simulated, span, pairs, span.number)]
    (component,) = joined(simulated, pairs, parts)
    assert component.mapper.registered.all()
    errors_m = [rmse(metric_errors_m(one.mapper, simulated)) for one in (component, in_one)]
    assert 0 < errors_m[0] < 1.2 * errors_m[1] + 1e-3


def test_a_sub_map_without_images_leaves_components(simulated: SimulatedDrive) -> None:
    """The middle one shows nothing, and its neighbours share no units."""
    unit = np.array([image.unit for image in simulated.drive.images])
    dark = range(8, 16)
    pairs = [
        p
        for p in true_matches(simulated)
        if not any(unit[i] in dark for i in (p.image_a, p.image_b))
        and (unit[p.image_a] < dark.start) == (unit[p.image_b] < dark.start)
    ]
    spans = cut(UNITS, 3, 4)
    parts = [part for span in (spans[0], spans[2]) for part in parts_of(simulated, span, pairs, span.number)]
    components = joined(simulated, pairs, parts)
    found = sorted(np.flatnonzero(component.mapper.registered).tolist() for component in components)
    assert found == [list(range(8)), list(range(16, 24))]
    for component in components:
        assert rmse(metric_errors_m(component.mapper, simulated)) < 0.02
        assert component.links == []  # not with itself, mapped again


def test_a_drive_of_which_no_sub_map_could_begin_is_refused(simulated: SimulatedDrive) -> None:
    with pytest.raises(ReconstructionError, match="no part of the drive") as refused:
        joined(simulated, true_matches(simulated), [])
    assert refused.value.code == "no-initial-units"
