"""Links of the documentation: files, anchors, and the navigation of the site. No link leaves the machine."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from urllib.parse import unquote, urlsplit

from markdown_it import MarkdownIt
from markdown_it.token import Token

NAVIGATION = Path("docs/site/mkdocs.yml")
_NAVIGATION_ENTRY = re.compile(r"^\s*- (?:[^:#]+: )?(\S+\.md)$", re.MULTILINE)


def broken_links(repository: Path) -> list[str]:
    """Problems of the links in README.md, CHANGELOG.md, schemas/ and docs/, one line each.

    Pages of docs/ link to nothing outside of it, else the links of the site would break; every page is in the site's
    navigation, and every entry of the navigation is a page.
    """
    root = repository.resolve()
    docs = root / "docs"
    pages = [
        path for path in (root / "README.md", root / "CHANGELOG.md", root / "schemas" / "README.md") if path.exists()
    ]
    pages += sorted(docs.rglob("*.md"))
    found = [problem for page in pages for problem in _problems_of(page, root)]
    return found + _navigation_problems(root, docs)


def _problems_of(page: Path, root: Path) -> Iterator[str]:
    name = page.relative_to(root)
    for target in _targets(page):
        parts = urlsplit(target)
        if parts.scheme or parts.netloc:
            continue
        path = (page.parent / unquote(parts.path)).resolve() if parts.path else page
        if not path.exists():
            yield f"{name}: {target} does not exist"
        elif not path.is_relative_to(root):
            yield f"{name}: {target} is outside of the repository"
        elif name.parts[0] == "docs" and not path.is_relative_to(root / "docs"):
            yield f"{name}: {target} is outside of docs/, and not part of the site"
        elif parts.fragment and (path.suffix != ".md" or unquote(parts.fragment) not in _anchors(path)):
            yield f"{name}: {target} has no heading of this name"


def _navigation_problems(root: Path, docs: Path) -> list[str]:
    listed = _NAVIGATION_ENTRY.findall((root / NAVIGATION).read_text(encoding="utf-8"))
    there = {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")}
    missing = [f"{NAVIGATION}: {name} does not exist" for name in sorted(set(listed) - there)]
    return missing + [f"{NAVIGATION}: docs/{name} is not in the navigation" for name in sorted(there - set(listed))]


def _tokens(page: Path) -> list[Token]:
    return MarkdownIt("commonmark").enable("table").parse(page.read_text(encoding="utf-8"))


def _targets(page: Path) -> Iterator[str]:
    for token in _tokens(page):
        for child in token.children or ():
            target = child.attrGet("href" if child.type == "link_open" else "src")
            if target is not None:
                yield str(target)


def _anchors(page: Path) -> set[str]:
    """Anchors that GitHub and MkDocs both give the headings of a page."""
    headings = []
    tokens = _tokens(page)
    for before, token in pairwise(tokens):
        if before.type == "heading_open":
            headings.append("".join(child.content for child in token.children or ()))
    kept = [re.sub(r"[^\w\s-]", "", heading.lower()).strip() for heading in headings]
    on_github = [slug.replace(" ", "-") for slug in kept]
    on_site = [re.sub(r"[-\s]+", "-", slug) for slug in kept]
    return {slug for slug in on_github if on_github.count(slug) == 1 and slug in on_site}
