from __future__ import annotations

import os
import time

import pytest

from schemas.api.jobs import ReconstructionSettings
from service.domain.jobs import ProgressNote
from worker.child_protocol import Work
from worker.progress import UNITS, WEIGHTS, ProgressMeter
from worker.progress_pipe import ProgressReader, ProgressWriter, StageReport


def meter(work: Work = Work.RECONSTRUCTION) -> ProgressMeter:
    return ProgressMeter(work, started_s=100.0)


def eta_s(m: ProgressMeter, now_s: float) -> tuple[float, float]:
    note = m.at(now_s)
    assert note.eta_low_s is not None
    assert note.eta_high_s is not None
    return note.eta_low_s, note.eta_high_s


@pytest.mark.parametrize("work", list(Work))
def test_weights_are_percent(work: Work) -> None:
    assert sum(WEIGHTS[work].values()) == 100.0


def test_begins_at_nothing() -> None:
    assert meter().at(100.0) == ProgressNote()
    assert meter().stage == ""


def test_stages_add_up_to_the_whole() -> None:
    m = meter()
    before = 0.0
    for stage, weight in WEIGHTS[Work.RECONSTRUCTION].items():
        m.update(stage, 1, 4)
        assert m.at(100.0).percent == pytest.approx(before + weight / 4)
        m.update(stage, 4, 4)
        before += weight
        assert m.at(100.0).percent == pytest.approx(before)
        assert (m.at(100.0).done, m.at(100.0).total, m.at(100.0).unit) == (4, 4, UNITS.get(stage))
    assert before == 100.0
    assert m.at(100.0).reused == ()


def test_never_falls() -> None:
    """Mapping can take units out again."""
    m = meter()
    m.update("mapping", 30, 51)
    high = m.at(100.0).percent
    m.update("mapping", 20, 51)
    assert m.at(100.0).percent == high
    assert m.at(100.0).done == 20
    m.update("features", 1, 100)
    assert m.at(100.0).percent == high


def test_end_of_a_stage_keeps_its_count() -> None:
    """The engine says "1 of 1" at the end of a stage; that is not one image."""
    m = meter()
    m.update("mapping", 30, 51)
    m.update("mapping", 1, 1)
    p = m.at(100.0)
    assert (p.done, p.total, p.unit, p.reused) == (51, 51, "units", ())


def test_reused_stages_jump_and_are_named() -> None:
    m = meter()
    m.update("preflight", 24, 24)
    for stage in ("features", "matches"):
        m.update(stage, 1, 1)
        assert m.at(100.0).unit is None
    assert m.at(100.0).reused == ("features", "matches")
    assert m.at(100.0).percent == 64.0
    m.update("mapping", 1, 51)
    assert m.at(100.0).reused == ("features", "matches")


@pytest.mark.parametrize(("done", "total"), [(0, 0), (5, 0), (-1, 10), (20, 10)])
def test_odd_counts_stay_in_their_stage(done: int, total: int) -> None:
    m = meter()
    m.update("features", done, total)
    assert 7.0 <= m.at(100.0).percent <= 39.0


def test_unknown_stage_counts_nothing() -> None:
    m = meter()
    m.update("preflight", 2, 2)
    m.update("meditation", 1, 2)
    p = m.at(100.0)
    assert (p.percent, p.stage, p.unit) == (7.0, "meditation", None)


def test_no_time_to_the_end_before_it_means_something() -> None:
    m = meter()
    m.update("features", 1, 2)
    assert m.at(101.0).eta_low_s is None  # too early
    slow = meter()
    slow.update("fetch", 1, 2)
    assert slow.at(160.0).eta_high_s is None  # too little done


def test_time_to_the_end_holds_the_truth_and_narrows() -> None:
    """Work at a steady rate of one percent a second."""
    width = float("inf")
    m = meter()
    for percent, report in {
        20: ("features", 13, 32),
        50: ("matches", 11, 25),
        80: ("mapping", 16, 20),
        95: ("export", 2, 4),
    }.items():
        m.update(*report)
        assert m.at(100.0).percent == pytest.approx(percent)
        low_s, high_s = eta_s(m, 100.0 + percent)
        assert 0 < low_s < 100.0 - percent < high_s
        assert high_s - low_s < width
        width = high_s - low_s


def test_time_to_the_end_does_not_count_on_what_was_reused() -> None:
    """64 percent came for nothing: the next ten took ten seconds, so the other 26 take about 26."""
    m = meter()
    m.update("preflight", 1, 1)
    m.update("features", 1, 1)
    m.update("matches", 1, 1)
    m.update("mapping", 10, 20)
    low_s, high_s = eta_s(m, 117.0)  # 7 of preflight and 10 of mapping in 17 s
    assert low_s < 26.0 < high_s < 40.0


def test_reports_pass_through_a_pipe_in_pieces() -> None:
    reader = ProgressReader()
    assert reader.feed(b'["features", 1, 12]\n["fea') == [StageReport("features", 1, 12)]
    assert reader.feed(b'tures", 2, 12]') == []
    assert reader.feed(b"\n") == [StageReport("features", 2, 12)]
    assert reader.feed(b"") == []


def test_writer_drops_what_comes_too_often() -> None:
    read_end, write_end = os.pipe()
    write = ProgressWriter(write_end)
    begun_s = time.monotonic()
    for done in range(1, 5001):
        write("features", done, 5000)
    write("features", 1, 1)
    write("matches", 1, 700)
    took_s = time.monotonic() - begun_s
    os.close(write_end)
    with os.fdopen(read_end, "rb") as pipe:
        reports = ProgressReader().feed(pipe.read())
    assert reports[0] == ("features", 1, 5000)
    assert reports[-3:] == [("features", 5000, 5000), ("features", 1, 1), ("matches", 1, 700)]
    assert len(reports) <= 5 + took_s / 0.2


def test_writer_notices_that_nobody_reads() -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    with pytest.raises(BrokenPipeError):
        ProgressWriter(write_end)("features", 1, 2)
    os.close(write_end)


def test_every_setting_of_a_request_reaches_the_engine() -> None:
    from worker.engine_settings import engine_config

    plain = engine_config(ReconstructionSettings().model_dump(), threads=3)
    assert plain.threads == 3
    assert plain == engine_config({}, threads=3)
    asked = ReconstructionSettings(
        use_gnss=False, max_keypoints=500, max_side_px=800, refine_calibration=False, refine_focal=True, seed=7,
        extractor="xfeat", matcher="lighterglue", segmentation_model="streets",
        semantic_triangulation=False, motion_compensation=False, submaps=4,
    )  # fmt: skip
    assert None not in asked.model_dump().values()
    config = engine_config(asked.model_dump(), threads=3)
    assert (config.use_gnss, config.seed) == (False, 7)
    assert (config.features.max_keypoints, config.features.max_side_px) == (500, 800)
    assert (config.bundle_adjustment.refine_calibration, config.bundle_adjustment.refine_focal) == (False, True)
    assert (config.features.extractor, config.matching.matcher) == ("xfeat", "lighterglue")
    assert config.semantics.model == "streets"
    assert config.submaps.count == 4
    assert (config.mapping.semantic_triangulation, config.mapping.motion_compensation) == (False, False)
    assert (plain.use_gnss, plain.features.max_keypoints, plain.bundle_adjustment.refine_focal) == (True, 2048, None)
