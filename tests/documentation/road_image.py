"""Makes a small picture of a scene's road: `python -m tests.documentation.road_image SCENE FILE.jpg`.

The committed image `docs/images/road.jpg` shows a rendered drive around a block:

    mrasfm synth --cameras 3 --units 130 --world loop --seed 1 --out loop
    mrasfm reconstruct loop --out scene
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

WIDTH_PX = 900
QUALITY = 82
PAPER = 255.0


def main() -> None:
    """Shrink the whole road onto white paper."""
    parser = argparse.ArgumentParser(description="Make a small picture of a scene's road.")
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("file", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    picture = cv2.imread(str(arguments.scene / "pictures" / "road.png"), cv2.IMREAD_UNCHANGED)
    opacity = picture[..., 3:] / 255.0
    paper = (opacity * picture[..., :3] + (1 - opacity) * PAPER).astype(np.uint8)
    size = WIDTH_PX, round(WIDTH_PX * paper.shape[0] / paper.shape[1])
    small = cv2.resize(paper, size, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(arguments.file), small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
