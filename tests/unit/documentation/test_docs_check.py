"""The check of the documentation finds broken links and outdated pages."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from mrasfm_engine.config import EngineConfig
from tests.documentation.__main__ import generated, outdated, pages
from tests.documentation.links import NAVIGATION, broken_links

REPOSITORY = Path(__file__).resolve().parents[3]


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A repository whose documentation is sound."""
    (tmp_path / NAVIGATION).parent.mkdir(parents=True)
    (tmp_path / NAVIGATION).write_text("nav:\n  - Home: index.md\n  - Part:\n      - Page: part/page.md\n")
    (tmp_path / "docs" / "part").mkdir()
    (tmp_path / "README.md").write_text("# Name\n[page](docs/part/page.md#two-words) [licence](LICENSE)\n")
    (tmp_path / "LICENSE").write_text("free\n")
    (tmp_path / "docs" / "picture.png").write_bytes(b"PNG")
    (tmp_path / "docs" / "index.md").write_text("# Home\n![picture](picture.png) [here](#home) <https://example.org>\n")
    (tmp_path / "docs" / "part" / "page.md").write_text(
        "# Page\n\n| a |\n|---|\n| [up](../index.md) |\n\n## Two `words`\n\n```\n[no](link)\n```\n"
    )
    return tmp_path


def test_sound_documentation_has_no_problem(site: Path) -> None:
    assert broken_links(site) == []


@pytest.mark.parametrize(
    ("page", "text", "problem"),
    [
        ("README.md", "[a](docs/none.md)", "README.md: docs/none.md does not exist"),
        ("README.md", "[a](docs/Index.md)", "README.md: docs/Index.md does not exist"),
        ("README.md", "[a](../../etc)", "README.md: ../../etc "),
        ("README.md", "[a](docs/index.md#none)", "README.md: docs/index.md#none has no heading of this name"),
        ("docs/index.md", "# Home\n[a](#hom)", "docs/index.md: #hom has no heading of this name"),
        ("docs/index.md", "![a](none.png)", "docs/index.md: none.png does not exist"),
        ("docs/index.md", "| a |\n|---|\n| [b](none.md) |", "docs/index.md: none.md does not exist"),
        ("docs/index.md", "[a](../LICENSE)", "docs/index.md: ../LICENSE is outside of docs/, and not part of the site"),
        ("docs/part/page.md", "## Same words\n## Same words\n[a](#same-words)", "#same-words has no heading"),
        ("docs/part/new.md", "# New", "docs/part/new.md is not in the navigation"),
    ],
)
def test_broken_page_is_named(site: Path, page: str, text: str, problem: str) -> None:
    (site / page).write_text(text + "\n")
    found = [line for line in broken_links(site) if "two-words" not in line]  # README.md's, of a page that lost it
    assert len(found) == 1
    assert problem in found[0]


def test_navigation_to_no_page_is_named(site: Path) -> None:
    with (site / NAVIGATION).open("a") as navigation:
        navigation.write("  - Lost: lost.md\n")
    assert broken_links(site) == [f"{NAVIGATION}: lost.md does not exist"]


def test_outdated_page_is_named(tmp_path: Path) -> None:
    for path, text in generated(tmp_path).items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    assert outdated(tmp_path) == []
    with (tmp_path / "docs" / "cli.md").open("a") as page:
        page.write("by hand\n")
    (tmp_path / "docs" / "configuration.md").unlink()
    (tmp_path / "mrasfm_engine" / "command_index.json").write_text("{}")
    files = ("docs/cli.md", "docs/configuration.md", "mrasfm_engine/command_index.json")
    assert outdated(tmp_path) == [f"{name} is not current: run make docs" for name in files]


def test_generated_pages_are_complete() -> None:
    commands, settings = pages()["cli.md"], pages()["configuration.md"]
    for words in ("## mrasfm reconstruct", "### mrasfm keys revoke", "`--log-level debug\\|info\\|warning\\|error`"):
        assert words in commands
    assert "| `MRASFM_LEASE_SECONDS` | `45.0` | > 0, <= 604800 |" in settings
    assert "| `extractor` | `sift` | `sift` `superpoint` `aliked` `xfeat` |" in settings
    assert not re.search(r"\|\s*\|$", commands, re.MULTILINE), "an argument has no help"


def test_examples_of_settings_are_valid() -> None:
    texts = [path.read_text(encoding="utf-8") for path in [REPOSITORY / "README.md", *REPOSITORY.glob("docs/**/*.md")]]
    examples = [block for text in texts for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL)]
    assert examples
    for example in examples:
        EngineConfig.model_validate(tomllib.loads(example))


def test_readme_is_short() -> None:
    assert len((REPOSITORY / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_test_files_that_the_documentation_names_exist() -> None:
    page = (REPOSITORY / "docs" / "development" / "testing.md").read_text()
    named = re.findall(r"`([a-z_/0-9]+/test_[a-z_0-9]+\.py)`", page)
    assert len(named) > 20
    folders = (REPOSITORY, REPOSITORY / "tests" / "unit")
    assert [file for file in named if not any((folder / file).is_file() for folder in folders)] == []
