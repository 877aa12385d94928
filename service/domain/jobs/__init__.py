"""Jobs: the only statements that change a job's state.

    QUEUED -> RUNNING -> SUCCEEDED | FAILED | CANCELLED

and back from RUNNING to QUEUED when an attempt failed in a way that may pass, when its worker died, or when its worker
was told to stop. How often that happens is bounded, see `_blame`. A worker holds a job by a lease that it renews with
every heartbeat, and by a fencing number that rises with every claim. All that it writes is conditional on that number:
a worker that was believed dead and comes back writes nothing.
"""

from __future__ import annotations

from service.domain.jobs._blame import FULL_BLAME, HALF_BLAME, LESS_MEMORY, NO_BLAME, RetryLimits, blame_of_loss
from service.domain.jobs._completion import cancelled, fail, record_findings, release, succeed
from service.domain.jobs._dependencies import MIN_SCENES, look_at, members_of, orphans, tend
from service.domain.jobs._leases import (
    ProgressNote,
    bound_times,
    cancel_requested,
    claim,
    end_lease,
    expire_leases,
    has_succeeded,
    heartbeat,
    note_finished_stage,
)
from service.domain.jobs._planning import SubmapPlace, wait_for_submaps
from service.domain.jobs._queries import Claim, FencedError, active_of_drive, events_after
from service.domain.jobs._queue import all_due, backlogs, count_stalled, due, due_after, mark_enqueued
from service.domain.jobs._requests import (
    OfTree,
    cancel_orphan,
    create,
    request_cancel,
    require_failed,
    require_not_rejected,
    require_places,
    retry,
)
from service.domain.jobs._submaps import children_of, look_at_submaps, number_of, submaps_of, untold_parents

__all__ = [
    "FULL_BLAME",
    "HALF_BLAME",
    "LESS_MEMORY",
    "MIN_SCENES",
    "NO_BLAME",
    "Claim",
    "FencedError",
    "OfTree",
    "ProgressNote",
    "RetryLimits",
    "SubmapPlace",
    "active_of_drive",
    "all_due",
    "backlogs",
    "blame_of_loss",
    "bound_times",
    "cancel_orphan",
    "cancel_requested",
    "cancelled",
    "children_of",
    "claim",
    "count_stalled",
    "create",
    "due",
    "due_after",
    "end_lease",
    "events_after",
    "expire_leases",
    "fail",
    "has_succeeded",
    "heartbeat",
    "look_at",
    "look_at_submaps",
    "mark_enqueued",
    "members_of",
    "note_finished_stage",
    "number_of",
    "orphans",
    "record_findings",
    "release",
    "request_cancel",
    "require_failed",
    "require_not_rejected",
    "require_places",
    "retry",
    "submaps_of",
    "succeed",
    "tend",
    "untold_parents",
    "wait_for_submaps",
]
