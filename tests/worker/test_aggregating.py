"""Aggregations from the question to the map, with the real engine; only messages are left out, or sent for real."""

from __future__ import annotations

import itertools
import json
import shutil
from html import escape
from pathlib import Path
from typing import Any

import cv2
import pytest
from sqlalchemy import select

from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.synthetic.drive_writer import render_drives
from mrasfm_engine.synthetic.options import SynthOptions
from schemas.api.aggregations import AggregationRequest
from service.database.tables import Blob, Job, MapFile, MapScene, MapVersion
from service.domain import aggregations, jobs, scenes
from service.errors import DriveTwice
from service.job_queue import JobQueue
from tests.helpers.export_example import make_scene
from tests.helpers.export_images import USUAL, written
from tests.helpers.live_api import SUMMARY
from tests.helpers.service_world import TERMINAL, World, is_gone, kill, wait_until
from tests.helpers.small_scenes import drive_along, make_street
from tests.unit.aggregation.test_components_in_map import WAY, in_components
from worker.job_execution import Runner


@pytest.fixture(scope="session")
def two_drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two rendered drives of one street. Tests only read them."""
    out = tmp_path_factory.mktemp("rendered") / "drives"
    options = SynthOptions(cameras=4, units=14, seed=1, drives=2, width=480, height=270, texture_px=256)
    return render_drives(options, out)


@pytest.fixture
def unpowered(tmp_path: Path) -> World:
    """Records and files alone."""
    return World(tmp_path)


def ask(world: World, **asked: Any) -> tuple[Job, list[Job]]:
    with world.database.write() as session:
        return aggregations.create(
            session,
            project_id=world.project_id,
            asked=AggregationRequest.model_validate(asked),
            job_expires_us=None,
        )


def run(world: World, *found: Job) -> None:
    for job in found:
        Runner(world.settings).run(job.id)


def versions(world: World) -> list[MapVersion]:
    with world.database.read() as session:
        return list(session.scalars(select(MapVersion).order_by(MapVersion.number)))


def document(world: World, number: int, path: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(stored(world, number, path))
    return found


def stored(world: World, number: int, path: str) -> bytes:
    with world.database.read() as session:
        mine = (MapFile.number == number) & (MapFile.path == path)
        key = session.scalars(select(Blob.key).join(MapFile, MapFile.blob_id == Blob.id).where(mine)).one()
    return world.artifacts.read(key)


def paths(world: World, number: int) -> set[str]:
    with world.database.read() as session:
        return set(session.scalars(select(MapFile.path).where(MapFile.number == number)))


@pytest.mark.slow
def test_a_map_is_titled_by_its_name_and_a_drive_that_failed_is_a_finding(unpowered: World, tmp_path: Path) -> None:
    world = unpowered
    ids = [scene_of_example(world, tmp_path, name) for name in ("a", "b")]
    failing = world.add_drive(named_drive(tmp_path, "b_size"))
    job, (child,) = ask(world, scenes=ids, drives=[failing], name="kitti street")
    run(world, child, job)
    assert (world.job(child.id).state, world.job(job.id).state) == ("FAILED", "SUCCEEDED"), world.job(job.id).problem
    problem = world.job(child.id).problem
    assert problem is not None
    report, page = document(world, 1, "report.json"), stored(world, 1, "report.html").decode()
    assert report["name"] == "kitti street"
    assert "<title>kitti street: map</title>" in page
    assert '<p class="kind">Map</p><h1>kitti street</h1>' in page

    assert report["findings"][0] == {
        "severity": "warning",
        "code": "drive-left-out",
        "what": f"drive b_size is not in the map: {problem['detail']}",
        "remedy": problem["remedy"],
    }
    codes = [finding["code"] for finding in report["findings"]]
    assert codes.count("drive-left-out") == len(report["failed_drives"]) == 1
    (version,) = versions(world)
    assert version.summary["warnings"] == len(codes)
    assert "1 drive is not in the map: b_size" in page
    assert f"drive b_size is not in the map: {escape(problem['detail'])}" in page


@pytest.mark.slow
def test_two_drives_become_a_map(unpowered: World, two_drives: list[Path]) -> None:
    """One recording comes once; what was finished is reused; a version is made from another."""
    world = unpowered
    ids = [world.add_drive(folder) for folder in two_drives]
    again = world.add_drive(two_drives[0])
    job, due = ask(world, drives=ids)
    assert len(due) == 2
    run(world, *due)
    run(world, job)
    ended = world.job(job.id)
    assert (ended.state, ended.map_version) == ("SUCCEEDED", 1), ended.problem
    percents = [event.data["percent"] for event in world.events(job.id) if event.kind == "progress"]
    assert percents == sorted(percents)
    (version,) = versions(world)
    assert version.summary["registered_units"] == 28
    assert (version.summary["connected"], version.summary["seams"]) == (2, 1)
    assert {"points.ply", "poses.json", "poses.tum", "frame.json", "map.json", "report.json"} <= paths(world, 1)
    assert document(world, 1, "report.json")["failed_drives"] == []
    names = {scene["name"] for scene in document(world, 1, "map.json")["scenes"]}
    with world.database.read() as session:
        assert names == set(session.scalars(select(MapScene.name)))

    with pytest.raises(DriveTwice, match="have the same images"):
        ask(world, drives=[again], map_id=ended.map_id)
    assert len(versions(world)) == 1

    # Another map of the same scenes: nothing that takes long is done again.
    job, due = ask(world, drives=ids, name="again")
    assert [each.id for each in due] == [job.id]
    run(world, job)
    assert "seams" in world.job(job.id).reused
    assert list(world.settings.scratch_dir.iterdir()) == []


def publish_scene(world: World, folder: Path, drive: Path) -> tuple[str, str]:
    """A scene that was made elsewhere, as the result of a drive; ids of both."""
    drive_id = world.add_drive(drive)
    job_id = world.ask(drive_id, wake=False)
    files = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    stored = {name: world.store(path) for name, path in files.items()}
    with world.database.write() as session:
        held = jobs.claim(session, job_id, owner="worker@test", lease_us=60_000_000)
        assert held is not None
        return drive_id, scenes.publish(session, held, files=stored, summary=SUMMARY, expires_us=None)


def named_drive(root: Path, name: str) -> Path:
    """The example as a drive, one of its images with a mark; they show too little for a reconstruction."""
    written(root / name, USUAL)
    drive = root / name / "drive"
    manifest = json.loads((drive / "drive.json").read_text())
    (drive / "drive.json").write_text(json.dumps(manifest | {"name": name}))
    marked = min(drive.rglob("*.png"))
    image = cv2.imread(str(marked))
    cv2.imwrite(str(marked), cv2.putText(image, name, (9, 60), cv2.FONT_HERSHEY_SIMPLEX, 1.0, (0, 0, 0)))
    return drive


def scene_of_example(world: World, root: Path, name: str) -> str:
    """The example's scene, with other files of images than others of it, as that of a drive; its id."""
    drive = named_drive(root, name)
    write_scene(make_scene(folder=name), root / name / "made", {"settings": {"features": {"extractor": "sift"}}})
    return publish_scene(world, root / name / "made", drive)[1]


