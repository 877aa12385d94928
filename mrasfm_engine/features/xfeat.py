"""XFeat's keypoints and descriptors."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.features.network_extractor import Detections, NetworkExtractor, planes
from mrasfm_engine.learned.catalogue import KnownModel, LearnedMethod
from mrasfm_engine.learned.network import STRIDE_PX, Array, Network
from mrasfm_engine.learned.signatures import ModelKind, Signature, float_tensor
from mrasfm_engine.types import Bools, Bytes, Floats, Floats32

# XFeat (Potje et al., CVPR 2024) as exported by noahzhy/xfeat_lightglue_onnx: image RGB 0..1, keypoints in pixels.
SIGNATURE = Signature(
    inputs=(float_tensor("images", 1, 3, "H", "W"),),
    outputs=(float_tensor("keypoints", "K", 2), float_tensor("descriptors", "K", 64), float_tensor("scores", "K")),
)
MODELS = (
    KnownModel(
        name="xfeat",
        kind=ModelKind.EXTRACTOR,
        method="xfeat",
        descriptors="xfeat",
        signature=SIGNATURE,
        licence="Apache-2.0",
        commercial_use=True,
        source="noahzhy/xfeat_lightglue_onnx on GitHub: onnx/xfeat_2048_640x360.onnx",
        sha256="78038a53f1f095a67ed1a0be424a5a5e7e64df4cc572e269df9de5d60c564fba",
    ),
)


class XFeatDetector:
    """XFeat (Potje et al., CVPR 2024), exported with its own resampling to multiples of 32.

    Its keypoints are whole pixels of the shrunk image, and refined: see `keypoint_refinement`.
    """

    image = "images"
    takes_number = False
    is_refined = True

    def __init__(self, network: Network) -> None:
        self.network = network

    def detect(self, pixels: Bytes, wanted: int, min_score: float | None) -> Detections:
        """See `Detector`; number and least score are part of the exported network."""
        found, drawn_px = self._run(pixels)
        # The network shrinks the image to multiples of 32, takes whole pixels there, counted from 0, and multiplies
        # them by the shrinkage.
        rows, columns = pixels.shape[:2]
        shrinkage = np.array([columns / _down(columns), rows / _down(rows)], np.float32)
        half = np.float32(0.5) * shrinkage
        detections = Detections(found["keypoints"] + half, found["descriptors"], found["scores"])
        return detections if drawn_px is None else detections[~_near(detections.xy_px, drawn_px)]

    def _run(self, pixels: Bytes) -> tuple[dict[str, Array], Floats | None]:
        """Outputs of the network, and where (k, 2) dots were drawn for it to find.

        The exported network fails where it finds nothing, as on a black image.
        """
        try:
            return self.network.run({"images": planes(pixels)}), None
        except ReconstructionError:
            quarters = np.array([(x, y) for y in (1, 3) for x in (1, 3)])
            column, row = (quarters * (pixels.shape[1], pixels.shape[0]) // 4).T
            dotted = pixels.copy()
            dotted[row, column] = np.where(pixels[row, column] < 128, 255, 0)
            return self.network.run({"images": planes(dotted)}), np.stack([column, row], 1) + 0.5


def _near(xy_px: Floats32, places_px: Floats) -> Bools:
    """Mask (n,) of keypoints that show what is at one of some places, as they share its cell of the shrunk image."""
    apart_px = np.linalg.norm(xy_px[:, None] - places_px, axis=2)
    result: Bools = (apart_px < STRIDE_PX).any(axis=1)
    return result


def _down(size: int) -> int:
    return size // STRIDE_PX * STRIDE_PX


METHOD = LearnedMethod[FeatureConfig, NetworkExtractor](
    build=lambda config, network, _: NetworkExtractor(XFeatDetector(network), config)
)
