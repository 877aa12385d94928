"""Jobs that take longer than the broker waits for an acknowledgement."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from service.job_queue import JobQueue
from tests.helpers.service_world import World, wait_until

VISIBILITY_TIMEOUT_S = 6.0
HELD_S = 22.0
WORKERS = 3

# A worker as ours but without the step that renews what it holds.
WITHOUT_RENEWAL = """
import os, socket
from service.settings import Settings
from worker.app import make_app
from worker.lease import RenewLeases
app = make_app(Settings())
app.steps["consumer"].discard(RenewLeases)
app.Worker(
    hostname=f"all.{os.getpid()}@{socket.gethostname()}", queues=["reconstructions"], concurrency=1, pool="prefork",
    loglevel="INFO", without_gossip=True, without_mingle=True, without_heartbeat=True, quiet=True,
).start()
"""


@pytest.mark.slow
def test_long_job_runs_once(make_world: Callable[..., World], brief_drive: Path) -> None:
    """Both installations hold a job for more than three timeouts; only where leases are renewed it is sent once."""
    renewed, other = (make_world(visibility_timeout_seconds=VISIBILITY_TIMEOUT_S) for _ in range(2))
    for _ in range(WORKERS):
        renewed.start_worker()
        other.start(command=("-c", WITHOUT_RENEWAL))
    held: dict[World, psutil.Process] = {}
    job_ids: dict[World, str] = {}
    for world in (renewed, other):
        job_ids[world] = world.ask(world.add_drive(brief_drive))
        held[world] = world.hold(job_ids[world])
    time.sleep(HELD_S)
    for world, child in held.items():
        assert world.children() == [child]
        child.resume()
    for world, job_id in job_ids.items():
        job = world.wait_for_end(job_id)
        assert (job.state, job.attempt, job.fence) == ("SUCCEEDED", 1, 1)
        assert world.outcomes(job_id) == ["succeeded"]
        assert [scene.id for scene in world.scenes()] == [job.scene_id]
    wait_until(lambda: JobQueue(renewed.settings).waiting() == set(), "the acknowledgement")
    assert "nothing to do" not in renewed.log()
    assert "nothing to do" in other.log(), "without renewal the message comes again"
