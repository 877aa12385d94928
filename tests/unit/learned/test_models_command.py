from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from mrasfm_engine.commands import models
from mrasfm_engine.errors import InputError
from mrasfm_engine.learned.catalogue import known_models
from mrasfm_engine.learned.onnx_file import sha256_of
from tests.helpers import learned_graphs


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
    assert set(lines) >= {model.name for model in known_models()}
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


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def pipe(path: Path) -> None:
    os.mkfifo(path)


def link_to_a_pipe(path: Path) -> None:
    os.mkfifo(path.with_name("pipe"))
    path.symlink_to(path.with_name("pipe"))


def folder_of_that_name(path: Path) -> None:
    path.mkdir()


def empty(path: Path) -> None:
    path.touch()


def missing(path: Path) -> None:
    path.unlink(missing_ok=True)


def link_to_itself(path: Path) -> None:
    path.symlink_to(path)


def too_large(path: Path) -> None:
    with path.open("wb") as file:
        file.write(learned_graphs.superpoint())
        file.truncate(2**31)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (device, "is a device"),
        (pipe, "is a pipe"),
        (link_to_a_pipe, "is a pipe"),
        (folder_of_that_name, "is a folder"),
        (empty, "it is empty (0 bytes)"),
        (missing, "cannot be read: No such file or directory"),
        (link_to_itself, "cannot be read: Too many levels of symbolic links"),
        (too_large, "has more than 2147483647 bytes"),
    ],
)
def test_what_cannot_be_a_models_file_is_refused(
    tmp_path: Path, folder: Path, make: Callable[[Path], None], words: str
) -> None:
    """At once: without waiting for a writer, and without reading what never ends into memory."""
    path = tmp_path / "given.onnx"
    make(path)
    # Of little memory, so that reading on and on ends soon; in a process of its own, as it may wait for ever.
    script = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30));"
        "from mrasfm_engine.cli import main; sys.exit(main())"
    )
    command = [sys.executable, "-P", "-c", script, "models", "add", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2, done.stderr
    what, remedy = done.stderr.splitlines()
    assert what.startswith("mrasfm: error: ")
    assert str(path) in what
    assert words in what
    assert remedy.startswith("  ")
    assert not folder.exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read_is_refused(tmp_path: Path) -> None:
    (tmp_path / "sp.onnx").write_bytes(learned_graphs.superpoint())
    (tmp_path / "sp.onnx").chmod(0)
    with pytest.raises(InputError, match=r"sp\.onnx cannot be read: Permission denied"):
        run("add", str(tmp_path / "sp.onnx"))
