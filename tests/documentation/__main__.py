"""Writes the generated pages of docs/; with `--check`, compares them and follows all links.

`python -m tests.documentation` is `make docs`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

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


def outdated(docs: Path) -> list[str]:
    """Generated pages that differ from what the sources say."""
    return [
        f"docs/{name} is not current: run make docs"
        for name, text in pages().items()
        if not (docs / name).is_file() or (docs / name).read_text(encoding="utf-8") != text
    ]


def main() -> int:
    """Write or check; 1 where a page is outdated or a link broken."""
    parser = argparse.ArgumentParser(prog="documentation", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    arguments = parser.parse_args()
    docs = REPOSITORY / "docs"
    problems = outdated(docs) if arguments.check else []
    if not arguments.check:
        for name, text in pages().items():
            (docs / name).parent.mkdir(parents=True, exist_ok=True)
            (docs / name).write_text(text, encoding="utf-8")
    problems += broken_links(REPOSITORY)
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
