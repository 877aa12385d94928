"""Reconstructions of long drives and the jobs of their sub-maps.

A reconstruction that was planned waits for its sub-maps as an aggregation waits for its reconstructions. A transaction
that holds the row of a sub-map's job may go on to the reconstruction's row, and from there to those of aggregations;
none goes the other way, and none holds the rows of two reconstructions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import exists, func, or_, select
from sqlalchemy.orm import Session, load_only

from schemas.api.jobs import JobKind
from schemas.api.problems import PROBLEM_TYPE, Problem
from service.database.tables import TERMINAL, Job, JobMember, JobState, now_us
from service.domain.jobs._dependencies import WAITS, resolve_child, tell_aggregations, waiting_for
from service.domain.jobs._queries import ACTIVE, change, tell_progress, tell_state

SUBMAPS_STAGE = "submaps"
# Of a reconstruction's time: what comes before the sub-maps, and with them.
PLANNED_PERCENT = 7.0
MAPPED_PERCENT = 75.0


def look_at_submaps(session: Session, parent_id: str) -> None:
    """Let a reconstruction go on, or end, where its sub-maps leave nothing to wait for."""
    # Locked before they are counted: of two that end at one time, the second has to see the first.
    parent = session.get(Job, parent_id, populate_existing=True, with_for_update=True)
    if parent is None or parent.state in TERMINAL:
        return
    found = _submaps(session, parent_id)
    failed = [job for job in found if job.state in (JobState.FAILED, JobState.CANCELLED)]
    left = sum(job.state in ACTIVE for job in found)
    if failed:
        ended = {
            "state": JobState.FAILED,
            "finished_us": now_us(),
            "problem": _problem(parent, failed[0]),
            "waiting_for": left,
        }
        if change(session, parent_id, WAITS, ended):
            tell_state(session, parent_id)
            resolve_child(session, session.get_one(Job, parent_id, populate_existing=True))
    elif change(session, parent_id, WAITS, waiting_for(session, left)):
        tell_submaps(session, parent_id)


def _submaps(session: Session, parent_id: str) -> list[Job]:
    """Jobs of a reconstruction's sub-maps, in the order of the drive."""
    found = session.scalars(select(Job).where(Job.parent_id == parent_id).execution_options(populate_existing=True))
    return sorted(found, key=number_of)


def number_of(submap: Job) -> int:
    """Number of a sub-map along its drive, from 1."""
    return int((submap.request or {}).get("number", 0))


def _problem(parent: Job, submap: Job) -> dict[str, Any]:
    """Problem of a reconstruction whose sub-map cannot be mapped: the sub-map's own, with its number."""
    place = f"sub-map {number_of(submap)} of {(submap.request or {}).get('total')}"
    if submap.problem is not None:
        return {**submap.problem, "detail": f"{place}: {submap.problem['detail']}", "job_id": parent.id}
    problem = Problem(
        type=PROBLEM_TYPE + "submap-cancelled",
        title="The drive could not be reconstructed",
        detail=f"{place} was cancelled, job {submap.id}",
        remedy="Retry the reconstruction: finished stages are reused.",
        retryable=True,
        stage=SUBMAPS_STAGE,
        job_id=parent.id,
    )
    return problem.model_dump(mode="json", exclude_none=True)


def tell_parents(session: Session, child: Job) -> None:
    """Pass a job's progress on to those that wait for it."""
    if child.parent_id is None:
        tell_aggregations(session, child)
    else:
        tell_submaps(session, child.parent_id)


def tell_submaps(session: Session, parent_id: str) -> None:
    """Note the progress of a reconstruction's sub-maps, all together; it never falls, also where one begins anew."""
    parent = session.get(Job, parent_id, populate_existing=True, with_for_update=True)
    if parent is None or parent.state != JobState.QUEUED:
        return
    rows = session.execute(select(Job.state, Job.percent).where(Job.parent_id == parent_id)).all()
    share = sum(row.percent for row in rows) / (100.0 * max(len(rows), 1))
    percent = PLANNED_PERCENT + (parent.children_percent - PLANNED_PERCENT) * share
    values = {
        "stage": SUBMAPS_STAGE,
        "done": sum(row.state in TERMINAL for row in rows),
        "total": len(rows),
        "unit": "sub-maps",
        "percent": round(max(percent, parent.percent), 2),
    }
    if change(session, parent_id, Job.state == JobState.QUEUED, values):
        parent = session.get_one(Job, parent_id, populate_existing=True)
        tell_progress(session, parent)
        tell_aggregations(session, parent)


def untold_parents(session: Session) -> list[str]:
    """Reconstructions that wait, and whose sub-maps have ended without their being told."""
    submap = Job.__table__.alias("submap")
    mine = submap.c.parent_id == Job.id
    is_active = exists().where(mine, submap.c.state.in_(ACTIVE))
    has_failed = exists().where(mine, submap.c.state.in_((JobState.FAILED, JobState.CANCELLED)))
    waiting = WAITS & (Job.kind == JobKind.RECONSTRUCTION)
    return list(session.scalars(select(Job.id).where(waiting, or_(~is_active, has_failed)).order_by(Job.id)))


def submaps_of(session: Session, job_ids: Sequence[str]) -> dict[str, list[Job]]:
    """Jobs of the sub-maps of reconstructions, by the reconstruction's id, in the order of the drive."""
    found: dict[str, list[Job]] = {}
    shown = load_only(
        Job.id, Job.kind, Job.parent_id, Job.request, Job.state, Job.heartbeat_us, Job.percent, Job.problem
    )
    for job in session.scalars(select(Job).where(Job.parent_id.in_(job_ids)).options(shown)):
        found.setdefault(job.parent_id or "", []).append(job)
    return {parent_id: sorted(submaps, key=number_of) for parent_id, submaps in found.items()}


def children_of(session: Session, job_ids: Sequence[str]) -> dict[str, int]:
    """Number of the members of aggregations and of the sub-maps of reconstructions, by the job's id.

    A job has either; one that has none is left out.
    """
    members = select(JobMember.job_id, func.count()).where(JobMember.job_id.in_(job_ids)).group_by(JobMember.job_id)
    submaps = select(Job.parent_id, func.count()).where(Job.parent_id.in_(job_ids)).group_by(Job.parent_id)
    counts = [*session.execute(members).all(), *session.execute(submaps).all()]
    return {str(job_id): count for job_id, count in counts}
