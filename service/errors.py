"""The service's error: one exception that carries the problem details of its answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from schemas.api.problems import PROBLEM_TYPE, Problem, ProblemItem
from schemas.api.resource import Finding
from schemas.parsing import DocumentError


class ServiceError(Exception):
    """A request that is refused, or cannot be served now.

    Parameters
    ----------
    status
        Of the HTTP answer.
    code
        Stable identifier in lower case with dashes; the problem's type is made of it.
    title
        The same for every problem of the code.
    detail
        One sentence that names the file, field or resource and what is wrong with it.
    remedy
        One sentence that says what to do.
    errors, findings
        All defects where there are several.
    headers
        Of the HTTP answer, for example Retry-After.
    """

    def __init__(
        self,
        status: int,
        code: str,
        title: str,
        detail: str,
        *,
        remedy: str,
        errors: Sequence[ProblemItem] = (),
        findings: Sequence[Finding] = (),
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(f"{detail} {remedy}")
        self.status = status
        self.code = code
        self.headers = dict(headers or {})
        self.problem = Problem(
            type=PROBLEM_TYPE + code,
            title=title,
            status=status,
            detail=detail,
            remedy=remedy,
            errors=list(errors),
            findings=list(findings),
        )


def of_problem(problem: Problem) -> ServiceError:
    """The error that a problem was the answer to."""
    return ServiceError(
        problem.status or 500,
        problem.type.removeprefix(PROBLEM_TYPE),
        problem.title,
        problem.detail,
        remedy=problem.remedy,
        errors=problem.errors,
        findings=problem.findings,
    )


def invalid_document(error: DocumentError, *, what: str) -> ServiceError:
    """422 with all defects of a document."""
    return ServiceError(
        422,
        "invalid-document",
        "The document does not follow its contract",
        f"{what}: {error}",
        remedy="Correct the fields that are named; the page /docs of this service describes every field.",
        errors=[ProblemItem(field=problem.path, detail=problem.what) for problem in error.problems[:100]],
    )


def too_slow(detail: str, *, remedy: str, headers: Mapping[str, str] | None = None) -> ServiceError:
    """408: something of the request did not come in time."""
    return ServiceError(408, "too-slow", "The request took too long", detail, remedy=remedy, headers=headers)


def store_unavailable() -> ServiceError:
    """503: the artifact store does not answer, or misses what it should hold."""
    return ServiceError(
        503,
        "store-unavailable",
        "The artifact store does not answer",
        "the bytes could not be stored or read; the request had no effect",
        remedy="Repeat it in some seconds; if it fails again, tell the operator.",
        headers={"Retry-After": "5"},
    )


def not_found(what: str, name: str) -> ServiceError:
    """404, the same for what never was, what was deleted and what belongs to another project."""
    return ServiceError(
        404,
        "not-found",
        "Not found",
        f"there is no {what} {name!r} in this project",
        remedy="Check the id, and that the API key is of the right project.",
    )