@pytest.mark.slow
def test_components_are_scenes_of_the_map(unpowered: World, two_drives: list[Path], tmp_path: Path) -> None:
    """Both components of a drive without positions, by a drive that has some; one elsewhere is left out."""
    world, folder = unpowered, tmp_path / "made"
    street, elsewhere = (make_street(length_m=36.0, points=1500, seed=seed) for seed in (0, 2))
    in_components(street, street, folder / "tunnel")
    in_components(street, elsewhere, folder / "shaft")
    drive_along(street, folder / "lit", WAY + 1.0, lateral_m=0.8, seed=2)
    made = zip(("tunnel", "lit"), two_drives, strict=True)
    ids = [publish_scene(world, folder / name, drive)[1] for name, drive in made]
    job, due = ask(world, scenes=ids)
    run(world, *due)
    ended = world.job(job.id)
    assert ended.state == "SUCCEEDED", ended.problem
    with world.database.read() as session:
        rows = session.scalars(select(MapScene).order_by(MapScene.name)).all()
        names = [scene.name for scene in rows]
        assert [scene.scene_id for scene in rows] == [ids[0], ids[0], ids[1]]
    tunnel, lit = names[0], names[2]
    assert names[1] == f"{tunnel}#1"
    assert {f"calibration/{name}.json" for name in names} <= paths(world, 1)
    assert {f"seams/{a}~{b}.npz" for a, b in itertools.combinations(names, 2)} <= paths(world, 1)

    # Their seams are found again, those of a component too.
    again, due = ask(world, scenes=ids, name="again")
    run(world, *due)
    assert "seams" in world.job(again.id).reused

    # A drive goes with all of its components; one that nothing places is named with its drive.
    drive_id, scene_id = publish_scene(world, folder / "shaft", two_drives[0])
    job, due = ask(world, map_id=ended.map_id, remove=[ids[0]], scenes=[scene_id])
    run(world, *due)
    ended = world.job(job.id)
    assert ended.state == "SUCCEEDED", ended.problem
    (version,) = (found for found in versions(world) if found.number == 2)
    placed = [scene["name"] for scene in document(world, 2, "map.json")["scenes"]]
    assert len(placed) == 2
    assert lit in placed
    (failed,) = version.failed
    assert (failed["name"], failed["drive_id"]) == (f"{next(n for n in placed if n != lit)}#1", drive_id)
    assert "no seam places it" in failed["problem"]["detail"]


