"""LightGlue in the two forms in which it is exported."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.learned.catalogue import COLMAP_RELEASE, KnownModel, LearnedMethod
from mrasfm_engine.learned.network import Network
from mrasfm_engine.learned.signatures import FLOAT32, INT64, ModelKind, Signature, Tensor, float_tensor
from mrasfm_engine.matching.network_matcher import NetworkMatcher, Prepared
from mrasfm_engine.types import Floats32, Ints

# LightGlue (Lindenberger et al., ICCV 2023) as COLMAP publishes it: keypoints in pixels, matches0 -1 where none.
LIGHTGLUE_COLMAP = Signature(
    inputs=(
        float_tensor("kpts0", 1, "N0", 2),
        float_tensor("kpts1", 1, "N1", 2),
        float_tensor("desc0", 1, "N0", "D"),
        float_tensor("desc1", 1, "N1", "D"),
        float_tensor("image_size0", 1, 2),
        float_tensor("image_size1", 1, 2),
    ),
    outputs=(Tensor("matches0", (INT64, FLOAT32), ("N0",)), float_tensor("mscores0", "N0")),
)
# LightGlue as exported by fabio-sim/LightGlue-ONNX: keypoints (xy - size / 2) / (max(size) / 2).
LIGHTGLUE = Signature(
    inputs=(
        float_tensor("kpts0", 1, "N0", 2),
        float_tensor("kpts1", 1, "N1", 2),
        float_tensor("desc0", 1, "N0", 256),
        float_tensor("desc1", 1, "N1", 256),
    ),
    outputs=(Tensor("matches0", (INT64,), ("M", 2)), float_tensor("mscores0", "M")),
)
MODELS = (
    KnownModel(
        name="aliked-lightglue",
        kind=ModelKind.MATCHER,
        method="lightglue",
        descriptors="aliked",
        signature=LIGHTGLUE_COLMAP,
        licence="Apache-2.0",
        commercial_use=True,
        source="COLMAP 3.13.0",
        url=f"{COLMAP_RELEASE}/aliked-lightglue.onnx",
        sha256="b9a5de7204648b18a8cf5dcac819f9d30de1a5961ef03756803c8b86c2dceb8d",
    ),
    KnownModel(
        name="superpoint-lightglue",
        kind=ModelKind.MATCHER,
        method="lightglue",
        descriptors="superpoint",
        signature=LIGHTGLUE,
        licence="Apache-2.0, for descriptors that are research only",
        commercial_use=False,
        source="an export as fabio-sim/LightGlue-ONNX (1.0) writes it",
    ),
)


class LightGlueMatcher(NetworkMatcher):
    """LightGlue (Lindenberger et al., ICCV 2023) as fabio-sim/LightGlue-ONNX exports it."""

    usual_min_score = 0.1  # the published value

    def _run(self, a: Prepared, b: Prepared) -> tuple[Ints, Floats32]:
        found = self.network.run(self._feed(a, b))
        return found["matches0"], found["mscores0"]


class ColmapLightGlueMatcher(LightGlueMatcher):
    """LightGlue as COLMAP publishes it, which brings keypoints into its units itself."""

    def _units(self, xy_px: Floats32, size: Floats32) -> Floats32:
        return xy_px - np.float32(0.5)

    def _run(self, a: Prepared, b: Prepared) -> tuple[Ints, Floats32]:
        found = self.network.run({**self._feed(a, b), "image_size0": a.size, "image_size1": b.size})
        partner, scores = found["matches0"], found["mscores0"]
        are_indices = partner.shape == scores.shape == (a.count,) and (np.abs(partner) <= b.count).all()  # no NaN is
        if not are_indices:
            raise self._bad(
                f"partners {list(partner.shape)} with scores {list(scores.shape)} that are not one for each of its "
                f"{a.count} keypoints, among {b.count} others",
                "Export it so that it takes any number of keypoints and gives indices of both, without padding.",
            )
        matched = np.flatnonzero(partner >= 0)
        return np.stack([matched, partner[matched].astype(np.int64)], axis=1), scores[matched]


def _build(config: MatchConfig, network: Network, model: KnownModel) -> NetworkMatcher:
    kind = ColmapLightGlueMatcher if model.signature == LIGHTGLUE_COLMAP else LightGlueMatcher
    return kind(network, config)


METHOD = LearnedMethod[MatchConfig, NetworkMatcher](build=_build)
