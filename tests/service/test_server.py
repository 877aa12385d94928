"""Several processes that serve one socket."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import psutil
import pytest

from tests.helpers.live_api import DEADLINE_S, ApiProcess, api_process, settings_of, wait_until
from tests.helpers.process_tree import children_of

POLLS = 20


@pytest.fixture
def api(tmp_path: Path) -> Iterator[ApiProcess]:
    with api_process(settings_of(tmp_path / "data"), tmp_path, MRASFM_API_PROCESSES="2") as running:
        yield running


def serving(api: ApiProcess) -> list[psutil.Process]:
    assert api.process is not None
    return children_of(api.process.pid, "spawn_main")


def test_processes_serve_count_and_end_together(api: ApiProcess) -> None:
    wait_until(lambda: len(serving(api)) == 2, "both")
    for _ in range(POLLS):  # each on a connection of its own, that any process may take
        assert httpx.get(f"{api.url}/livez", timeout=DEADLINE_S).is_success
    told = httpx.get(f"{api.url}/metrics", timeout=DEADLINE_S).text
    counted = re.search(r'mrasfm_http_requests_total{method="GET",route="/livez",status="200"} (\S+)', told)
    assert counted is not None, told
    assert float(counted[1]) >= POLLS
    assert "mrasfm_database_up 1.0" in told

    killed = serving(api)[0]
    killed.kill()
    for _ in range(POLLS):
        assert httpx.get(f"{api.url}/livez", timeout=DEADLINE_S).is_success
    wait_until(lambda: len(serving(api)) == 2 and killed not in serving(api), "another")

    left = serving(api)
    assert api.process is not None
    api.process.terminate()
    assert api.process.wait(DEADLINE_S) == 0
    assert not [process for process in left if process.is_running()]


@pytest.mark.slow
def test_a_parent_that_is_killed_leaves_nobody(api: ApiProcess) -> None:
    wait_until(lambda: len(serving(api)) == 2, "both")
    left = serving(api)
    api.kill()
    gone, alive = psutil.wait_procs(left, timeout=DEADLINE_S)
    assert len(gone) == 2
    assert alive == []
    with pytest.raises(httpx.TransportError):
        httpx.get(f"{api.url}/livez", timeout=5)
    (of_killed,) = api.settings.metrics_dir.iterdir()
    api.start()
    (of_next,) = api.settings.metrics_dir.iterdir()
    assert of_next != of_killed, "what a killed parent left is removed at the next start"
    assert api.process is not None
    api.process.terminate()
    assert api.process.wait(DEADLINE_S) == 0
    assert list(api.settings.metrics_dir.iterdir()) == []


@pytest.mark.slow
def test_a_parent_that_lives_keeps_its_counts(api: ApiProcess, tmp_path: Path) -> None:
    """Another API on the same data folder removes nothing of it."""
    (own,) = api.settings.metrics_dir.iterdir()
    (tmp_path / "other").mkdir()
    with api_process(api.settings, tmp_path / "other", MRASFM_API_PROCESSES="2"):
        assert own in set(api.settings.metrics_dir.iterdir())
        assert len(list(api.settings.metrics_dir.iterdir())) == 2
    assert list(api.settings.metrics_dir.iterdir()) == [own]
    assert "mrasfm_http_requests_total" in httpx.get(f"{api.url}/metrics", timeout=DEADLINE_S).text
