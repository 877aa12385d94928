"""Findings: results of checks, with severity, place and remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any


class Severity(StrEnum):
    """Severity of a finding: an error of a check stops the reconstruction, one in a report says that it went wrong."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One defect of a drive, or one thing about it that a user should know.

    Attributes
    ----------
    code
        Stable identifier in lower case with dashes.
    what
        One sentence that names the file or field.
    remedy
        One sentence that says what to do.
    count
        Number of defects: over one where the finding stands for others like one before it.
    """

    severity: Severity
    code: str
    what: str
    remedy: str
    count: int = 1

    def __str__(self) -> str:
        return f"{self.severity}: {self.what}\n  {self.remedy}"


def as_json(finding: Finding) -> dict[str, Any]:
    """A finding as it stands in a report; with `count` where that is not one."""
    return {
        "severity": str(finding.severity),
        "code": finding.code,
        "what": finding.what,
        "remedy": finding.remedy,
        **({} if finding.count == 1 else {"count": finding.count}),
    }


def more_errors(counts: Sequence[int]) -> str:
    """Words on how many errors there are besides one, from the counts of all findings that are errors; may be empty."""
    more = sum(counts) - 1
    return f" ({more} more error{'' if more == 1 else 's'})" if more > 0 else ""


def error(code: str, what: str, remedy: str) -> Finding:
    """A finding that stops the reconstruction, or, in its report, says what went wrong."""
    return Finding(severity=Severity.ERROR, code=code, what=what, remedy=remedy)


def warning(code: str, what: str, remedy: str) -> Finding:
    """A finding of what a user should know."""
    return Finding(severity=Severity.WARNING, code=code, what=what, remedy=remedy)


def listed(names: Sequence[object], shown: int = 3) -> str:
    """Names joined by commas; of many, the first few and how many more there are."""
    head = ", ".join(str(name) for name in names[:shown])
    return head if len(names) <= shown else f"{head} and {len(names) - shown} more"


def enumerated(sentences: Sequence[str], shown: int, *, count: int | None = None) -> str:
    """Sentences joined by semicolons; of many, the first few and how many more there are.

    Parameters
    ----------
    count
        Of all, where not all are given.
    """
    more = (count or len(sentences)) - len(sentences[:shown])
    return "; ".join([*sentences[:shown], *([f"and {more} more"] if more else [])])
