"""Which extractor, matcher and segmenter a configuration asks for, checked and loaded before any work.

| features.extractor | matching.matcher |
|---|---|
| any | nearest |
| superpoint | superglue, lightglue |
| aliked | lightglue |
| xfeat | lighterglue |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from mrasfm_engine.config import EngineConfig, FeatureConfig, MatchConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.features.extraction import Extractor, SiftExtractor
from mrasfm_engine.features.learned_extractors import (
    AlikedDetector,
    Detector,
    LearnedExtractor,
    SuperPointDetector,
    XFeatDetector,
)
from mrasfm_engine.features.segmentation import OnnxSegmenter, Segmenter
from mrasfm_engine.learned import signatures
from mrasfm_engine.learned.catalogue import CATALOGUE, default_model
from mrasfm_engine.learned.model_folder import InstalledModel, ModelFolder, default_folder
from mrasfm_engine.learned.network import Network
from mrasfm_engine.matching.learned_matchers import (
    ColmapLightGlueMatcher,
    LearnedMatcher,
    LighterGlueMatcher,
    LightGlueMatcher,
    SuperGlueMatcher,
)
from mrasfm_engine.matching.nearest_neighbour import Matcher, NearestNeighbourMatcher
from schemas import LabelMap

_DETECTORS: dict[str, Callable[[Network], Detector]] = {
    "xfeat": XFeatDetector,
    "aliked": AlikedDetector,
    "superpoint": SuperPointDetector,
}
# By signature: one method has been exported in several ways.
_MATCHERS: dict[signatures.Signature, type[LearnedMatcher]] = {
    signatures.LIGHTERGLUE: LighterGlueMatcher,
    signatures.LIGHTGLUE: LightGlueMatcher,
    signatures.LIGHTGLUE_COLMAP: ColmapLightGlueMatcher,
    signatures.SUPERGLUE: SuperGlueMatcher,
}


@dataclass(frozen=True)
class LoadedModel:
    """A model that is in use."""

    installed: InstalledModel
    network: Network

    def describe(self) -> dict[str, Any]:
        """For the report: which file ran, under which licence, on what."""
        return {
            "name": self.installed.name,
            "sha256": self.installed.sha256,
            "licence": self.installed.licence,
            "commercial_use": self.installed.commercial_use,
            "provider": self.network.provider,
        }


@dataclass(frozen=True)
class Components:
    """What finds and matches keypoints in this run. Building them is all that reads models."""

    extractor: Extractor
    matcher: Matcher
    segmenter: Segmenter | None
    models: dict[str, LoadedModel]  # by what they are used for: extractor, matcher, segmenter

    def fingerprint_of(self, *uses: str) -> dict[str, str]:
        """Hashes of the models used for these: what a stage's result depends on besides its settings."""
        return {use: self.models[use].installed.sha256 for use in uses if use in self.models}

    def describe(self) -> dict[str, Any]:
        """The models in use, for the report."""
        return {use: model.describe() for use, model in self.models.items()}


def load_components(config: EngineConfig, label_map: LabelMap | None) -> Components:
    """Build what the configuration asks for.

    Parameters
    ----------
    label_map
        The drive's: which ids a segmenter may give.

    Raises
    ------
    InputError
        Where extractor and matcher do not go together, or a model is missing, damaged, or not what the settings say.
    """
    require_compatible(config.features, config.matching)
    folder = ModelFolder(config.models.folder or default_folder())
    load = partial(_load, folder, gpu=config.models.gpu)
    models: dict[str, LoadedModel] = {}
    extractor: Extractor = SiftExtractor(config.features)
    matcher: Matcher = NearestNeighbourMatcher(config.matching)
    segmenter: Segmenter | None = None
    method = config.features.extractor
    if method != "sift":
        loaded = load("features.model", config.features.model, method, method)
        models["extractor"] = loaded
        extractor = LearnedExtractor(_DETECTORS[method](loaded.network), config.features)
    if config.matching.matcher != "nearest":
        loaded = load("matching.model", config.matching.model, config.matching.matcher, method)
        models["matcher"] = loaded
        matcher = _MATCHERS[loaded.installed.known.signature](loaded.network, config.matching)
    if config.semantics.model is not None:
        loaded = load("semantics.model", config.semantics.model, "segmenter", None)
        models["segmenter"] = loaded
        segmenter = OnnxSegmenter(loaded.network, label_map)
    return Components(extractor, matcher, segmenter, models)


def require_compatible(feature_config: FeatureConfig, match_config: MatchConfig) -> None:
    """Refuse a matcher that was trained on other descriptors.

    Raises
    ------
    InputError
        That names both settings.
    """
    for section, what, choice in (
        ("features", feature_config.model, feature_config.extractor),
        ("matching", match_config.model, match_config.matcher),
    ):
        if what is not None and choice in ("sift", "nearest"):
            name = "extractor" if section == "features" else "matcher"
            raise InputError(
                f'{section}.model = "{what}" is given, but {section}.{name} = "{choice}" needs no model',
                remedy=f"Set {section}.{name}, or leave out {section}.model.",
                code="bad-settings",
            )
    if match_config.matcher == "nearest" or default_model(match_config.matcher, feature_config.extractor) is not None:
        return
    partners = sorted({m.descriptors for m in CATALOGUE if m.method == match_config.matcher and m.descriptors})
    raise InputError(
        f'matching.matcher = "{match_config.matcher}" was not trained on the descriptors of '
        f'features.extractor = "{feature_config.extractor}"',
        remedy=f"Set features.extractor to {' or '.join(partners)}, or matching.matcher to nearest.",
        code="bad-settings",
    )


def _load(
    folder: ModelFolder, setting: str, name: str | None, method: str, descriptors: str | None, *, gpu: bool
) -> LoadedModel:
    usual = default_model(method, descriptors) if descriptors is not None else None
    wanted = name or (usual.name if usual is not None else method)
    installed, data = folder.load(wanted)
    if installed.known.method != method or installed.known.descriptors != descriptors:
        of = "" if descriptors is None or descriptors == method else f" for {descriptors}"
        raise InputError(
            f'{setting} = "{wanted}" is a model for {installed.known.method}, not for {method}{of}',
            remedy=f"`mrasfm models list` shows which model is for what; {setting} may be left out.",
            code="bad-settings",
        )
    return LoadedModel(installed, Network(wanted, data, gpu=gpu))
