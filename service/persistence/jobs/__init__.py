"""Jobs: the only statements that change a job's state.

    QUEUED -> RUNNING -> SUCCEEDED | FAILED | CANCELLED

and back from RUNNING to QUEUED when an attempt failed in a way that may pass, when its worker died, or when its worker
was told to stop. A worker holds a job by a lease that it renews with every heartbeat, and by a fencing number that
rises with every claim. All that it writes is conditional on that number: a worker that was believed dead and comes
back writes nothing.
"""

from __future__ import annotations

from service.persistence.jobs._asking import (
    OfTree,
    cancel_orphan,
    create,
    request_cancel,
    require_failed,
    require_places,
    retry,
)
from service.persistence.jobs._ending import cancelled, fail, record_findings, release, succeed
from service.persistence.jobs._holding import (
    ProgressNote,
    bound_times,
    cancel_requested,
    claim,
    end_lease,
    expire_leases,
    has_succeeded,
    heartbeat,
)
from service.persistence.jobs._queue import all_due, due, mark_enqueued
from service.persistence.jobs._rows import Claim, FencedError, active_of_drive, events_after
from service.persistence.jobs._tree import MIN_SCENES, look_at, members_of, orphans, tend

__all__ = [
    "MIN_SCENES",
    "Claim",
    "FencedError",
    "OfTree",
    "ProgressNote",
    "active_of_drive",
    "all_due",
    "bound_times",
    "cancel_orphan",
    "cancel_requested",
    "cancelled",
    "claim",
    "create",
    "due",
    "end_lease",
    "events_after",
    "expire_leases",
    "fail",
    "has_succeeded",
    "heartbeat",
    "look_at",
    "mark_enqueued",
    "members_of",
    "orphans",
    "record_findings",
    "release",
    "request_cancel",
    "require_failed",
    "require_places",
    "retry",
    "succeed",
    "tend",
]
