"""Rows of a project: what belongs to another project does not exist."""

from __future__ import annotations

import re
from typing import TypeVar

from sqlalchemy.orm import Session

from service.database.tables import Drive, Export, Job, Map, Scene, Upload
from service.errors import not_found

Row = TypeVar("Row", Drive, Export, Job, Map, Scene, Upload)

_ID = re.compile(r"[a-z]{3}_[0-9a-f]{1,36}")
_NAMES = {Drive: "drive", Export: "export", Job: "job", Map: "map", Scene: "scene", Upload: "upload"}


def is_id(text: str) -> bool:
    """Return whether a text can be an id of ours; other texts may hold what a database refuses in a parameter."""
    return _ID.fullmatch(text) is not None


def require(session: Session, table: type[Row], project_id: str, row_id: str, *, lock: bool = False) -> Row:
    """The project's row of this id.

    Parameters
    ----------
    lock
        Read it anew and keep others from changing it until the session ends.

    Raises
    ------
    ServiceError
        404, the same for what never was, what was deleted and what belongs to another project.
    """
    row = None
    if is_id(row_id):
        row = session.get(table, row_id, with_for_update=lock or None, populate_existing=lock)
    if row is None or row.project_id != project_id:
        raise not_found(_NAMES[table], row_id)
    return row
