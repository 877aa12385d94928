"""Exports as jobs, from the request to the files: only the engine is a process of its own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pycolmap
import pytest

from schemas.api.exports import ExportRequest
from schemas.api.jobs import JobKind
from schemas.api.scenes import SceneComponent, SceneSummary
from service.database.tables import Blob, Drive, Export, ExportFile, Job, Scene
from service.domain import exports, jobs, scenes
from service.errors import DriveDeleted, ExportDeleted
from tests.helpers.export_images import USUAL, written
from tests.helpers.service_world import World, wait_until
from worker import job_execution
from worker.job_execution import Runner
from worker.outcomes import Succeeded

SUMMARY = SceneSummary(
    registered_units=4, units=5, registered_images=7, images=10, points=50, georeferenced=True, warnings=0,
    engine_version="0.1.0", components=[
        SceneComponent(
            component=1, folder="components/1", georeferenced=True, registered_units=4, registered_images=7, points=50
        )
    ],
)  # fmt: skip


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    """Records and files alone; messages are not needed."""
    made = World(tmp_path / "world")
    yield made
    made.close()


@pytest.fixture
def scene_id(world: World, tmp_path: Path) -> str:
    """The example as a drive and a scene of the service."""
    written(tmp_path, USUAL)
    drive_id = world.add_drive(tmp_path / "drive")
    return publish_scene(world, drive_id, tmp_path / "scene")


def publish_scene(world: World, drive_id: str, folder: Path) -> str:
    """A folder as the scene of a drive, and once more as a component of that scene."""
    files = {
        path.relative_to(folder).as_posix(): world.store(path) for path in folder.rglob("*") if path.is_file()
    }  # fmt: skip
    files |= {f"components/1/{path}": file for path, file in files.items()}
    job_id = world.ask(drive_id, wake=False)
    with world.database.write() as session:
        held = jobs.claim(session, job_id, owner="test", lease_us=60_000_000)
        assert held is not None
        return scenes.publish(session, held, files=files, summary=SUMMARY, expires_us=None)


def ask(world: World, scene_id: str, *formats: str, **options: object) -> tuple[str, str | None]:
    """Ask for an export; its id, and its job's where one is new."""
    with world.database.write() as session:
        export, job = exports.create(
            session,
            project_id=world.project_id,
            subject=session.get_one(Scene, scene_id),
            asked=ExportRequest(formats=list(formats), **options),
            job_expires_us=None,
        )
        return export.id, None if job is None else job.id


def run(world: World, job_id: str) -> Job:
    Runner(world.settings).run(job_id)
    return world.job(job_id)


def export_of(world: World, export_id: str) -> Export:
    with world.database.read() as session:
        return session.get_one(Export, export_id)


def fetched(world: World, export_id: str, target: Path) -> Path:
    """All files of an export in a folder."""
    with world.database.read() as session:
        keys = {
            file.path: session.get_one(Blob, file.blob_id).key
            for file in session.query(ExportFile).filter_by(export_id=export_id)
        }
    for path, key in keys.items():
        (target / path).parent.mkdir(parents=True, exist_ok=True)
        (target / path).write_bytes(world.artifacts.read(key))
    return target


@pytest.mark.engine
def test_an_export_with_images_is_made_of_the_drives_files(world: World, scene_id: str, tmp_path: Path) -> None:
    export_id, job_id = ask(world, scene_id, "colmap", "kitti", image_size_px=320)
    assert job_id is not None
    job = run(world, job_id)
    assert job.state == "SUCCEEDED", job.problem
    found = fetched(world, export_id, tmp_path / "found")
    model = pycolmap.Reconstruction(str(found / "colmap" / "sparse" / "0"))
    assert len(model.images) == 7
    assert all(max(camera.width, camera.height) == 320 for camera in model.cameras.values())
    assert len(list((found / "colmap" / "images").iterdir())) == 7
    assert len((found / "kitti" / "00" / "poses.txt").read_text().splitlines()) == 4
    export = export_of(world, export_id)
    assert export.fence == 1
    assert export.results is not None
    assert [result["format"] for result in export.results] == ["colmap", "kitti"]
    assert all(result["withheld"] is None and result["files"] > 0 for result in export.results)
    stages = [event.data["stage"] for event in world.events(job_id) if event.kind == "progress"]
    assert stages, "progress is told"
    assert job.percent == 100.0
    # The same again is there; other options are another export.
    assert ask(world, scene_id, "kitti", "colmap", image_size_px=320) == (export_id, None)
    assert ask(world, scene_id, "colmap", image_size_px=320)[1] is not None


