"""Notes on fields of a calibration that the importer does not know: what they say has no part in the drive."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from schemas.findings import listed
from schemas.misspelt import similar_name

# Fields in which a calibration says where it comes from.
COMMENTS = frozenset({"body_frame", "comment", "comments", "description", "name", "notes", "source"})
MAX_SHOWN = 8
MAX_CHARACTERS = 40
# As other formats name coefficients of a lens; without them the images would be taken as rectified.
_DISTORTION = frozenset({"d", "dist", "dist_coeffs", "distortion", "distortion_coefficients", "distortion_coeffs"})


def notes_of_unknown_fields(what: str, unknown: Iterable[str], *, known: Collection[str]) -> list[str]:
    """A note that names unknown fields, each with the known one that it may stand for; none where there are none.

    Parameters
    ----------
    what
        The document, or the part of it, that has them.
    known
        All fields that are read.
    """
    names = [name for name in dict.fromkeys(unknown) if name not in COMMENTS and not name.startswith("_")]
    if not names:
        return []
    shown = listed([_with_match(name, known) for name in names], MAX_SHOWN)
    lens = " Distortion is read from 'model' and 'params' alone." if _DISTORTION & set(map(str.lower, names)) else ""
    return [f"{what}: not known, and not read: {shown}.{lens}"]


def _with_match(name: str, known: Collection[str]) -> str:
    shown = name if len(name) <= MAX_CHARACTERS else name[:MAX_CHARACTERS] + "..."
    if name.lower() in _DISTORTION:
        return shown  # no single field stands for it
    match = similar_name(name, known)
    return shown if match is None else f"{shown} (is it {match}?)"
