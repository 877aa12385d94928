"""What the kinds of jobs differ in."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import pytest
from sqlalchemy.exc import OperationalError

from schemas.api.jobs import JobKind
from service.database.connections import Database
from service.domain import jobs
from service.domain.checkpoints import MapShelf
from service.settings import Settings
from worker.job_handlers import handler_of


def test_an_aggregation_reads_its_inputs_where_it_needs_them(tmp_path: Path) -> None:
    """Its publication, after hours of work, does not: there a database that fails is asked again."""
    settings = Settings(data_dir=tmp_path)
    database = Database.from_settings(settings)  # that has no tables
    held = jobs.Claim(
        job_id="job_1", fence=1, attempt=1, project_id="prj_1", kind=JobKind.AGGREGATION, drive_id=None, map_id="map_1",
        settings={},
    )  # fmt: skip
    handler = handler_of(database, held, settings)
    with pytest.raises(OperationalError):
        _ = handler.shelf
    database.close()


def test_every_pair_of_scenes_has_a_checkpoint_of_its_own_name() -> None:
    scenes = {name: f"scn_{number}" for number, name in enumerate(("a", "a--b", "b--c", "c"))}
    shelf = MapShelf.from_scenes("map_1", "prj_1", scenes=scenes, settings={})
    assert set(shelf.digests) == {f"seam-{a}~{b}.npz" for a, b in permutations(scenes, 2)}
    assert len(shelf.digests) == len(set(shelf.digests.values())) == 12
