"""Attempts at real drives, in real children."""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path

import pytest

from mrasfm_engine.cli import main
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.axes import flu_from_body
from mrasfm_engine.learned.model_folder import FOLDER_VARIABLE, ModelFolder
from mrasfm_engine.scene.drive import matrix_from_pose, pose_from_matrix
from schemas import BodyAxes, Pose
from schemas.artifacts import CHECKPOINT_FOLDER, checkpoint_file
from schemas.manifest_check import check_manifest
from schemas.parsing import parse_manifest
from service.domain.jobs import ProgressNote
from service.settings import Settings
from tests.helpers import learned_graphs
from tests.helpers.process_tree import children_of
from tests.worker.conftest import go_on, meter_of, settings_with, stop_once_it_works
from worker.attempt import AttemptFolder, run_attempt
from worker.child_protocol import Attempt, Work
from worker.outcomes import Failed, Outcome, Succeeded
from worker.progress import ProgressMeter
from worker.termination import CheckStop, StopReason, StopRequest

STAGES = ["preflight", "features", "matches", "mapping", "refinement", "pictures", "export"]


def attempt(
    drive: Path,
    scratch: Path,
    settings: Settings,
    check_stop: CheckStop = go_on,
    work: Work = Work.RECONSTRUCTION,
    meter: ProgressMeter | None = None,
    **asked: object,
) -> Outcome:
    return run_attempt(
        Attempt(work=work, drive=drive, settings=asked),
        scratch=scratch,
        check_stop=check_stop,
        meter=meter or meter_of(work),
        settings=settings,
    )


def attempt_with_a_signal(
    drive: Path, scratch: Path, settings: Settings, number: signal.Signals, *, steps: int = 0
) -> Outcome:
    """The child gets a signal as soon as it reports a stage; or so many steps of one, when its code is imported."""
    meter, sent = meter_of(), []

    def check_stop() -> None:
        is_due = meter.at(0.0).done >= steps if steps else meter.stage
        if is_due and not sent:
            sent.append(number)
            (child,) = children_of(os.getpid(), "worker.child")
            os.kill(child.pid, number)

    return attempt(drive, scratch, settings, check_stop, meter=meter)


def leftovers(scratch: Path) -> list[str]:
    return [str(path) for path in scratch.rglob("*") if "partial" in path.name]


def test_reconstruction_and_another_that_reuses_its_stages(
    brief_drive: Path, scratch: Path, settings: Settings, tmp_path: Path
) -> None:
    seen: list[ProgressNote] = []
    meter = meter_of()
    outcome = attempt(
        brief_drive, scratch, settings, lambda: seen.append(meter.at(0.0)), meter=meter, max_keypoints=1000, seed=5
    )
    assert isinstance(outcome, Succeeded)
    report = outcome.report
    assert report == json.loads((outcome.out / "report.json").read_text(encoding="utf-8"))
    assert report["summary"]["registered_units"] == 4
    assert report["settings"]["features"]["max_keypoints"] == 1000
    assert report["settings"]["seed"] == 5
    assert report["settings"]["threads"] == 1
    assert (outcome.out / "points.ply").stat().st_size > 0
    assert leftovers(scratch) == []

    percents = [progress.percent for progress in seen]
    assert percents == sorted(percents)
    assert percents[0] == 0.0
    assert 50.0 < percents[-1] <= 97.0
    stages = [progress.stage for progress in seen if progress.stage]
    assert sorted(set(stages), key=STAGES.index) == list(dict.fromkeys(stages))
    assert all(progress.done <= progress.total for progress in seen)
    assert {progress.unit for progress in seen if progress.stage == "matches"} <= {"pairs"}

    second = tmp_path / "second"
    AttemptFolder(second).out.mkdir(parents=True)
    AttemptFolder(scratch).finished_stages.rename(AttemptFolder(second).finished_stages)
    meter = meter_of()
    again = attempt(
        brief_drive, second, settings, lambda: seen.append(meter.at(0.0)), meter=meter, max_keypoints=1000, seed=5
    )
    assert isinstance(again, Succeeded)
    reused = {stage["stage"]: stage["reused"] for stage in again.report["stages"]}
    assert reused == {stage: stage != "pictures" for stage in STAGES[1:-1]}
    assert seen[-1].reused == ("features", "matches", "mapping", "refinement")


