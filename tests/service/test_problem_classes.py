"""Every refusal is a class with a code of its own, and no refusal is told apart by a literal."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import pytest

from service import errors
from service.errors import DriveCommitted, ServiceError, TooLarge
from tests.documentation.problems import problem_classes

SERVICE = Path(errors.__file__).parent


def test_a_class_makes_its_problem() -> None:
    error = DriveCommitted("drive drv_1 is frozen", remedy="Create a new drive.")
    assert (error.status, error.code) == (409, "drive-committed")
    shown = error.problem.model_dump(exclude_defaults=True)
    assert shown == {
        "type": "urn:mrasfm:problem:drive-committed",
        "title": "The drive is committed",
        "status": 409,
        "detail": "drive drv_1 is frozen",
        "remedy": "Create a new drive.",
    }


def test_codes_are_declared_once() -> None:
    counts = Counter(kind.code for kind in problem_classes())
    assert len(counts) > 60
    assert max(counts.values()) == 1
    assert all(400 <= kind.status < 600 and kind.title for kind in problem_classes())


@pytest.mark.parametrize("path", sorted(SERVICE.rglob("*.py")), ids=lambda path: str(path.relative_to(SERVICE)))
def test_no_refusal_is_made_or_matched_by_its_code(path: Path) -> None:
    codes = {kind.code for kind in problem_classes()} - {"busy"}
    allowed = {"not-found", "method-not-allowed"} if path.name == "app.py" else set()  # the web framework's
    literals = {
        node.value
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert literals & codes <= allowed
    plain = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    assert not [call for call in plain if isinstance(call.func, ast.Name) and call.func.id == ServiceError.__name__]


def test_a_class_may_be_caught() -> None:
    with pytest.raises(TooLarge):
        raise TooLarge("the body has 2 bytes, the bound is 1", remedy="Send less.")
