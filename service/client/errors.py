"""Errors between a client and the service."""

from __future__ import annotations

from schemas.api.problems import PROBLEM_TYPE, Problem


class ClientError(Exception):
    """Root of everything that this package raises; the message says what to do."""


class ApiError(ClientError):
    """The service refused a request.

    Parameters
    ----------
    problem
        What it answered with.
    status
        Of the HTTP answer.
    """

    def __init__(self, problem: Problem, *, status: int) -> None:
        super().__init__(f"{problem.detail.rstrip('.')}. {problem.remedy}")
        self.problem = problem
        self.status = status

    @property
    def code(self) -> str:
        """The problem's stable name, for example `drive-incomplete`."""
        return self.problem.type.removeprefix(PROBLEM_TYPE)


class UnreachableError(ClientError):
    """The service did not answer, also after many tries."""


class DriveFolderError(ClientError):
    """The folder is not a drive that can be sent, or changed while it was sent."""


class SceneFolderError(ClientError):
    """A scene cannot be put into the folder, or what the service offers must not be put there."""
