"""Idempotency keys: a POST that is repeated under its key has its effect once.

The key is held first, in a transaction of its own, so that a second request sees the first in flight. The effect and
the answer that will be replayed are committed together: whenever the process is killed, either both are there or none.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import delete, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from service.errors import ServiceError
from service.persistence.database import Database
from service.persistence.tables import IdempotencyKey, Job, new_id, now_us

# After this a request's process is believed dead. Most take seconds; a preparation has minutes.
_HELD_FOR_US = 60_000_000
_HELD_TO_PREPARE_US = 300_000_000


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a POST answers, and which jobs it made."""

    status: int
    body: Any  # JSON
    headers: Mapping[str, str] = field(default_factory=dict)
    jobs: tuple[Job, ...] = ()
    replayed: bool = False


Effect = Callable[[Session], Answer]


def once(
    database: Database,
    effect: Effect,
    *,
    project_id: str,
    key: str | None,
    request_sha256: str,
    keep_us: int,
    prepare: Callable[[], None] | None = None,
) -> Answer:
    """Run `effect` in one transaction, or replay the answer that it had under this key.

    Parameters
    ----------
    effect
        May be run a second time, where nothing of the first is left: see `Database.transact`.
    key
        The client's; None runs the effect.
    request_sha256
        Of method, path and body: the same key with another request is refused.
    keep_us
        How long answers are replayed.
    prepare
        Runs before the effect, outside its transaction, and not for a replay: what takes long must not keep other
        writers waiting.

    Raises
    ------
    ServiceError
        409 while the first request is in flight, 422 where the key was used for another request, and all that the
        effect and its preparation raise: then the key is free again.
    """
    if key is None:
        if prepare is not None:
            prepare()
        return database.transact(effect)
    holder = new_id("idk")
    hold_us = _HELD_FOR_US if prepare is None else _HELD_TO_PREPARE_US
    with database.write() as session:
        replay = _hold(
            session, project_id, key, holder=holder, request_sha256=request_sha256, keep_us=keep_us, hold_us=hold_us
        )
    if replay is not None:
        return replay

    def recorded_effect(session: Session) -> Answer:
        answer = effect(session)
        values = {"status": answer.status, "headers": dict(answer.headers), "body": json.dumps(answer.body)}
        mine = update(IdempotencyKey).where(*_mine(project_id, key, holder))
        if not session.execute(mine.values(**values)).rowcount:  # type: ignore[attr-defined]
            raise _in_flight(key)  # it took so long that another request took the key over
        return answer

    with _freed_on_error(database, project_id, key, holder):
        if prepare is not None:
            prepare()
        return database.transact(recorded_effect)


def _mine(project_id: str, key: str, holder: str) -> tuple[Any, ...]:
    return (IdempotencyKey.project_id == project_id, IdempotencyKey.key == key, IdempotencyKey.holder == holder)


def _hold(
    session: Session, project_id: str, key: str, *, holder: str, request_sha256: str, keep_us: int, hold_us: int
) -> Answer | None:
    insert = postgresql.insert if session.get_bind().dialect.name == "postgresql" else sqlite.insert
    now = now_us()
    outlived = (IdempotencyKey.project_id == project_id, IdempotencyKey.key == key)
    session.execute(delete(IdempotencyKey).where(*outlived, IdempotencyKey.created_us < now - keep_us))
    statement = insert(IdempotencyKey).values(
        project_id=project_id,
        key=key,
        request_sha256=request_sha256,
        holder=holder,
        held_until_us=now + hold_us,
        created_us=now,
    )
    if session.execute(statement.on_conflict_do_nothing().returning(IdempotencyKey.holder)).first() is not None:
        return None
    row = session.get(IdempotencyKey, (project_id, key), with_for_update=True)
    if row is None:  # the other request failed at this moment, and freed the key
        raise _in_flight(key)
    if row.request_sha256 != request_sha256:
        raise ServiceError(
            422,
            "idempotency-key-reused",
            "The idempotency key was used for another request",
            f"Idempotency-Key {key!r} was used before, for a request with another path or body",
            remedy="Make a new key for every new request; repeat a request unchanged.",
        )
    if row.status is not None:
        body, headers = json.loads(row.body or "null"), row.headers or {}
        return Answer(status=row.status, body=body, headers=headers, replayed=True)
    if row.held_until_us > now:
        raise _in_flight(key)
    row.holder, row.held_until_us = holder, now + hold_us
    return None


def _in_flight(key: str) -> ServiceError:
    return ServiceError(
        409,
        "request-in-flight",
        "The same request is being served",
        f"a request with Idempotency-Key {key!r} has not been answered yet",
        remedy="Repeat it in a second.",
        headers={"Retry-After": "1"},
    )


@contextlib.contextmanager
def _freed_on_error(database: Database, project_id: str, key: str, holder: str) -> Iterator[None]:
    try:
        yield
    except BaseException:
        with contextlib.suppress(Exception), database.write() as session:  # else the hold ends by itself
            session.execute(
                delete(IdempotencyKey).where(*_mine(project_id, key, holder), IdempotencyKey.status.is_(None))
            )
        raise
