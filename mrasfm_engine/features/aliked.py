"""ALIKED's keypoints and descriptors."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.features.network_extractor import Detections, NetworkExtractor, planes
from mrasfm_engine.learned.catalogue import COLMAP_RELEASE, KnownModel, LearnedMethod
from mrasfm_engine.learned.network import Network
from mrasfm_engine.learned.signatures import INT64, ModelKind, Signature, Tensor, float_tensor
from mrasfm_engine.types import Bytes

# ALIKED (Zhao et al., TIM 2023) as COLMAP publishes it: image RGB 0..1, sides multiples of 32, keypoints in -1..1.
SIGNATURE = Signature(
    inputs=(
        float_tensor("image", 1, 3, "H", "W"),
        Tensor("max_keypoints", (INT64,), ()),
        float_tensor("min_score"),
    ),
    outputs=(
        float_tensor("keypoints", 1, "K", 2),
        float_tensor("descriptors", 1, "K", "D"),
        float_tensor("scores", 1, "K"),
    ),
)
MODELS = (
    KnownModel(
        name="aliked-n16rot",
        kind=ModelKind.EXTRACTOR,
        method="aliked",
        descriptors="aliked",
        signature=SIGNATURE,
        licence="BSD-3-Clause",
        commercial_use=True,
        source="COLMAP 3.13.0",
        url=f"{COLMAP_RELEASE}/aliked-n16rot.onnx",
        sha256="39c423d0a6f03d39ec89d3d1d61853765c2fb6a8b8381376c703e5758778a547",
    ),
)


class AlikedDetector:
    """ALIKED (Zhao et al., TIM 2023) as COLMAP publishes it."""

    image = "image"
    takes_number = True
    is_refined = False
    usual_min_score = 0.2  # COLMAP's

    def __init__(self, network: Network) -> None:
        self.network = network

    def detect(self, pixels: Bytes, wanted: int, min_score: float | None) -> Detections:
        """See `Detector`."""
        found = self.network.run(
            {
                "image": planes(pixels),
                "max_keypoints": np.array(wanted, np.int64),
                "min_score": np.array(self.usual_min_score if min_score is None else min_score, np.float32),
            }
        )
        # -1 and 1 are the centres of the first and last pixel.
        rows, columns = pixels.shape[:2]
        half_range = 0.5 * np.array([columns - 1, rows - 1], np.float32)
        xy = (found["keypoints"][0] + np.float32(1)) * half_range + np.float32(0.5)
        return Detections(xy, found["descriptors"][0], found["scores"][0])


METHOD = LearnedMethod[FeatureConfig, NetworkExtractor](
    build=lambda config, network, _: NetworkExtractor(AlikedDetector(network), config)
)
