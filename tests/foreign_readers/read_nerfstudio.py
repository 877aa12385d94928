"""Prints what nerfstudio's parsers make of an export with `colmap` and `nerfstudio`, as JSON: `... EXPORT`.

nerfstudio brings gigabytes (torch with CUDA) and old versions of much else: it is no part of the lock. Acceptance line
33 runs this where `MRASFM_TEST_NERFSTUDIO` names the interpreter of an environment that has it.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils as colmap_files

AS_IT_IS: dict[str, Any] = {
    "eval_mode": "all",
    "orientation_method": "none",
    "center_method": "none",
    "auto_scale_poses": False,
    "downscale_factor": 1,
}
PERSPECTIVE = 1


def parsed(config: Any) -> Any:
    return config.setup().get_dataparser_outputs("train")


def main() -> None:
    """Errors are the distances of COLMAP's keypoints from where nerfstudio's cameras see its points."""
    export = Path(sys.argv[1])
    model = export / "colmap" / "sparse" / "0"
    found = parsed(
        ColmapDataParserConfig(
            data=export / "colmap",
            colmap_path=Path("sparse/0"),
            assume_colmap_world_coordinate_convention=False,
            **AS_IT_IS,
        )
    )
    own = parsed(NerfstudioDataParserConfig(data=export / "nerfstudio", **AS_IT_IS))
    points = colmap_files.read_points3D_binary(model / "points3D.bin")
    xyz = dict(zip(points, found.metadata["points3D_xyz"].numpy(), strict=True))
    by_name = {path.name: index for index, path in enumerate(found.image_filenames)}
    errors = []
    for image in colmap_files.read_images_binary(model / "images.bin").values():
        index = by_name[image.name]
        seen = image.point3D_ids >= 0
        errors.append(
            reprojection(
                found.cameras, index, np.array([xyz[number] for number in image.point3D_ids[seen]]), image.xys[seen]
            )
        )
    apart = [
        np.abs(found.cameras.camera_to_worlds[by_name[path.name]] - own.cameras.camera_to_worlds[index]).max().item()
        for index, path in enumerate(own.image_filenames)
    ]
    print(
        json.dumps(
            {
                "images": len(found.image_filenames),
                "images_of_transforms": len(own.image_filenames),
                "masks": len(own.mask_filenames or ()),
                "all_perspective": all(bool((o.cameras.camera_type == PERSPECTIVE).all()) for o in (found, own)),
                "points": len(points),
                "median_px": float(np.median(np.concatenate(errors))),
                "formats_apart": max(apart),
            }
        )
    )


def reprojection(cameras: Any, index: int, points: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Distances of keypoints (n, 2) from points (n, 3): cameras look along -z, with y upwards."""
    pose = cameras.camera_to_worlds[index].numpy()
    in_camera = (points - pose[:, 3]) @ pose[:, :3]
    u = cameras.fx[index].item() * in_camera[:, 0] / -in_camera[:, 2] + cameras.cx[index].item()
    v = cameras.fy[index].item() * -in_camera[:, 1] / -in_camera[:, 2] + cameras.cy[index].item()
    return np.linalg.norm(np.stack([u, v], -1) - xy, axis=1)


if __name__ == "__main__":
    main()
