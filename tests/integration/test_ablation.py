"""`mrasfm ablate`: rows, what they share, and bad input."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from mrasfm_engine import ablation
from mrasfm_engine.ablation import FULL, SWITCHES, Row, _remark, switches_named
from mrasfm_engine.config import EngineConfig, SemanticsConfig
from mrasfm_engine.preflight.drive_reader import read_drive
from tests.integration.conftest import CommandResult, Variant

Run = Callable[..., CommandResult]
CSBA, SELECTION, PRIORS = "bundle_adjustment.camera_set_adjustment", "pairs.selection", "bundle_adjustment.priors"


@pytest.fixture
def small(variant: Variant) -> Variant:
    return variant.keep(cameras=["front", "left"], units=6).save()


def test_every_part_is_on_by_default_and_each_switch_turns_off_one() -> None:
    config = EngineConfig()
    names = {switch.name for switch in SWITCHES}
    assert {CSBA, SELECTION, PRIORS} <= names
    for switch in SWITCHES:
        before, after = config.model_dump(), switch.turned_off(config).model_dump()
        assert before[switch.section].pop(switch.field) is True
        assert after[switch.section].pop(switch.field) is False
        assert before == after


@pytest.mark.slow
def test_what_the_road_is_known_by_without_masks_depends_on_a_model_for_them(small: Variant) -> None:
    for frame in small.document["frames"]:
        for image in frame["images"].values():
            image.pop("mask")
    drive, config = read_drive(small.save().root), EngineConfig()
    [switch] = switches_named(["mapping.semantic_triangulation"])
    assert "no masks" in _remark(switch, drive, config)
    by_model = config.model_copy(update={"semantics": SemanticsConfig(model="mine")})
    assert _remark(switch, drive, by_model) == ""


@pytest.mark.slow
def test_the_table_as_json(small: Variant, mrasfm: Run, tmp_path: Path) -> None:
    only = [word for name in (CSBA, SELECTION, PRIORS) for word in ("--only", name)]
    truth = small.root / "truth.tum"
    result = mrasfm("ablate", small.root, "--truth", truth, "--out", tmp_path / "out", "--json", *only)
    assert result.code == 0, result.err
    document = json.loads(result.out)
    assert document == json.loads((tmp_path / "out" / "ablation.json").read_text(encoding="utf-8"))
    assert document["true_calibration"].endswith("truth_calibration.json")
    rows = {row["name"]: row for row in document["rows"]}
    assert list(rows) == [FULL, CSBA, SELECTION, PRIORS]
    full = rows[FULL]
    assert (full["registered_images"], full["total_images"]) == (12, 12)
    assert 0 < full["errors"]["units"]["similarity_rmse_m"] < 0.05
    assert 0 < full["errors"]["images"]["rotation_median_deg"] < 0.5
    assert 0 < full["mapping_s"] < full["whole_s"]
    # 6 units of 2 cameras: units and cameras are the unknowns, or all images.
    assert rows[CSBA]["pose_parameters"] == 72
    assert full["pose_parameters"] in (36, 48)
    # What a part does not affect is taken from the full method.
    kept = {path.parent.name for path in (tmp_path / "out").glob("*/matches.npz")}
    assert kept == {FULL, SELECTION}
    assert {path.parent.name for path in (tmp_path / "out").glob("*/features.npz")} == {FULL}


@pytest.mark.slow
def test_the_table_for_people(small: Variant, mrasfm: Run) -> None:
    small.keep(units=4).save()
    truth = small.root / "truth.tum"
    result = mrasfm("ablate", small.root, "--truth", truth, "--no-gnss", "--only", PRIORS)
    assert result.code == 0, result.err
    assert "images registered" in result.out
    assert "no priors: no GNSS" in result.out
    assert not list(small.root.parent.glob("mrasfm-ablation-*"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--truth", "nowhere.tum"), "nowhere.tum does not exist"),
        (("--truth", "{drive}/drive.json"), "drive.json, line 1"),
        (("--truth", "{drive}/late.tum"), "0 timestamps in common"),
        (("--truth", "{drive}/truth.tum", "--only", "pairs.window_units"), "--only pairs.window_units"),
        (("--truth", "{drive}/truth.tum", "--truth-calibration", "{drive}/drive.json"), "is not a calibration"),
        (("--truth", "{drive}/truth.tum", "--truth-calibration", "{drive}/one.json"), "has no pose of left"),
        (("--truth", "{drive}/truth.tum", "--out", "{drive}/drive.json"), "cannot write {drive}/drive.json"),
    ],
)
def test_bad_input_is_named_before_any_work(
    small: Variant, mrasfm: Run, options: tuple[str, ...], message: str
) -> None:
    lines = (small.root / "truth.tum").read_text(encoding="utf-8").splitlines()[1:]
    later = [f"{float(line.split()[0]) + 1e6:.6f} {line.split(maxsplit=1)[1]}" for line in lines]
    small.write("late.tum", "\n".join(later).encode())
    calibration = json.loads((small.root / "truth_calibration.json").read_text(encoding="utf-8"))
    small.write("one.json", json.dumps({"front": calibration["front"]}).encode())
    result = mrasfm("ablate", small.root, *(option.format(drive=small.root) for option in options))
    assert result.code == 2
    assert message.format(drive=small.root) in result.err
    assert "features" not in result.err


def test_a_drive_that_is_none_is_refused(mrasfm: Run, small: Variant, tmp_path: Path) -> None:
    result = mrasfm("ablate", tmp_path / "none", "--truth", small.root / "truth.tum")
    assert result.code == 2
    assert "does not exist" in result.err


def test_only_what_cannot_be_written_is_blamed_on_the_folder_for_the_result(
    mrasfm: Run, small: Variant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, command = tmp_path / "out", ("ablate", small.root, "--truth", small.root / "truth.tum", "--out")

    def damaged(*_: object, **__: object) -> list[Row]:
        raise OSError(errno.EIO, "Input/output error", str(small.root / "drive.json"))

    monkeypatch.setattr(ablation, "ablate", damaged)
    with pytest.raises(OSError, match=r"Input/output error.*drive\.json"):
        mrasfm(*command, out)
    monkeypatch.setattr(ablation, "ablate", lambda *_, **__: [])
    (out / "ablation.json").mkdir()
    result = mrasfm(*command, out)
    assert result.code == 2
    assert f"cannot write {out / 'ablation.json'}" in result.err
