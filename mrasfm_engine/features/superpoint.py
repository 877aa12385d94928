"""SuperPoint's keypoints and descriptors."""

from __future__ import annotations

import cv2
import numpy as np

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.features.network_extractor import Detections, NetworkExtractor
from mrasfm_engine.learned.catalogue import KnownModel, LearnedMethod
from mrasfm_engine.learned.network import Network
from mrasfm_engine.learned.signatures import FLOAT32, INT64, ModelKind, Signature, Tensor, float_tensor
from mrasfm_engine.types import Bytes

# SuperPoint (DeTone et al., CVPRW 2018) as exported by fabio-sim/LightGlue-ONNX: gray 0..1, keypoints in pixels.
SIGNATURE = Signature(
    inputs=(float_tensor("image", 1, 1, "H", "W"),),
    outputs=(
        Tensor("keypoints", (INT64, FLOAT32), (1, "K", 2)),
        float_tensor("scores", 1, "K"),
        float_tensor("descriptors", 1, "K", 256),
    ),
)
MODELS = (
    KnownModel(
        name="superpoint",
        kind=ModelKind.EXTRACTOR,
        method="superpoint",
        descriptors="superpoint",
        signature=SIGNATURE,
        licence="Magic Leap, research only",
        commercial_use=False,
        source="an export as fabio-sim/LightGlue-ONNX (1.0) writes it",
    ),
)


class SuperPointDetector:
    """SuperPoint (DeTone et al., CVPRW 2018) as exported for LightGlue."""

    image = "image"
    takes_number = False
    is_refined = False

    def __init__(self, network: Network) -> None:
        self.network = network

    def detect(self, pixels: Bytes, wanted: int, min_score: float | None) -> Detections:
        """See `Detector`; number and least score are part of the exported network."""
        gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        found = self.network.run({"image": gray[None, None].astype(np.float32) / np.float32(255)})
        xy = found["keypoints"][0].astype(np.float32) + np.float32(0.5)
        return Detections(xy, found["descriptors"][0], found["scores"][0])


METHOD = LearnedMethod[FeatureConfig, NetworkExtractor](
    build=lambda config, network, _: NetworkExtractor(SuperPointDetector(network), config)
)