@pytest.mark.slow
def test_bad_input_has_the_words_of_the_command(
    own_drive: Path, scratch: Path, settings: Settings, capfd: pytest.CaptureFixture[str]
) -> None:
    images = sorted((own_drive / "images").rglob("*.jpg"))
    images[0].unlink()
    images[3].write_bytes(images[3].read_bytes()[:-2000])
    assert main(["reconstruct", str(own_drive), "--out", str(own_drive.parent / "scene")]) == 2
    words = capfd.readouterr().err
    outcome = attempt(own_drive, scratch, settings)
    assert isinstance(outcome, Failed)
    assert outcome.code == "missing-file"
    assert not outcome.retryable
    assert outcome.stage == "preflight"
    assert f"mrasfm: error: {outcome.what}\n  {outcome.remedy}" in words
    assert "1 more error" in outcome.what
    errors = [finding for finding in outcome.findings if finding["severity"] == "error"]
    assert len(errors) == 2
    assert str(own_drive) not in json.dumps(outcome.findings) + outcome.what


@pytest.mark.parametrize("work", [Work.RECONSTRUCTION, Work.PREFLIGHT])
def test_broken_manifest(own_brief_drive: Path, scratch: Path, settings: Settings, work: Work) -> None:
    (own_brief_drive / "drive.json").write_text('{"name": NaN}', encoding="utf-8")
    outcome = attempt(own_brief_drive, scratch, settings, work=work)
    assert isinstance(outcome, Failed)
    assert (outcome.code, outcome.retryable, outcome.stage) == ("bad-document", False, "")
    assert outcome.what == "drive manifest drive.json: holds NaN, which is not a JSON number"


def test_unknown_setting(brief_drive: Path, scratch: Path, settings: Settings) -> None:
    outcome = attempt(brief_drive, scratch, settings, gravity=9.81)
    assert isinstance(outcome, Failed)
    assert (outcome.code, outcome.retryable) == ("bad-settings", False)
    assert "gravity" in outcome.what


