"""Requests that schemathesis makes from our OpenAPI page, sent to a running API."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]
SEED = 1


@dataclass(frozen=True)
class Fuzzed:
    """What came of it."""

    passed: bool
    requests: int
    statuses: dict[str, int]  # how often each was answered, by route and status
    output: str


def fuzz(url: str, key: str, folder: Path, *, max_examples: int, phases: str) -> Fuzzed:
    """Send requests with a valid key, and check every answer against the page.

    The stream of a project is left out: it does not end by itself.
    """
    command = [
        *(sys.executable, "-c", "from schemathesis.cli import schemathesis; schemathesis()"),
        *("--config-file", str(HERE / "schemathesis.toml")),
        *("run", f"{url}/openapi.json", "--header", f"Authorization: Bearer {key}"),
        *("--seed", str(SEED), "--max-examples", str(max_examples), "--phases", phases, "--continue-on-failure"),
        *("--generation-database", "none", "--suppress-health-check", "all", "--no-color", "--warnings", "off"),
        *("--request-timeout", "60", "--exclude-path", "/v1/events", "--report", "ndjson", "--report-dir", str(folder)),
    ]
    environment = {**os.environ, "SCHEMATHESIS_HOOKS": "tests.helpers.fuzz_hooks", "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    statuses = _statuses(folder)
    return Fuzzed(done.returncode == 0, sum(statuses.values()), statuses, done.stdout + done.stderr)


def _statuses(folder: Path) -> dict[str, int]:
    counted: Counter[str] = Counter()
    for report in folder.glob("*.ndjson"):
        with report.open() as lines:
            for line in lines:
                counted.update(_answers(json.loads(line)))
    return dict(sorted(counted.items()))


def _answers(event: dict[str, Any]) -> Iterator[str]:
    recorded = event.get("ScenarioFinished", {}).get("recorder", {})
    cases = recorded.get("cases", {})
    for case_id, exchange in recorded.get("interactions", {}).items():
        response = exchange["response"]
        if case_id in cases and response is not None:
            case = cases[case_id]["value"]
            yield f"{case['method']} {case['path']} {response['status_code']}"
