"""`mrasfm projects`: what an operator does where a quota is full."""

from __future__ import annotations

import argparse

import pytest

from service.commands import projects
from tests.helpers.live_api import Api, problem_of
from tests.helpers.tiny_drive import tiny_drive


def run(api: Api, *arguments: str) -> int:
    parser = argparse.ArgumentParser()
    projects.register(parser.add_subparsers())
    parsed = parser.parse_args(["projects", "--data", str(api.settings.data_dir), *arguments])
    return int(parsed.run(parsed))


def test_a_quota_that_is_full_is_made_larger(api: Api, capsys: pytest.CaptureFixture[str]) -> None:
    client = api.client(max_drives=1)
    project = api.project(client.project_id)
    client.create()
    problem = problem_of(client.post("/v1/drives", content=tiny_drive("b").raw), 429, "too-many-drives")
    assert "mrasfm projects set" in problem["remedy"]
    assert run(api, "set", project.name, "--max-drives", "2") == 0
    client.create(tiny_drive("b"))
    changed = api.project(client.project_id)
    assert (changed.max_drives, changed.max_bytes) == (2, project.max_bytes), "the others stay"
    assert run(api, "set", project.name, "--max-bytes", "1000", "--max-active-jobs", "3") == 0
    problem_of(client.post("/v1/drives", content=tiny_drive("c").raw), 429, "too-many-drives")
    capsys.readouterr()
    assert run(api, "list") == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith(project.name)]
    assert f"{changed.used_bytes} of 1000 bytes" in line
    assert "3 active jobs, 2 drives" in line


def test_what_cannot_be_set_is_said(api: Api, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(api, "set", "nobody", "--max-drives", "2") == 2
    assert "no project 'nobody'" in capsys.readouterr().err
    assert run(api, "set", "nobody") == 2
    assert "--max-bytes, --max-active-jobs, --max-drives" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["0", "-1", "many", "1e9", "10" * 40])
def test_quotas_are_whole_numbers_that_the_database_holds(
    api: Api, capsys: pytest.CaptureFixture[str], value: str
) -> None:
    for option in ("--max-bytes", "--max-active-jobs", "--max-drives"):
        with pytest.raises(SystemExit):
            run(api, "set", "nobody", f"{option}={value}")
        assert f"{value!r}" in capsys.readouterr().err
