"""The page of a scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.export.report_page._calibration import calibration_sections
from mrasfm_engine.export.report_page._common import (
    findings_section,
    findings_verdict,
    heading,
    share_verdict,
    stage_of,
    stages_section,
    verdict,
)
from mrasfm_engine.export.report_page._figures import CameraResiduals, camera_residuals, gnss_residuals
from mrasfm_engine.export.report_page._html import (
    chart,
    facts,
    heat_map,
    items,
    number,
    page,
    pair,
    section,
    table,
    text,
)
from mrasfm_engine.scene.scene import Scene
from schemas.artifacts import PICTURES_FOLDER, Stage, road_not_drawn

MOST_NAMED = 12
# Findings on a calibration that images contradict: also where, as of two cameras, none is the wrong one.
AGAINST_CALIBRATION = frozenset(
    {
        "calibration-contradicted",
        "calibration-unexplained",
        "camera-against-rig",
        "camera-miscalibrated",
        "camera-without-matches",
        "camera-without-points",
        "cameras-backwards",
        "focal-beyond-prior",
    }
)


def scene_page(scene: Scene, folder: Path, report: Mapping[str, Any], calibration: Mapping[str, Any]) -> str:
    """The page.

    Parameters
    ----------
    folder
        Of the result, whose `pictures/` are written already.
    report
        `report.json` with its `summary`.
    """
    stages, summary = report.get("stages", ()), report["summary"]
    name = str(report.get("drive", scene.drive.manifest.name))
    refinement = stage_of(stages, Stage.REFINEMENT)
    lines = list(_verdicts(report, calibration, refinement))
    return page(
        f"{name}: scene",
        [
            heading("Scene", name, report.get("engine_version", ""), lines, summary),
            _pictures(folder / PICTURES_FOLDER, road_not_drawn(report)),
            calibration_sections(calibration),
            _residuals(camera_residuals(scene)),
            _gnss(scene, refinement),
            _scale(refinement),
            _rejected(scene, stages),
            findings_section(report.get("findings", ())),
            stages_section(stages),
        ],
    )


def _verdicts(
    report: Mapping[str, Any], calibration: Mapping[str, Any], refinement: Mapping[str, Any]
) -> Iterator[str]:
    summary, findings = report["summary"], report.get("findings", ())
    yield share_verdict(summary, "units")
    yield share_verdict(summary, "images")
    wrong = [name for name, camera in calibration["cameras"].items() if camera["wrong"]]
    if wrong:
        yield verdict("bad", f"not mounted as given: {text(', '.join(wrong))}")
    elif any(finding["code"] in AGAINST_CALIBRATION for finding in findings):
        yield verdict("warn", "images contradict the calibration, see findings")
    else:
        yield verdict("good", "no camera contradicts its calibration")
    if summary["georeferenced"]:
        yield verdict("good", "placed on the earth by GNSS")
    else:
        is_asked = not report.get("settings", {}).get("use_gnss", True)
        why = "GNSS is left out, as the settings ask" if is_asked else "no GNSS that could be used"
        yield verdict("warn", f"not placed on the earth: {why}")
    sigma = refinement.get("scale", {}).get("sigma_relative")
    if sigma is not None:
        yield verdict("good" if sigma < 0.02 else "warn", f"sigma of the scale {number(100 * sigma, '%')}")
    if findings:
        yield findings_verdict(findings)


def _pictures(folder: Path, reason: str | None) -> str:
    ground = pair(
        folder,
        "birds_eye_before.png",
        "birds_eye_after.png",
        "All cameras projected onto the ground, with the calibration as given and as refined",
    )
    road = (
        ""
        if ground
        else pair(
            folder,
            "road_before.png",
            "road_after.png",
            "Points of the road, before and after points off its surface were dropped",
        )
    )
    why = f"<p>The picture of the road from above is not drawn: {text(reason)}.</p>\n" if reason else ""
    return section("Before and after", ground, road, why) or section(
        "Before and after", "<p>There are no pictures: they were switched off, or no ground is seen.</p>\n"
    )


def _residuals(cameras: Sequence[CameraResiduals] | None) -> str:
    if cameras is None:
        return section("Residuals", "<p>Not shown by camera: the rows of an image have poses of their own.</p>\n")
    largest = max((float(np.nanmax(camera.grid_px)) for camera in cameras), default=1.0) or 1.0
    rows = [
        (
            [
                text(camera.name),
                number(camera.observations),
                number(camera.rms_px, "px"),
                number(camera.median_px, "px"),
                heat_map(camera.grid_px, width=camera.width, height=camera.height, unit="px", largest=largest),
            ],
            f'data-camera="{text(camera.name)}"',
        )
        for camera in cameras
    ]
    words = (
        f"<p>Over the image: mean length in each cell, white for 0 and full colour for {number(largest, 'px')}.</p>\n"
    )
    return section(
        "Residuals by camera",
        table(["Camera", "Observations", "RMS", "Median", "Over the image"], rows, attributes="data-residuals"),
        words,
    )


def _gnss(scene: Scene, refinement: Mapping[str, Any]) -> str:
    gnss = refinement.get("gnss", {})
    found = gnss_residuals(scene, gnss)
    if found is None:
        return ""
    seconds, off_m = found
    named = dict(zip(("east", "north", "up"), off_m.T, strict=True))
    figures = {
        label: number(gnss[name], unit)
        for name, label, unit in (
            ("residual_rms_m", "RMS", "m"),
            ("units_used", "Units used", ""),
            ("noise_factor", "Noise against the declared sigmas", "times"),
        )
        if name in gnss
    }
    figures["Outliers"] = number(len(gnss.get("outliers_at_us", [])))
    title = "The receiver's position less the antenna's in the scene"
    return section("GNSS residuals over time", chart(title, seconds, named, x_unit="s", y_unit="m"), facts(figures))


def _scale(refinement: Mapping[str, Any]) -> str:
    scale, gnss = refinement.get("scale", {}), refinement.get("gnss", {})
    figures = {}
    if "sigma_relative" in scale:
        figures["Sigma of the scale"] = number(100 * scale["sigma_relative"], "%")
    if "from" in scale:
        figures["It rests on"] = text(scale["from"])
    if gnss.get("scale_of_rig_against_gnss") is not None:
        figures["Scale of the rig against GNSS"] = number(gnss["scale_of_rig_against_gnss"], "", 5)
    return section("Scale", facts(figures) if figures else "")


def _rejected(scene: Scene, stages: Sequence[Mapping[str, Any]]) -> str:
    mapping, refinement = stage_of(stages, Stage.MAPPING), stage_of(stages, Stage.REFINEMENT)
    pairs = stage_of(stages, Stage.MATCHES).get("rejected_pairs", {})
    tracks = refinement.get("moving_objects", {}).get("tracks_dropped_because", {})
    adjusted, off_road = refinement.get("rejected", {}), refinement.get("road", {}).get("dropped")
    lines = [f"{number(count)} pairs of images: {text(why)}" for why, count in pairs.items() if count]
    if mapping.get("places_alike"):
        lines.append(f"{number(mapping['places_alike']['pairs_set_aside'])} pairs of images: places look alike")
    lines += [
        f"{number(adjusted[what])} {what} in the last adjustment"
        for what in ("observations", "points")
        if adjusted.get(what)
    ]
    lines += [f"{number(count)} tracks: {text(why)}" for why, count in tracks.items() if count]
    if off_road:
        lines.append(f"{number(off_road)} points off the surface of the road")
    lines += [f"{_named(_files(mapping[name]))}: {what}" for name, what in _LISTS.items() if mapping.get(name)]
    between = refinement.get("between_keyframes", {})
    told = [*mapping.get("units_not_registered", ()), *between.get("units_not_registered", ())]
    reason = {entry["unit"]: entry["reason"] for entry in told}
    missing = np.flatnonzero(~scene.unit_registered).tolist()
    if missing:
        named = [f"{unit} ({reason[unit]})" if unit in reason else unit for unit in missing]
        lines.append(f"{number(len(missing))} units without a pose: {_named(named)}")
    return section("Rejected, and why", items(lines) if lines else "<p>Nothing.</p>\n")


_LISTS = {
    "images_occluded": "images that something covers",
    "images_dark_or_without_texture": "images that are dark or without texture",
    "images_posed_by_their_unit_alone": "images that only their unit gives a pose",
}


def _files(images: Sequence[str | Mapping[str, Any]]) -> list[str]:
    return [image if isinstance(image, str) else str(image["file"]) for image in images]


def _named(values: Sequence[Any]) -> str:
    more = f" and {len(values) - MOST_NAMED} more" if len(values) > MOST_NAMED else ""
    return text(", ".join(map(str, values[:MOST_NAMED])) + more)
