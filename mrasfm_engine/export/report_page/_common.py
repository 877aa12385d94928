"""Sections that scenes and maps have alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mrasfm_engine.export.report_page._html import bars, facts, items, number, section, text
from schemas.findings import Finding

SHARES = {"units": "Units registered", "images": "Images registered"}
COUNTS = {"points": "Points", "observations": "Observations"}


def summary_facts(summary: Mapping[str, Any]) -> dict[str, str]:
    """Figures of a result."""
    found = {
        label: f"{number(summary[f'registered_{name}'])} of {number(summary[f'total_{name}'])}"
        for name, label in SHARES.items()
        if f"total_{name}" in summary
    }
    found |= {label: number(summary[name]) for name, label in COUNTS.items() if name in summary}
    for name, label, unit in (
        ("mean_track_length", "Mean track length", "images"),
        ("mean_reprojection_error_px", "Mean reprojection error", "px"),
    ):
        if name in summary:
            found[label] = number(summary[name], unit)
    found["Place on the earth"] = "by GNSS" if summary.get("georeferenced") else "none"
    return found


def verdict(kind: str, words: str) -> str:
    """A line of the verdicts: kind is good, warn or bad. The words are HTML."""
    label = {"good": "OK", "warn": "Note", "bad": "Fault"}[kind]
    return f'<span class="badge {kind}">{label}</span> {words}'


def share_verdict(summary: Mapping[str, Any], what: str) -> str:
    """Verdict on how many units or images have a pose."""
    registered, total = summary[f"registered_{what}"], summary[f"total_{what}"]
    kind = "good" if registered == total else "warn" if registered >= 0.9 * total else "bad"
    return verdict(kind, f"{number(registered)} of {number(total)} {what} have a pose")


def findings_verdict(findings: Sequence[Any]) -> str:
    """Verdict that there are findings."""
    return verdict("warn", f"{number(len(findings))} finding{'s' if len(findings) > 1 else ''}, see below")


def heading(kind: str, name: str, version: object, lines: Sequence[str], summary: Mapping[str, Any]) -> str:
    """Title, verdicts and figures; without a line for the kind where that is empty."""
    above = f'<p class="kind">{text(kind)}</p>' if kind else ""
    title = f"{above}<h1>{text(name)}</h1><p>MRASfM {text(version)}</p>"
    verdicts = section("Verdicts", items(lines, "verdicts"), facts(summary_facts(summary)))
    return f"<header>{title}</header>\n{verdicts}"


def findings_section(findings: Sequence[Finding | Mapping[str, Any]]) -> str:
    """All findings with their remedies."""
    documents = [f.model_dump() if hasattr(f, "model_dump") else _fields(f) for f in findings]
    lines = [
        f"<strong>{text(d['severity'])}</strong>: {text(d['what'])}<br><span class='remedy'>{text(d['remedy'])}</span>"
        for d in documents
    ]
    return section("Findings", items(lines, "findings") if lines else "<p>None.</p>\n")


def _fields(finding: Any) -> Mapping[str, Any]:
    if isinstance(finding, Mapping):
        return finding
    return {name: getattr(finding, name) for name in ("severity", "what", "remedy")}


def stages_section(stages: Sequence[Mapping[str, Any]]) -> str:
    """Time by stage."""
    rows = [
        (
            str(stage["stage"]).replace("-", " "),
            float(stage.get("seconds", 0.0)),
            number(float(stage.get("seconds", 0.0)), "s") + (" (reused)" if stage.get("reused") else ""),
        )
        for stage in stages
    ]
    return section("Time by stage", bars(rows) if rows else "")


def stage_of(stages: Sequence[Mapping[str, Any]], name: str) -> Mapping[str, Any]:
    """The report of a stage; empty where it did not run."""
    return next((stage for stage in stages if stage["stage"] == name), {})