@pytest.mark.slow
def test_a_scene_that_fits_into_no_map_is_left_out(unpowered: World, two_drives: list[Path]) -> None:
    """As its drive was driven without a receiver, elsewhere. Where all are required, it takes the others with it."""
    world = unpowered
    folder = Path(world.settings.data_dir) / "indoors"
    options = SynthOptions(cameras=4, units=8, seed=7, drives=1, width=480, height=270, texture_px=256)
    shutil.copytree(render_drives(options, Path(world.settings.data_dir) / "rendered")[0], folder)
    manifest = json.loads((folder / "drive.json").read_text())
    del manifest["gnss"]
    manifest["name"] = "indoors"
    (folder / "drive.json").write_text(json.dumps(manifest))
    ids = [world.add_drive(drive) for drive in (*two_drives, folder)]
    job, due = ask(world, drives=ids)
    run(world, *due, job)
    ended = world.job(job.id)
    assert (ended.state, ended.map_version) == ("SUCCEEDED", 1), ended.problem
    (version,) = versions(world)
    (failed,) = version.failed
    assert (failed["name"], failed["drive_id"], failed["job_id"]) == ("indoors", ids[2], due[2].id)
    assert failed["problem"]["type"].endswith("not-georeferenced")
    report = document(world, 1, "report.json")
    assert report["failed_drives"] == version.failed
    codes = [finding["code"] for finding in report["findings"]]
    assert "scene-left-out" in codes
    assert "drive-left-out" not in codes, "one finding for each drive"
    page = stored(world, 1, "report.html").decode()
    assert page.count("indoors is not in the map") == 1
    assert "not in the map: indoors" not in page
    assert len(document(world, 1, "map.json")["scenes"]) == version.summary["scenes"] == 2

    job, due = ask(world, drives=ids, require_all=True)
    run(world, *due)
    refused = world.job(job.id)
    assert refused.problem is not None
    assert (refused.state, refused.problem["type"]) == ("FAILED", "urn:mrasfm:problem:not-georeferenced")


@pytest.mark.slow
def test_a_worker_is_killed_in_the_middle(world: World, two_drives: list[Path]) -> None:
    """Two workers, one of them killed while the map is made, with a drive that fails: one version all the same."""
    world.start_reconciler()
    workers = [world.start_worker(), world.start_worker()]
    ids = [world.add_drive(folder) for folder in two_drives]
    damaged = Path(world.settings.data_dir) / "damaged"
    damaged.mkdir()
    ids.append(world.add_drive(_damaged(two_drives[0], damaged)))
    job, due = ask(world, drives=ids)
    JobQueue(world.settings).send(due)
    with world.database.read() as session:
        children = {m.drive_id: m.child_id for m, _ in jobs.members_of(session, [job.id])[job.id]}
    ends = {drive_id: ended_in_time(world, str(children[drive_id])).state for drive_id in ids}
    assert list(ends.values()) == ["SUCCEEDED", "SUCCEEDED", "FAILED"]
    stage = world.hold(job.id)
    holder = world.job(job.id).owner
    assert holder is not None
    victim = next(worker for worker in workers if _started(worker.pid, int(holder.rpartition(":")[2])))
    for process in (victim.pid, int(holder.rpartition(":")[2])):
        kill(process)
    wait_until(lambda: is_gone(stage), "the stage's end")
    ended = ended_in_time(world, job.id)
    assert (ended.state, ended.attempt) == ("SUCCEEDED", 2), ended.problem
    (version,) = versions(world)
    assert [failed["drive_id"] for failed in version.failed] == [ids[2]]
    (named,) = document(world, 1, "report.json")["failed_drives"]
    assert named["drive_id"] == ids[2]
    assert named["problem"]["detail"]
    assert len(world.scenes()) == 2


def ended_in_time(world: World, job_id: str) -> Job:
    """Two reconstructions at one time, and what they wait for, take their time on a busy machine."""
    wait_until(lambda: world.job(job_id).state in TERMINAL, lambda: world.log()[-3000:], within_s=900)
    return world.job(job_id)


def _damaged(drive: Path, out: Path) -> Path:
    """A drive whose images end early."""
    for file in drive.rglob("*"):
        if file.is_file():
            target = out / file.relative_to(drive)
            target.parent.mkdir(parents=True, exist_ok=True)
            data = file.read_bytes()
            target.write_bytes(data[:-2000] if file.suffix == ".jpg" else data)
    return out


def _started(pid: int, child: int) -> bool:
    import psutil

    return pid in {parent.pid for parent in psutil.Process(child).parents()} | {child}