@pytest.mark.slow
def test_models_are_looked_for_where_the_worker_says(
    small_drive: Path, scratch: Path, settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And a client is not told where that is."""
    models = tmp_path / "models"
    monkeypatch.setenv(FOLDER_VARIABLE, str(models))
    outcome = attempt(small_drive, scratch, settings, segmentation_model="streets")
    assert isinstance(outcome, Failed)
    assert (outcome.code, outcome.retryable) == ("missing-model", False)
    assert str(tmp_path) not in outcome.what + outcome.remedy
    assert "the models' folder of the worker" in outcome.what
    ModelFolder(models).add_data(learned_graphs.segmenter(), "streets", what="made here")
    assert isinstance(attempt(small_drive, scratch, settings, segmentation_model="streets"), Succeeded)


@pytest.mark.slow
def test_drive_that_cannot_be_reconstructed(own_drive: Path, scratch: Path, settings: Settings) -> None:
    """Every image is the same grey."""
    from cv2 import imread, imwrite

    for file in (own_drive / "images").rglob("*.jpg"):
        pixels = imread(str(file))
        pixels[:] = 90
        assert imwrite(str(file), pixels)
    outcome = attempt(own_drive, scratch, settings)
    assert isinstance(outcome, Failed)
    assert (outcome.code, outcome.retryable, outcome.stage) == ("no-features", False, "features")


@pytest.mark.slow
def test_preflight_of_a_sound_drive(small_drive: Path, scratch: Path, settings: Settings) -> None:
    outcome = attempt(small_drive, scratch, settings, work=Work.PREFLIGHT)
    assert isinstance(outcome, Succeeded)
    assert outcome.report["sound"] is True
    assert all(finding["severity"] == "warning" for finding in outcome.report["findings"])


@pytest.mark.slow
def test_preflight_finds_a_damaged_image(own_drive: Path, scratch: Path, settings: Settings) -> None:
    file = sorted((own_drive / "images").rglob("*.jpg"))[0]
    file.write_bytes(b"")
    outcome = attempt(own_drive, scratch, settings, work=Work.PREFLIGHT)
    assert isinstance(outcome, Succeeded)
    assert outcome.report["sound"] is False
    assert [finding["code"] for finding in outcome.report["findings"]] == ["empty-file"]


@pytest.mark.slow
def test_preflight_finds_an_inverted_calibration(own_drive: Path, scratch: Path, settings: Settings) -> None:
    """Of a stereo pair in axes where its inverse stands upright too: only the images tell."""
    path = own_drive / "drive.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    rdf_from_flu = se3.inverse(flu_from_body(BodyAxes.RDF))
    document["rig"]["body_axes"] = "rdf"
    for camera in document["rig"]["cameras"]:
        rdf_from_cam = rdf_from_flu @ matrix_from_pose(Pose(**camera["rig_from_cam"]))
        camera["rig_from_cam"] = pose_from_matrix(se3.inverse(rdf_from_cam)).model_dump()
    path.write_text(json.dumps(document), encoding="utf-8")
    assert check_manifest(parse_manifest(path.read_bytes()), use_gnss=False) == []
    outcome = attempt(own_drive, scratch, settings, work=Work.PREFLIGHT, use_gnss=False)
    assert isinstance(outcome, Succeeded)
    assert outcome.report["sound"] is False
    assert [finding["code"] for finding in outcome.report["findings"]] == ["calibration-inverted"]


def test_killed_child(brief_drive: Path, scratch: Path, settings: Settings) -> None:
    outcome = attempt_with_a_signal(brief_drive, scratch, settings, signal.SIGKILL)
    assert isinstance(outcome, Failed)
    assert (outcome.code, outcome.retryable, outcome.blame) == ("engine-killed", True, 0.0)
    assert outcome.stage in STAGES
    assert repr(outcome.stage) in outcome.what
    assert "was killed" in outcome.what


@pytest.mark.slow
def test_aborted_child(small_drive: Path, scratch: Path, settings: Settings) -> None:
    outcome = attempt_with_a_signal(small_drive, scratch, settings, signal.SIGABRT, steps=2)
    assert isinstance(outcome, Failed)
    assert (outcome.code, outcome.retryable) == ("engine-abort", True)
    assert "SIGABRT" in outcome.what
    # faulthandler says where it was; how many threads it lists after that, and C++ frames below, varies
    assert re.search(r'File "mrasfm_engine/.*", line \d+ in ', outcome.log_tail)
    files = re.findall(r'File "(.*?)"', outcome.log_tail)
    assert not [path for path in files if path.startswith("/")], "they are shown to users"


def test_cancel(brief_drive: Path, scratch: Path, settings: Settings) -> None:
    """By the token alone: signals would come after 20 s."""
    meter = meter_of()
    with pytest.raises(StopRequest) as stopped:
        attempt(brief_drive, scratch, settings, stop_once_it_works(meter, StopReason.CANCEL), meter=meter)
    assert stopped.value.reason is StopReason.CANCEL
    assert meter.stage in STAGES
    scene = AttemptFolder(scratch).out
    assert not scene.exists() or {path.name for path in scene.iterdir()} <= {".stages"}
    assert leftovers(scratch) == []
    assert '"cancelled"' in AttemptFolder(scratch).result.read_text(encoding="utf-8")


@pytest.mark.slow
def test_timeout(small_drive: Path, scratch: Path, tmp_path: Path) -> None:
    outcome = attempt(small_drive, scratch, settings_with(tmp_path, job_timeout_seconds=0.5))
    assert isinstance(outcome, Failed)
    assert (outcome.code, outcome.retryable) == ("timeout", False)
    assert "0.5 s" in outcome.what


@pytest.mark.slow
def test_full_disk(small_drive: Path, scratch: Path, settings: Settings) -> None:
    """A finished stage cannot be written, as the engine says; later it may be."""
    (AttemptFolder(scratch).out / CHECKPOINT_FOLDER / checkpoint_file("features") / "in its place").mkdir(parents=True)
    outcome = attempt(small_drive, scratch, settings)
    assert isinstance(outcome, Failed)
    assert (outcome.code, outcome.retryable, outcome.stage) == ("storage", True, "features")
    assert str(scratch) not in outcome.what
