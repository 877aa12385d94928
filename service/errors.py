"""The service's errors: one class for each type of problem that the HTTP API answers with.

Name, status and docstring make the problem: `class DriveCommitted(ServiceError, status=409)` is answered with 409, the
type `urn:mrasfm:problem:drive-committed` and the docstring as title.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from schemas.api.problems import PROBLEM_TYPE, Problem, ProblemItem
from schemas.api.resource import Finding
from schemas.findings import more_errors
from schemas.parsing import DocumentError

_NO_MAP = "No map can come of this"


class ServiceError(Exception):
    """A request that is refused, or cannot be served now.

    Parameters
    ----------
    detail
        One sentence that names the file, field or resource and what is wrong with it.
    remedy
        One sentence that says what to do.
    errors, findings
        All defects where there are several.
    headers
        Of the HTTP answer, for example Retry-After.
    title, code
        In place of the class's.
    """

    status: int
    code: str  # stable identifier in lower case with dashes, the end of the problem's type
    title: str

    def __init_subclass__(cls, *, status: int, title: str | None = None) -> None:
        super().__init_subclass__()
        cls.status = status
        cls.code = re.sub("(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "-", cls.__name__).lower()
        cls.title = title or (cls.__doc__ or cls.code.replace("-", " ")).splitlines()[0].removesuffix(".")

    def __init__(
        self,
        detail: str,
        *,
        remedy: str,
        errors: Sequence[ProblemItem] = (),
        findings: Sequence[Finding] = (),
        headers: Mapping[str, str] | None = None,
        title: str | None = None,
        code: str | None = None,
    ) -> None:
        super().__init__(f"{detail} {remedy}")
        self.code = code or self.code
        self.headers = dict(headers or {})
        self.problem = Problem(
            type=PROBLEM_TYPE + self.code,
            title=title or self.title,
            status=self.status,
            detail=detail,
            remedy=remedy,
            errors=list(errors),
            findings=list(findings),
        )


class OtherError(ServiceError, status=500):
    """A problem that is known as a document only: another process's, or the web framework's."""

    def __init__(self, problem: Problem, *, headers: Mapping[str, str] | None = None) -> None:
        self.status = problem.status or 500
        super().__init__(
            problem.detail,
            remedy=problem.remedy,
            errors=problem.errors,
            findings=problem.findings,
            headers=headers,
            title=problem.title,
            code=problem.type.removeprefix(PROBLEM_TYPE),
        )


# Requests


class Unauthorized(ServiceError, status=401):
    """No valid API key."""


class ForeignOrigin(ServiceError, status=403):
    """Another site's page asked for this."""


class NotFound(ServiceError, status=404):
    """Not found."""


class MethodNotAllowed(ServiceError, status=405):
    """Method not allowed."""


class MalformedRequest(ServiceError, status=400):
    """Malformed request."""


class HeadTooLarge(ServiceError, status=431):
    """The request's head is too large."""


class EncodedBody(ServiceError, status=415):
    """The body is encoded."""


class TooLarge(ServiceError, status=413):
    """Too large."""


class TooSlow(ServiceError, status=408):
    """The request took too long."""


class WrongMediaType(ServiceError, status=415):
    """Another media type."""


class InvalidRequest(ServiceError, status=422):
    """The request is not valid."""


class InvalidDocument(ServiceError, status=422):
    """The document does not follow its contract."""


class BadCursor(ServiceError, status=422):
    """The cursor is not valid."""


class PreconditionFailed(ServiceError, status=412):
    """The file has another version."""


class RangeOutside(ServiceError, status=416):
    """The range lies outside the file."""


class MalformedDigest(ServiceError, status=400):
    """Malformed digest."""


class WrongDigest(ServiceError, status=422):
    """Wrong digest."""


class WrongLength(ServiceError, status=400):
    """Wrong length."""


class PartialBody(ServiceError, status=400):
    """A part of a file."""


# Repeated requests


