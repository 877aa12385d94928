from __future__ import annotations

import argparse
import json
from pathlib import Path

import learned_graphs
import pytest

from mrasfm_engine.commands import models
from mrasfm_engine.errors import InputError
from mrasfm_engine.learned.catalogue import CATALOGUE
from mrasfm_engine.learned.onnx_file import sha256_of


def run(*words: str) -> int:
    parser = argparse.ArgumentParser()
    models.register(parser.add_subparsers())
    arguments = parser.parse_args(["models", *words])
    code: int = arguments.run(arguments)
    return code


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MRASFM_MODELS", str(tmp_path / "models"))
    return tmp_path / "models"


def test_the_list_shows_licence_use_and_whether_a_model_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("list") == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
    assert set(lines) >= {model.name for model in CATALOGUE}
    assert "Apache-2.0" in lines["xfeat"]
    assert "yes" in lines["xfeat"]
    assert "no (pull)" in lines["aliked-n16rot"]
    assert "NO" in lines["superpoint"]
    assert "research only" in lines["superpoint"]


def test_adding_shows_hash_and_warns_of_the_licence(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sp.onnx").write_bytes(learned_graphs.superpoint())
    assert run("add", str(tmp_path / "sp.onnx")) == 0
    said = capsys.readouterr().out
    assert f"SHA-256:  {sha256_of(learned_graphs.superpoint())} (recorded" in said
    assert "WARNING: commercial use is not allowed" in said
    assert run("list", "--json") == 0
    listed = {m["name"]: m for m in json.loads(capsys.readouterr().out)["models"]}
    assert listed["superpoint"]["here"] is True
    assert listed["xfeat"]["here"] is False
    assert listed["superpoint"]["signature"].startswith("image float32[1,1,H,W] -> keypoints")


def test_an_own_name_is_listed_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "s.onnx").write_bytes(learned_graphs.segmenter())
    assert run("add", str(tmp_path / "s.onnx"), "--name", "street-v2", "--folder", str(tmp_path / "own")) == 0
    assert "WARNING: commercial use may not be allowed" in capsys.readouterr().out
    assert run("list", "--folder", str(tmp_path / "own")) == 0
    assert "street-v2" in capsys.readouterr().out


def test_unknown_names_are_refused() -> None:
    with pytest.raises(InputError, match="there is no model nothing"):
        run("pull", "nothing")
