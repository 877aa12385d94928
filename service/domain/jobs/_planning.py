"""A reconstruction of a long drive becomes a tree of jobs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from sqlalchemy.orm import Session

from schemas.api.jobs import JobKind
from service.domain.jobs._completion import cancelled, requeue
from service.domain.jobs._queries import Claim, locked
from service.domain.jobs._requests import create
from service.domain.jobs._submaps import MAPPED_PERCENT, tell_submaps


@dataclass(frozen=True, kw_only=True)
class SubmapPlace:
    """Place of a sub-map in its drive.

    Attributes
    ----------
    number
        From 1.
    total
        Sub-maps of the drive.
    first_unit, last_unit
        Indices of frames in the manifest, both inclusive.
    """

    number: int
    total: int
    first_unit: int
    last_unit: int


def wait_for_submaps(session: Session, held: Claim, places: Sequence[SubmapPlace]) -> list[str]:
    """Record a job for each sub-map that is not finished, and give the reconstruction back until they have ended.

    No attempt is blamed for it. A reconstruction whose end was asked for ends here.

    Returns
    -------
    list of str
        The jobs.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more; the caller's session must roll back.
    """
    parent = locked(session, held.job_id)
    if parent.cancel_requested_us is not None:
        cancelled(session, held)
        return []
    values = {
        "waiting_for": len(places),
        "children_percent": MAPPED_PERCENT,
        "eta_low_s": None,
        "eta_high_s": None,
    }
    requeue(session, held, "planned", None, not_before_us=0, values=values)
    made = [
        create(
            session,
            project_id=held.project_id,
            kind=JobKind.SUBMAP,
            drive_id=held.drive_id,
            settings=held.settings,
            expires_us=parent.expires_us,
            is_child=True,
            parent_id=held.job_id,
            request=asdict(place),
        )
        for place in places
    ]
    tell_submaps(session, held.job_id)
    return [job.id for job in made]
