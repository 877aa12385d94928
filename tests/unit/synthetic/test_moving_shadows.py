from __future__ import annotations

import numpy as np

from mrasfm_engine.synthetic.light import along_street, daylight
from mrasfm_engine.synthetic.motion import drive_motion
from mrasfm_engine.synthetic.moving_shadows import HEIGHT_M, SPEED_SHARE, moving_shadows, street_heading
from mrasfm_engine.synthetic.options import small_options
from mrasfm_engine.synthetic.streets import lay_out

OPTIONS = small_options(units=20, moving_shadows=30, seed=4, ramp_percent=6.0)


def test_companions_move_along_the_road_at_other_speeds_and_near_the_vehicle() -> None:
    layout = lay_out(OPTIONS, np.random.default_rng(0))
    own = drive_motion(OPTIONS, layout, 0, np.random.default_rng(1))
    casters = moving_shadows(OPTIONS, layout, 0, own, np.random.default_rng(2))
    assert len(casters) == 31
    times = np.arange(OPTIONS.units) / OPTIONS.rate_hz
    way = own.world_from_rig(times)
    np.testing.assert_allclose(casters[0].boxes(0.5)[:, 5], np.sin(street_angle(own.world_from_rig(0.5))), atol=1e-9)
    speed = OPTIONS.spacing_m * OPTIONS.rate_hz
    for caster in casters[1:]:
        boxes = np.stack([caster.boxes(t) for t in times])
        centre = boxes[:, :, :2].mean(1)
        moved = np.linalg.norm(np.diff(centre, axis=0), axis=1).mean() * OPTIONS.rate_hz / speed
        assert min(abs(s) for pair in SPEED_SHARE for s in pair) * 0.8 < moved < 1.0
        assert np.linalg.norm(centre - way[:, :2, 3], axis=1).min() < 20.0
        above = boxes[:, :, 2] - layout.ground.height(boxes[:, :, :2])
        assert HEIGHT_M[0] - 0.3 < above.min() < above.max() < HEIGHT_M[1] + 0.3
        assert (boxes[:, :, 3] > boxes[:, :, 2]).all()


def test_none_without_the_option() -> None:
    options = small_options(units=5)
    layout = lay_out(options, np.random.default_rng(0))
    own = drive_motion(options, layout, 0, np.random.default_rng(1))
    assert moving_shadows(options, layout, 0, own, np.random.default_rng(2)) == []


def test_the_sun_stands_along_the_street_at_its_height() -> None:
    for seed in range(8):
        light = daylight(np.random.default_rng(seed))
        turned = along_street(light, 0.7)
        angle = np.arctan2(turned.to_sun[1], turned.to_sun[0]) - 0.7
        assert abs(np.sin(angle)) <= np.sin(np.radians(15.0)) + 1e-9
        assert turned.to_sun[2] == light.to_sun[2]
        assert abs(np.linalg.norm(turned.to_sun) - 1.0) < 1e-9


def test_heading_of_the_whole_drive() -> None:
    layout = lay_out(OPTIONS, np.random.default_rng(0))
    own = drive_motion(OPTIONS, layout, 0, np.random.default_rng(1))
    middle = street_angle(own.world_from_rig(0.5 * OPTIONS.units / OPTIONS.rate_hz))
    assert 0 < abs(street_heading(own, OPTIONS) - middle) < np.radians(30)


def street_angle(world_from_rig: np.ndarray) -> float:
    return float(np.arctan2(world_from_rig[1, 0], world_from_rig[0, 0]))
