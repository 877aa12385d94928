"""The extractor, matcher and segmenter of a configuration, checked and loaded before any work.

`schemas.methods` is the table of extractors and matchers.

| features.extractor | matching.matcher |
|---|---|
| any | nearest |
| superpoint | superglue, lightglue |
| aliked | lightglue |
| xfeat | lighterglue |
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

from mrasfm_engine.config import EngineConfig, FeatureConfig, MatchConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.features.extraction import Extractor
from mrasfm_engine.features.segmentation import OnnxSegmenter, Segmenter
from mrasfm_engine.learned.catalogue import LearnedMethod, Method, default_model, known_models
from mrasfm_engine.learned.model_folder import InstalledModel, ModelFolder, default_folder
from mrasfm_engine.learned.network import Network
from mrasfm_engine.matching.prepared_images import Matcher
from mrasfm_engine.types import Cancel
from schemas import LabelMap
from schemas.methods import EXTRACTORS, MATCHERS


@dataclass(frozen=True)
class LoadedModel:
    """A model that is in use."""

    installed: InstalledModel
    network: Network

    def describe(self) -> dict[str, Any]:
        """Entry of the report: which file ran, under which licence, on what."""
        return {
            "name": self.installed.name,
            "sha256": self.installed.sha256,
            "licence": self.installed.licence,
            "commercial_use": self.installed.commercial_use,
            "provider": self.network.provider,
        }


@dataclass(frozen=True)
class Components:
    """Extractor, matcher and segmenter of this run. Building them is all that reads models."""

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


def load_components(config: EngineConfig, label_map: LabelMap | None, cancel: Cancel = lambda: False) -> Components:
    """Build what the configuration asks for.

    Parameters
    ----------
    label_map
        The drive's: which ids a segmenter may give.
    cancel
        Ends calls of models; called in a thread of its own.

    Raises
    ------
    InputError
        Where extractor and matcher do not go together, or a model is missing, damaged, or not what the settings say.
    """
    require_compatible(config.features, config.matching)
    load = partial(_load, ModelFolder(config.models.folder or default_folder()), gpu=config.models.gpu, cancel=cancel)
    models: dict[str, LoadedModel] = {}
    descriptors = config.features.extractor
    extracting = extractor_method(descriptors)
    if isinstance(extracting, LearnedMethod):
        loaded = models["extractor"] = load("features.model", config.features.model, descriptors, descriptors)
        extractor = extracting.build(config.features, loaded.network, loaded.installed.known)
    else:
        extractor = extracting.build(config.features)
    matching = matcher_method(config.matching.matcher)
    if isinstance(matching, LearnedMethod):
        loaded = load("matching.model", config.matching.model, config.matching.matcher, descriptors)
        models["matcher"] = loaded
        matcher = matching.build(config.matching, loaded.network, loaded.installed.known)
    else:
        matcher = matching.build(config.matching)
    segmenter: Segmenter | None = None
    if config.semantics.model is not None:
        loaded = models["segmenter"] = load("semantics.model", config.semantics.model, "segmenter", None)
        segmenter = OnnxSegmenter(loaded.network, label_map)
    return Components(extractor, matcher, segmenter, models)


def extractor_method(name: str) -> Method[FeatureConfig, Extractor] | LearnedMethod[FeatureConfig, Extractor]:
    """Import the extractor of a name of `schemas.methods`."""
    method: Method[FeatureConfig, Extractor] | LearnedMethod[FeatureConfig, Extractor]
    method = import_module(EXTRACTORS[name]).METHOD
    return method


def matcher_method(name: str) -> Method[MatchConfig, Matcher] | LearnedMethod[MatchConfig, Matcher]:
    """Import the matcher of a name of `schemas.methods`."""
    method: Method[MatchConfig, Matcher] | LearnedMethod[MatchConfig, Matcher] = import_module(MATCHERS[name]).METHOD
    return method


def require_compatible(feature_config: FeatureConfig, match_config: MatchConfig) -> None:
    """Refuse a matcher that was trained on other descriptors.

    Raises
    ------
    InputError
        That names both settings.
    """
    extractor, matcher = feature_config.extractor, match_config.matcher
    for section, model, setting, needs_model in (
        ("features", feature_config.model, f'extractor = "{extractor}"', _needs_model(extractor_method(extractor))),
        ("matching", match_config.model, f'matcher = "{matcher}"', _needs_model(matcher_method(matcher))),
    ):
        if model is not None and not needs_model:
            raise InputError(
                f'{section}.model = "{model}" is given, but {section}.{setting} needs no model',
                remedy=f"Set {section}.{setting.split()[0]}, or leave out {section}.model.",
                code="bad-settings",
            )
    if not _needs_model(matcher_method(matcher)) or default_model(matcher, extractor) is not None:
        return
    partners = sorted({m.descriptors for m in known_models() if m.method == matcher and m.descriptors})
    raise InputError(
        f'matching.matcher = "{matcher}" was not trained on the descriptors of features.extractor = "{extractor}"',
        remedy=f"Set features.extractor to {' or '.join(partners)}, or matching.matcher to nearest.",
        code="bad-settings",
    )


def _needs_model(method: object) -> bool:
    return isinstance(method, LearnedMethod)


def _load(
    folder: ModelFolder,
    setting: str,
    name: str | None,
    method: str,
    descriptors: str | None,
    *,
    gpu: bool,
    cancel: Cancel,
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
    network = Network(wanted, data, gpu=gpu, cancel=cancel)
    if problems := installed.known.signature.mismatches(network.signature):  # an earlier version took it in
        raise InputError(
            f'{setting} = "{wanted}" does not have the signature of {installed.known.name}: {"; ".join(problems)}',
            remedy="Export it with these inputs and outputs, and add it again with mrasfm models add.",
            code="bad-model",
        )
    return LoadedModel(installed, network)
