"""LighterGlue: LightGlue with three layers, for XFeat's descriptors."""

from __future__ import annotations

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.learned.catalogue import KnownModel, LearnedMethod
from mrasfm_engine.learned.signatures import INT64, ModelKind, Signature, Tensor, float_tensor
from mrasfm_engine.matching.network_matcher import NetworkMatcher, Prepared
from mrasfm_engine.types import Floats32, Ints

# As exported by noahzhy/xfeat_lightglue_onnx; keypoints as LightGlue was trained, (xy - size / 2) / (max(size) / 2).
LIGHTERGLUE = Signature(
    inputs=(
        float_tensor("kpts0", 1, "N0", 2),
        float_tensor("kpts1", 1, "N1", 2),
        float_tensor("desc0", 1, "N0", 64),
        float_tensor("desc1", 1, "N1", 64),
    ),
    outputs=(Tensor("matches", (INT64,), ("M", 2)), float_tensor("scores", "M")),
)
MODELS = (
    KnownModel(
        name="xfeat-lighterglue",
        kind=ModelKind.MATCHER,
        method="lighterglue",
        descriptors="xfeat",
        signature=LIGHTERGLUE,
        licence="Apache-2.0",
        commercial_use=True,
        source="noahzhy/xfeat_lightglue_onnx on GitHub: onnx/lighterglue_L3.onnx",
        sha256="a721f366f54b20328fa98c799cc31478edb1c31f0c941528df3d363c3753760d",
    ),
)


class LighterGlueMatcher(NetworkMatcher):
    """LightGlue with three layers for XFeat's descriptors; with so few of them low scores are often wrong."""

    usual_min_score = 0.3  # half of the wrong matches that 0.1 lets through, four fifths of the right ones

    def _run(self, a: Prepared, b: Prepared) -> tuple[Ints, Floats32]:
        found = self.network.run(self._feed(a, b))
        return found["matches"], found["scores"]


METHOD = LearnedMethod[MatchConfig, NetworkMatcher](
    build=lambda config, network, _: LighterGlueMatcher(network, config)
)
