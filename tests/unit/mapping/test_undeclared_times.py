from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, EngineConfig
from mrasfm_engine.mapping import undeclared_times
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.refinement import refine
from schemas.findings import Finding
from tests.helpers.simulated_drive import make_model, make_simulated_drive, with_cameras, with_true_poses
from tests.unit.mapping.test_placement import ARM_M, received

UNITS = 20


def findings(
    late_ms: list[int],
    *,
    sigma_m: float | None = None,
    units: int = UNITS,
    readout_ms: int = 0,
    given: Callable[[np.ndarray], np.ndarray] = lambda rig: rig,
    settings: BundleAdjustmentConfig | None = None,
    **camera: Any,
) -> list[Finding]:
    """Late cameras of a drive whose manifest has one timestamp for each frame, and declares no readout."""
    simulated = make_simulated_drive(
        units=units,
        cameras=len(late_ms),
        points=1500,
        time_offset_ms=late_ms,
        late_ms=late_ms,
        readout_ms=readout_ms,
        given=given,
    )
    cameras = [c.model_copy(update={"readout_us": None, **camera}) for c in simulated.drive.cameras]
    simulated = with_cameras(simulated, cameras)
    config = EngineConfig(threads=1, bundle_adjustment=settings or BundleAdjustmentConfig())
    mapper = with_true_poses(make_model(simulated, config=config), simulated, range(units))
    gnss = None if sigma_m is None else received(simulated, sigma_m)
    return refine(mapper, AbsolutePriors(gnss=gnss, antenna_in_rig_m=ARM_M)).late_cameras


@pytest.mark.parametrize(("late_ms", "sigma_m"), [([0, 0, 40, 0], None), ([0, -20, 0], 0.3)])
def test_a_late_camera_is_named_with_its_offset_and_with_the_field_that_lets_it_vary(
    late_ms: list[int], sigma_m: float | None
) -> None:
    (said,) = findings(late_ms, sigma_m=sigma_m)
    (camera,) = np.flatnonzero(late_ms)
    name = make_simulated_drive(units=2, cameras=len(late_ms), points=50).drive.cameras[camera].name
    assert said.code == "time-offset-undeclared"
    assert f"camera {name} " in said.what
    stated_ms, sigma_ms = (float(said.what.split(mark)[1].split(" ms")[0]) for mark in ("taken ", "(sigma "))
    assert stated_ms == pytest.approx(late_ms[camera], abs=2.0)
    assert 0.1 <= sigma_ms < 3.0
    assert "sigma_time_offset_us" in said.remedy


@pytest.mark.parametrize(("late_ms", "where"), [(100, "1 frame later"), (-100, "1 frame earlier"), (40, "")])
def test_images_that_belong_to_another_frame_are_told_to_which(late_ms: int, where: str) -> None:
    (said,) = findings([0, 0, late_ms, 0])
    assert said.remedy.partition("they belong ")[2] == (where and f"{where}.")


def test_of_two_cameras_both_are_named() -> None:
    (said,) = findings([0, 30], sigma_m=0.1)
    assert said.code == "time-offset-undeclared"
    assert "left and right" in said.what
    assert float(said.what.split("taken ")[1].split(" ms")[0]) == pytest.approx(30.0, abs=3.0)


def moved_ahead(rig_from_cam: np.ndarray) -> np.ndarray:
    result = rig_from_cam.copy()
    result[2, 0, 3] += 0.4
    return result


@pytest.mark.parametrize(
    "arguments", [{}, {"given": moved_ahead}, {"readout_ms": 20}], ids=["nothing", "a wrong place", "a shutter"]
)
def test_nothing_else_passes_for_a_late_camera(arguments: dict[str, Any]) -> None:
    """Given places that are wrong, and shutters that roll without a word in the manifest."""
    assert findings([0] * 4, **arguments) == []


def test_what_the_manifest_declares_is_estimated_instead() -> None:
    (said,) = findings([0, 0, 40, 0], sigma_time_offset_us=5000.0)
    assert said.code == "time-offset-beyond-prior"
    assert findings([0, 0, 40, 0], sigma_time_offset_us=20000.0) == []


def test_few_units_and_settings_leave_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(undeclared_times, "_LateImages", None)  # not even begun
    assert findings([0, 0, 40, 0], units=8, sigma_m=0.1) == []
    assert findings([0, 0, 40, 0], settings=BundleAdjustmentConfig(refine_time_offsets=False)) == []


def test_without_a_suspicion_nothing_is_asked_of_the_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(undeclared_times, "_LateImages", None)
    assert findings([0] * 3) == []


def test_a_camera_at_a_wrong_place_does_not_have_the_scene_adjusted_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(undeclared_times, "adjust_poses", None)
    assert findings([0] * 4, given=moved_ahead) == []
