"""Bits flipped in what was written of a scene and its exports: every one withholds its file and names it.

The fast suite samples them; the slow one goes through many more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.export import run_export as exports
from mrasfm_engine.export.calibration import calibration_document
from mrasfm_engine.export.check import Check, ReadBack
from mrasfm_engine.export.contract import DriveFiles, ExportOptions, ExportSource, ExportWork
from mrasfm_engine.export.formats import WRITERS
from mrasfm_engine.export.map import MapContent, write_map
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.export.stored_scene import _frame_in_map, read_source
from mrasfm_engine.scene.drive import Drive
from schemas import Rig
from tests.helpers.export_example import make_scene, scene_with_road, withheld_files
from tests.helpers.export_images import FISHEYES, USUAL, written

FEW, MANY = 6, 2_000
FORMS = [form for form in WRITERS if form != "geotiff"]  # it has a picture, and a test, of its own
PICTURES = {"road.png": b"\x89PNG and so on" * 9}


def flipped(content: bytes, count: int, seed: int) -> Iterator[bytes]:
    """The content with one bit flipped, at places all over it; among them those of its beginning and its end."""
    bits = 8 * len(content)
    chosen = np.random.default_rng(seed).choice(bits, min(count, bits), replace=False)
    for at in {0, bits - 1, *chosen.tolist()}:
        changed = bytearray(content)
        changed[at // 8] ^= 1 << at % 8
        yield bytes(changed)


@pytest.fixture(scope="module", params=["usual", "fisheyes"])
def source(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ExportSource:
    folder = tmp_path_factory.mktemp("flipped")
    written(folder, USUAL if request.param == "usual" else FISHEYES, masked=True, kind="jpg")
    return replace(read_source(folder / "scene"), files=DriveFiles(folders={"": folder / "drive"}))


def undetected(form: str, source: ExportSource, folder: Path, count: int) -> list[str]:
    """Files of a format with a flipped bit that nobody saw, or whose file was not named."""
    work = ExportWork(source=source, options=ExportOptions(image_size_px=64), folder=folder, step=lambda *_: None)
    made = WRITERS[form](work)
    assert exports._fault(made, folder) is None
    found, kinds = [], set()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        kind = (path.parent, path.suffix) if path.suffix in (".jpg", ".png") else (path, "")
        if kind in kinds:  # images of a folder have one check: one of them is enough
            continue
        kinds.add(kind)
        content = path.read_bytes()
        for changed in flipped(content, count, len(found)):
            path.write_bytes(changed)
            fault = exports._fault(made, folder)
            if fault is None or path.name not in fault:
                found.append(f"{path.relative_to(folder)}: {fault}")
        path.write_bytes(content)
    assert len(kinds) > (form in ("colmap", "nerfstudio", "nuscenes", "kitti", "geojson"))
    return found


@pytest.mark.parametrize("source", ["usual"], indirect=True)
@pytest.mark.parametrize("form", FORMS)
def test_a_bit_of_any_file_of_a_format(form: str, source: ExportSource, tmp_path: Path) -> None:
    assert undetected(form, source, tmp_path, FEW) == []


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_many_bits_of_any_file_of_a_format(form: str, source: ExportSource, tmp_path: Path) -> None:
    assert undetected(form, source, tmp_path, MANY) == []


def flipping(file: str, bit: float) -> Callable[[ReadBack, Check], str | None]:
    """`ReadBack.fault` that flips a bit of a file, at a part of its length, before a check reads it."""
    before, done = ReadBack.fault, []

    def fault(read_back: ReadBack, check: Check) -> str | None:
        path = read_back._folder / file
        if not done and path.is_file() and check.file in (file, Path(file).parent.as_posix()):
            content = bytearray(path.read_bytes())
            at = int(bit * (8 * len(content) - 1))
            content[at // 8] ^= 1 << at % 8
            path.write_bytes(content)
            done.append(file)
        return before(read_back, check)

    return fault


def write_road(out: Path) -> None:
    write_scene(scene_with_road(), out, {}, lambda: PICTURES)


def write_one_map(out: Path) -> None:
    """A map of one scene: cameras and images are called a/NAME, and a checkpoint is kept."""
    scene = make_scene()
    manifest = scene.drive.manifest
    cameras = [camera.model_copy(update={"name": f"a/{camera.name}"}) for camera in manifest.rig.cameras]
    frames = [_frame_in_map(frame, "a") for frame in manifest.frames]
    drive = Drive(Path(), manifest.model_copy(update={"rig": Rig.model_construct(cameras=cameras), "frames": frames}))
    content = MapContent(
        scene=replace(scene, drive=drive),
        scene_of_unit=["a"] * len(frames),
        document={"version": 1, "scenes": [], "seams": [], "components": []},
        calibrations={"a": calibration_document(scene)},
        pictures=PICTURES,
        scenes={"a": ("0" * 64, {"points": np.arange(3000.0)}, {"manifest": manifest.model_dump(mode="json")})},
        seams={},
    )
    write_map(content, out, {})


def unseen(
    out: Path, file: str, bit: float, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path], None] = write_road
) -> str | None:
    """Word of a scene that is published with a flipped bit in a file, or whose file is not named."""
    with monkeypatch.context() as patch:
        patch.setattr(ReadBack, "fault", flipping(file, bit))
        try:
            write(out)
        except MrasfmError as error:
            return None if file.rpartition("/")[2] in str(error) else f"{file}: {error}"
    named = [note for note in withheld_files(out) if file.rpartition("/")[2] in note]
    return None if named and not (out / file).exists() else f"{file}, {bit:.4f}"


@pytest.fixture(scope="module")
def files_of_a_scene(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    out = tmp_path_factory.mktemp("scene") / "scene"
    write_scene(scene_with_road(), out, {}, lambda: PICTURES)
    return sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())


SAMPLED = ("calibration.json", "features.db", "frame.json", "model/points3D.bin", "poses.json", "trajectory.gpkg")


@pytest.mark.parametrize("file", SAMPLED)
def test_a_bit_of_a_file_of_a_scene(file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, bit in enumerate((0.31, 0.77)):
        assert unseen(tmp_path / str(number), file, bit, monkeypatch) is None


@pytest.mark.slow
def test_bits_of_all_files_of_a_scene(
    files_of_a_scene: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(files_of_a_scene) > 25
    rng, found = np.random.default_rng(0), []
    for file in files_of_a_scene:
        for number, bit in enumerate([0.0, 1.0, *rng.random(10).tolist()]):
            found.append(unseen(tmp_path / f"{file.replace('/', '_')} {number}", file, bit, monkeypatch))
    assert [what for what in found if what is not None] == []


@pytest.mark.parametrize("file", ["scenes/a.npz", "map.json", "model/images.bin", "calibration/a.json"])
def test_a_bit_of_a_file_of_a_map(file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, bit in enumerate((0.31, 0.77)):
        assert unseen(tmp_path / str(number), file, bit, monkeypatch, write_one_map) is None


@pytest.mark.slow
def test_bits_of_all_files_of_a_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_one_map(tmp_path / "map")
    files = sorted(p.relative_to(tmp_path / "map").as_posix() for p in (tmp_path / "map").rglob("*") if p.is_file())
    rng, found = np.random.default_rng(0), []
    for file in files:
        for number, bit in enumerate([0.0, 1.0, *rng.random(4).tolist()]):
            out = tmp_path / f"{file.replace('/', '_')} {number}"
            found.append(unseen(out, file, bit, monkeypatch, write_one_map))
    assert len(files) > 20
    assert [what for what in found if what is not None] == []
