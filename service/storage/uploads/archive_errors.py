"""Names of entries and damage in refusals of archives."""

from __future__ import annotations

from service.errors import DamagedArchive, ServiceError

_SHOWN_CHARACTERS = 120


def damaged(what: str) -> ServiceError:
    """The archive's bytes contradict themselves or end too early."""
    return DamagedArchive(f"the archive is damaged: {what}", remedy="Make the archive again, and send it whole.")


def shown(name: str | bytes) -> str:
    """An entry's name in quotes: nothing in it can disturb a terminal or a log, or fill a page."""
    text = name.decode("utf-8", "backslashreplace") if isinstance(name, bytes) else name
    return repr(text if len(text) <= _SHOWN_CHARACTERS else text[:_SHOWN_CHARACTERS] + "...")
