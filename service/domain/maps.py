"""Maps: versions that are published whole or not at all, never change, and keep what they are made of."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from sqlalchemy import ColumnElement, delete, false, func, or_, select, tuple_, update
from sqlalchemy.orm import Session

from schemas.api.maps import MapSummary
from schemas.artifacts import drive_of_scene
from service.database.tables import TERMINAL, Job, JobMember, Map, MapFile, MapScene, MapVersion, Scene
from service.domain import jobs
from service.domain.access import require
from service.domain.scenes import media_type
from service.errors import MapBusy, UsedByJob, UsedByMap, VersionCurrent, not_found
from service.storage import blobs, named_blobs
from service.storage.blob_writer import StoredFile
from service.storage.named_blobs import Named

VersionKey = tuple[str, int]  # the map's id and the version's number


def get(session: Session, project_id: str, map_id: str, *, lock: bool = False) -> Map:
    """The project's map.

    Raises
    ------
    ServiceError
        404 where it has no such map.
    """
    return require(session, Map, project_id, map_id, lock=lock)


def version_of(session: Session, found: Map, number: str) -> MapVersion:
    """A version by its number, or `current`.

    Raises
    ------
    ServiceError
        404 where the map has no such version.
    """
    wanted = found.current_version if number == "current" else _number(number)
    version = None if wanted is None else session.get(MapVersion, (found.id, wanted))
    if version is None:
        raise not_found(f"version of map {found.id} numbered", number)
    return version


def _number(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 10 and text[0] != "0" else None


def scenes_of(session: Session, found: Map) -> list[MapScene]:
    """The scenes of a map's current version; none where it has no version."""
    mine = (MapScene.map_id == found.id) & (MapScene.number == (found.current_version or 0))
    return list(session.scalars(select(MapScene).where(mine).order_by(MapScene.name)))


def children_of(session: Session, keys: Collection[VersionKey]) -> dict[VersionKey, int]:
    """Number of the scenes and failed drives of versions; one that has none may be left out."""
    scenes = select(MapScene.map_id, MapScene.number, func.count()).group_by(MapScene.map_id, MapScene.number)
    failed = select(MapVersion.map_id, MapVersion.number, func.json_array_length(MapVersion.failed))
    counts: dict[VersionKey, int] = {}
    for statement in (scenes.where(_is_of(MapScene, keys)), failed.where(_is_of(MapVersion, keys))):
        for map_id, number, count in session.execute(statement):
            counts[map_id, number] = counts.get((map_id, number), 0) + count
    return counts


def versions_of(session: Session, keys: Collection[VersionKey]) -> dict[VersionKey, MapVersion]:
    """Versions that are there, each whole."""
    found = session.scalars(select(MapVersion).where(_is_of(MapVersion, keys)))
    return {(version.map_id, version.number): version for version in found}


def scenes_of_versions(session: Session, keys: Collection[VersionKey]) -> dict[VersionKey, list[MapScene]]:
    """Scenes of versions, by name; a version that has none is left out."""
    found: dict[VersionKey, list[MapScene]] = {}
    for scene in session.scalars(select(MapScene).where(_is_of(MapScene, keys)).order_by(MapScene.name)):
        found.setdefault((scene.map_id, scene.number), []).append(scene)
    return found


def _is_of(table: type[MapScene] | type[MapVersion], keys: Collection[VersionKey]) -> ColumnElement[bool]:
    return tuple_(table.map_id, table.number).in_(keys)


def jobs_under_way(session: Session, map_ids: Collection[str]) -> dict[str, str]:
    """The aggregations that make the next versions of maps, by map; one without is left out."""
    found = session.execute(select(Job.map_id, Job.id).where(Job.map_id.in_(map_ids), Job.state.not_in(TERMINAL)))
    return {str(map_id): job_id for map_id, job_id in found}


