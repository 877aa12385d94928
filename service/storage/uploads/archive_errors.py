"""Refusals of archives: the meaning of each code, and the form in which names of entries are shown."""

from __future__ import annotations

from enum import Enum

from service.errors import ServiceError

_SHOWN_CHARACTERS = 120


class Refusal(Enum):
    """Refusal of an archive: status, code and title of the answer."""

    NOT_AN_ARCHIVE = (415, "not-an-archive", "Not an archive")
    DAMAGED = (422, "damaged-archive", "The archive is damaged")
    UNSUPPORTED = (422, "unsupported-archive", "The archive is of a kind that is not supported")
    UNSAFE = (422, "unsafe-archive", "The archive holds an entry that is refused")
    TOO_LARGE = (422, "archive-too-large", "The archive is too large")
    UNEXPECTED = (422, "unexpected-file", "The archive holds files that are not in the drive's manifest")
    OTHER_MANIFEST = (422, "other-manifest", "The archive holds another manifest")
    EMPTY = (422, "empty-archive", "The archive holds no file")

    def __call__(self, detail: str, remedy: str) -> ServiceError:
        """The error to raise."""
        status, code, title = self.value
        return ServiceError(status, code, title, detail, remedy=remedy)


def damaged(what: str) -> ServiceError:
    """The archive's bytes contradict themselves or end too early."""
    return Refusal.DAMAGED(f"the archive is damaged: {what}", "Make the archive again, and send it whole.")


def shown(name: str | bytes) -> str:
    """An entry's name in quotes: nothing in it can disturb a terminal or a log, or fill a page."""
    text = name.decode("utf-8", "backslashreplace") if isinstance(name, bytes) else name
    return repr(text if len(text) <= _SHOWN_CHARACTERS else text[:_SHOWN_CHARACTERS] + "...")
