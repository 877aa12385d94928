"""The product speaks as docs/development/naming.md says, has no import cycle and no copied function."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGES = ("schemas", "service", "worker", "mrasfm_engine")
MAX_EQUAL_LINES = 15
# Migrations repeat tables as they once were; the renderer paints many things in the same way.
MAY_REPEAT = ("service/database/migrations", "mrasfm_engine/synthetic")

# Words that the code once had for things of which the field has a name.
_OLD_NAMES = """
    registration Model grow register_all Eyes rig_from_eye Shots Seen points_seen solved kept barred moving_along
    still_images wrong_camera camera_vote single_images image_adjustment point_settling point_choice coupling reduced
    unit_sets calibration_verdict fine final joint consensus peers growth run_apart Ran of heart patience silence
    escalation settling wakeups assignments messages Verdict Look Tick Counting _asking _holding _ending _tree _rows
    slots storing adopt take_back collecting trees owned keeping answers bodies heads Once pulse process_guard
    parent_death unusable_database follow Told plugins search matching settle adjustment correspondence persistence
"""
OLD_NAMES = frozenset(_OLD_NAMES.split())
_NO_BEGINNINGS = """
    What Who Where Of Whether How Which Why When Until By For From To On At With So Those There Is Up It They
"""
NO_BEGINNINGS = frozenset(_NO_BEGINNINGS.split())
OLD_BEGINNINGS = ("judge_", "settle_", "settled_", "_settle", "_way")
# Names of the list that the vocabulary gives to a room, by the room's section of the settings.
ROOMS = {("mrasfm_engine/config.py", "matching")}


@pytest.fixture(autouse=True, scope="module")
def _forget_trees() -> Iterator[None]:
    """Leave no million of nodes to the garbage collector, which would look through them in all later tests."""
    yield
    _trees.cache_clear()
    _nodes.cache_clear()


@cache
def _trees() -> dict[str, ast.Module]:
    paths = [path for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py")]
    return {str(path.relative_to(REPOSITORY)): ast.parse(path.read_text(encoding="utf-8")) for path in sorted(paths)}


@cache
def _nodes(tree: ast.Module) -> list[ast.AST]:
    return list(ast.walk(tree))


def _names(path: str, tree: ast.Module) -> Iterator[tuple[str, int]]:
    yield from ((part.removesuffix(".py"), 0) for part in Path(path).parts[1:])
    for node in _nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name, node.lineno
        elif isinstance(node, ast.ClassDef):
            yield node.name, node.lineno
            for field in node.body:  # settings, and fields of documents and data classes
                if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                    yield field.target.id, field.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno


@pytest.mark.parametrize("package", PACKAGES)
def test_no_old_name_is_left(package: str) -> None:
    found = [
        f"{path}:{line} {name}"
        for path, tree in _trees().items()
        if path.startswith(f"{package}/")
        for name, line in _names(path, tree)
        if (name in OLD_NAMES or name.startswith(OLD_BEGINNINGS))
        and (path, name) not in ROOMS
        and not (line == 0 and name == "matching")
    ]
    assert found == []


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_begin_with_what_they_describe(package: str) -> None:
    found = [
        f"{path}: {docstring.splitlines()[0]}"
        for path, tree in _trees().items()
        if path.startswith(f"{package}/")
        for node in _nodes(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if (docstring := ast.get_docstring(node)) and docstring.split()[0] in NO_BEGINNINGS
    ]
    assert found == []


_NAMES_SECTION = re.compile(r"^(Parameters|Attributes)\n-+\n(.*?)(?=\n\n\w+\n-{3,}|\Z)", re.DOTALL | re.MULTILINE)


def _documented(node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> Iterator[str]:
    for section in _NAMES_SECTION.finditer(ast.get_docstring(node) or ""):
        for line in section[2].splitlines():
            if line and not line.startswith(" "):
                yield from (name.strip().lstrip("*") for name in line.split(","))


def _arguments(function: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    given = function.args
    named = (*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg)
    return {argument.arg for argument in named if argument is not None}


def _members(node: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> set[str]:
    """Fields, properties, attributes set on `self` and arguments of the class and its bases."""
    found: set[str] = set()
    for part in ast.walk(node):
        if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
            found.add(part.target.id)
        elif isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name) and part.value.id == "self":
            found.add(part.attr)
        elif isinstance(part, ast.FunctionDef):
            found |= {part.name} | (_arguments(part) if part.name == "__init__" else set())
    for base in node.bases:
        name = base.value if isinstance(base, ast.Subscript) else base
        if isinstance(name, ast.Name) and name.id in classes and name.id != node.name:
            found |= _members(classes[name.id], classes)
    return found


def test_documented_arguments_and_attributes_exist() -> None:
    classes = {n.name: n for tree in _trees().values() for n in _nodes(tree) if isinstance(n, ast.ClassDef)}
    unknown = []
    for path, tree in _trees().items():
        for node in _nodes(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                known = _arguments(node)
            elif isinstance(node, ast.ClassDef):
                known = _members(node, classes)
            else:
                continue
            unknown += [f"{path}: {node.name}: {name}" for name in _documented(node) if name not in known]
    assert unknown == []


def _module_of(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _imports(tree: ast.Module, modules: frozenset[str]) -> Iterator[str]:
    for node in _nodes(tree):  # those of functions and those for type checkers too
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom) and node.module in modules:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in modules else node.module


def test_no_module_imports_itself_by_way_of_others() -> None:
    trees = {_module_of(path): tree for path, tree in _trees().items()}
    modules = frozenset(trees)
    left = {module: set(_imports(tree, modules)) - {module} for module, tree in trees.items()}
    while free := {module for module, imported in left.items() if not imported & left.keys()}:
        left = {module: imported for module, imported in left.items() if module not in free}
    # What is left imports modules that are left: those that nothing left imports lead to a cycle, and are not in one.
    while outer := left.keys() - {name for imported in left.values() for name in imported}:
        left = {module: imported for module, imported in left.items() if module not in outer}
    assert sorted(left) == []


def _functions(path: str, tree: ast.Module) -> Iterator[tuple[str, list[str]]]:
    lines = (REPOSITORY / path).read_text(encoding="utf-8").splitlines()
    holders: list[ast.Module | ast.ClassDef] = [tree]
    while holders:
        for node in holders.pop().body:
            if isinstance(node, ast.ClassDef):
                holders.append(node)
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                first = node.body[1 if ast.get_docstring(node) and len(node.body) > 1 else 0]
                body = [line.strip() for line in lines[first.lineno - 1 : node.end_lineno]]
                yield f"{path}:{node.name}", [line for line in body if line and not line.startswith("#")]


def test_no_two_functions_are_copies() -> None:
    places: dict[tuple[str, ...], set[str]] = defaultdict(set)
    for path, tree in _trees().items():
        if path.startswith(MAY_REPEAT):
            continue
        for name, lines in _functions(path, tree):
            for start in range(len(lines) - MAX_EQUAL_LINES):
                places[tuple(lines[start : start + MAX_EQUAL_LINES + 1])].add(name)
    assert {tuple(sorted(names)) for names in places.values() if len(names) > 1} == set()
