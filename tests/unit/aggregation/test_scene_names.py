from __future__ import annotations

from pathlib import Path

import pytest

from mrasfm_engine.aggregation.load import name_scenes
from mrasfm_engine.commands.aggregate import _named
from mrasfm_engine.errors import InputError


def test_two_scenes_of_one_name_are_refused_alike_by_the_command_and_the_engine() -> None:
    folders = [Path("one/street"), Path("two/street")]
    with pytest.raises(InputError, match="one/street and two/street") as by_engine:
        name_scenes(folders)
    with pytest.raises(InputError) as by_command:
        _named([f"street={folder}" for folder in folders])
    assert str(by_command.value) == str(by_engine.value)
    assert by_command.value.code == by_engine.value.code == "duplicate-scene"


def test_scenes_whose_names_differ_in_case_alone_would_share_files() -> None:
    with pytest.raises(InputError, match=r"'Street' and 'street', one name on many systems: one and two"):
        name_scenes({"Street": Path("one"), "street": Path("two")})
    with pytest.raises(InputError, match="'Street' and 'street'"):
        _named(["Street=one", "street=two"])
