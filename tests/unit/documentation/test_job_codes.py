"""The list of codes of failed jobs and findings has all that the sources give."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from tests.documentation import job_codes

REPOSITORY = Path(__file__).resolve().parents[3]


def test_no_code_is_given_in_a_way_that_the_list_does_not_see() -> None:
    assert job_codes.unresolved() == ()


@pytest.mark.parametrize(
    ("code", "severities", "words"),
    [
        ("path-escapes", {""}, "file … is a link to a place outside the drive"),
        ("no-features", {""}, "no image of the drive has a keypoint"),
        ("timeout", {""}, "the attempt was stopped …: it took longer than … s"),
        ("worker-lost", {""}, "worker … was not heard of any more during attempt …"),
        ("out-of-memory", {""}, "worker … was lost in attempt …, and memory had run out there"),
        ("different-features", {""}, "Reconstruct all drives with one extractor."),
        ("calibration-inverted", {""}, "rig.cameras: rig_from_cam looks like its inverse, cam_from_rig"),
        ("gnss-leap-seconds", {"error", "warning"}, "as when one clock counts GPS time and the other UTC"),
        ("gnss-jump", {"warning"}, "GNSS jumps at …: … m in … s at the first"),
        ("scale-uncertain", {"warning"}, "lengths are known to … (one sigma): the drive observes the scale badly"),
        ("unsynchronised", {"error", "warning"}, "images are over … ms from their frame's time"),
        ("alpha-channel", {"warning"}, "have an alpha channel, which is ignored"),
        ("truncated-images", {"warning"}, "images are truncated and left out"),
    ],
)
def test_codes_with_their_words(code: str, severities: set[str], words: str) -> None:
    found = [use for use in job_codes.uses() if use.code == code]
    assert {use.severity for use in found} == severities
    assert any(words in use.words for use in found)
    row = next(line for line in job_codes.sections().splitlines() if line.startswith(f"| `{code}`"))
    assert words in row


def test_every_code_has_words() -> None:
    rows = [line for line in job_codes.sections().splitlines() if line.startswith("| `")]
    assert len(rows) > 150
    assert [row for row in rows if not row.split(" | ")[-1].strip(" |")] == []


def test_every_code_that_tests_of_workers_expect_is_in_the_list() -> None:
    """Jobs end with these: whatever the list misses would show here."""
    listed = set(re.findall(r"`([a-z0-9-]+)`", job_codes.sections()))
    expected = set()
    for path in sorted((REPOSITORY / "tests" / "worker").glob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Compare) and ast.unparse(node.left).endswith(".code"):
                expected |= {text.value for text in node.comparators if isinstance(text, ast.Constant)}
            if isinstance(node, ast.Compare) and ast.unparse(node.left).startswith("(outcome.code, "):
                first = getattr(node.comparators[0], "elts", [None])[0]
                expected |= {first.value} if isinstance(first, ast.Constant) else set()
    assert len(expected) > 8
    assert expected - listed <= {"failed", "broken", "drive-rejected"}, "of problems that tests make up"


def test_every_finding_that_tests_of_the_check_expect_is_in_the_list() -> None:
    listed = {use.code for use in job_codes.uses() if use.severity}
    expected = set()
    for path in sorted((REPOSITORY / "tests" / "unit" / "preflight").glob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("only", "one"):
                expected |= {text.value for text in node.args if isinstance(text, ast.Constant)}
    codes = {text for text in expected if isinstance(text, str) and "-" in text}
    assert len(codes) > 8
    assert codes - listed - {use.code for use in job_codes.uses()} == set()


def test_the_sources_are_those_of_jobs() -> None:
    names = {path.relative_to(REPOSITORY).as_posix() for path in job_codes.source_files()}
    assert {"worker/outcomes.py", "schemas/gnss_check.py", "service/domain/jobs/_leases.py"} <= names
    assert not any(name.startswith(("mrasfm_engine/importers/", "mrasfm_engine/commands/")) for name in names)
