"""Maps and their versions as the API shows them."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session, load_only

from schemas.api.maps import MapFileResource, MapResource, MapVersionResource
from schemas.api.resource import Page
from service.api.dependencies import moment
from service.api.http.paging import count_together, cursor_of, newest, newest_after, page_of
from service.api.routes.downloads import files_of
from service.database.tables import Map, MapFile, MapScene, MapVersion
from service.domain import maps
from service.domain.maps import VersionKey

CHILDREN_OF_PAGE = 2000  # scenes and failed drives that a page of versions shows, unless one version alone has more


def page_of_maps(session: Session, project_id: str, *, cursor: str | None, limit: int) -> Page[MapResource]:
    """A page of a project's maps, the newest first.

    Each version may show a thousand scenes: the page ends before the limit where they would be too many, and `next`
    goes on with the first map that was left out.
    """
    found, following = newest(session, Map, project_id, cursor=cursor, limit=limit)
    children = maps.children_of(session, _current_versions(found))
    counts = [children.get((each.id, each.current_version or 0), 0) for each in found]
    shown = found[: count_together(counts, CHILDREN_OF_PAGE)]
    if len(shown) < len(found):
        following = newest_after(shown[-1])
    return Page[MapResource](items=_views_of(session, shown), next=following)


def page_of_versions(session: Session, found: Map, *, cursor: str | None, limit: int) -> Page[MapVersionResource]:
    """A page of a map's versions, the newest first, without their files; it ends early likewise."""
    statement = select(MapVersion).options(load_only(MapVersion.number)).where(MapVersion.map_id == found.id)
    rows, following = page_of(session, statement, MapVersion.number, cursor=cursor, limit=limit)
    keys: list[VersionKey] = [(found.id, version.number) for (version,) in rows]
    children = maps.children_of(session, keys)
    shown = keys[: count_together([children.get(key, 0) for key in keys], CHILDREN_OF_PAGE)]
    if len(shown) < len(keys):
        following = cursor_of(shown[-1][1])
    versions, scenes = maps.versions_of(session, shown), maps.scenes_of_versions(session, shown)
    items = [_shown_version(found, versions[key], scenes.get(key, ())) for key in shown]
    return Page[MapVersionResource](items=items, next=following)


def map_view(session: Session, found: Map) -> MapResource:
    """One map with its current version."""
    return _views_of(session, [found])[0]


def version_view(session: Session, found: Map, version: MapVersion) -> MapVersionResource:
    """One version with its files."""
    key = (found.id, version.number)
    scenes = maps.scenes_of_versions(session, [key])
    url = f"/v1/maps/{found.id}/versions/{version.number}"
    files = files_of(session, MapFile, files_of_version(version), MapFileResource, url)
    return _shown_version(found, version, scenes.get(key, ()), files)


def files_of_version(version: MapVersion) -> ColumnElement[bool]:
    """The condition that a file is one of this version's."""
    return (MapFile.map_id == version.map_id) & (MapFile.number == version.number)


def _current_versions(found: Sequence[Map]) -> list[VersionKey]:
    return [(each.id, each.current_version) for each in found if each.current_version is not None]


def _views_of(session: Session, found: Sequence[Map]) -> list[MapResource]:
    """Maps with their current versions, by as many queries as one of them takes."""
    keys = _current_versions(found)
    versions, scenes = maps.versions_of(session, keys), maps.scenes_of_versions(session, keys)
    jobs = maps.jobs_under_way(session, [each.id for each in found])
    shown: list[MapResource] = []
    for each in found:
        key = (each.id, each.current_version or 0)
        version = _shown_version(each, versions[key], scenes.get(key, ())) if key in versions else None
        shown.append(_shown(each, version, jobs.get(each.id)))
    return shown


def _shown(found: Map, version: MapVersionResource | None, job_id: str | None) -> MapResource:
    return MapResource.model_validate(
        {
            "id": found.id,
            "name": found.name,
            "current_version": found.current_version,
            "version": version,
            "job_id": job_id,
            "created_at": moment(found.created_us),
            "expires_at": moment(found.expires_us),
        }
    )


def _shown_version(
    found: Map, version: MapVersion, scenes: Sequence[MapScene], files: Sequence[MapFileResource] = ()
) -> MapVersionResource:
    shown = ("name", "drive_id", "scene_id", "connected")
    return MapVersionResource.model_validate(
        {
            "map_id": found.id,
            "number": version.number,
            "is_current": version.number == found.current_version,
            "name": found.name,
            "job_id": version.job_id,
            "summary": version.summary,
            "scenes": [{name: getattr(scene, name) for name in shown} for scene in scenes],
            "unconnected": [scene.name for scene in scenes if not scene.connected],
            "failed": version.failed,
            "files": list(files),
            "created_at": moment(version.created_us),
        }
    )
