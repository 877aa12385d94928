"""Passes of the reconciler: when each was last made, by whichever process."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.database.connections import clock_us
from service.database.tables import Pass

JOBS = "jobs"  # lost messages and lost workers: what has to go on while jobs are to be done
SWEEP, WEBHOOKS, ORPHANS = "sweep", "webhooks", "orphans"
_ALIVE_S = 60.0
_MISSED = 3  # passes


def note(session: Session, name: str) -> None:
    """Note that a pass was made just now."""
    session.merge(Pass(name=name, done_us=clock_us(session)))  # other hosts compare it


def ages_us(session: Session) -> dict[str, int]:
    """Time since the last of each pass that was ever made; below zero where the clock was set back since."""
    now = clock_us(session)
    return {row.name: now - row.done_us for row in session.scalars(select(Pass))}


def are_made(session: Session, *, every_s: float) -> bool:
    """True where a reconciler has looked after the jobs lately, who does it every `every_s`."""
    age_us = ages_us(session).get(JOBS)
    return age_us is not None and age_us < 1e6 * max(_ALIVE_S, _MISSED * every_s)
