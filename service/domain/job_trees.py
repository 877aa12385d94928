"""Trees of jobs, kept in step: one transaction for each job, so that none waits for another's."""

from __future__ import annotations

from service.database.connections import Database
from service.domain import jobs


def tend(database: Database) -> None:
    """Let jobs begin for which others have ended, and end those that none needs any more."""
    with database.read() as session:
        untold = jobs.untold_parents(session)
    for job_id in untold:
        with database.write() as session:
            jobs.look_at_submaps(session, job_id)
    with database.write() as session:
        jobs.tend(session)
    end_orphans(database)


def end_orphans(database: Database) -> list[str]:
    """Ask for the end of jobs that were made for others, none of which waits for them any more.

    Returns
    -------
    list of str
        The jobs.
    """
    ended: list[str] = []
    while found := _orphans(database):
        before = len(ended)
        for job_id in found:
            with database.write() as session:
                if jobs.cancel_orphan(session, job_id):
                    ended.append(job_id)
        if len(ended) == before:  # each has ended by itself, or is needed again
            break
    return ended


def _orphans(database: Database) -> list[str]:
    """Jobs that none needs; a reconstruction that is ended leaves its sub-maps."""
    with database.read() as session:
        return jobs.orphans(session)
