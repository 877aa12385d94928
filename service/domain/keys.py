"""Projects and their API keys."""

from __future__ import annotations

import hashlib
import secrets
import time

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.database.connections import Database
from service.database.tables import ApiKey, ConsoleSession, Project, now_us
from service.settings import Settings

FIRST_PROJECT = "default"
_MAX_KNOWN = 10_000
SESSION_PREFIX = "session_"  # of the secrets of the console's sessions
_PREFIX = "mrasfm_"  # lets secret scanners recognise a key that was pushed somewhere


def secret_sha256(secret: str) -> str:
    """Hash of a key, which is all that is stored. A plain hash suffices: the secret has 256 random bits."""
    return hashlib.sha256(secret.encode()).hexdigest()


def create_project(session: Session, name: str, settings: Settings) -> Project:
    """A new project with the settings' quotas."""
    project = Project(
        name=name,
        max_bytes=settings.project_max_bytes,
        max_active_jobs=settings.project_max_active_jobs,
        max_drives=settings.project_max_drives,
    )
    session.add(project)
    session.flush()
    return project


def find_project(session: Session, name: str) -> Project | None:
    """The project of this name."""
    return session.scalar(select(Project).where(Project.name == name))


def create_key(session: Session, project: Project, name: str) -> tuple[ApiKey, str]:
    """A new key of a project, and its secret, which is not kept."""
    secret = _PREFIX + secrets.token_urlsafe(32)
    key = ApiKey(project_id=project.id, name=name, secret_sha256=secret_sha256(secret))
    session.add(key)
    session.flush()
    return key, secret


def revoke_key(session: Session, key_id: str) -> bool:
    """End a key; False where there is none of this id."""
    key = session.get(ApiKey, key_id)
    if key is None:
        return False
    key.revoked_us = key.revoked_us or now_us()
    return True


def is_session(secret: str) -> bool:
    """Return whether a secret is a session's of the console, and not a key."""
    return secret.startswith(SESSION_PREFIX)


def project_of(session: Session, secret: str) -> str | None:
    """The id of the project that a key, or a session of the console, opens; None where it opens none."""
    keys = select(ApiKey.project_id).where(ApiKey.revoked_us.is_(None))
    if not is_session(secret):
        return session.scalar(keys.where(ApiKey.secret_sha256 == secret_sha256(secret)))
    mine = (ConsoleSession.secret_sha256 == secret_sha256(secret)) & (ConsoleSession.expires_us > now_us())
    return session.scalar(keys.join(ConsoleSession, ConsoleSession.key_id == ApiKey.id).where(mine))


class KeyRing:
    """Remembers for some seconds which project a key or session opens: who sends files sends many with one key.

    A key that is revoked ends within `KEPT_S`, and an answer that goes on for long where it asks `find` again.
    """

    KEPT_S = 3.0

    def __init__(self, database: Database) -> None:
        self._database = database
        self._known: dict[str, tuple[str, float]] = {}  # by the secret's hash: project, and until when

    def remembered(self, secret: str) -> str | None:
        """The project's id if the key was looked up a moment ago; never waits."""
        project_id, until_s = self._known.get(secret_sha256(secret), ("", 0.0))
        return project_id if time.monotonic() < until_s else None

    def find(self, secret: str) -> str | None:
        """The project's id, remembered or looked up."""
        return self.remembered(secret) or self.look_up(secret)

    def forget(self, secret: str) -> None:
        """Look the secret up when it comes next."""
        self._known.pop(secret_sha256(secret), None)

    def look_up(self, secret: str) -> str | None:
        """The project's id from the database; None where the key opens none."""
        with self._database.read() as session:
            project_id = project_of(session, secret)
        if project_id is not None:
            if len(self._known) >= _MAX_KNOWN:
                self._known.clear()
            self._known[secret_sha256(secret)] = (project_id, time.monotonic() + self.KEPT_S)
        return project_id


def ensure_first_key(settings: Settings) -> str | None:
    """Make the first project and key where there is none yet.

    Returns
    -------
    str or None
        The key's secret, which cannot be shown again; None where keys were made before.
    """
    database = Database.from_settings(settings)
    try:
        with database.write() as session:
            if session.scalar(select(ApiKey.id).limit(1)) is not None:
                return None
            project = find_project(session, FIRST_PROJECT) or create_project(session, FIRST_PROJECT, settings)
            return create_key(session, project, "first")[1]
    finally:
        database.close()