def require_idle(session: Session, found: Map) -> None:
    """Refuse two aggregations at one time: the second would undo the first.

    Raises
    ------
    ServiceError
        409.
    """
    job_id = jobs_under_way(session, [found.id]).get(found.id)
    if job_id is not None:
        raise MapBusy(
            f"job {job_id} is making the next version of map {found.id}",
            remedy="Wait for its end, or cancel it.",
            headers={"Retry-After": "10"},
        )


def publish(
    session: Session,
    held: jobs.Claim,
    *,
    files: Mapping[str, StoredFile],
    summary: MapSummary,
    names: Collection[str],
    unconnected: Collection[str],
    failed: Sequence[Mapping[str, Any]],
    expires_us: int | None,
    reused: Sequence[str] = (),
) -> int:
    """Make the next version of the job's map of stored files, by path, show it, and end the job.

    Parameters
    ----------
    names
        The version's scenes: NAME for a member or a scene that stays, NAME#N for its component N.
    unconnected
        Names of the scenes that overlap no other.
    failed
        Members that are not in it, see `named`, and why: `problem`.

    Returns
    -------
    int
        The version's number.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more; the caller's session must roll back.
    """
    map_id = held.map_id or ""
    number = (session.scalar(select(Map.newest_version).where(Map.id == map_id)) or 0) + 1
    jobs.succeed(session, held, map_version=number, reused=reused)
    job = session.get_one(Job, held.job_id)
    members = [member for member, _ in jobs.members_of(session, [held.job_id]).get(held.job_id, [])]
    kept = kept_scenes(session, job)
    session.add(
        MapVersion(
            map_id=map_id,
            number=number,
            job_id=held.job_id,
            fence=held.fence,
            summary=summary.model_dump(mode="json"),
            failed=[dict(drive) for drive in failed],
        )
    )
    session.flush()
    made_of = {scene.name: (scene.drive_id, scene.scene_id) for scene in kept}
    made_of |= {m.name: (m.drive_id, m.scene_id) for m in members if m.scene_id is not None}
    for name in names:
        drive_id, scene_id = made_of.get(name) or made_of[drive_of_scene(name)]
        connected = name not in unconnected
        session.add(
            MapScene(map_id=map_id, number=number, name=name, drive_id=drive_id, scene_id=scene_id, connected=connected)
        )
    for path, file in files.items():
        blob = blobs.record(session, project_id=held.project_id, within_quota=False, **file.identity)
        session.add(MapFile(map_id=map_id, number=number, path=path, blob_id=blob.id, media_type=media_type(path)))
    shown = {"current_version": number, "newest_version": number, "expires_us": expires_us}
    session.execute(update(Map).where(Map.id == map_id).values(**shown))
    return number


def kept_scenes(session: Session, job: Job) -> list[MapScene]:
    """Scenes of the version that an aggregation began with, without those that it takes out."""
    request = job.request or {}
    base, removed = request.get("base_version"), set(request.get("remove", ()))
    mine = (MapScene.map_id == job.map_id) & (MapScene.number == (base or 0))
    found = session.scalars(select(MapScene).where(mine).order_by(MapScene.name))
    return [scene for scene in found if scene.name not in removed]


def named(member: JobMember) -> dict[str, Any]:
    """A member, as a version and its report call it."""
    return {"name": member.name, "drive_id": member.drive_id, "job_id": member.child_id}


def show_version(session: Session, found: Map, number: int) -> None:
    """Make a version that is there the current one.

    Raises
    ------
    ServiceError
        404 where there is none of this number; 409 while an aggregation works on the version that is current.
    """
    version_of(session, found, str(number))
    require_idle(session, found)
    found.current_version = number


def remove(session: Session, found: Map) -> Named:
    """Delete a map with all its versions. Its scenes stay.

    Returns
    -------
    Named
        Blobs that it named.

    Raises
    ------
    ServiceError
        409 while an aggregation makes a version of it.
    """
    require_idle(session, found)
    named_by_it = named_blobs.of_map(session, found.id)
    session.execute(delete(Map).where(Map.id == found.id))
    return named_by_it


