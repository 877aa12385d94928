"""Publishing a scene: all of it in one transaction, or nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath

from sqlalchemy.orm import Session

from schemas.api.scenes import SceneSummary
from service.database.tables import Drive, Scene, SceneFile, new_id
from service.domain import jobs
from service.domain.checkpoints import settings_sha256
from service.storage import blobs
from service.storage.blob_writer import StoredFile

_MEDIA_TYPES = {
    ".json": "application/json",
    ".txt": "text/plain; charset=utf-8",
    ".tum": "text/plain; charset=utf-8",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".html": "text/html; charset=utf-8",
    ".pgw": "text/plain; charset=utf-8",
    ".tif": "image/tiff",
    ".db": "application/vnd.sqlite3",
    ".laz": "application/vnd.laszip",
    ".yaml": "application/yaml",
    ".urdf": "application/xml",
    ".gpkg": "application/geopackage+sqlite3",
}


def media_type(path: str) -> str:
    """Media type of an artifact, by its name."""
    return _MEDIA_TYPES.get(PurePosixPath(path).suffix, "application/octet-stream")


def publish(
    session: Session,
    held: jobs.Claim,
    *,
    files: Mapping[str, StoredFile],
    summary: SceneSummary,
    expires_us: int | None,
    reused: Sequence[str] = (),
) -> str:
    """Make a scene of stored files, by path, and end its job.

    Parameters
    ----------
    reused
        Stages of the job whose results were there already.

    Returns
    -------
    str
        The scene's id.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more; the caller's session must roll back.
    """
    scene_id = new_id("scn")
    jobs.succeed(session, held, scene_id=scene_id, reused=reused)  # first: it sees whether the job is still held
    drive_id = held.drive_id or ""
    drive = session.get(Drive, drive_id)
    session.add(
        Scene(
            id=scene_id,
            project_id=held.project_id,
            job_id=held.job_id,
            drive_id=drive_id,
            name=drive_id if drive is None else drive.name,
            fence=held.fence,
            settings_sha256=settings_sha256(held.settings),
            summary=summary.model_dump(mode="json"),
            expires_us=expires_us,
        )
    )
    session.flush()
    for path, file in files.items():
        blob = blobs.record(session, project_id=held.project_id, within_quota=False, **file.identity)
        session.add(SceneFile(scene_id=scene_id, path=path, blob_id=blob.id, media_type=media_type(path)))
    return scene_id
