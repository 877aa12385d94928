"""Format `colmap`: a workspace of COLMAP with undistorted images, as 3DGS, nerfstudio and multi-view stereo read it.

`images/` holds the pinhole images, `masks/NAME.png` their masks (COLMAP's names: 0 where a moving object, the own car
or no image is), `sparse/0/` the model with rigs and frames. Its keypoints are those that observe a point.
"""

from __future__ import annotations

from functools import partial

from mrasfm_engine.export import colmap, colmap_io, comparisons, readers
from mrasfm_engine.export.check import Check
from mrasfm_engine.export.contract import ExportWork, Written
from mrasfm_engine.export.undistorted import undistorted, write_images

MODEL = "sparse/0"


def write_colmap(work: ExportWork) -> Written:
    """Write the workspace."""
    made = undistorted(work.source, work.options.image_size_px)
    folder = work.folder / MODEL
    folder.mkdir(parents=True)
    digests = {f"{MODEL}/{name}": digest for name, digest in colmap.write_model(made.scene, folder).items()}
    checks = [
        Check(f"{MODEL}/images.bin", readers.images_binary, partial(comparisons.images, made.scene)),
        Check(f"{MODEL}/points3D.bin", readers.points_binary, partial(comparisons.points_binary, made.scene)),
        Check(MODEL, colmap_io.read_binary, partial(comparisons.model, made.scene)),
    ]
    return Written(checks=[*checks, *write_images(work, made)], notes=made.notes(), digests=digests)
