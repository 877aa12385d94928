"""The page of a map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mrasfm_engine.export.report_page._common import findings_section, heading, share_verdict, stages_section, verdict
from mrasfm_engine.export.report_page._html import facts, number, page, pair, section, table, text

PICTURED = 2  # seams whose pictures are on the page: each has up to a megabyte
SEAM_FIGURES = (
    ("inliers", "Shared points", ""),
    ("residual_before_px", "Residual before", "px"),
    ("residual_after_px", "Residual after", "px"),
    ("sigma_translation_m", "Sigma of the translation", "m"),
    ("sigma_rotation_deg", "Sigma of the rotation", "deg"),
    ("scale", "Scale", ""),
)


def map_page(document: Mapping[str, Any], folder: Path, report: Mapping[str, Any]) -> str:
    """The page; `document` is `map.json`, `folder` the map's, whose `pictures/` are written already."""
    return page(
        "Map",
        [
            heading(
                "Map",
                "Map",
                report.get("engine_version", ""),
                list(_verdicts(document, report["summary"])),
                report["summary"],
            ),
            _scenes(document),
            *_seams(document, folder),
            findings_section(report.get("findings", ())),
            stages_section(report.get("stages", ())),
        ],
    )


def _verdicts(document: Mapping[str, Any], summary: Mapping[str, Any]) -> Iterator[str]:
    scenes, unconnected = document["scenes"], document["unconnected"]
    connected = len(scenes) - len(unconnected)
    yield verdict(
        "warn" if unconnected else "good", f"{number(connected)} of {number(len(scenes))} scenes are connected"
    )
    yield share_verdict(summary, "images")
    if document["left_out"]:
        yield verdict("bad", f"{number(len(document['left_out']))} scenes are left out: nothing places them")
    if document["loops"]:
        yield verdict("warn", f"{number(len(document['loops']))} loops of seams do not close")


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


def _seams(document: Mapping[str, Any], folder: Path) -> Iterator[str]:
    pictured = 0
    for seam in document["seams"]:
        state = (
            "accepted" if seam["accepted"] else f"rejected: {text(seam.get('reason', 'the evidence does not suffice'))}"
        )
        figures = {label: number(seam[name], unit) for name, label, unit in SEAM_FIGURES if seam.get(name) is not None}
        pictures = seam.get("pictures")
        shown = ""
        if pictures and pictured < PICTURED:
            shown, pictured = (
                pair(folder, pictures["before"], pictures["after"], "Points of both scenes from above"),
                pictured + 1,
            )
        elif pictures:
            shown = f"<p>Its pictures: {text(pictures['before'])}, {text(pictures['after'])}.</p>\n"
        yield section(f"Seam of {seam['a']} and {seam['b']}", f"<p>{state}</p>\n", facts(figures), shown)
