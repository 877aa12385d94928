"""Idempotency keys: a POST that is repeated under its key has its effect once.

The key is held first, in a transaction of its own, so that a second request sees the first in flight. The effect and
the answer that will be replayed are committed together: whenever the process is killed, either both are there or none.
A hold is renewed while its process lives, and ends soon after it died: see `request_holds`. A request that lost its
hold, because its process was stopped for a while, commits nothing.
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

from service.database.connections import Database, clock_us
from service.database.tables import IdempotencyKey, Job, new_id
from service.domain.request_holds import Hold, HoldKeeper
from service.errors import IdempotencyKeyReused, RequestInFlight, ServiceError


@dataclass(frozen=True, kw_only=True)
class Answer:
    """Response to a POST, and the jobs that it made."""

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
    holds: HoldKeeper,
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
    holds
        Renews the hold until the request is answered.
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
    hold = Hold(project_id, key, new_id("idk"))
    with database.write() as session:
        replay = _take(session, hold, request_sha256=request_sha256, keep_us=keep_us, held_for_us=holds.held_for_us)
    if replay is not None:
        return replay

    def recorded_effect(session: Session) -> Answer:
        taken_over = _answered_by_another(session, hold)
        if taken_over is not None:
            return taken_over
        answer = effect(session)
        values = {"status": answer.status, "headers": dict(answer.headers), "body": json.dumps(answer.body)}
        mine = update(IdempotencyKey).where(hold.is_mine())
        if not session.execute(mine.values(**values)).rowcount:  # type: ignore[attr-defined]
            raise _in_flight(key)  # rolls the effect back
        return answer

    with _freed_on_error(database, hold), holds.renewed(hold):
        if prepare is not None:
            prepare()
        return database.transact(recorded_effect)


def _take(session: Session, hold: Hold, *, request_sha256: str, keep_us: int, held_for_us: int) -> Answer | None:
    """Hold the key; None where that was possible, the answer where the request has one already."""
    insert = postgresql.insert if session.get_bind().dialect.name == "postgresql" else sqlite.insert
    now = clock_us(session)  # several hosts compare these times
    project_id, key = hold.project_id, hold.key
    outlived = (IdempotencyKey.project_id == project_id, IdempotencyKey.key == key)
    session.execute(delete(IdempotencyKey).where(*outlived, IdempotencyKey.created_us < now - keep_us))
    statement = insert(IdempotencyKey).values(
        project_id=project_id,
        key=key,
        request_sha256=request_sha256,
        holder=hold.holder,
        held_until_us=now + held_for_us,
        created_us=now,
    )
    if session.execute(statement.on_conflict_do_nothing().returning(IdempotencyKey.holder)).first() is not None:
        return None
    row = session.get(IdempotencyKey, (project_id, key), with_for_update=True)
    if row is None:  # the other request failed at this moment, and freed the key
        raise _in_flight(key)
    if row.request_sha256 != request_sha256:
        raise IdempotencyKeyReused(
            f"Idempotency-Key {key!r} was used before, for a request with another path or body",
            remedy="Make a new key for every new request; repeat a request unchanged.",
        )
    replay = _replay(row)
    if replay is not None:
        return replay
    now = clock_us(session)  # again: a renewal for which the row was waited for is later
    # A hold that ends later than any that begins now is from before the clock was set back.
    if now < row.held_until_us <= now + held_for_us:
        raise _in_flight(key)
    row.holder, row.held_until_us = hold.holder, now + held_for_us
    return None


def _answered_by_another(session: Session, hold: Hold) -> Answer | None:
    """The answer of the request that took the key over while this process was stopped; None where none did."""
    row = session.get(IdempotencyKey, (hold.project_id, hold.key))
    if row is not None and row.holder == hold.holder:
        return None
    replay = None if row is None else _replay(row)
    if replay is None:
        raise _in_flight(hold.key)
    return replay


def _replay(row: IdempotencyKey) -> Answer | None:
    if row.status is None:
        return None
    return Answer(status=row.status, body=json.loads(row.body or "null"), headers=row.headers or {}, replayed=True)


def _in_flight(key: str) -> ServiceError:
    return RequestInFlight(
        f"a request with Idempotency-Key {key!r} has not been answered yet",
        remedy="Repeat it in a second.",
        headers={"Retry-After": "1"},
    )


@contextlib.contextmanager
def _freed_on_error(database: Database, hold: Hold) -> Iterator[None]:
    try:
        yield
    except BaseException:
        with contextlib.suppress(Exception), database.write() as session:  # else the hold ends by itself
            session.execute(delete(IdempotencyKey).where(hold.is_mine(), IdempotencyKey.status.is_(None)))
        raise
