"""Images that are those before them once more, from a camera that hangs or a recorder that writes twice."""

from __future__ import annotations

import filecmp

import numpy as np

from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.types import Bools


def repeated_images(drive: Drive) -> Bools:
    """Find images whose files are, byte for byte, those of the unit before in which their camera has one.

    They show where the vehicle was before. Noise makes any two images of a sensor differ, also where it stands.

    Returns
    -------
    array (images,)
    """
    result = np.zeros(len(drive.images), dtype=np.bool_)
    before = {k: drive.before[camera.name] for k, camera in enumerate(drive.cameras) if camera.name in drive.before}
    for i, image in enumerate(drive.images):
        if image.camera in before:
            result[i] = have_same_bytes(drive, before[image.camera], image.file)
        before[image.camera] = image.file
    return result


def have_same_bytes(drive: Drive, file: str, other: str) -> bool:
    """Return whether two files of a drive have the same contents; a file that is not there has none."""
    try:  # by their sizes most differ already
        return filecmp.cmp(drive.root / file, drive.root / other, shallow=False)
    except OSError:  # whoever reads their pixels names it
        return False
