"""Calibration of a scene: corrections with sigmas and verdicts, and intrinsics, as the console shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mrasfm_engine.export.report_page._html import decimals_of, exact, section, shown, table, text

AXES = ("x", "y", "z")
SIGMA_DIGITS, INTRINSIC_DIGITS = 3, 6


def calibration_sections(document: Mapping[str, Any]) -> str:
    """Both corrections and the intrinsics of all cameras."""
    cameras = document["cameras"]
    why = f"<p>{'Refined' if document.get('adjusted') else 'Kept as given'}: {text(document.get('why', ''))}.</p>\n"
    return section(
        "Calibration",
        why,
        "<h3>Correction of the rotation about the rig's axes</h3>",
        _corrections(cameras, "rotation", "rotation_vector_deg", "deg"),
        "<h3>Correction of the position along the rig's axes</h3>",
        _corrections(cameras, "translation", "translation_m", "m"),
        "<h3>Intrinsics</h3>",
        _intrinsics(cameras),
    )


def _corrections(cameras: Mapping[str, Any], what: str, field: str, unit: str) -> str:
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
    return table(head, rows, attributes=f'data-corrections="{what}"')


def _value(value: float, sigma: float | None, axis: str) -> str:
    if sigma is None or sigma <= 0:
        return f'<span class="n" data-axis="{axis}" data-value="{exact(value)}">{shown(value, SIGMA_DIGITS)}</span>'
    decimals = decimals_of(sigma, SIGMA_DIGITS)
    return (
        f'<span class="n" data-axis="{axis}" data-value="{exact(value)}" data-sigma="{exact(sigma)}">'
        f"{value:.{decimals}f} <small>± {sigma:.{decimals}f}</small></span>"
    )


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
