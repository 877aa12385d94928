"""The service's own records, read from its database file beside the service, which is not told."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

_TIMEOUT_S = 10.0


class Records:
    """Reads only: a connection that cannot write takes no checkpoint of the log of changes, whoever is killed."""

    def __init__(self, data: Path) -> None:
        self.path = data / "mrasfm.sqlite3"

    def rows(self, statement: str, *values: object) -> list[Any]:
        """The rows of a SELECT or a PRAGMA."""
        with closing(sqlite3.connect(f"file:{self.path}?mode=ro", uri=True, timeout=_TIMEOUT_S)) as connection:
            return connection.execute(statement, values).fetchall()

    def work_of(self, job_id: str) -> str:
        """The kind of a job that an engine works on, and its stage as last reported: up to a second ago."""
        found = self.rows("SELECT kind, stage FROM jobs WHERE id = ?", job_id)
        if not found:
            return "unknown"
        kind, stage = found[0]
        # The worker fetches before there is an engine; it has not reported a stage of its own yet.
        return f"{kind.lower()}, starting" if stage in (None, "fetch") else f"{kind.lower()}, {stage}"

    def holder_of(self, job_id: str) -> int | None:
        """Process that holds a job."""
        found = self.rows("SELECT owner FROM jobs WHERE id = ? AND state = 'RUNNING'", job_id)
        return int(found[0][0].rpartition(":")[2]) if found and found[0][0] else None

    def published_s(self) -> list[float]:
        """When each scene and each version of a map was recorded, in seconds as of `time.time`."""
        rows = self.rows("SELECT created_us FROM scenes UNION ALL SELECT created_us FROM map_versions")
        return sorted(created_us / 1e6 for (created_us,) in rows)

    def publication_s(self, job_id: str, fence: int) -> float | None:
        """When this attempt at a job was recorded to have published; None where it never was."""
        of_scene = "SELECT created_us FROM scenes WHERE job_id = ? AND fence = ?"
        of_map = "SELECT created_us FROM map_versions WHERE job_id = ? AND fence = ?"
        rows = self.rows(f"{of_scene} UNION ALL {of_map}", job_id, fence, job_id, fence)
        return rows[0][0] / 1e6 if rows else None


def nearest_s(times_s: Sequence[float], at_s: float) -> float:
    """How far the nearest of some times is from another; infinite where there is none."""
    return min((abs(time_s - at_s) for time_s in times_s), default=float("inf"))
