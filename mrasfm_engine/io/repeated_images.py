"""Images that are those before them once more, from a camera that hangs or a recorder that writes twice.

They show where the vehicle was before. Sensors have noise, by which new images differ, also of what stands.
"""

from __future__ import annotations

import filecmp
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from mrasfm_engine.scene.drive import Drive, DriveImage


def repeated_images(drive: Drive, content_sha256: Mapping[str, str]) -> frozenset[str]:
    """Files of images with the contents of the image before them of their camera, by the SHA-256 of all files."""
    return frozenset(
        image.file
        for run in _runs(drive.images, lambda a, b: content_sha256[a] == content_sha256[b])
        for image in run[1:]
    )


def runs_of_same_images(root: Path, images: Sequence[DriveImage]) -> list[list[DriveImage]]:
    """Images of each camera that follow one another and have the same contents, two or more of them.

    Parameters
    ----------
    root
        Folder that their files are in.
    images
        In their order in time. Files that cannot be read are no copies.
    """
    return _runs(images, lambda a, b: have_same_contents(root / a, root / b))


def have_same_contents(file: Path, other: Path) -> bool:
    """Return whether two files have the same bytes; by their sizes most differ already."""
    try:
        return filecmp.cmp(file, other, shallow=False)
    except OSError:  # whoever reads their pixels names it
        return False


def _runs(images: Sequence[DriveImage], are_same: Callable[[str, str], bool]) -> list[list[DriveImage]]:
    last: dict[int, list[DriveImage]] = {}  # by camera, the run that its next image may belong to
    runs = []
    for image in images:
        run = last.get(image.camera)
        if run is None or not are_same(run[-1].file, image.file):
            run = last[image.camera] = []
            runs.append(run)
        run.append(image)
    return [run for run in runs if len(run) > 1]
