"""What the kinds of jobs differ in."""

from __future__ import annotations

import json
from itertools import permutations
from pathlib import Path

import pytest
from sqlalchemy.exc import OperationalError

from schemas.api.jobs import JobKind
from service.database.connections import Database
from service.domain import checkpoints, jobs
from service.domain.checkpoints import MapShelf, settings_sha256
from service.domain.drive_checkout import check_out
from service.settings import Settings
from service.storage.blob_writer import file_sha256, store_file
from tests.helpers.service_world import World
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
    shelf = MapShelf("map_1", "prj_1", scenes, settings_sha256({}))
    seams = {f"seam-{a}~{b}.npz" for a, b in permutations(scenes, 2)}
    digests = {name: shelf.digest(name) or "" for name in (*seams, "scales.npz")}
    assert "" not in digests.values()
    assert len(set(digests.values())) == 13, "and lengths of scenes without positions one for all"
    assert shelf.find({digest: digest for digest in digests.values()}) == digests
    assert shelf.find({digests["seam-a~c.npz"]: 1}) == {"seam-a~c.npz": 1}
    others = ("seam-a~d.npz", "seam-a~a.npz", "seam-a.npz", "seam-a~c", "features.npz", "../seam-a~c.npz")
    assert [shelf.digest(name) for name in others] == [None] * len(others)
    fewer = MapShelf("map_1", "prj_1", {"a": "scn_0", "c": "scn_3"}, settings_sha256({}))
    assert fewer.digest("seam-a~c.npz") == digests["seam-a~c.npz"]
    assert fewer.digest("scales.npz") != digests["scales.npz"]
    under_others = MapShelf("map_1", "prj_1", scenes, settings_sha256({"seed": 1}))
    assert {under_others.digest(name) for name in digests}.isdisjoint(digests.values())


def test_a_sub_map_brings_its_own_stages_and_the_plans(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    database = Database.from_settings(settings)
    held = jobs.Claim(
        job_id="job_1", fence=1, attempt=1, project_id="prj_1", kind=JobKind.SUBMAP, drive_id="drv_1", map_id=None,
        settings={}, request={"number": 1, "total": 12, "first_unit": 0, "last_unit": 99},
    )  # fmt: skip
    handler = handler_of(database, held, settings)
    files = ["standing.npz", "own-car.npz", "submaps.npz", "features.npz", "submap-1-features.npz"]
    files += ["submap-1-mapping.npz", "submap-11-features.npz", "submap-2-matches.npz"]
    assert [name for name in files if handler.is_wanted(name)] == [*files[:3], *files[4:6]]
    database.close()


def test_a_part_of_a_drive_is_laid_out(tmp_path: Path, brief_drive: Path) -> None:
    """And the digests of all its files, which name the whole."""
    world = World(tmp_path / "world")
    drive_id = world.add_drive(brief_drive)
    target, done = tmp_path / "part", list[tuple[int, int]]()
    fetch = world.artifacts.fetch
    drive = check_out(world.database, drive_id, target, fetch=fetch, units=range(1, 3))
    drive.bring_all(fetch, lambda *count: done.append(count))
    manifest = json.loads((brief_drive / "drive.json").read_bytes())
    images = [image for frame in manifest["frames"] for image in frame["images"].values()]
    named = {name for image in images for name in (image["file"], image.get("mask")) if name}
    wanted = [image for frame in manifest["frames"][1:3] for image in frame["images"].values()]
    brought = {path.relative_to(target).as_posix() for path in target.rglob("*") if path.is_file()}
    assert brought == {"drive.json"} | {name for image in wanted for name in (image["file"], image.get("mask")) if name}
    assert drive.content_sha256.keys() == named
    assert drive.size_bytes == sum((target / name).stat().st_size for name in brought - {"drive.json"})
    assert done[-1] == (len(brought) - 1, len(brought) - 1)
    world.close()


def test_stages_on_the_shelf(tmp_path: Path, brief_drive: Path) -> None:
    """Those of sub-maps that a drive is not cut into any more are dropped."""
    world = World(tmp_path / "world")
    shelf = checkpoints.DriveShelf(world.add_drive(brief_drive), "ab" * 32)
    names = ["submaps.npz", "submap-1-features.npz", "submap-2-features.npz", "submap-10-features.npz"]
    stored = {}
    for name in names:
        path = tmp_path / name
        path.write_text(name, encoding="utf-8")
        stored[name] = store_file(
            world.database, world.artifacts, project_id=world.project_id, path=path, sha256=file_sha256(path),
            size_bytes=path.stat().st_size,
        )  # fmt: skip
    with world.database.write() as session:
        assert checkpoints.keep(session, shelf, stored)
        assert checkpoints.missing(session, shelf, [*names, "submap-3-features.npz"]) == ["submap-3-features.npz"]
        checkpoints.drop_submaps(session, shelf, after=2)
        assert checkpoints.missing(session, shelf, names) == ["submap-10-features.npz"]
    folder = tmp_path / "restored"
    fetch = world.artifacts.fetch
    brought = checkpoints.restore(world.database, shelf, folder, fetch=fetch, is_wanted=lambda name: "-2-" in name)
    assert brought == [path.name for path in folder.iterdir()] == ["submap-2-features.npz"]
    world.close()
