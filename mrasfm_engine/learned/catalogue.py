"""The models that are known, with their licences; what a licence forbids to pass on is brought by the user.

No model comes with MRASfM and none is downloaded unasked.
"""

from __future__ import annotations

from dataclasses import dataclass

from mrasfm_engine.errors import InputError
from mrasfm_engine.learned import signatures
from mrasfm_engine.learned.signatures import ModelKind, Signature

_COLMAP_RELEASE = "https://github.com/colmap/colmap/releases/download/3.13.0"


@dataclass(frozen=True, kw_only=True)
class KnownModel:
    """What is known of a model before its file is there."""

    name: str
    kind: ModelKind
    method: str  # value of the setting that it serves: features.extractor, matching.matcher
    descriptors: str | None  # of which extractor; a matcher is trained on those of one
    signature: Signature
    licence: str
    commercial_use: bool | None  # None: depends on the file that the user brings
    source: str  # who publishes it
    url: str | None = None  # where `mrasfm models pull` gets it
    sha256: str | None = None  # None: the user's own export, registered by its signature

    @property
    def is_published(self) -> bool:
        """Whether exactly one file is this model."""
        return self.sha256 is not None


CATALOGUE: tuple[KnownModel, ...] = (
    KnownModel(
        name="xfeat",
        kind=ModelKind.EXTRACTOR,
        method="xfeat",
        descriptors="xfeat",
        signature=signatures.XFEAT,
        licence="Apache-2.0",
        commercial_use=True,
        source="noahzhy/xfeat_lightglue_onnx on GitHub: onnx/xfeat_2048_640x360.onnx",
        sha256="78038a53f1f095a67ed1a0be424a5a5e7e64df4cc572e269df9de5d60c564fba",
    ),
    KnownModel(
        name="xfeat-lighterglue",
        kind=ModelKind.MATCHER,
        method="lighterglue",
        descriptors="xfeat",
        signature=signatures.LIGHTERGLUE,
        licence="Apache-2.0",
        commercial_use=True,
        source="noahzhy/xfeat_lightglue_onnx on GitHub: onnx/lighterglue_L3.onnx",
        sha256="a721f366f54b20328fa98c799cc31478edb1c31f0c941528df3d363c3753760d",
    ),
    KnownModel(
        name="aliked-n16rot",
        kind=ModelKind.EXTRACTOR,
        method="aliked",
        descriptors="aliked",
        signature=signatures.ALIKED,
        licence="BSD-3-Clause",
        commercial_use=True,
        source="COLMAP 3.13.0",
        url=f"{_COLMAP_RELEASE}/aliked-n16rot.onnx",
        sha256="39c423d0a6f03d39ec89d3d1d61853765c2fb6a8b8381376c703e5758778a547",
    ),
    KnownModel(
        name="aliked-lightglue",
        kind=ModelKind.MATCHER,
        method="lightglue",
        descriptors="aliked",
        signature=signatures.LIGHTGLUE_COLMAP,
        licence="Apache-2.0",
        commercial_use=True,
        source="COLMAP 3.13.0",
        url=f"{_COLMAP_RELEASE}/aliked-lightglue.onnx",
        sha256="b9a5de7204648b18a8cf5dcac819f9d30de1a5961ef03756803c8b86c2dceb8d",
    ),
    KnownModel(
        name="superpoint",
        kind=ModelKind.EXTRACTOR,
        method="superpoint",
        descriptors="superpoint",
        signature=signatures.SUPERPOINT,
        licence="Magic Leap, research only",
        commercial_use=False,
        source="an export as fabio-sim/LightGlue-ONNX (1.0) writes it",
    ),
    KnownModel(
        name="superpoint-lightglue",
        kind=ModelKind.MATCHER,
        method="lightglue",
        descriptors="superpoint",
        signature=signatures.LIGHTGLUE,
        licence="Apache-2.0, for descriptors that are research only",
        commercial_use=False,
        source="an export as fabio-sim/LightGlue-ONNX (1.0) writes it",
    ),
    KnownModel(
        name="superglue",
        kind=ModelKind.MATCHER,
        method="superglue",
        descriptors="superpoint",
        signature=signatures.SUPERGLUE,
        licence="Magic Leap, research only",
        commercial_use=False,
        source="an export as yuefanhao/SuperPoint-SuperGlue-TensorRT writes it",
    ),
    KnownModel(
        name="segmenter",
        kind=ModelKind.SEGMENTER,
        method="segmenter",
        descriptors=None,
        signature=signatures.SEGMENTER,
        licence="that of the file",
        commercial_use=None,
        source="an export of your own",
    ),
)


def known_model(name: str) -> KnownModel:
    """The model of this name.

    Raises
    ------
    InputError
        Where there is none.
    """
    for model in CATALOGUE:
        if model.name == name:
            return model
    names = ", ".join(model.name for model in CATALOGUE)
    raise InputError(f"there is no model {name}", remedy=f"Known are {names}.", code="unknown-model")


def by_sha256(sha256: str) -> KnownModel | None:
    """The published model whose file has this hash."""
    return next((model for model in CATALOGUE if model.sha256 == sha256), None)


def default_model(method: str, descriptors: str) -> KnownModel | None:
    """The model that serves a setting for these descriptors, None where there is none."""
    return next((m for m in CATALOGUE if m.method == method and m.descriptors == descriptors), None)
