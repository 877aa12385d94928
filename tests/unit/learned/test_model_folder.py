from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from mrasfm_engine.errors import InputError, StorageError
from mrasfm_engine.learned import catalogue
from mrasfm_engine.learned.model_folder import ModelFolder, default_folder
from mrasfm_engine.learned.onnx_file import sha256_of
from tests.helpers import learned_graphs


def write(folder: Path, data: bytes) -> Path:
    path = folder / "given.onnx"
    path.write_bytes(data)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> ModelFolder:
    return ModelFolder(tmp_path / "models")


@pytest.fixture
def published(monkeypatch: pytest.MonkeyPatch) -> bytes:
    """A small graph in the place of the published XFeat."""
    data = learned_graphs.xfeat()
    known = tuple(replace(m, sha256=sha256_of(data)) if m.name == "xfeat" else m for m in catalogue.known_models())
    monkeypatch.setattr(catalogue, "known_models", lambda: known)
    return data


def test_a_published_model_is_known_by_its_hash(folder: ModelFolder, tmp_path: Path, published: bytes) -> None:
    model = folder.add(write(tmp_path, published))
    assert (model.name, model.is_published, model.licence, model.commercial_use) == ("xfeat", True, "Apache-2.0", True)
    again, data = folder.load("xfeat")
    assert again == model
    assert data == published


def test_another_file_is_not_taken_for_a_published_model(folder: ModelFolder, tmp_path: Path, published: bytes) -> None:
    other = learned_graphs.xfeat(threshold=0.3)
    with pytest.raises(InputError) as error:
        folder.add(write(tmp_path, other), "xfeat")
    assert sha256_of(published) in error.value.what
    assert sha256_of(other) in error.value.what
    assert folder.installed() == []


def test_an_own_export_is_known_by_its_signature_and_keeps_no_foreign_licence(
    folder: ModelFolder, tmp_path: Path
) -> None:
    model = folder.add(write(tmp_path, learned_graphs.xfeat()), "xfeat-small")
    assert (model.name, model.known.name) == ("xfeat-small", "xfeat")
    assert (model.is_published, model.licence, model.commercial_use) == (False, "that of the file", None)


def test_an_own_export_takes_no_published_name_by_itself(folder: ModelFolder, tmp_path: Path, published: bytes) -> None:
    model = folder.add(write(tmp_path, published))
    with pytest.raises(InputError, match="not the file that is published") as error:
        folder.add(write(tmp_path, learned_graphs.xfeat(threshold=0.3)))
    assert "--name" in error.value.remedy
    assert folder.load("xfeat") == (model, published)


def test_superpoint_is_registered_with_its_hash_and_its_licence(folder: ModelFolder, tmp_path: Path) -> None:
    data = learned_graphs.superpoint()
    model = folder.add(write(tmp_path, data))
    assert (model.name, model.sha256) == ("superpoint", sha256_of(data))
    assert (model.licence, model.commercial_use) == ("Magic Leap, research only", False)
    assert json.loads((folder.path / "superpoint.json").read_text())["sha256"] == sha256_of(data)


def test_a_foreign_signature_is_refused_with_the_nearest_known(folder: ModelFolder, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"does not have the signature of superpoint.*input image float32\[1,1,H,W\]"):
        folder.add(write(tmp_path, learned_graphs.aliked()), "superpoint")
    assert not folder.path.exists()


def test_external_data_and_unknown_operators_are_refused(folder: ModelFolder, tmp_path: Path) -> None:
    data = learned_graphs.superpoint()
    with pytest.raises(InputError, match="in other files"):
        folder.add(write(tmp_path, learned_graphs.with_external_data(data)))
    with pytest.raises(InputError, match="Wizardry"):
        folder.add(write(tmp_path, learned_graphs.with_unknown_operator(data)))
    assert not folder.path.exists()


def test_a_model_can_be_replaced_and_leaves_nothing(folder: ModelFolder, tmp_path: Path) -> None:
    folder.add(write(tmp_path, learned_graphs.superpoint()))
    model = folder.add(write(tmp_path, learned_graphs.superpoint(threshold=0.2)))
    assert {p.name for p in folder.path.iterdir()} == {model.file.name, "superpoint.json"}
    assert folder.load("superpoint")[0] == model


def test_a_file_that_was_changed_is_refused(folder: ModelFolder, tmp_path: Path) -> None:
    model = folder.add(write(tmp_path, learned_graphs.superpoint()))
    model.file.write_bytes(learned_graphs.superpoint(threshold=0.2))
    with pytest.raises(InputError, match=f"superpoint was changed: SHA-256 {model.sha256} was recorded"):
        folder.load("superpoint")


def test_a_missing_model_says_how_to_get_it(folder: ModelFolder) -> None:
    for name, remedy in (
        ("aliked-n16rot", "Run mrasfm models pull aliked-n16rot"),
        ("superpoint", "fabio-sim/LightGlue-ONNX"),
        ("mine", "mrasfm models add FILE --name NAME"),
    ):
        with pytest.raises(InputError) as error:
            folder.load(name)
        assert remedy in error.value.remedy


@pytest.mark.parametrize("record", ["", "{", "[]", '{"name": "superpoint"}', '{"name": "../x", "sha256": "1"}'])
def test_damaged_records_are_no_models(folder: ModelFolder, tmp_path: Path, record: str) -> None:
    kept = folder.add(write(tmp_path, learned_graphs.segmenter()))
    (folder.path / "superpoint.json").write_text(record)
    assert folder.installed() == [kept]


@pytest.mark.parametrize("name", ["", "../x", "A b", "x/y", "-x"])
def test_names_that_are_no_file_names_are_refused(folder: ModelFolder, tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="is no name for a model"):
        folder.add(write(tmp_path, learned_graphs.segmenter()), name)


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="segmenter cannot be written"):
        ModelFolder(tmp_path / "file" / "models").add(write(tmp_path, learned_graphs.segmenter()))


def test_models_lie_where_the_platform_keeps_data() -> None:
    home = Path(os.sep, "home", "me")
    assert default_folder({"MRASFM_MODELS": "/m"}, "linux", home) == Path("/m")
    assert default_folder({}, "linux", home) == home / ".local/share/mrasfm/models"
    assert default_folder({"XDG_DATA_HOME": "/d"}, "linux", home) == Path("/d/mrasfm/models")
    assert default_folder({"XDG_DATA_HOME": "relative"}, "linux", home) == home / ".local/share/mrasfm/models"
    assert default_folder({}, "darwin", home) == home / "Library/Application Support/mrasfm/models"
    assert default_folder({"LOCALAPPDATA": "/local"}, "win32", home) == Path("/local/mrasfm/models")