class IdempotencyKeyReused(ServiceError, status=422):
    """The idempotency key was used for another request."""


class RequestInFlight(ServiceError, status=409):
    """The same request is being served."""


# State of the service


class InternalError(ServiceError, status=500):
    """The service failed."""


class NotReady(ServiceError, status=503):
    """The service is not ready."""


class Busy(ServiceError, status=503):
    """The service is busy with large requests."""


class DiskFull(ServiceError, status=507):
    """Disk full."""


class StoreUnavailable(ServiceError, status=503):
    """The artifact store does not answer."""


class DatabaseUnavailable(ServiceError, status=503):
    """The database does not answer."""


class StorageChanged(ServiceError, status=503):
    """The storage changed meanwhile."""


class CheckFailed(ServiceError, status=503):
    """The check of the manifest did not answer."""


# Quotas


class QuotaFull(ServiceError, status=413):
    """The project's storage quota is full."""


class TooManyDrives(ServiceError, status=429):
    """Too many drives."""


class TooManyJobs(ServiceError, status=429):
    """Too many jobs."""


class TooManyUploads(ServiceError, status=429):
    """Too many uploads are open."""


class TooManyLargeBodies(ServiceError, status=429):
    """Too many large requests of this project."""


class AggregationTooLarge(ServiceError, status=422):
    """The project's quota of jobs is too small for it."""


# Drives and their files


class ManifestTooLarge(ServiceError, status=422):
    """The manifest is too large to be checked."""


class DriveIncomplete(ServiceError, status=409):
    """The drive is not complete."""


class DriveRejected(ServiceError, status=422):
    """The check of the drive found errors."""


class DriveCommitted(ServiceError, status=409):
    """The drive is committed."""


class DriveNotCommitted(ServiceError, status=409):
    """The drive is not committed."""


class DriveChanging(ServiceError, status=409):
    """The drive is being written."""


class DriveDeleted(ServiceError, status=409):
    """The drive was deleted."""


class DriveInUse(ServiceError, status=409):
    """Jobs need the drive."""


class NotInManifest(ServiceError, status=422):
    """The manifest does not name the file."""


class FileExists(ServiceError, status=409):
    """Another content is stored under this name."""


class ImageRefused(ServiceError, status=422):
    """The image is refused."""


# Archives


class NotAnArchive(ServiceError, status=415):
    """Not an archive."""


class DamagedArchive(ServiceError, status=422):
    """The archive is damaged."""


class UnsupportedArchive(ServiceError, status=422):
    """The archive is of a kind that is not supported."""


class UnsafeArchive(ServiceError, status=422):
    """The archive holds an entry that is refused."""


class ArchiveTooLarge(ServiceError, status=422):
    """The archive is too large."""


class UnexpectedFile(ServiceError, status=422):
    """The archive holds files that are not in the drive's manifest."""


class OtherManifest(ServiceError, status=422):
    """The archive holds another manifest."""


class EmptyArchive(ServiceError, status=422):
    """The archive holds no file."""


# Resumable uploads


class TusVersion(ServiceError, status=412):
    """Another version of tus."""


class MalformedUpload(ServiceError, status=400):
    """Not as tus has it."""


class ChecksumMismatch(ServiceError, status=460):
    """Checksum mismatch."""


class WrongOffset(ServiceError, status=409):
    """The offset is another."""


class UploadExpired(ServiceError, status=410):
    """The upload has expired."""


class UploadLocked(ServiceError, status=423):
    """The upload is being written."""


# Jobs


class JobEnded(ServiceError, status=409):
    """The job has ended."""


class JobNotFailed(ServiceError, status=409):
    """The job did not fail."""


class JobOfTree(ServiceError, status=409):
    """The job is a part of another."""


class RetryActive(ServiceError, status=409):
    """The job is being done again."""


class CheckActive(ServiceError, status=409):
    """The drive has its check."""


# Exports


class NotGeoreferenced(ServiceError, status=422):
    """The result is not georeferenced."""


