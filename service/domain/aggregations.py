"""Aggregations as they are asked for: what is there already, what must be reconstructed first, and the job itself."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from schemas.api.aggregations import AggregationRequest
from schemas.api.drives import DriveState, PreflightState
from schemas.api.jobs import JobKind
from schemas.api.problems import PROBLEM_TYPE, Problem, ProblemItem
from schemas.api.resource import Finding
from schemas.artifacts import Stage, drive_of_scene
from schemas.file_names import portable_key
from service.database.tables import TERMINAL, Drive, Job, JobMember, JobState, Map, MapScene, Project, Scene, new_id
from service.domain import drives, jobs, maps
from service.domain.access import require
from service.domain.checkpoints import settings_sha256
from service.domain.same_images import drives_of_one_recording
from service.errors import (
    AggregationTooLarge,
    DriveNotCommitted,
    DriveRejected,
    DriveTwice,
    NothingToDo,
    NotInMap,
    RemovedTwice,
    TooFewScenes,
)

# Of the whole tree's time, measured with drives of 40 units: two reconstructions at one time, then the aggregation.
CHILDREN_PERCENT = 80.0
_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")
_NAME_LENGTH = 80


@dataclass
class _Plan:
    """A checked request: which drives come, with which scene where it is there, and what of the map stays."""

    drives: list[Drive] = field(default_factory=list)
    scenes: dict[str, Scene] = field(default_factory=dict)  # by drive, as asked for
    found: dict[str, Scene] = field(default_factory=dict)  # by drive, of those that were asked for by their drives
    under_way: dict[str, Job] = field(default_factory=dict)  # by drive
    remaining: list[MapScene] = field(default_factory=list)
    removed: list[MapScene] = field(default_factory=list)

    @property
    def remaining_drives(self) -> set[str]:
        """Drives whose scenes stay, in one component or several."""
        return {scene.drive_id for scene in self.remaining}

    @property
    def missing(self) -> list[Drive]:
        """Drives whose scenes nobody makes yet; those that cannot have one are none of them."""
        known = self.found.keys() | self.under_way.keys()
        return [d for d in self.drives if d.id not in known and d.preflight_state != PreflightState.REJECTED]


def create(
    session: Session,
    *,
    project_id: str,
    asked: AggregationRequest,
    job_expires_us: int | None,
    retry_of: Job | None = None,
) -> tuple[Job, list[Job]]:
    """Record an aggregation, and jobs for what it needs and nobody makes yet.

    Returns
    -------
    job, due
        The aggregation, and all jobs that may begin now.

    Raises
    ------
    ServiceError
        404 for what is not there; 409 where a drive is not committed or the map is being made; 422 where a drive comes
        twice, no map can come of it, with `require_all` a drive was rejected, or the project may never have so many
        jobs at one time; 429 where it may not now.
    """
    map_id = asked.map_id if retry_of is None else retry_of.map_id
    of_map = None if map_id is None else maps.get(session, project_id, map_id, lock=True)
    if of_map is not None:
        maps.require_idle(session, of_map)
    plan = _checked(session, project_id, asked, of_map)
    if of_map is None:
        of_map = Map(id=new_id("map"), project_id=project_id, name=asked.name or _map_name(plan))
        session.add(of_map)
    if of_map.current_version is None:
        of_map.expires_us = job_expires_us  # its record is all there is of it, until a version is published
    settings = asked.settings.model_dump(mode="json", exclude_none=True)
    # Before the project is locked, as a new job does: who publishes a scene holds its job and wants the project. The
    # row of a new map holds only the project's key, and others hold that beside the lock.
    _find_what_is_there(session, plan, settings)
    _require_quota(session, project_id, plan)
    job = jobs.create(
        session,
        project_id=project_id,
        kind=JobKind.AGGREGATION,
        drive_id=None,
        settings=settings,
        retry_of=None if retry_of is None else retry_of.id,
        expires_us=job_expires_us,
        has_place=True,
        map_id=of_map.id,
        request={
            "asked": asked.model_dump(mode="json", exclude_none=True),
            "require_all": asked.require_all,
            "base_version": of_map.current_version,
            "kept_scenes": len(plan.remaining_drives),
            "remove": [scene.name for scene in plan.removed],
        },
        waiting_for=1,  # until its members are known
    )
    children = list(_members(session, job, plan))
    if any(child is not None for child in children):
        session.execute(update(Job).where(Job.id == job.id).values(children_percent=CHILDREN_PERCENT))
    session.flush()
    jobs.look_at(session, job.id)
    session.refresh(job)
    made = [child for child in children if child is not None and child.is_child and child.attempt == 0]
    return job, [*made, *([job] if job.state == JobState.QUEUED and job.waiting_for == 0 else [])]


def retry(session: Session, job: Job, *, expires_us: int | None) -> tuple[Job, list[Job]]:
    """Ask again for an aggregation that failed or was cancelled; see `create`.

    Raises
    ------
    ServiceError
        As `create`; 409 too where the job may still succeed, or did.
    """
    jobs.require_failed(job)
    asked = AggregationRequest.model_validate((job.request or {}).get("asked", {}))
    return create(session, project_id=job.project_id, asked=asked, job_expires_us=expires_us, retry_of=job)


def _checked(session: Session, project_id: str, asked: AggregationRequest, of_map: Map | None) -> _Plan:
    plan = _Plan()
    if of_map is not None:
        plan.remaining = maps.scenes_of(session, of_map)
    _take_out(plan, asked.remove, of_map)
    # Rows that are locked so are not deleted; other aggregations may do the same, in whatever order.
    session.scalars(select(Scene.id).where(Scene.id.in_(asked.scenes)).with_for_update(read=True, key_share=True)).all()
    for scene_id in asked.scenes:
        scene = require(session, Scene, project_id, scene_id)
        _require_once(plan, scene.drive_id, f"scene {scene_id}")
        plan.scenes[scene.drive_id] = scene
    found = [drives.get(session, project_id, drive_id, lock=True) for drive_id in sorted(set(asked.drives))]
    by_id = {drive.id: drive for drive in found}
    for drive_id in asked.drives:
        _require_once(plan, drive_id, "the request")
        plan.drives.append(by_id[drive_id])
    _require_ready(plan.drives, require_all=asked.require_all)
    _require_different_recordings(session, plan)
    coming = len(plan.scenes) + len(plan.drives)
    if not coming and not plan.removed:
        raise NothingToDo("the request names neither drives nor scenes", remedy="Name what the map is made of.")
    left = coming + len(plan.remaining_drives)
    if left < jobs.MIN_SCENES:
        what = f"{left} scene is left, a map needs {jobs.MIN_SCENES}"
        raise TooFewScenes(what, remedy="Name more drives or scenes; a single scene needs no aggregation.")
    return plan


def _take_out(plan: _Plan, remove: Collection[str], of_map: Map | None) -> None:
    named: dict[str, list[MapScene]] = {}
    for scene in plan.remaining:  # a drive has several where it is in components
        for given in (scene.drive_id, scene.scene_id):
            named.setdefault(given, []).append(scene)
    unknown = sorted(set(remove) - named.keys())
    if unknown:
        where = "a new map" if of_map is None else f"the current version of map {of_map.id}"
        errors = [ProblemItem(field="remove", detail=f"{given} is not in it") for given in unknown]
        what = f"{unknown[0]!r} is not in {where}"
        raise NotInMap(what, remedy="See the version's scenes for what can be taken out.", errors=errors)
    taken = [scene for given in remove for scene in named[given]]
    twice = next((scene for i, scene in enumerate(taken) if scene in taken[:i]), None)
    if twice is not None:
        raise RemovedTwice(f"scene {twice.name!r} is to be taken out twice", remedy="Name it once.")
    plan.removed = taken
    plan.remaining = [scene for scene in plan.remaining if scene not in taken]


def _require_once(plan: _Plan, drive_id: str, what: str) -> None:
    """The same drive twice would fit itself everywhere."""
    kept = next((scene for scene in plan.remaining if scene.drive_id == drive_id), None)
    if kept is not None:
        remedy = f"Take the one that is there out in the same request: remove {kept.scene_id}."
        raise DriveTwice(f"{what} brings drive {drive_id}, which is in the map as {kept.name!r}", remedy=remedy)
    if drive_id in plan.scenes or any(drive.id == drive_id for drive in plan.drives):
        raise DriveTwice(f"{what} brings drive {drive_id} a second time", remedy="Name each drive once.")


def _require_different_recordings(session: Session, plan: _Plan) -> None:
    """A recording that was uploaded twice would do the same."""
    coming = {*plan.scenes, *(drive.id for drive in plan.drives)}
    same = drives_of_one_recording(session, coming, plan.remaining_drives)
    if same is None:
        return
    a, b = same
    kept = [scene for scene in plan.remaining if scene.drive_id in (a.id, b.id)]
    remedy = f"Take the one that is there out in the same request: remove {kept[0].scene_id}." if kept else ""
    raise DriveTwice(
        f"drives {a.id} ({a.name}) and {b.id} ({b.name}) have the same images",
        remedy=remedy or "Name one of them, and delete the other if it was uploaded by mistake.",
    )


def _require_ready(found: Collection[Drive], *, require_all: bool) -> None:
    open_drives = [drive for drive in found if drive.state == DriveState.OPEN]
    if open_drives:
        more = f", and {len(open_drives) - 1} more" if len(open_drives) > 1 else ""
        raise DriveNotCommitted(
            f"drive {open_drives[0].id} still takes files{more}",
            remedy="Upload what is missing, then commit them.",
            errors=[ProblemItem(field=drive.id, detail="is not committed") for drive in open_drives],
        )
    rejected = [drive for drive in found if drive.preflight_state == PreflightState.REJECTED]
    if rejected and require_all:
        problem = _rejection(rejected[0])
        raise DriveRejected(
            f"drive {rejected[0].id}: {problem.detail}", remedy=problem.remedy, findings=problem.findings
        )


def _find_what_is_there(session: Session, plan: _Plan, settings: Mapping[str, Any]) -> None:
    for drive in plan.drives:
        # In this order: a job that ends while its row is waited for leaves a scene that is seen afterwards.
        job = _job_under_way(session, drive, settings)
        scene = _scene_of(session, drive, settings)
        if scene is not None:
            plan.found[drive.id] = scene
        elif job is not None:
            plan.under_way[drive.id] = job


def _require_quota(session: Session, project_id: str, plan: _Plan) -> None:
    """Room for the aggregation and all that it needs, before any of them is recorded."""
    needed, limit = 1 + len(plan.missing), session.get_one(Project, project_id).max_active_jobs
    if needed > limit:
        raise AggregationTooLarge(
            f"the aggregation and the reconstructions that it needs are {needed} jobs at one time, the project's quota "
            f"is {limit}: waiting does not help",
            remedy=f"Reconstruct at least {needed - limit} of the drives first, no more than {limit} at one time, then "
            "ask again: scenes made with the same settings are reused, others can be named as scenes. Or ask the "
            "operator for a larger quota ('mrasfm projects set').",
        )
    jobs.require_places(session, project_id, needed)


def _members(session: Session, job: Job, plan: _Plan) -> Iterator[Job | None]:
    """Record what the aggregation brings; for each the job that makes its scene, None where that is there."""
    # A component's name stands for its drive, also where the largest one is not in the version.
    taken = {portable_key(drive_of_scene(scene.name)) for scene in (*plan.remaining, *plan.removed)}
    for drive_id, scene in plan.scenes.items():
        name = _name(scene.name, taken)
        session.add(JobMember(job_id=job.id, drive_id=drive_id, name=name, scene_id=scene.id))
        yield None
    for drive in plan.drives:
        member = JobMember(job_id=job.id, drive_id=drive.id, name=_name(drive.name, taken))
        session.add(member)
        known = plan.found.get(drive.id)
        if known is not None:
            member.scene_id = known.id
            yield None
        elif drive.preflight_state == PreflightState.REJECTED:
            member.problem = _rejection(drive).model_dump(mode="json", exclude_none=True)
            yield None
        else:
            child = plan.under_way.get(drive.id) or _child(session, drive, job)
            member.child_id = child.id
            yield child


def _scene_of(session: Session, drive: Drive, settings: Mapping[str, Any]) -> Scene | None:
    """The newest scene of a drive that a reconstruction would make again."""
    same = (Scene.drive_id == drive.id) & (Scene.settings_sha256 == settings_sha256(settings))
    statement = select(Scene).where(same).order_by(Scene.created_us.desc())
    made = session.scalars(statement.with_for_update(read=True, key_share=True))
    return next((scene for scene in made if scene.summary.get("engine_version") == version("mrasfm")), None)


def _job_under_way(session: Session, drive: Drive, settings: Mapping[str, Any]) -> Job | None:
    """A reconstruction that somebody has asked for already; locked, so that it does not end unseen."""
    active = jobs.active_of_drive(drive.id).where(Job.kind == JobKind.RECONSTRUCTION, Job.cancel_requested_us.is_(None))
    for found in session.scalars(active.order_by(Job.created_us)).all():
        session.refresh(found, with_for_update=True)
        still = found.state not in TERMINAL and found.cancel_requested_us is None
        if still and found.settings == settings:
            return found
    return None


def _child(session: Session, drive: Drive, job: Job) -> Job:
    return jobs.create(
        session,
        project_id=job.project_id,
        kind=JobKind.RECONSTRUCTION,
        drive_id=drive.id,
        settings=job.settings,
        expires_us=job.expires_us,
        has_place=True,
        is_child=True,
    )


def _rejection(drive: Drive) -> Problem:
    """Problem of a drive whose check found errors, and which cannot be reconstructed."""
    errors = [finding for finding in drive.findings if finding.get("severity") == "error"]
    first = errors[0] if errors else {}
    return Problem(
        type=PROBLEM_TYPE + DriveRejected.code,
        title="The check of the drive found errors",
        detail=str(first.get("what", "the check of the drive found errors")),
        remedy=str(first.get("remedy", "Correct the drive, and upload it as a new one.")),
        findings=[Finding.model_validate(finding) for finding in drive.findings],
        stage=Stage.PREFLIGHT,
        retryable=False,
    )


def _name(wanted: str, taken: set[str]) -> str:
    """A scene's name in the map: the engine takes it, a file's name could be made of it, and no other has it.

    Names that are `taken` are keys of them: many systems take names that differ in case alone for one.
    """
    safe = _UNSAFE.sub("-", wanted).strip("-._")[:_NAME_LENGTH] or "drive"
    names = (safe if i == 1 else f"{safe}-{i}" for i in range(1, len(taken) + 2))
    found = next(name for name in names if portable_key(name) not in taken)
    taken.add(portable_key(found))
    return found


def _map_name(plan: _Plan) -> str:
    names = [*(scene.name for scene in plan.scenes.values()), *(drive.name for drive in plan.drives)]
    return names[0][:180] if len(names) == 1 else f"{names[0][:180]} and {len(names) - 1} more"
