"""The command as a whole: its help, the loading of one subcommand alone, completion, JSON, and `open`."""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine import cli
from mrasfm_engine.cli import HEADINGS, build_parser, main
from mrasfm_engine.commands.completion import FOLDER
from mrasfm_engine.commands.open import page_of
from mrasfm_engine.errors import InputError
from service.commands import client_program

HELP_CPU_S = 0.2
# Commands that run until they are stopped, print a text, or change one thing.
WITHOUT_JSON = {"api", "worker", "reconciler", "standalone", "migrate", "describe", "completion", "demo", "view"}
MRASFM = (sys.executable, "-P", "-c", "import sys; from mrasfm_engine.cli import main; sys.exit(main())")


def test_the_help_loads_no_command_and_takes_no_time() -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([*MRASFM, "--help"], capture_output=True, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < HELP_CPU_S
    assert all(f"\n{heading}:\n" in done.stdout for heading in HEADINGS)
    code = "import sys; from mrasfm_engine.cli import main; main(['--help']); print(sorted(sys.modules))"
    loaded = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True).stdout
    assert "numpy" not in loaded
    assert "mrasfm_engine.commands" not in loaded


def test_one_command_is_loaded_alone() -> None:
    code = (
        "import sys; from mrasfm_engine.cli import main\n"
        "try: main(['completion', '--help'])\n"
        "except SystemExit: pass\n"
        "print(sorted(n for n in sys.modules if n.startswith(('mrasfm_engine.commands.', 'service'))))"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "['mrasfm_engine.commands.completion']"


def commands() -> dict[str, argparse.ArgumentParser]:
    (action,) = (a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return dict(action.choices)


def test_every_command_has_a_heading_and_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for name in commands():
        (line,) = [line for line in text.splitlines() if line.startswith(f"  {name} ")]
        assert len(line.split(maxsplit=1)[1]) > 10, name
    assert main([]) == cli.EXIT_BAD_INPUT
    assert capsys.readouterr().err == text


def test_a_command_that_does_not_exist(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["reconstuct"])
    assert ended.value.code == 2
    assert "invalid choice: 'reconstuct'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "usage"),
    [
        (["keys", "create", "--bogus"], "mrasfm keys create"),
        (["keys", "--bogus", "list"], "mrasfm keys"),
        (["projects", "set", "default", "--bogus"], "mrasfm projects set"),
        (["reconstruct", "drive", "--out", "scene", "--bogus"], "mrasfm reconstruct"),
    ],
)
def test_an_unknown_option_shows_the_usage_of_its_command(
    words: list[str], usage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(f"usage: {usage} [-h]")
    assert f"{usage}: error: unrecognized arguments: --bogus" in said


def test_an_unknown_option_of_the_client_shows_the_usage_of_its_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        client_program.main(["list", "drives", "--bogus"])
    assert capsys.readouterr().err.startswith("usage: mrasfm-client list [-h]")


def test_results_can_be_had_as_json() -> None:
    def has_it(parser: argparse.ArgumentParser) -> bool:
        nested = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
        return "--json" in parser.format_usage() or any(has_it(p) for action in nested for p in action.choices.values())

    lacking = {name for name, parser in commands().items() if not has_it(parser)}
    assert lacking == WITHOUT_JSON


def test_no_result_goes_to_a_folder_without_a_name() -> None:
    """A shell makes an empty word of a variable that is not set, and a path the working directory of that."""

    def outputs(parser: argparse.ArgumentParser) -> list[argparse.Action]:
        nested = [p for a in parser._actions if isinstance(a, argparse._SubParsersAction) for p in a.choices.values()]
        own = [action for action in parser._actions if "--out" in action.option_strings]
        return [*own, *(action for each in nested for action in outputs(each))]

    found = [action for parser in [*commands().values(), client_program.build_parser()] for action in outputs(parser)]
    assert len(found) >= 13
    for action in found:
        assert callable(action.type)
        assert action.type(".") == Path()
        with pytest.raises(argparse.ArgumentTypeError, match="no folder is given"):
            action.type("")


def test_an_empty_folder_is_refused_before_anything_is_read(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["reconstruct", "no drive", "--out", ""])
    assert ended.value.code == 2
    assert "argument --out: no folder is given" in capsys.readouterr().err


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_a_file_whose_name_a_terminal_would_obey_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "\x1b[2Jü\x9b.txt").touch()
    assert main(["reconstruct", str(tmp_path / "drive"), "--out", str(tmp_path)]) == cli.EXIT_BAD_INPUT
    said = capsys.readouterr().err
    assert r"\x1b[2Jü\x9b.txt was made by no scene" in said
    assert said.replace("\n", "").isprintable()


@pytest.mark.parametrize(
    "words",
    [
        ("preflight", "PATH"),
        ("import", "PATH", "--out", "drive"),
        ("export", "scene", "--format", "kitti", "--out", "PATH"),
        ("export", "PATH", "--format", "kitti", "--out", "export"),
    ],
)
def test_a_path_that_no_system_has_is_named(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    path = "a" * 300
    assert main([path if word == "PATH" else word for word in words]) == 2
    message = capsys.readouterr().err
    assert message.startswith(f"mrasfm: error: {path}")
    assert message.endswith(": File name too long\n  Check the path and its permissions.\n")


def test_memory_that_runs_out_is_told_without_a_stack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def too_large(*arguments: object, **options: object) -> None:
        np.empty((10**7, 10**7))

    monkeypatch.setattr("mrasfm_engine.commands.preflight.read_drive", too_large)
    assert main(["preflight", str(tmp_path)]) == 1
    message = capsys.readouterr().err
    assert message.startswith("mrasfm: error: memory ran out: Unable to allocate 728. TiB")
    assert "features.max_side_px" in message


def test_bash_completes_commands_and_options() -> None:
    script = FOLDER / "mrasfm.bash"

    def completed(*words: str) -> list[str]:
        code = (
            f"source {script}; COMP_WORDS=(mrasfm {' '.join(repr(word) for word in words)}); "
            f"COMP_CWORD={len(words)}; "
            f"$(complete -p mrasfm | sed 's/.*-F \\([^ ]*\\) .*/\\1/') mrasfm {words[-1]!r} x; "
            "printf '%s\\n' \"${COMPREPLY[@]}\""
        )
        done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
        return done.stdout.split()

    assert completed("recon") == ["reconciler", "reconstruct"]
    assert "--no-gnss" in completed("reconstruct", "--no")
    assert "colmap" in completed("export", "scene", "--format", "col")


def test_open_shows_the_best_that_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match="is no scene or map"):
        page_of(tmp_path)
    (tmp_path / "report.json").write_text("{}")
    assert page_of(tmp_path) == tmp_path
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "road.png").touch()
    assert page_of(tmp_path).name == "road.png"
    page = tmp_path / "report.html"
    page.touch()
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    assert main(["open", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"page": str(page), "url": page.as_uri()}
    assert main(["open", str(tmp_path)]) == 1
    assert capsys.readouterr().out == f"{page}\n"
    # A program that stands for the browser is really started.
    browser, told = tmp_path / "browser", tmp_path / "told"
    browser.write_text(f'#!/bin/sh\necho "$1" > {told}\n')
    browser.chmod(0o755)
    environment = {**os.environ, "BROWSER": str(browser)}
    subprocess.run([*MRASFM, "open", str(tmp_path)], env=environment, check=True, capture_output=True)
    assert told.read_text() == f"{page.as_uri()}\n"
