"""Aggregations and the reconstructions that they wait for; `_submaps` is the same for reconstructions.

Everything is decided from the database: by the transaction in which a child ends, and once more by the reconciler.
A transaction that holds a child's row may go on to its parents' rows, and none goes the other way: no two can wait for
each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import and_, exists, func, or_, select
from sqlalchemy.orm import Session, load_only

from schemas.api.jobs import JobKind
from schemas.api.problems import PROBLEM_TYPE, Problem
from service.database.connections import clock_us
from service.database.tables import TERMINAL, Job, JobMember, JobState, now_us
from service.domain.jobs._queries import ACTIVE, change, tell_progress, tell_state

MIN_SCENES = 2
CHILDREN_STAGE = "reconstructions"

_OPEN = JobMember.child_id.is_not(None) & JobMember.scene_id.is_(None) & JobMember.problem.is_(None)
WAITS = (Job.state == JobState.QUEUED) & (Job.waiting_for > 0)


def resolve_child(session: Session, child: Job) -> None:
    """Note how a job ended in the aggregations that wait for it; those that wait for no other may begin."""
    waiting = select(JobMember).where(JobMember.child_id == child.id, _OPEN).order_by(JobMember.job_id)
    for member in session.scalars(waiting).all():
        _resolve(member, child)
        session.flush()
        look_at(session, member.job_id)


def _resolve(member: JobMember, child: Job | None) -> None:
    if child is not None and child.scene_id is not None:
        member.scene_id = child.scene_id
    elif child is not None and child.problem is not None:
        member.problem = child.problem
    else:
        how = "was cancelled" if child is not None else "is not there any more"
        member.problem = _problem("reconstruction-cancelled", f"its reconstruction, job {member.child_id}, {how}")


def look_at(session: Session, parent_id: str) -> None:
    """Let an aggregation begin, or end, where it has nothing left to wait for."""
    # Locked before its members are counted: of two that end at one time, the second has to see the first.
    parent = session.get(Job, parent_id, populate_existing=True, with_for_update=True)
    if parent is None or parent.state in TERMINAL:
        return
    open_members = select(func.count()).select_from(JobMember).where(JobMember.job_id == parent_id, _OPEN)
    left = session.scalar(open_members) or 0
    problem = _hopeless(session, parent, left)
    if problem is not None:
        ended = {"state": JobState.FAILED, "finished_us": now_us(), "problem": problem, "waiting_for": left}
        if change(session, parent_id, WAITS, ended):
            tell_state(session, parent_id)
        return
    if change(session, parent_id, WAITS, waiting_for(session, left)):
        _tell(session, parent_id)


def waiting_for(session: Session, left: int) -> dict[str, Any]:
    """Values of a job that waits for so many others; where it waits for none, it may begin from now on."""
    return {"waiting_for": left} if left else {"waiting_for": 0, "not_before_us": clock_us(session)}


def _hopeless(session: Session, parent: Job, left: int) -> dict[str, Any] | None:
    """Reason for which an aggregation can make no map any more; None where it can."""
    asked = parent.request or {}
    members = session.scalars(select(JobMember).where(JobMember.job_id == parent.id).order_by(JobMember.name)).all()
    failed = [member for member in members if member.problem is not None]
    if failed and asked.get("require_all"):
        what = "was asked for with require_all"
        return _failed_members(parent, failed, f"{what}, and {_named(failed)}", "Leave out the drives that failed")
    made = sum(member.scene_id is not None for member in members)
    enough = made + int(asked.get("kept_scenes", 0)) >= MIN_SCENES and (made or asked.get("remove"))
    if left or enough:
        return None
    what = f"has {made} new scenes and {asked.get('kept_scenes', 0)} of the map: {_named(failed)}"
    return _failed_members(parent, failed, what, "Correct or replace the drives that failed")


def _failed_members(parent: Job, failed: Sequence[JobMember], what: str, remedy: str) -> dict[str, Any]:
    errors = [{"field": member.name, "detail": str((member.problem or {}).get("detail", ""))} for member in failed]
    described = _problem(
        "drives-failed",
        f"the aggregation {what}",
        remedy=f"{remedy}, then ask again: scenes that are there are reused.",
    )
    return {**described, "title": "No map can be made", "errors": errors, "job_id": parent.id, "stage": CHILDREN_STAGE}


def _named(failed: Sequence[JobMember]) -> str:
    if not failed:
        return "none failed"
    first = failed[0]
    more = f", and {len(failed) - 1} more" if len(failed) > 1 else ""
    return f"{first.name} failed ({(first.problem or {}).get('detail', '')}){more}"


def _problem(code: str, detail: str, *, remedy: str = "Retry it.") -> dict[str, Any]:
    problem = Problem(
        type=PROBLEM_TYPE + code, title="The drive has no scene", detail=detail, remedy=remedy, retryable=True
    )
    return problem.model_dump(mode="json", exclude_none=True)


def tell_aggregations(session: Session, child: Job) -> None:
    """Pass a child's progress on to the aggregations that wait for it."""
    waiting = select(JobMember.job_id).where(JobMember.child_id == child.id, _OPEN).order_by(JobMember.job_id)
    for parent_id in session.scalars(waiting).all():
        _tell(session, parent_id)


