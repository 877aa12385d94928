"""Trees of jobs, kept in step: one transaction for each job, so that none waits for another's."""

from __future__ import annotations

from service.database.connections import Database
from service.domain import jobs


def tend(database: Database) -> None:
    """Let aggregations begin whose reconstructions have ended, and end reconstructions that none needs any more."""
    with database.write() as session:
        jobs.tend(session)
    end_orphans(database)


def end_orphans(database: Database) -> list[str]:
    """Ask for the end of jobs that were made for aggregations, none of which waits for them any more.

    Returns
    -------
    list of str
        The jobs.
    """
    with database.read() as session:
        found = jobs.orphans(session)
    ended = []
    for job_id in found:
        with database.write() as session:
            if jobs.cancel_orphan(session, job_id):
                ended.append(job_id)
    return ended
