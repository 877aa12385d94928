"""Images that are those before them once more, from a camera that hangs or a recorder that writes twice.

They show where the vehicle was before. Sensors have noise, by which new images differ, also of what stands.
"""

from __future__ import annotations

import filecmp
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from mrasfm_engine.scene.drive import Drive, DriveImage

SameContents = Callable[[str, str], bool]  # of two files by name


def repeated_images(drive: Drive, content_sha256: Mapping[str, str]) -> frozenset[str]:
    """Files of images with the contents of the image before them of their camera, by the SHA-256 of all files."""
    return frozenset(
        image.file
        for run in runs_of_same_images(drive.images, comparison_of_contents(drive, content_sha256))
        for image in run[1:]
    )


def runs_of_same_images(images: Sequence[DriveImage], are_same: SameContents) -> list[list[DriveImage]]:
    """Images of each camera, in their order in time, that follow one another and are the same, two or more of them."""
    last: dict[int, list[DriveImage]] = {}  # by camera, the run that its next image may belong to
    runs = []
    for image in images:
        run = last.get(image.camera)
        if run is None or not are_same(run[-1].file, image.file):
            run = last[image.camera] = []
            runs.append(run)
        run.append(image)
    return [run for run in runs if len(run) > 1]


def comparison_of_contents(drive: Drive, content_sha256: Mapping[str, str] | None) -> SameContents:
    """Tell whether two files are the same, by the SHA-256 of all where it is known, else by reading both.

    Files that cannot be read are no copies.
    """
    if content_sha256 is not None:
        return lambda a, b: content_sha256[a] == content_sha256[b]
    return lambda a, b: _have_same_contents(drive.path_of(a), drive.path_of(b))


def _have_same_contents(file: Path, other: Path) -> bool:
    """Return whether two files have the same bytes; by their sizes most differ already."""
    try:
        return filecmp.cmp(file, other, shallow=False)
    except OSError:  # whoever reads their pixels names it
        return False