def test_files_that_are_alike_are_one_object(world: World, scene_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Masks are often alike. An object for each would have no record, and lie in the store for a day."""

    def made(*_: object, scratch: Path, **__: object) -> Succeeded:
        out = scratch / "made"
        out.mkdir()
        for name, content in (("a.png", b"mask"), ("b.png", b"mask"), ("c.png", b"another")):
            (out / name).write_bytes(content)
        return Succeeded(report={"results": []}, out=out)

    monkeypatch.setattr(job_execution, "run_attempt", made)
    export_id, job_id = ask(world, scene_id, "kitti")
    assert job_id is not None
    before = {item.key for item in world.artifacts.objects()}
    job = run(world, job_id)
    assert job.state == "SUCCEEDED", job.problem
    with world.database.read() as session:
        blob_ids = [file.blob_id for file in session.query(ExportFile).filter_by(export_id=export_id)]
        recorded = {session.get_one(Blob, blob_id).key for blob_id in blob_ids}
    assert (len(blob_ids), len(recorded)) == (3, 2)
    assert {item.key for item in world.artifacts.objects()} - before == recorded


@pytest.mark.slow
@pytest.mark.engine
def test_what_the_engine_refuses_ends_the_job_with_its_words(world: World, scene_id: str) -> None:
    """An image of the drive is another by now: as if a disk had lied."""
    export_id, job_id = ask(world, scene_id, "nerfstudio")
    assert job_id is not None
    with world.database.write() as session:
        keys = session.query(Blob.key, Blob.id).filter(Blob.size_bytes > 100_000).all()
    for key, _ in keys:
        (world.settings.data_dir / "artifacts" / key).write_bytes(b"\x89PNG damaged")
    job = run(world, job_id)
    assert (job.state, (job.problem or {})["title"]) == ("FAILED", "Nothing could be exported")
    assert str(world.settings.data_dir) not in str(job.problem)
    assert export_of(world, export_id).results is None
    # Asked for again, it is another export with another job; retried, the same with another.
    assert ask(world, scene_id, "nerfstudio")[0] != export_id
    with world.database.write() as session:
        new = exports.retry(session, session.get_one(Job, job_id), expires_us=None)
        assert session.get_one(Export, export_id).job_id == new.id
        assert (new.kind, new.retry_of, new.request) == (JobKind.EXPORT, job_id, {"export_id": export_id})


@pytest.mark.engine
def test_formats_without_images_need_no_drive_also_of_a_component(world: World, scene_id: str) -> None:
    with world.database.write() as session:
        session.delete(session.get_one(Drive, session.get_one(Scene, scene_id).drive_id))
    with pytest.raises(DriveDeleted):
        ask(world, scene_id, "kitti", "colmap")
    export_id, job_id = ask(world, scene_id, "kitti", "geojson", component=1)
    assert job_id is not None
    job = run(world, job_id)
    assert job.state == "SUCCEEDED", job.problem
    results = export_of(world, export_id).results or []
    assert [(result["format"], result["files"]) for result in results] == [("geojson", 3), ("kitti", 4)]


def test_cancel_and_fencing(world: World, scene_id: str) -> None:
    export_id, job_id = ask(world, scene_id, "kitti")
    assert job_id is not None
    with world.database.write() as session:
        old = jobs.claim(session, job_id, owner="a", lease_us=1)
        assert old is not None
        jobs.release(session, old)
        held = jobs.claim(session, job_id, owner="b", lease_us=60_000_000)
        assert held is not None
    with pytest.raises(jobs.FencedError), world.database.write() as session:
        exports.publish(session, old, files={}, results=[], expires_us=None)
    assert export_of(world, export_id).results is None
    with world.database.write() as session:
        jobs.request_cancel(session, job_id)
        jobs.cancelled(session, held)
    assert world.job(job_id).state == "CANCELLED"
    assert ask(world, scene_id, "kitti")[0] != export_id, "a cancelled one is made anew"


def test_an_export_that_was_deleted_ends_its_job(world: World, scene_id: str) -> None:
    export_id, job_id = ask(world, scene_id, "kitti")
    assert job_id is not None
    with world.database.write() as session:
        session.delete(session.get_one(Export, export_id))
    job = run(world, job_id)
    assert (job.state, (job.problem or {})["type"]) == ("FAILED", "urn:mrasfm:problem:export-deleted")
    with world.database.write() as session, pytest.raises(ExportDeleted):
        exports.retry(session, session.get_one(Job, job_id), expires_us=None)


def test_retention(world: World, scene_id: str) -> None:
    """An export goes at its date, not while it is made; one without a result goes with its job's record."""
    export_id, job_id = ask(world, scene_id, "kitti")
    other, other_job = ask(world, scene_id, "geojson")
    assert job_id is not None
    with world.database.write() as session:
        session.get_one(Export, export_id).expires_us = 1
        session.delete(session.get_one(Job, other_job))
    with world.database.write() as session:
        assert exports.forget_expired(session, 2) == 1
    assert export_of(world, export_id).id == export_id
    with world.database.read() as session:
        assert session.get(Export, other) is None
    world.cancel(job_id)
    with world.database.write() as session:
        assert exports.forget_expired(session, 2) == 1
        assert exports.forget_expired(session, 2) == 0


@pytest.mark.engine
def test_over_broker_and_worker(tmp_path: Path) -> None:
    """The message goes to the queue of short jobs."""
    world = World(tmp_path / "world")
    world.broker.start()
    try:
        written(tmp_path, USUAL)
        scene_id = publish_scene(world, world.add_drive(tmp_path / "drive"), tmp_path / "scene")
        export_id, job_id = ask(world, scene_id, "kitti")
        assert job_id is not None
        world.start_worker("checks")
        world.wake(job_id)
        assert world.wait_for_end(job_id).state == "SUCCEEDED"
        wait_until(lambda: export_of(world, export_id).results is not None, "the export")
        assert (fetched(world, export_id, tmp_path / "found") / "kitti" / "00" / "calib.txt").is_file()
    finally:
        world.close()
