"""Line 33: exports of images for splatting, as readers of others take them, and the client's wheel in an environment
of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap

from mrasfm_engine.export.stored_scene import read_source
from mrasfm_engine.export.undistorted import reprojection_errors_px
from mrasfm_engine.synthetic.drive_writer import render_drives
from mrasfm_engine.synthetic.options import SynthOptions
from mrasfm_engine.synthetic.rigs import true_cameras
from tests.benchmarks import fisheyes
from tests.benchmarks.commands import CommandFailed, mrasfm
from tests.benchmarks.table import Figure, exactly
from tests.helpers import splatting_rule

LINE = "33"
REPOSITORY = Path(__file__).resolve().parents[2]
OPENCV = ("--camera-model", "OPENCV", "--cameras", 6, "--units", 12, "--seed", 7)
FISHEYE_UNITS, SEED = 8, 3
MOST_OF_OWN = 1.1  # median reprojection error of the pinhole images, in that of the scene
MOST_MB = 60.0
NERFSTUDIO = "MRASFM_TEST_NERFSTUDIO"  # names the interpreter of an environment with nerfstudio
READER = Path(__file__).resolve().parents[1] / "foreign_readers" / "read_nerfstudio.py"
SHOWN = 0.9  # of the scene's observations


def exports_of_images(data: Path, work: Path) -> Iterator[Figure]:
    """Workspaces of a rendered drive with usual cameras and of one with fisheyes of 190 deg."""
    drive = work / "usual cameras"
    mrasfm("synth", *OPENCV, "--out", drive)
    yield from _workspace("six OPENCV cameras", drive, work)
    options = SynthOptions(
        cameras=4, units=FISHEYE_UNITS, seed=SEED, width=fisheyes.WIDTH, height=fisheyes.HEIGHT, masks=False,
        tight=True, gnss=False,
    )  # fmt: skip
    rig = true_cameras(4, width=fisheyes.WIDTH, height=fisheyes.HEIGHT, rng=np.random.default_rng([SEED, 1]))
    faces = work / "faces for fisheyes"
    render_drives(options, faces, rig=[face for camera in rig for face in fisheyes.faces_of(camera)])
    for model in fisheyes.MODELS:
        yield from _workspace(f"four fisheyes, {model}", fisheyes.composed(faces, work / model, model), work)


def _workspace(title: str, drive: Path, work: Path) -> Iterator[Figure]:
    scene, out = work / f"{title}, scene", work / f"{title}, export"
    mrasfm("reconstruct", drive, "--out", scene)
    mrasfm("export", scene, "--drive", drive, "--format", "colmap", "--format", "nerfstudio", "--out", out)
    source = read_source(scene).scene
    own = float(np.median(reprojection_errors_px(source)))
    model = pycolmap.Reconstruction(str(out / "colmap" / "sparse" / "0"))
    errors = [
        float(np.linalg.norm(image.project_point(model.points3D[point.point3D_id].xyz) - point.xy))
        for image in model.images.values()
        for point in image.points2D
        if point.has_point3D()
    ]
    what = f"{title}: median reprojection of the pinhole images, in that of the scene"
    yield Figure(line=LINE, what=what, value=float(np.median(errors)) / own, above=0.3, most=MOST_OF_OWN)
    shown = len(errors) / len(source.observation_point)
    yield Figure(line=LINE, what=f"{title}: observations that they show", value=shown, above=SHOWN, most=1.5)
    by_rule = float(np.median(splatting_rule.errors_px(*splatting_rule.load(out / "colmap"))))
    what = f"{title}: median reprojection by the rule of 3DGS, in that of the scene"
    yield Figure(line=LINE, what=what, value=by_rule / own, above=0.3, most=MOST_OF_OWN)
    yield exactly(LINE, f"{title}: cameras that 3DGS takes", _taken_by_splatting(model, out), len(model.cameras))
    yield exactly(LINE, f"{title}: frames of transforms.json with all their files", _frames(out), len(model.images))
    yield from _of_nerfstudio(title, out, own, len(model.images))


def _of_nerfstudio(title: str, out: Path, own_px: float, images: int) -> Iterator[Figure]:
    """nerfstudio's parsers, where an environment with it is named."""
    python = os.environ.get(NERFSTUDIO)
    if not python:
        yield Figure(line=LINE, what=f"{title}: nerfstudio: skipped", value=0, remark=f"{NERFSTUDIO} names none")
        return
    said = json.loads(run_apart([python, READER, out], out).strip().splitlines()[-1])
    yield exactly(LINE, f"{title}: nerfstudio, images of both formats", said["images"], images)
    yield exactly(LINE, f"{title}: nerfstudio, images of transforms.json", said["images_of_transforms"], images)
    yield exactly(LINE, f"{title}: nerfstudio, all cameras are perspective", int(said["all_perspective"]), 1)
    what = f"{title}: nerfstudio, median reprojection in that of the scene"
    yield Figure(line=LINE, what=what, value=said["median_px"] / own_px, above=0.3, most=MOST_OF_OWN)
    apart = said["formats_apart"]
    yield Figure(line=LINE, what=f"{title}: nerfstudio, poses of the formats apart", value=apart, above=-1, most=1e-4)


