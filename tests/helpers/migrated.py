"""Migrated databases. Hundreds of tests begin with an empty one, and to migrate it takes a fifth of a second."""

from __future__ import annotations

import shutil
import tempfile
from functools import cache
from pathlib import Path

from sqlalchemy import make_url

from service.database.connections import migrate
from service.settings import Settings


def migrated(settings: Settings) -> None:
    """Do as `migrate` does; a new SQLite database is the copy of one that this process has migrated before."""
    url = make_url(settings.resolved_database_url)
    path = Path(url.database or "")
    if url.get_backend_name() != "sqlite" or url.query or path.exists():
        migrate(settings)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_new_database())


@cache
def _new_database() -> bytes:
    folder = Path(tempfile.mkdtemp(prefix="migrated"))
    try:
        migrate(Settings(data_dir=folder, database_url=None))
        (file,) = folder.iterdir()  # nothing lies in a journal beside it
        return file.read_bytes()
    finally:
        shutil.rmtree(folder)
