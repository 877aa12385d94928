"""The page of a map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mrasfm_engine.export.report_page._calibration import map_calibration_sections, wrong_cameras
from mrasfm_engine.export.report_page._common import (
    findings_section,
    findings_verdict,
    heading,
    share_verdict,
    stages_section,
    verdict,
)
from mrasfm_engine.export.report_page._html import (
    PREVIEW_BYTES,
    facts,
    number,
    number_with_sigma,
    page,
    pair,
    section,
    table,
    text,
)
from mrasfm_engine.export.report_page._read_back import MOST_BYTES
from schemas.findings import listed

# Below this nothing is seen on it; the pictures of seams for which there is no room are named.
SMALLEST_PICTURE_BYTES = 12_000
BASE64 = 4 / 3
MARGIN_BYTES = 60_000  # of the page: style, script, headings
SEAM_FIGURES = (
    ("inliers", "Shared points", ""),
    ("residual_before_px", "Residual before", "px"),
    ("residual_after_px", "Residual after", "px"),
    ("sigma_translation_m", "Sigma of the translation before the last adjustment", "m"),
    ("sigma_rotation_deg", "Sigma of the rotation before the last adjustment", "deg"),
)
MOST_NAMED = 12  # of the drives that are not in the map
SCALE_DIGITS = 5  # where its sigma is not known


def map_page(
    document: Mapping[str, Any],
    folder: Path,
    report: Mapping[str, Any],
    calibrations: Mapping[str, Mapping[str, Any]],
) -> str:
    """The page.

    Parameters
    ----------
    document
        `map.json`.
    folder
        The map's, whose `pictures/` are written already.
    report
        `report.json` with its `summary`; `name` is that of the map where it has one.
    calibrations
        `calibration/NAME.json` by scene.
    """
    others = [
        map_calibration_sections(calibrations),
        findings_section(report.get("findings", ())),
        stages_section(report.get("stages", ())),
    ]
    lines = list(_verdicts(document, report, calibrations))
    name = report.get("name", "")
    kind, title = ("Map", name) if name else ("", "Map")
    begin = [heading(kind, title, report.get("engine_version", ""), lines, report["summary"]), _scenes(document)]
    room = MOST_BYTES - MARGIN_BYTES - sum(len(part.encode()) for part in (*begin, *others, *_seams(document)))
    return page(f"{name}: map" if name else "Map", [*begin, *_seams(document, folder, room), *others])


def _verdicts(
    document: Mapping[str, Any], report: Mapping[str, Any], calibrations: Mapping[str, Mapping[str, Any]]
) -> Iterator[str]:
    scenes, unconnected = document["scenes"], document["unconnected"]
    connected = len(scenes) - len(unconnected)
    yield verdict(
        "warn" if unconnected else "good", f"{number(connected)} of {number(len(scenes))} scenes are connected"
    )
    yield share_verdict(report["summary"], "images")
    wrong = {name: cameras for name, one in calibrations.items() if (cameras := wrong_cameras(one))}
    if wrong:
        named = "; ".join(f"{', '.join(cameras)} in {name}" for name, cameras in wrong.items())
        yield verdict("bad", f"not mounted as given: {text(named)}")
    elif calibrations:
        yield verdict("good", "no single camera contradicts its calibration")
    fit_nowhere = {scene["name"] for scene in document["left_out"]}
    failed = [name for drive in report.get("failed_drives", ()) if (name := drive["name"]) not in fit_nowhere]
    if failed:
        drives = "1 drive is" if len(failed) == 1 else f"{number(len(failed))} drives are"
        yield verdict("bad", f"{drives} not in the map: {text(listed(failed, MOST_NAMED))}")
    if document["left_out"]:
        yield verdict("bad", f"{number(len(document['left_out']))} scenes are left out: nothing places them")
    if document["loops"]:
        yield verdict("warn", f"{number(len(document['loops']))} loops of seams do not close")
    if report.get("findings"):
        yield findings_verdict(report["findings"])


def _scenes(document: Mapping[str, Any]) -> str:
    rows = [
        (
            [
                text(scene["name"]),
                text(scene["verdict"]),
                f"{number(scene['registered_units'])} of {number(scene['total_units'])}",
                number(scene["points"]),
                number(scene["moved_from_positions_m"], "m")
                if scene.get("moved_from_positions_m") is not None
                else "–",
            ],
            "",
        )
        for scene in document["scenes"]
    ]
    return section("Scenes", table(["Scene", "Verdict", "Units", "Points", "Moved from its positions"], rows))


def _seams(document: Mapping[str, Any], folder: Path | None = None, room_bytes: int = 0) -> Iterator[str]:
    """A section of each seam; with a folder also its pictures, which take so many bytes of the page together."""
    left = sum("pictures" in seam for seam in document["seams"])
    for seam in document["seams"]:
        accepted, reason = seam["accepted"], text(seam.get("reason", "the evidence does not suffice"))
        state = "accepted" if accepted else f"rejected: {reason}"
        figures = {label: number(seam[name], unit) for name, label, unit in SEAM_FIGURES if seam.get(name) is not None}
        if seam.get("scale") is not None:
            figures["Scale of the second scene against the first"] = _scale(seam["scale"], seam.get("sigma_scale"))
        drawn = ""
        if folder is not None and "pictures" in seam:
            each = int(room_bytes / BASE64 / 2 / left)
            drawn, left = _pictures(seam["pictures"], folder, max(each, SMALLEST_PICTURE_BYTES), room_bytes), left - 1
            room_bytes -= len(drawn)
        elif folder is not None and accepted:
            drawn = "<p>There are no pictures: they were switched off.</p>\n"
        yield section(f"Seam of {seam['a']} and {seam['b']}", f"<p>{state}</p>\n", facts(figures), drawn)
    if not document["seams"]:
        yield section("Seams", "<p>No two scenes are close enough to one another to look for a seam.</p>\n")


def _scale(scale: float, sigma: float | None) -> str:
    return number_with_sigma(scale, sigma) if sigma else number(scale, digits=SCALE_DIGITS)


def _pictures(names: Mapping[str, str], folder: Path, each_bytes: int, room_bytes: int) -> str:
    """A seam's pictures, or their names where the page has no room for them."""
    caption = "Points of both scenes from above"
    drawn = pair(folder, names["before"], names["after"], caption, min(each_bytes, PREVIEW_BYTES))
    if drawn and len(drawn) <= room_bytes:
        return drawn
    return f"<p>Its pictures: {text(names['before'])}, {text(names['after'])}.</p>\n"
