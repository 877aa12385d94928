"""Sessions of the web console: a key is given once, and a cookie that scripts cannot read stands for it."""

from __future__ import annotations

import secrets
from dataclasses import dataclass

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from service.database.tables import ApiKey, ConsoleSession, Project, now_us
from service.domain.keys import SESSION_PREFIX, is_session, secret_sha256

KEPT_S = 12 * 3600
_MAX_OF_A_KEY = 200  # the oldest end first: whoever logs in in a loop fills no database


@dataclass(frozen=True, kw_only=True)
class Opened:
    """The key that a request's secret stands for, and what the key opens."""

    key: ApiKey
    project: Project
    expires_us: int | None  # of the session; None for a key itself


def begin(session: Session, key_id: str) -> tuple[str, int]:
    """A new session of a key: its secret, which is not kept, and when it ends in microseconds since 1970."""
    session.execute(delete(ConsoleSession).where(ConsoleSession.expires_us <= now_us()))
    of_key = select(ConsoleSession.id).where(ConsoleSession.key_id == key_id)
    surplus = session.scalars(of_key.order_by(ConsoleSession.created_us.desc()).offset(_MAX_OF_A_KEY - 1)).all()
    session.execute(delete(ConsoleSession).where(ConsoleSession.id.in_(surplus)))
    secret, expires_us = SESSION_PREFIX + secrets.token_urlsafe(32), now_us() + KEPT_S * 1_000_000
    session.add(ConsoleSession(key_id=key_id, secret_sha256=secret_sha256(secret), expires_us=expires_us))
    return secret, expires_us


def end(session: Session, secret: str) -> None:
    """End a session; without effect where there is none."""
    session.execute(delete(ConsoleSession).where(ConsoleSession.secret_sha256 == secret_sha256(secret)))


def opened_by(session: Session, secret: str) -> Opened | None:
    """The key and project that a key's or session's secret opens; None where it opens none any more."""
    expires_us: int | None = None
    keys = select(ApiKey, Project).join(Project, ApiKey.project_id == Project.id).where(ApiKey.revoked_us.is_(None))
    if is_session(secret):
        found = session.scalar(
            select(ConsoleSession).where(
                ConsoleSession.secret_sha256 == secret_sha256(secret), ConsoleSession.expires_us > now_us()
            )
        )
        if found is None:
            return None
        keys, expires_us = keys.where(ApiKey.id == found.key_id), found.expires_us
    else:
        keys = keys.where(ApiKey.secret_sha256 == secret_sha256(secret))
    row = session.execute(keys).first()
    return None if row is None else Opened(key=row[0], project=row[1], expires_us=expires_us)
