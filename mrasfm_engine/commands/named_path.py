"""Paths on the command line that may stand behind a scene's name: NAME=PATH."""

from __future__ import annotations

from pathlib import Path


def split_name(word: str) -> tuple[str | None, Path]:
    """A scene's name, None where the word is a path alone, and the path.

    Paths may hold an equals sign, also `date=2024-05-01/drive`. What stands before the first one is a name unless a
    folder ends in it, or the whole word is there and the rest is not: `./A=B` is a path whatever there is.
    """
    name, equals, rest = word.partition("=")
    if not equals or not name or not rest or Path(name).name != name:
        return None, Path(word)
    if Path(word).exists() and not Path(rest).exists():
        return None, Path(word)
    return name, Path(rest)