def remove_version(session: Session, found: Map, number: str) -> Named:
    """Delete a version that is not the current one.

    Returns
    -------
    Named
        Blobs that it named.

    Raises
    ------
    ServiceError
        404, or 409 where it is the current one or an aggregation may need it.
    """
    version = version_of(session, found, number)
    require_idle(session, found)
    if version.number == found.current_version:
        raise VersionCurrent(
            f"version {version.number} is the current one of map {found.id}",
            remedy="Make another version the current one first, or delete the map.",
        )
    named_by_it = named_blobs.of_version(session, found.id, version.number)
    session.execute(delete(MapVersion).where(MapVersion.map_id == found.id, MapVersion.number == version.number))
    return named_by_it


def require_unused(session: Session, *, what: str, drive_id: str | None = None, scene_id: str | None = None) -> None:
    """Refuse to delete what a map is made of, or is being made of.

    Raises
    ------
    ServiceError
        409 with the map's name.
    """
    is_it = MapScene.drive_id == drive_id if scene_id is None else MapScene.scene_id == scene_id
    statement = select(Map.id, Map.name, MapScene.number).join(MapScene, MapScene.map_id == Map.id).where(is_it)
    found = session.execute(statement.order_by(Map.created_us, MapScene.number).limit(4)).all()
    if found:
        named = ", ".join(f"version {row.number} of map {row.name!r} ({row.id})" for row in found[:3])
        more = " and others" if len(found) > 3 else ""
        raise UsedByMap(
            f"{what} is part of {named}{more}",
            remedy="Make a version without it and delete the versions that have it, or delete the map.",
        )
    wanted = JobMember.drive_id == drive_id if scene_id is None else JobMember.scene_id == scene_id
    active = select(Job.id).join(JobMember, JobMember.job_id == Job.id).where(wanted, Job.state.not_in(TERMINAL))
    job_id = session.scalar(active.limit(1))
    if job_id is not None:
        raise UsedByJob(f"{what} is needed by the aggregation {job_id}", remedy="Wait for its end, or cancel it.")


def forget_expired(
    session: Session,
    now: int,
    *,
    unless: Callable[[type[Map] | type[Scene]], ColumnElement[bool]] = lambda table: false(),
    limit: int = 20,
) -> int:
    """Delete maps, then scenes, that have passed their retention dates; what a map or a job needs stays.

    Parameters
    ----------
    unless
        The condition under which a map or scene stays all the same.
    limit
        Of each no more than this, with their files: the transaction is to be short.

    Returns
    -------
    int
        How many were deleted; 0 where none is left.
    """
    busy = select(Job.id).where(Job.map_id == Map.id, Job.state.not_in(TERMINAL)).exists()
    in_job = (
        select(JobMember.job_id)
        .join(Job, Job.id == JobMember.job_id)
        .where(JobMember.scene_id == Scene.id, Job.state.not_in(TERMINAL))
    )
    in_map = select(MapScene.map_id).where(MapScene.scene_id == Scene.id)
    return _forget(session, Map, (Map.expires_us < now) & ~or_(busy, unless(Map)), limit) + _forget(
        session, Scene, (Scene.expires_us < now) & ~or_(in_map.exists(), in_job.exists(), unless(Scene)), limit
    )


def _forget(session: Session, table: type[Map] | type[Scene], ripe: ColumnElement[bool], limit: int) -> int:
    # Locked first: an aggregation that is asked for at this moment has been recorded then, or finds nothing.
    found = session.scalars(select(table.id).where(ripe).order_by(table.id).limit(limit).with_for_update()).all()
    dropped = delete(table).where(table.id.in_(found), ripe).execution_options(synchronize_session=False)
    return int(session.execute(dropped).rowcount)  # type: ignore[attr-defined]
