from __future__ import annotations

from dataclasses import replace

import numpy as np

from mrasfm_engine.mapping.calibration import scale_with_baselines
from mrasfm_engine.mapping.implausible_lengths import length_findings
from mrasfm_engine.mapping.refinement_result import Refinement
from mrasfm_engine.mapping.road import RoadAssessment, assess_road
from tests.unit.mapping.test_road_filter import drive_over_shadows, mapped


def test_lengths_that_no_vehicle_has_are_said_whatever_their_sigma() -> None:
    simulated, _ = drive_over_shadows(share=0.0)
    mapper = mapped(simulated)
    road = assess_road(mapper, for_map=True)
    assert isinstance(road, RoadAssessment)
    assert length_findings(mapper, Refinement(road=road)) == []

    lifted = replace(road, fitted=replace(road.fitted, rig_height_m=9.0))
    (said,) = length_findings(mapper, Refinement(road=lifted))
    assert said.code == "implausible-lengths"
    height_m = 9.0 + float(np.median(mapper.state.camera_position_m[:, 2]))
    assert f"cameras stand {height_m:.1f} m above the road" in said.what

    scale_with_baselines(mapper, 10.0)
    (said,) = length_findings(mapper, Refinement(road="nothing shows it"))
    assert "the vehicle drives up to 111 m/s" in said.what
    assert "cameras" not in said.what
