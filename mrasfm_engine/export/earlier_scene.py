"""The scene that lies in a folder already: whether it is that of another drive."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mrasfm_engine.errors import InputError
from mrasfm_engine.io.stage_store import fingerprint
from mrasfm_engine.scene.drive import Drive
from schemas.artifacts import IMAGES_SHA256, REPORT_FILE


def require_same_drive(out: Path, drive: Drive, contents: Callable[[], Mapping[str, str]]) -> None:
    """Refuse a folder that holds the scene of another drive, which the scene of this one would replace.

    The images of a camera that are as they were make it the same drive, also under another name. Where no camera can be
    compared, the name decides, and whether the drive has any file of the scene. A damaged scene is nobody's.

    Parameters
    ----------
    contents
        SHA-256 of the drive's files by name; it is called only where the scene's report has fingerprints of images.

    Raises
    ------
    InputError
        That names the folder and the other drive.
    """
    report = _document(out / REPORT_FILE)
    name, fingerprints = report.get("drive"), report.get(IMAGES_SHA256)
    if not isinstance(name, str):
        return
    images = _images(out)
    files = {image.file for image in drive.images}
    same = _same_cameras(images, fingerprints, files, contents) if isinstance(fingerprints, dict) else []
    if any(same):
        return
    shares_files = not images or any(file in files for _, file, _ in images)
    if name == drive.manifest.name and not same and shares_files:
        return
    other = f"another drive, {name!r}" if name != drive.manifest.name else f"a drive {name!r} with other images"
    raise InputError(
        f"{out} holds the scene of {other}, which would be replaced",
        remedy="Give the scene another folder with --out, or replace that one with --force.",
        code="other-scene",
    )


def _same_cameras(
    images: list[tuple[str, str, bool]],
    fingerprints: dict[str, Any],
    files: set[str],
    contents: Callable[[], Mapping[str, str]],
) -> list[bool]:
    """Return for each camera whose registered images the drive all has, by their names, whether they are the same."""
    registered: dict[str, list[str]] = {}
    for camera, file, is_registered in images:
        if is_registered:
            registered.setdefault(camera, []).append(file)
    compared = {camera: of for camera, of in registered.items() if camera in fingerprints and files.issuperset(of)}
    if not compared:
        return []
    sha256 = contents()
    return [
        fingerprint([(file, sha256[file]) for file in of]) == fingerprints[camera] for camera, of in compared.items()
    ]


def _images(out: Path) -> list[tuple[str, str, bool]]:
    """Camera and file of each image of a scene, and whether it is registered; empty where that cannot be read."""
    try:
        return [
            (str(image["camera"]), str(image["file"]), bool(image["registered"]))
            for image in _document(out / "poses.json")["images"]
        ]
    except (LookupError, TypeError):
        return []


def _document(path: Path) -> dict[str, Any]:
    """Read a JSON document; empty where it cannot be read."""
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}
