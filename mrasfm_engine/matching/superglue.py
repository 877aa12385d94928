"""SuperGlue."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.learned.catalogue import KnownModel, LearnedMethod
from mrasfm_engine.learned.signatures import ModelKind, Signature, float_tensor
from mrasfm_engine.matching.network_matcher import NetworkMatcher, Prepared
from mrasfm_engine.types import Floats32, Ints

# SuperGlue (Sarlin et al., CVPR 2020) as exported by yuefanhao/SuperPoint-SuperGlue-TensorRT and used by AirSLAM:
# keypoints (xy - size / 2) / (0.7 max(size)), descriptors by column, logarithms of the assignment with its dustbins.
SUPERGLUE = Signature(
    inputs=(
        float_tensor("keypoints_0", 1, "N0", 2),
        float_tensor("scores_0", 1, "N0"),
        float_tensor("descriptors_0", 1, 256, "N0"),
        float_tensor("keypoints_1", 1, "N1", 2),
        float_tensor("scores_1", 1, "N1"),
        float_tensor("descriptors_1", 1, 256, "N1"),
    ),
    outputs=(float_tensor("scores", 1, "N0+1", "N1+1"),),
)
MODELS = (
    KnownModel(
        name="superglue",
        kind=ModelKind.MATCHER,
        method="superglue",
        descriptors="superpoint",
        signature=SUPERGLUE,
        licence="Magic Leap, research only",
        commercial_use=False,
        source="an export as yuefanhao/SuperPoint-SuperGlue-TensorRT writes it",
    ),
)


class SuperGlueMatcher(NetworkMatcher):
    """SuperGlue (Sarlin et al., CVPR 2020): mutual maxima of its assignment."""

    usual_min_score = 0.2

    def _units(self, xy_px: Floats32, size: Floats32) -> Floats32:
        result: Floats32 = (xy_px - np.float32(0.5) - size / 2) / (np.float32(0.7) * size.max())
        return result

    def _run(self, a: Prepared, b: Prepared) -> tuple[Ints, Floats32]:
        found = self.network.run(
            {
                "keypoints_0": a.xy,
                "scores_0": a.scores,
                "descriptors_0": np.ascontiguousarray(a.descriptors.transpose(0, 2, 1)),
                "keypoints_1": b.xy,
                "scores_1": b.scores,
                "descriptors_1": np.ascontiguousarray(b.descriptors.transpose(0, 2, 1)),
            }
        )
        # The last row and column stand for "no partner"; as in the published code the threshold decides that.
        assignment = found["scores"][0, :-1, :-1]
        best = assignment.argmax(axis=1)
        mutual = np.flatnonzero(assignment.argmax(axis=0)[best] == np.arange(len(best)))
        return np.stack([mutual, best[mutual]], axis=1), np.exp(assignment[mutual, best[mutual]])


METHOD = LearnedMethod[MatchConfig, NetworkMatcher](build=lambda config, network, _: SuperGlueMatcher(network, config))
