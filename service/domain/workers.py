"""Workers that are known."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from service.database.connections import clock_us
from service.database.tables import WorkerSeen

ONLINE_US = 60_000_000  # a worker that reported within this time is online


def count_processes(session: Session, queue: str) -> int:
    """Processes of the workers that are online and take jobs from a queue."""
    online = session.scalars(select(WorkerSeen).where(WorkerSeen.seen_us > clock_us(session) - ONLINE_US))
    return sum(worker.concurrency for worker in online if queue in worker.queues.split(","))


def report(session: Session, *, name: str, queues: Sequence[str], concurrency: int) -> None:
    """Note that a worker's main process is there."""
    now = clock_us(session)  # other hosts compare it
    row = session.get(WorkerSeen, name)
    if row is None:
        session.add(
            WorkerSeen(name=name, queues=",".join(queues), concurrency=concurrency, started_us=now, seen_us=now)
        )
    else:
        row.queues, row.concurrency, row.seen_us = ",".join(queues), concurrency, now


def leave(session: Session, name: str) -> None:
    """Drop a worker that was told to stop: it takes no jobs any more, and nobody has to look after it."""
    session.execute(delete(WorkerSeen).where(WorkerSeen.name == name))


def forget(session: Session, *, unseen_since_us: int) -> None:
    """Drop workers that have not been seen for long."""
    session.execute(delete(WorkerSeen).where(WorkerSeen.seen_us < unseen_since_us))
