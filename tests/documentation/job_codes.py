"""Codes of failed jobs and of findings, gathered from the sources of what a worker runs."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from mrasfm_engine.aggregation.map_report import MEANINGS
from mrasfm_engine.errors import CancelledError, InputError, ReconstructionError, StorageError
from mrasfm_engine.matching.calibration_check import _Reading
from mrasfm_engine.preflight.image_files import _GROUPED
from mrasfm_engine.scene.drive import INCOMPLETE
from tests.documentation.tables import table

REPOSITORY = Path(__file__).resolve().parents[2]
# What jobs run: the engine without its commands, importers and measurements, and the end of a job in the database.
PLACES = ("mrasfm_engine", "schemas", "worker", "service/domain/jobs")
ELSEWHERE = (
    "ablation.py",
    "benchmark/",
    "cli.py",
    "commands/",
    "evaluation/",
    "importers/",
    "learned/download.py",
    "synthetic/",
)
# Expressions that pass on the code of another error or finding, or take it from a table of `_of_tables`.
PASSED_ON = {
    "code",
    "errors[0].code",
    "error.code",
    "f'{reason}-image'",
    "f'{reason}-images'",
    "failed.code",
    "found['code']",
    "problem.code",
}
EPSG_CODES = {"match[1]", "match[2]"}
FINDINGS = ("error", "warning")
EITHER = ("_without_baselines", "finding")  # functions that make an error or a warning
ELLIPSIS = "…"
MAX_CHARACTERS = 150
_CODE = re.compile("[a-z0-9]+(-[a-z0-9]+)*")
_WORD = re.compile("[a-z]{2,}")

FAILURES = """
## Failed jobs

The `problem` of a job that failed has one of these codes, that of an `error` of the check of its drive, or
`drive-rejected`. The detail is shortened: … stands for what differs from job to job.

"""
FOUND = """
## Findings

The check of a drive, `report.json` and the problem `drive-rejected` list findings with these codes. An error of the
check stops the reconstruction; one in a report says what went wrong. A finding with two severities is an error where
the drive cannot be reconstructed with it.

