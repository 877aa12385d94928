"""Notes on images that an import may have lost: files that it did not read, and frames that lack a camera's image."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from mrasfm_engine.importers.recording import SourceUnit
from schemas.findings import enumerated, listed

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
# Files that recordings and file managers keep beside the images.
SIDECARS = frozenset({"times.txt", "timestamps.txt", "timestamps.json", "poses.txt", "poses.json", "intrinsics.json",
                      "readme", "readme.txt", "readme.md", "thumbs.db", "desktop.ini"})  # fmt: skip
MAX_FOLDERS, MAX_NAMES, MAX_CHARACTERS = 12, 3, 40  # in a note, which a manifest bounds


def is_image(path: Path) -> bool:
    """Return whether a file counts as an image by its name."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def unread_files(folder: Path) -> list[str]:
    """Names in a folder of images that are no images, and neither hidden nor known sidecars; folders end in a slash."""
    if not folder.is_dir():
        return []
    others = (path for path in folder.iterdir() if not is_image(path) and not path.name.startswith("."))
    return sorted(path.name + "/" * path.is_dir() for path in others if path.name.lower() not in SIDECARS)


def notes_of_unread_files(unread: Mapping[str, Sequence[str]]) -> list[str]:
    """A note that counts and names files of folders of images that are not read; none where there are none.

    Parameters
    ----------
    unread
        Names, as `unread_files` finds them, by what the note calls their folder.
    """
    parts = _counted(unread)
    return (
        [f"Files that are not read, as images are .png, .jpg or .jpeg: {enumerated(parts, MAX_FOLDERS)}."]
        if parts
        else []
    )


def notes_of_missing_images(cameras: Iterable[str], units: Sequence[SourceUnit]) -> list[str]:
    """A note that counts and names the frames without an image of a camera; none where every camera has all."""
    parts = []
    for camera in cameras:
        frames = [unit.source_frame for unit in units if camera not in unit.images]
        if frames:
            parts.append(f"{_short(camera)} in {len(frames)} of {len(units)} ({listed(frames, MAX_NAMES)})")
    return [f"Frames without an image of a camera: {enumerated(parts, MAX_FOLDERS)}."] if parts else []


def notes_of_empty_cameras(images: Mapping[str, Mapping[int, Path]]) -> list[str]:
    """A note that names the cameras in whose folders, by name, no image is; none where there is no such folder."""
    empty = [_short(camera) for camera, files in images.items() if not files]
    return [f"Cameras without any image, left out: {enumerated(empty, MAX_FOLDERS)}."] if empty else []


def notes_of_masks_without_a_frame(numbers: Mapping[str, Sequence[int]]) -> list[str]:
    """A note that counts and names masks of frames of which there is no image at all; none where there are none.

    Parameters
    ----------
    numbers
        Numbers of such frames by camera.
    """
    parts = _counted({camera: [*map(str, own)] for camera, own in numbers.items()})
    return [f"Masks of frames that have no images, left out: {enumerated(parts, MAX_FOLDERS)}."] if parts else []


def notes_of_images_without_a_camera(paths: Sequence[str]) -> list[str]:
    """A note that counts and names the images that begin with no camera's prefix; none where there are none."""
    names = listed([*map(_short, paths)], MAX_NAMES)
    return [f"Images that begin with no camera's image_prefix, left out: {len(paths)} ({names})."] if paths else []


def _counted(names: Mapping[str, Sequence[str]]) -> list[str]:
    """Words that count and name what is left out of a folder or camera each; none of those with nothing."""
    return [f"{_short(of)}: {len(own)} ({listed([*map(_short, own)], MAX_NAMES)})" for of, own in names.items() if own]


def _short(name: str) -> str:
    return name if len(name) <= MAX_CHARACTERS else name[:MAX_CHARACTERS] + "..."