def _tell(session: Session, parent_id: str) -> None:
    """Note the progress of an aggregation's children, all together; it never falls, also where one begins anew."""
    parent = session.get_one(Job, parent_id, populate_existing=True)
    statement = select(JobMember, Job.percent).outerjoin(Job, Job.id == JobMember.child_id)
    rows = session.execute(statement.where(JobMember.job_id == parent_id)).all()
    resolved = [member.scene_id is not None or member.problem is not None for member, _ in rows]
    children = [
        100.0 if is_resolved else percent or 0.0
        for (member, percent), is_resolved in zip(rows, resolved, strict=True)
        if member.child_id is not None
    ]
    if not children:
        return
    percent = parent.children_percent * sum(children) / (100.0 * len(children))
    values = {
        "stage": CHILDREN_STAGE,
        "done": sum(resolved),
        "total": len(rows),
        "unit": "scenes",
        "percent": round(max(percent, parent.percent), 2),
    }
    if change(session, parent_id, Job.state == JobState.QUEUED, values):
        tell_progress(session, session.get_one(Job, parent_id, populate_existing=True))


def tend(session: Session) -> None:
    """Find children that ended without their parents being told: their records may have gone meanwhile."""
    aggregations = WAITS & (Job.kind == JobKind.AGGREGATION)
    waiting = session.scalars(select(Job.id).where(aggregations).order_by(Job.id)).all()
    if not waiting:
        return
    ended = or_(Job.id.is_(None), Job.state.in_(TERMINAL))
    statement = select(JobMember, Job).outerjoin(Job, Job.id == JobMember.child_id).where(_OPEN, ended)
    for member, child in session.execute(statement.where(JobMember.job_id.in_(waiting))).all():
        _resolve(member, child)
    session.flush()
    for parent_id in waiting:
        if not session.scalar(select(exists().where(JobMember.job_id == parent_id, _OPEN))):
            look_at(session, parent_id)


def orphans(session: Session, *, among: Sequence[str] | None = None) -> list[str]:
    """Jobs under way that were made for others, none of which waits for them any more."""
    parent = Job.__table__.alias("parent")
    is_active = parent.c.state.in_(ACTIVE)
    by_aggregation = (
        select(JobMember.job_id)
        .join(parent, parent.c.id == JobMember.job_id)
        .where(JobMember.child_id == Job.id, is_active)
    )
    by_reconstruction = select(parent.c.id).where(parent.c.id == Job.parent_id, is_active)
    needed = or_(by_aggregation.exists(), by_reconstruction.exists())
    wanted = and_(Job.is_child, Job.state.in_(ACTIVE), Job.cancel_requested_us.is_(None), ~needed)
    if among is not None:
        wanted = wanted & Job.id.in_(among)
    return list(session.scalars(select(Job.id).where(wanted).order_by(Job.id)))


def members_of(session: Session, job_ids: Sequence[str]) -> dict[str, list[tuple[JobMember, Job | None]]]:
    """The members of aggregations and the jobs that make their scenes, by the aggregation's id.

    Of those jobs only what is shown of a member is loaded: an aggregation may have a thousand.
    """
    found: dict[str, list[tuple[JobMember, Job | None]]] = {}
    shown = load_only(Job.id, Job.kind, Job.state, Job.heartbeat_us, Job.percent)
    statement = select(JobMember, Job).outerjoin(Job, Job.id == JobMember.child_id).options(shown)
    statement = statement.where(JobMember.job_id.in_(job_ids)).order_by(JobMember.job_id, JobMember.name)
    for member, child in session.execute(statement):
        found.setdefault(member.job_id, []).append((member, child))
    return found
