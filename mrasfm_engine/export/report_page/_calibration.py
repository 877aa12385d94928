"""Calibration of a scene: corrections with sigmas and verdicts, and intrinsics, as the console shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mrasfm_engine.export.report_page._html import exact, number_with_sigma, section, shown, table, text

AXES = ("x", "y", "z")
SIGMA_DIGITS, INTRINSIC_DIGITS = 3, 6
MOST_SCENES = 40  # of a map whose tables are on the page: each has some 10 kB


def calibration_sections(document: Mapping[str, Any]) -> str:
    """Both corrections, the intrinsics and what is known of time offsets of all cameras."""
    cameras = document["cameras"]
    return section(
        "Calibration",
        _why(document),
        _tables(cameras, ""),
        "<h3>Intrinsics</h3>",
        _intrinsics(cameras),
        _time_offsets(cameras),
    )


def map_calibration_sections(calibrations: Mapping[str, Mapping[str, Any]]) -> str:
    """Corrections of all drives of a map, by scene; those with a camera that is not mounted as given come first."""
    order = sorted(calibrations, key=lambda name: not wrong_cameras(calibrations[name]))
    parts = [
        f"<h3>{text(name)}</h3>\n{_why(calibrations[name])}{_tables(calibrations[name]['cameras'], name)}"
        for name in order[:MOST_SCENES]
    ]
    rest = order[MOST_SCENES:]
    more = f"<p>In the folder calibration/: {text(', '.join(rest))}.</p>\n" if rest else ""
    return section("Calibration of each drive, after the map's adjustment", *parts, more)


def wrong_cameras(document: Mapping[str, Any]) -> list[str]:
    """Cameras that the images contradict."""
    return [name for name, camera in document["cameras"].items() if camera["wrong"]]


def _why(document: Mapping[str, Any]) -> str:
    if "why" not in document:
        return "<p>The calibration is used as given.</p>\n"
    return f"<p>{'Refined' if document.get('adjusted') else 'Kept as given'}: {text(document['why'])}.</p>\n"


def _tables(cameras: Mapping[str, Any], scene: str) -> str:
    return (
        "<h4>Correction of the rotation about the rig's axes, ± sigma</h4>"
        + _corrections(cameras, "rotation", "rotation_vector_deg", "deg", scene)
        + "<h4>Correction of the position along the rig's axes, ± sigma</h4>"
        + _corrections(cameras, "translation", "translation_m", "m", scene)
    )


def _time_offsets(cameras: Mapping[str, Any]) -> str:
    rows = [
        (
            [
                text(name),
                _value(camera["refined"]["time_offset_us"], camera["sigma"].get("time_offset_us"), "time_offset"),
                text(camera["verdict"].get("time_offset", "")),
            ],
            f'data-camera="{text(name)}"',
        )
        for name, camera in cameras.items()
        if "time_offset_us" in camera["refined"]
    ]
    if not rows:
        return ""
    return "<h3>Time offsets</h3>" + table(["Camera", "Offset [µs]", "Verdict"], rows, attributes="data-time-offsets")


def _corrections(cameras: Mapping[str, Any], what: str, field: str, unit: str, scene: str) -> str:
    sigma_field = "rotation_deg" if what == "rotation" else "translation_m"
    rows = []
    for name, camera in cameras.items():
        sigmas = camera["sigma"].get(sigma_field, [None] * 3)
        cells = [
            _value(value, sigma, axis)
            for value, sigma, axis in zip(camera["difference"][field], sigmas, AXES, strict=True)
        ]
        label = text(name) + (' <span class="badge bad">wrong</span>' if camera["wrong"] else "")
        own = f'data-camera="{text(name)}" data-wrong="{str(camera["wrong"]).lower()}"' + (
            ' class="wrong"' if camera["wrong"] else ""
        )
        rows.append(([label, *cells, text(_verdicts(camera["verdict"][what]))], own))
    head = ["Camera", *(f"{axis} [{unit}]" for axis in AXES), "Verdict"]
    return table(head, rows, attributes=f'data-corrections="{what}" data-scene="{text(scene)}"')


def _value(value: float, sigma: float | None, axis: str) -> str:
    if sigma is None or sigma <= 0:
        return f'<span class="n" data-axis="{axis}" data-value="{exact(value)}">{shown(value, SIGMA_DIGITS)}</span>'
    return number_with_sigma(value, sigma, digits=SIGMA_DIGITS, attributes=f'data-axis="{axis}"')


def _verdicts(words: Sequence[str]) -> str:
    if len(set(words)) == 1:
        return words[0]
    return "; ".join(f"{axis}: {word}" for axis, word in zip(AXES, words, strict=True))


def _intrinsics(cameras: Mapping[str, Any]) -> str:
    rows = []
    for name, camera in cameras.items():
        values = zip(camera["param_names"], camera["given"]["params"], camera["refined"]["params"], strict=True)
        for param, given, refined in values:
            unit = " [px]" if param[0] in "fc" else ""
            cells = [
                f'<span class="n" data-value="{exact(value)}">{shown(value, INTRINSIC_DIGITS)}</span>'
                for value in (given, refined)
            ]
            rows.append(
                (
                    [text(name), text(camera["model"]), text(param) + unit, *cells],
                    f'data-camera="{text(name)}" data-param="{text(param)}"',
                )
            )
    return table(["Camera", "Model", "Parameter", "Given", "Refined"], rows, attributes="data-intrinsics")
