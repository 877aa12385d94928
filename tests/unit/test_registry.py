from __future__ import annotations

from pathlib import Path

import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.features.network_extractor import NetworkExtractor
from mrasfm_engine.features.sift import SiftExtractor
from mrasfm_engine.learned.model_folder import ModelFolder
from mrasfm_engine.learned.onnx_file import sha256_of
from mrasfm_engine.learned.signatures import Signature
from mrasfm_engine.matching.lighterglue import LighterGlueMatcher
from mrasfm_engine.matching.lightglue import ColmapLightGlueMatcher, LightGlueMatcher
from mrasfm_engine.matching.nearest_neighbour import NearestNeighbourMatcher
from mrasfm_engine.matching.superglue import SuperGlueMatcher
from mrasfm_engine.registry import Components, load_components
from tests.helpers import learned_graphs

GRAPHS = {
    "own-xfeat": learned_graphs.xfeat,
    "own-lighterglue": learned_graphs.lighterglue,
    "own-aliked": learned_graphs.aliked,
    "own-aliked-lightglue": learned_graphs.colmap_lightglue,
    "superpoint": learned_graphs.superpoint,
    "superpoint-lightglue": learned_graphs.lightglue,
    "superglue": learned_graphs.superglue,
    "segmenter": learned_graphs.segmenter,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    work = tmp_path_factory.mktemp("models")
    for name, graph in GRAPHS.items():
        (work / "given.onnx").write_bytes(graph())
        ModelFolder(work / "models").add(work / "given.onnx", name)
    return work / "models"


def load(folder: Path, **sections: dict[str, object]) -> Components:
    return load_components(EngineConfig.model_validate({"models": {"folder": folder}, **sections}), None)


def test_without_settings_nothing_is_learned_and_no_folder_is_needed(tmp_path: Path) -> None:
    components = load(tmp_path / "nowhere")
    assert isinstance(components.extractor, SiftExtractor)
    assert isinstance(components.matcher, NearestNeighbourMatcher)
    assert components.segmenter is None
    assert components.describe() == {}
    assert components.fingerprint_of("extractor", "matcher") == {}


@pytest.mark.parametrize(
    ("extractor", "model", "matcher", "matching_model", "expected"),
    [
        ("superpoint", None, "superglue", None, SuperGlueMatcher),
        ("superpoint", None, "lightglue", None, LightGlueMatcher),
        ("superpoint", None, "nearest", None, NearestNeighbourMatcher),
        ("aliked", "own-aliked", "lightglue", "own-aliked-lightglue", ColmapLightGlueMatcher),
        ("aliked", "own-aliked", "nearest", None, NearestNeighbourMatcher),
        ("xfeat", "own-xfeat", "lighterglue", "own-lighterglue", LighterGlueMatcher),
        ("xfeat", "own-xfeat", "nearest", None, NearestNeighbourMatcher),
    ],
)
def test_what_goes_together_is_loaded(
    folder: Path, extractor: str, model: str | None, matcher: str, matching_model: str | None, expected: type
) -> None:
    components = load(
        folder,
        features={"extractor": extractor, "model": model},
        matching={"matcher": matcher, "model": matching_model},
    )
    assert isinstance(components.extractor, NetworkExtractor)
    assert isinstance(components.matcher, expected)
    name = model or extractor
    assert components.fingerprint_of("extractor") == {"extractor": sha256_of(GRAPHS[name]())}
    assert components.describe()["extractor"]["name"] == name
    assert components.describe()["extractor"]["provider"].endswith("ExecutionProvider")
    assert ("matcher" in components.models) == (matcher != "nearest")


@pytest.mark.parametrize(
    ("extractor", "matcher", "remedy"),
    [
        ("sift", "superglue", "superpoint"),
        ("sift", "lightglue", "aliked or superpoint"),
        ("sift", "lighterglue", "xfeat"),
        ("aliked", "superglue", "superpoint"),
        ("aliked", "lighterglue", "xfeat"),
        ("superpoint", "lighterglue", "xfeat"),
        ("xfeat", "lightglue", "aliked or superpoint"),
        ("xfeat", "superglue", "superpoint"),
    ],
)
def test_a_matcher_of_other_descriptors_is_refused_with_both_settings(
    tmp_path: Path, extractor: str, matcher: str, remedy: str
) -> None:
    with pytest.raises(InputError) as error:
        load(tmp_path, features={"extractor": extractor}, matching={"matcher": matcher})
    assert f'matching.matcher = "{matcher}"' in error.value.what
    assert f'features.extractor = "{extractor}"' in error.value.what
    assert f"Set features.extractor to {remedy}, or matching.matcher to nearest" in error.value.remedy


def test_a_model_of_another_use_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match=r'features.model = "own-aliked" is a model for aliked, not for xfeat'):
        load(folder, features={"extractor": "xfeat", "model": "own-aliked"})
    with pytest.raises(
        InputError, match=r'matching.model = "own-aliked-lightglue" .* not for lightglue for superpoint'
    ):
        load(
            folder,
            features={"extractor": "superpoint"},
            matching={"matcher": "lightglue", "model": "own-aliked-lightglue"},
        )
    with pytest.raises(InputError, match=r'semantics.model = "superpoint" is a model for superpoint'):
        load(folder, semantics={"model": "superpoint"})


def test_a_model_that_nothing_uses_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match=r'features.model = "superpoint" is given, but features.extractor = "sift"'):
        load(folder, features={"model": "superpoint"})
    with pytest.raises(InputError, match=r'matching.model = "superglue" is given, but matching.matcher = "nearest"'):
        load(folder, matching={"model": "superglue"})


def test_a_missing_model_is_refused_with_how_to_get_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="model aliked-n16rot is not in") as error:
        load(tmp_path, features={"extractor": "aliked"})
    assert "mrasfm models pull aliked-n16rot" in error.value.remedy


def test_a_model_that_an_earlier_version_took_in_is_checked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "given.onnx").write_bytes(learned_graphs.segmenter(0, 0))
    with monkeypatch.context() as earlier:
        earlier.setattr(Signature, "mismatches", lambda self, found: [])
        ModelFolder(tmp_path / "models").add(tmp_path / "given.onnx", "segmenter")
    with pytest.raises(
        InputError, match=r'semantics\.model = "segmenter" does not have the signature .*is for no image'
    ):
        load(tmp_path / "models", semantics={"model": "segmenter"})


def test_a_segmenter_is_loaded(folder: Path) -> None:
    components = load(folder, semantics={"model": "segmenter"})
    assert components.segmenter is not None
    assert components.fingerprint_of("extractor", "segmenter") == {"segmenter": sha256_of(learned_graphs.segmenter())}