def _taken_by_splatting(model: pycolmap.Reconstruction, out: Path) -> int:
    """Cameras that its loader takes: pinholes whose principal point is the middle, and whose images are found by the
    last part of their names."""
    images = out / "colmap" / "images"
    found = all((images / Path(image.name).name).is_file() for image in model.images.values())
    return sum(
        found and camera.model.name == "PINHOLE" and tuple(camera.params[2:]) == (camera.width / 2, camera.height / 2)
        for camera in model.cameras.values()
    )


def _frames(out: Path) -> int:
    folder = out / "nerfstudio"
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    return sum(
        all((folder / frame[key]).is_file() for key in ("file_path", "mask_path") if key in frame) for frame in frames
    )


def client_wheel(data: Path, work: Path) -> Iterator[Figure]:
    """The wheel of `mrasfm-client`: what it installs, and that it works beside folders of the product's names."""
    sources, dist = work / "client sources", work / "dist"
    run_apart([sys.executable, REPOSITORY / ".ci" / "build_client.py", sources], work)
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", dist]
    run_apart([*build, sources], work)
    run_apart([*build, REPOSITORY], work)
    (own,), (product,) = (sorted(dist.glob(f"{name}-*.whl")) for name in ("mrasfm_client", "mrasfm"))
    common = _installed(own) & _installed(product)
    yield exactly(LINE, "files that both wheels install + 1", len(common) + 1, 1)
    yield exactly(LINE, "top-level names that the client installs", len({n.split("/")[0] for n in _installed(own)}), 1)
    environment, bare = work / "client environment", work / "bare environment"
    for folder in (environment, bare):
        run_apart([sys.executable, "-m", "venv", folder], work)
    python = environment / "bin" / "python"
    try:
        run_apart([python, "-m", "pip", "install", "--quiet", own], work)
    except CommandFailed as error:
        yield Figure(line=LINE, what="the client: skipped, cannot be installed here", value=0, remark=str(error))
        return
    size = (_size_bytes(environment) - _size_bytes(bare)) / 1e6
    yield Figure(line=LINE, what="the client with all that it needs", value=size, unit="MB", above=1.0, most=MOST_MB)
    listed = run_apart([python, "-m", "pip", "list", "--format", "freeze"], work).lower()
    heavy = [name for name in ("numba", "pycolmap", "numpy", "opencv", "sqlalchemy", "fastapi") if name in listed]
    yield exactly(LINE, "packages of the engine or the service beside it + 1", len(heavy) + 1, 1)
    trap = work / "somebody's project"
    for name in ("service", "schemas"):
        (trap / name).mkdir(parents=True)
        (trap / name / "__init__.py").write_text("raise SystemExit('another one')")
    help_text = run_apart([environment / "bin" / "mrasfm-client", "--help"], trap)
    yield exactly(LINE, "the client works beside such folders", int("download" in help_text), 1)


def _installed(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def _size_bytes(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def run_apart(command: list[str | Path], folder: Path) -> str:
    """Run a program that sees nothing of this checkout; its output."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MRASFM_API_KEY")}
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        said = " / ".join((result.stderr or result.stdout).strip().splitlines()[-2:])
        raise CommandFailed(f"{Path(command[0]).name} {command[1]} ended with {result.returncode}: {said}")
    return result.stdout
