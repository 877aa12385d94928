"""The models that are known, with their licences; what a licence forbids to pass on is brought by the user.

No model comes with MRASfM and none is downloaded unasked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Generic, TypeVar

from mrasfm_engine.errors import InputError
from mrasfm_engine.learned.network import Network
from mrasfm_engine.learned.signatures import ModelKind, Signature
from schemas.methods import EXTRACTORS, MATCHERS

COLMAP_RELEASE = "https://github.com/colmap/colmap/releases/download/3.13.0"

_SEGMENTATION = "mrasfm_engine.features.segmentation"
Config_contra = TypeVar("Config_contra", contravariant=True)
Component_co = TypeVar("Component_co", covariant=True)


@dataclass(frozen=True, kw_only=True)
class KnownModel:
    """Catalogue entry of a model: name, use, signature, licence and source."""

    name: str
    kind: ModelKind
    method: str  # value of the setting that it serves: features.extractor, matching.matcher
    descriptors: str | None  # extractor of the descriptors that it finds, or that it was trained on
    signature: Signature
    licence: str
    commercial_use: bool | None  # None: depends on the file that the user brings
    source: str  # who publishes it
    url: str | None = None  # where `mrasfm models pull` gets it
    sha256: str | None = None  # None: the user's own export, registered by its signature

    @property
    def is_published(self) -> bool:
        """Exactly one file is this model."""
        return self.sha256 is not None


@dataclass(frozen=True, kw_only=True)
class Method(Generic[Config_contra, Component_co]):
    """An extractor or matcher that needs no model; the `METHOD` of its module (see `schemas.methods`)."""

    build: Callable[[Config_contra], Component_co]


@dataclass(frozen=True, kw_only=True)
class LearnedMethod(Generic[Config_contra, Component_co]):
    """An extractor or matcher around a trained network; the `METHOD` of its module, which lists them as `MODELS`.

    Attributes
    ----------
    build
        Called with the settings, the network and the catalogue's model that the network's file is or stands for.
    """

    build: Callable[[Config_contra, Network, KnownModel], Component_co]


def known_models() -> tuple[KnownModel, ...]:
    """List the models of all registered methods and of segmentation."""
    modules = (*EXTRACTORS.values(), *MATCHERS.values(), _SEGMENTATION)
    return tuple(model for module in modules for model in getattr(import_module(module), "MODELS", ()))


def known_model(name: str) -> KnownModel:
    """The model of this name.

    Raises
    ------
    InputError
        Where there is none.
    """
    for model in known_models():
        if model.name == name:
            return model
    names = ", ".join(model.name for model in known_models())
    raise InputError(f"there is no model {name}", remedy=f"Known are {names}.", code="unknown-model")


def by_sha256(sha256: str) -> KnownModel | None:
    """The published model whose file has this hash."""
    return next((model for model in known_models() if model.sha256 == sha256), None)


def default_model(method: str, descriptors: str) -> KnownModel | None:
    """The model that serves a setting for these descriptors, None where there is none."""
    return next((m for m in known_models() if m.method == method and m.descriptors == descriptors), None)