class ComponentUnknown(ServiceError, status=422):
    """The component has no files of its own."""


class FilesMissing(ServiceError, status=422):
    """The result lacks files that exports read."""

    report_key: str | None = None  # of the stored report that may give the reason


class BadCrs(ServiceError, status=422):
    """No such projected coordinate reference system."""


class CrsNotTaken(ServiceError, status=422):
    """No format takes a coordinate reference system."""


class ExportDeleted(ServiceError, status=409):
    """The export was deleted."""


class ExportActive(ServiceError, status=409):
    """The export is being made."""


# Webhooks


class AddressRefused(ServiceError, status=422):
    """The address is not told anything."""


class TooManyWebhooks(ServiceError, status=429):
    """The project has as many webhooks as it may."""


class TooManyStreams(ServiceError, status=429):
    """The project has as many event streams open as it may."""


class TooManySecrets(ServiceError, status=409):
    """The webhook's secret was replaced too often."""


class DeliveryPending(ServiceError, status=409):
    """The message is pending."""


# Maps


class NothingToDo(ServiceError, status=422, title=_NO_MAP):
    """The request names neither drives nor scenes."""


class TooFewScenes(ServiceError, status=422, title=_NO_MAP):
    """Fewer scenes than a map needs."""


class NotInMap(ServiceError, status=422, title=_NO_MAP):
    """The map has no such scene."""


class RemovedTwice(ServiceError, status=422, title=_NO_MAP):
    """A scene is to be taken out twice."""


class DriveTwice(ServiceError, status=422, title=_NO_MAP):
    """A drive comes twice."""


class MapBusy(ServiceError, status=409):
    """A version of the map is being made."""


class VersionCurrent(ServiceError, status=409):
    """The map shows this version."""


class UsedByMap(ServiceError, status=409):
    """A map needs it."""


class UsedByJob(ServiceError, status=409):
    """A job needs it."""


def invalid_document(error: DocumentError, *, what: str) -> InvalidDocument:
    """Make the error with all defects of a document."""
    return InvalidDocument(
        f"{what}: {error}",
        remedy="Correct the fields that are named; the page /docs of this service describes every field.",
        errors=[ProblemItem(field=problem.path, detail=problem.what) for problem in error.problems[:100]],
    )


def require_size(
    size_bytes: int,
    max_bytes: int,
    *,
    what: str = "body",
    remedy: str = "Split it, or ask the operator for a larger bound.",
    headers: Mapping[str, str] | None = None,
) -> None:
    """Refuse what is announced or has come, where it is larger than the bound.

    Raises
    ------
    TooLarge
    """
    if size_bytes > max_bytes:
        raise TooLarge(f"the {what} has over {max_bytes} bytes, which is the bound", remedy=remedy, headers=headers)


def store_unavailable() -> StoreUnavailable:
    """Make the error of an artifact store that does not answer, or misses what it should hold."""
    return StoreUnavailable(
        "the bytes could not be stored or read; the request had no effect",
        remedy="Repeat it in some seconds; if it fails again, tell the operator.",
        headers={"Retry-After": "5"},
    )


def drive_rejected(drive_id: str, findings: Sequence[Finding]) -> DriveRejected:
    """Make the error of a drive whose check found errors; its detail names the first."""
    errors = [finding for finding in findings if finding.severity == "error"]
    more = more_errors([finding.count for finding in errors])
    what = errors[0].what if errors else "its check found that it cannot be reconstructed"
    remedy = errors[0].remedy if errors else "Correct the drive, and upload it as a new one."
    return DriveRejected(f"drive {drive_id}: {what}{more}", remedy=remedy, findings=findings)


def not_found(what: str, name: str) -> NotFound:
    """Make the error for what never was, what was deleted and what belongs to another project."""
    return NotFound(
        f"there is no {what} {name!r} in this project",
        remedy="Check the id, and that the API key is of the right project.",
    )
