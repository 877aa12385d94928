"""Writes the generated pages of docs/ and the command's files; with `--check`, compares them and follows all links.

`python -m tests.documentation` is `make docs`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tests.documentation.command_files import command_files
from tests.documentation.commands import command_page
from tests.documentation.links import broken_links
from tests.documentation.problems import problems_page
from tests.documentation.settings import settings_page

REPOSITORY = Path(__file__).resolve().parents[2]


def pages() -> dict[str, str]:
    """The generated pages by their path in docs/."""
    manifest = (REPOSITORY / "schemas" / "README.md").read_text(encoding="utf-8")
    return {
        "cli.md": command_page(),
        "configuration.md": settings_page(),
        "service/problems.md": problems_page(),
        "input/manifest.md": f"<!-- A copy of schemas/README.md, made by make docs. -->\n\n{manifest}",
    }


def generated(repository: Path) -> dict[Path, str]:
    """All files that are made of the sources."""
    texts = {repository / "docs" / name: text for name, text in pages().items()}
    return texts | {repository / "mrasfm_engine" / name: text for name, text in command_files().items()}


def outdated(repository: Path) -> list[str]:
    """Generated files that differ from what the sources say."""
    return [
        f"{path.relative_to(repository)} is not current: run make docs"
        for path, text in generated(repository).items()
        if not path.is_file() or path.read_text(encoding="utf-8") != text
    ]


def main() -> int:
    """Write or check; 1 where a page is outdated or a link broken."""
    parser = argparse.ArgumentParser(prog="documentation", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    arguments = parser.parse_args()
    problems = outdated(REPOSITORY) if arguments.check else []
    if not arguments.check:
        for path, text in generated(REPOSITORY).items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    problems += broken_links(REPOSITORY)
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