"""


@dataclass(frozen=True, kw_only=True)
class Use:
    """One place in the sources that gives a code.

    Attributes
    ----------
    severity
        Of a finding; empty for what ends a job.
    words
        The message, or else the remedy, with an ellipsis for each value in it; empty where neither is written there.
    """

    code: str
    severity: str = ""
    words: str = ""


def sections() -> str:
    """Both tables, as Markdown."""
    found = uses()
    failures = {use.code: _words(found, use.code, "") for use in found if not use.severity}
    rows = [[f"`{code}`", words] for code, words in sorted(failures.items())]
    result = FAILURES + table(["code", "detail"], rows)
    of_findings = sorted({use.code for use in found if use.severity})
    rows = [[f"`{code}`", _severities(found, code), _words(found, code, *FINDINGS)] for code in of_findings]
    return result + FOUND + table(["code", "severity", "what it says"], rows)


def _words(found: Sequence[Use], code: str, *severities: str) -> str:
    of_code = [use for use in found if use.code == code and use.words]
    wanted = [use.words for use in of_code if use.severity in severities] or [use.words for use in of_code]
    return max(wanted, key=lambda words: len(words.replace(ELLIPSIS, "")))  # the one that says most


def _severities(found: Sequence[Use], code: str) -> str:
    return ", ".join(sorted({use.severity for use in found if use.code == code and use.severity}))


def uses() -> tuple[Use, ...]:
    """All places that give a code, in the order of the sources."""
    return (*_read_sources()[0], *_of_tables())


def unresolved() -> tuple[str, ...]:
    """Expressions that give a code and are neither a text nor known to pass one on."""
    return _read_sources()[1]


@cache
def _read_sources() -> tuple[tuple[Use, ...], tuple[str, ...]]:
    """What `uses` and `unresolved` find: to parse the sources takes seconds, and their trees would stay in memory."""
    found: list[Use] = []
    unknown = []
    for path in source_files():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        given = list(_given(tree))
        found += _uses_in(tree, given)
        unknown += [
            f"{path.relative_to(REPOSITORY)}:{expression.lineno}: {ast.unparse(expression)}"
            for _, expression in given
            if not isinstance(expression, ast.Constant) and ast.unparse(expression) not in PASSED_ON | EPSG_CODES
        ]
    return tuple(found), tuple(unknown)


def source_files() -> Iterator[Path]:
    """Sources of what jobs run."""
    for place in PLACES:
        for path in sorted((REPOSITORY / place).rglob("*.py")):
            if place != "mrasfm_engine" or not path.relative_to(REPOSITORY / place).as_posix().startswith(ELSEWHERE):
                yield path


def _given(tree: ast.Module) -> Iterator[tuple[ast.Call, ast.expr]]:
    """Calls that give a code, with the expression of it: by its name, or in the place of a parameter of this name."""
    places = dict.fromkeys((*FINDINGS, *EITHER), 0)
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.Call)]
    for node in nodes:
        if isinstance(node, ast.FunctionDef):
            names = [argument.arg for argument in node.args.args]
            if "code" in names:
                places[node.name] = names.index("code")
    for node in nodes:
        if not isinstance(node, ast.Call) or _is_of_log(node.func):
            continue
        named = {keyword.arg: keyword.value for keyword in node.keywords}
        place = places.get(_name(node))
        if "code" in named:
            yield node, named["code"]
        elif place is not None and isinstance(node.func, ast.Name | ast.IfExp) and len(node.args) > place:
            yield node, node.args[place]
        elif isinstance(typed := named.get("type"), ast.BinOp) and ast.unparse(typed.left) == "PROBLEM_TYPE":
            yield node, typed.right


def _is_of_log(function: ast.expr) -> bool:
    return isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name) and function.value.id == "log"


def _uses_in(tree: ast.Module, given_in_tree: Iterable[tuple[ast.Call, ast.expr]]) -> Iterator[Use]:
    for call, given in given_in_tree:
        if isinstance(given, ast.Constant) and _CODE.fullmatch(str(given.value)):
            name = _name(call)
            severities = FINDINGS if name in EITHER else (name if name in FINDINGS else "",)
            words = _message(call, tree)
            yield from (Use(code=given.value, severity=severity, words=words) for severity in severities)


def _name(call: ast.Call) -> str:
    if isinstance(call.func, ast.IfExp) and {ast.unparse(call.func.body), ast.unparse(call.func.orelse)} == {*FINDINGS}:
        return "finding"
    return call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")


def _message(call: ast.Call, tree: ast.Module) -> str:
    """The message of an error or a finding, or else the remedy: the first that is a text or a variable with one."""
    named = {keyword.arg: keyword.value for keyword in call.keywords}
    texts = [named.get("what"), named.get("detail"), *call.args, named.get("remedy")]
    found = (_text(_value(given, call, tree)) for given in texts)
    return next((words for words in found if " " in words and len(_WORD.findall(words)) > 1), "")


def _value(given: ast.expr | None, call: ast.Call, tree: ast.Module) -> ast.expr | None:
    """An expression, or of a variable the one that it was given last before the call, in the same function."""
    if not isinstance(given, ast.Name):
        return given
    functions = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and node.lineno < call.lineno <= (node.end_lineno or 0)
    ]
    return max(
        (
            node
            for function in functions
            for node in ast.walk(function)
            if isinstance(node, ast.Assign) and node.lineno < call.lineno and ast.unparse(node.targets[0]) == given.id
        ),
        key=lambda node: node.lineno,
        default=ast.Assign(targets=[], value=given),
    ).value


def _text(given: ast.expr | None) -> str:
    """A text with an ellipsis for each value in it; empty where the expression is none."""
    match given:
        case ast.Constant(value=str(value)):
            words = value
        case ast.JoinedStr(values=values):
            words = "".join(_text(value) if isinstance(value, ast.Constant) else ELLIPSIS for value in values)
        case ast.BinOp(left=left, right=right):
            first, second = _text(left), _text(right)
            words = first + (second or ELLIPSIS) if first else ""
        case ast.IfExp(body=body):
            words = _text(body)
        case _:
            return ""
    return words if len(words) <= MAX_CHARACTERS else words[: MAX_CHARACTERS - 1].rstrip() + ELLIPSIS


def _of_tables() -> Iterator[Use]:
    """Codes of classes, and of tables from which the sources take them."""
    for kind in (InputError, ReconstructionError, StorageError, CancelledError):
        yield Use(code=kind.code, words=(kind.__doc__ or "").splitlines()[0])
    for reading in _Reading:
        yield Use(code=reading.value[1], words=f"rig.cameras: rig_from_cam looks like {reading.value[0]}")
    for reason in sorted(INCOMPLETE):
        yield Use(code=f"{reason}-image", words=f"image {ELLIPSIS} is {reason}")
        words = f"{ELLIPSIS} of {ELLIPSIS} images are {reason} and left out: {ELLIPSIS}"
        yield Use(code=f"{reason}-images", severity="warning", words=words)
    for code, (state, _) in _GROUPED.items():
        yield Use(code=code, severity="warning", words=f"{ELLIPSIS} images {state}: {ELLIPSIS}")
    for code, (meaning, _) in MEANINGS.items():
        yield Use(code=code, severity="warning", words=f"the seams {ELLIPSIS} do not close; {meaning.rstrip(':')}")
