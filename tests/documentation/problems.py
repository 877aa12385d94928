"""The page of all problems that the HTTP API answers with, from their classes; of failed jobs, and of findings."""

from __future__ import annotations

from schemas.api.problems import PROBLEM_TYPE
from service import errors
from service.errors import OtherError, ServiceError
from tests.documentation import job_codes
from tests.documentation.tables import table

PREAMBLE = f"""<!-- Made from the sources by make docs: change the classes and messages there, not this page. -->

# Problems

[Requests](#requests), [failed jobs](#failed-jobs) and [findings](#findings) have these codes. A code stays what it is;
details and remedies may change.

## Requests

Every error is answered with `application/problem+json` (RFC 9457): `type`, `title`, `status`, `detail`, `remedy`, and
`errors` or `findings` where there are several. The type is `{PROBLEM_TYPE}` followed by the code. An unreadable image
is refused with a code of its own: `empty-file`, `not-an-image`, `damaged-image` or `image-too-large`. Other
answers of the web framework have `http-error`.

"""


def problem_classes() -> list[type[ServiceError]]:
    """All declared problems, by status and code."""
    found = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, ServiceError)]
    return sorted((kind for kind in found if kind not in (ServiceError, OtherError)), key=lambda k: (k.status, k.code))


def problems_page() -> str:
    """Every problem with its status, code and title, as Markdown."""
    rows = [[str(kind.status), f"`{kind.code}`", kind.title] for kind in problem_classes()]
    return PREAMBLE + table(["status", "code", "title"], rows) + job_codes.sections()
