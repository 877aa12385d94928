"""Findings in the summaries of commands."""

from __future__ import annotations

import pytest

from mrasfm_engine.commands.reconstruct import print_findings
from schemas.findings import as_json, warning


def test_each_finding_has_its_remedy_below_it(capsys: pytest.CaptureFixture[str]) -> None:
    print_findings([as_json(warning("code", "it is off", "Turn it on.")), as_json(warning("code", "so be it", ""))])
    assert capsys.readouterr().out == "  warning: it is off\n    Turn it on.\n  warning: so be it\n"
