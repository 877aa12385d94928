"""Workers that are known."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import delete
from sqlalchemy.orm import Session

from service.database.tables import WorkerSeen, now_us


def report(session: Session, *, name: str, queues: Sequence[str], concurrency: int) -> None:
    """Note that a worker's main process is there."""
    row = session.get(WorkerSeen, name)
    if row is None:
        session.add(WorkerSeen(name=name, queues=",".join(queues), concurrency=concurrency))
    else:
        row.queues, row.concurrency, row.seen_us = ",".join(queues), concurrency, now_us()


def forget(session: Session, *, unseen_since_us: int) -> None:
    """Drop workers that have not been seen for long."""
    session.execute(delete(WorkerSeen).where(WorkerSeen.seen_us < unseen_since_us))
