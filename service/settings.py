"""Settings of API, workers and reconciler: environment variables that begin with `MRASFM_`.

Everything has a default that suits one machine; production sets `MRASFM_DATABASE_URL`, `MRASFM_ARTIFACTS_URL` and
`MRASFM_REDIS_URL`. No setting has a default secret.
"""

from __future__ import annotations

import operator
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated
from urllib.parse import quote, urlsplit

from pydantic import AfterValidator, Field, SecretStr, ValidationError, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict
from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

from schemas.misspelt import similar_name

# Numbers have both bounds: what does not fit the database's integers, or a date, would fail at the first request.
_MAX_BYTES = 2**60
Bytes = Annotated[int, Field(ge=1, le=_MAX_BYTES)]
Hours = Annotated[float, Field(gt=0, le=24 * 365, allow_inf_nan=False)]
Days = Annotated[float, Field(gt=0, le=36_500, allow_inf_nan=False)]
Seconds = Annotated[float, Field(gt=0, le=7 * 86400, allow_inf_nan=False)]
Ratio = Annotated[float, Field(gt=1, le=1e6, allow_inf_nan=False)]


def _sendable(token: SecretStr) -> SecretStr:
    if not re.fullmatch(r"[A-Za-z0-9._~+/-]{16,}=*", token.get_secret_value()):
        raise ValueError("must have at least 16 letters, digits and -._~+/ only: make one with 'openssl rand -hex 24'")
    return token


def _tile_url(url: str) -> str:
    parts = urlsplit(url)
    named = all(f"{{{name}}}" in url for name in "zxy")
    if parts.scheme not in ("http", "https") or not re.fullmatch(r"[A-Za-z0-9.:\[\]-]+", parts.netloc) or not named:
        raise ValueError("must be http(s)://HOST/... with {z}, {x} and {y} in its path")
    return url


def _database_url(url: SecretStr) -> SecretStr:
    try:
        driver = make_url(url.get_secret_value()).drivername
    except (ArgumentError, ValueError):
        driver = ""
    if driver not in ("sqlite", "sqlite+pysqlite", "postgresql", "postgresql+psycopg"):
        raise ValueError("must be postgresql+psycopg://USER:PASSWORD@HOST/NAME or sqlite:///FILE")
    return url


def _redis_url(url: SecretStr) -> SecretStr:
    if not _has_scheme(url.get_secret_value(), "redis", "rediss", "redis+socket"):
        raise ValueError("must be redis://HOST:PORT/0, rediss://HOST:PORT/0 or redis+socket:///PATH")
    return url


def _artifacts_url(url: str) -> str:
    if not _has_scheme(url, "file", "s3", "s3a", "gs", "az", "azure", "adl", "abfs", "abfss"):
        raise ValueError("must be file:///FOLDER, s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or az://CONTAINER/PREFIX")
    return url


def _has_scheme(url: str, *schemes: str) -> bool:
    try:
        parts = urlsplit(url)
        return parts.scheme in schemes and parts.port != 0
    except ValueError:  # a port that is none
        return False


DatabaseUrl = Annotated[SecretStr, AfterValidator(_database_url)]
RedisUrl = Annotated[SecretStr, AfterValidator(_redis_url)]
ArtifactsUrl = Annotated[str, AfterValidator(_artifacts_url)]
Token = Annotated[SecretStr, AfterValidator(_sendable)]
TileUrl = Annotated[str, AfterValidator(_tile_url)]
Count = Annotated[int, Field(ge=1, le=10_000_000)]

_FITS: Mapping[str, Callable[[float, float], bool]] = {
    "at most half of": lambda first, second: 2 * first <= second,
    "less than": operator.lt,
    "at most": operator.le,
}
# Times of which each is fine, and which together would take jobs from workers that live.
_IN_STEP = (
    ("heartbeat_seconds", "at most half of", "lease_seconds"),
    ("heartbeat_seconds", "less than", "stalled_seconds"),
    ("visibility_renew_seconds", "at most half of", "visibility_timeout_seconds"),
    ("terminate_after_seconds", "at most", "kill_after_seconds"),
)

# docker-compose.yml alone reads these; they reach its containers with the settings of .env.
_OF_COMPOSE = frozenset(
    {"MRASFM_LISTEN", "MRASFM_WORKERS", "MRASFM_WORKER_MEMORY", "MRASFM_CHECKER_MEMORY", "MRASFM_VERSION"}
)


class Settings(BaseSettings):
    """Settings of one process. Sizes are in bytes, times in the unit of the name."""

    # Errors name the variable and not what it holds: that may be a secret.
    model_config = SettingsConfigDict(env_prefix="MRASFM_", frozen=True, extra="ignore", hide_input_in_errors=True)

    # Storage and broker
    data_dir: Path = Field(
        Path("mrasfm-data"), description="state of this machine: spool, scratch, and the embedded database and store"
    )
    database_url: DatabaseUrl | None = Field(None, description="SQLAlchemy's URL; by default SQLite in the data folder")
    artifacts_url: ArtifactsUrl | None = Field(
        None,
        description="obstore's URL: `file:///...`, `s3://bucket/prefix`, `gs://...`, `az://...`; else the data folder",
    )
    redis_url: RedisUrl | None = Field(
        None,
        description="`redis://...`, `rediss://...` or `redis+socket:///...`; `mrasfm standalone` starts its own broker",
    )
    s3_endpoint: str | None = Field(
        None, description="of an S3-compatible store; credentials come from `AWS_ACCESS_KEY_ID` and so on"
    )
    s3_region: str = Field("us-east-1", description="of the S3-compatible store")

    # API
    host: str = Field("127.0.0.1", description="address that the API listens on")
    port: Annotated[int, Field(ge=0, le=65535)] = Field(8000, description="port that the API listens on")
    api_processes: Annotated[int, Field(ge=0, le=64)] = Field(
        0, description="processes that take requests; 0: one for each core, at most 2"
    )
    max_manifest_bytes: Bytes = Field(64_000_000, description="a drive's manifest")
    max_json_bytes: Bytes = Field(8_000_000, description="every other JSON body")
    max_file_bytes: Bytes = Field(256_000_000, description="one image or mask")
    max_archive_bytes: Bytes = Field(50_000_000_000, description="one zip or tar, and its unpacked content")
    max_compression_ratio: Ratio = Field(200.0, description="of one archive entry; images hardly compress")
    min_free_disk_bytes: Annotated[int, Field(ge=0, le=_MAX_BYTES)] = Field(
        1_000_000_000, description="with less free disk space, uploads are refused (507)"
    )
    max_concurrent_writes: Count = Field(
        8, description="uploads that write to disk at one time; the others wait for their turn"
    )
    upload_hours: Hours = Field(24.0, description="a resumable upload ends after this time without a request")
    upload_idle_seconds: Seconds = Field(
        60.0,
        description="a request whose body sends nothing for this long ends; resumable uploads keep what was received",
    )
    console_tiles: TileUrl | None = Field(
        None,
        description="URL of map tiles for the web console, with `{z}`, `{x}` and `{y}`; without it the console asks "
        "this host only",
    )
    metrics_token: Token | None = Field(
        None, description="bearer token that Prometheus sends to read `/metrics`; by default anybody may read it"
    )
    poll_seconds: Annotated[float, Field(gt=0, le=2, allow_inf_nan=False)] = Field(
        1.0, description="an event stream checks for news, and whether its key is still valid, at this interval"
    )
    max_event_streams: Count = Field(100, description="event streams of one project, in each process of the API")

    # Webhooks
    webhook_private_addresses: bool = Field(
        False, description="webhooks may lead to addresses of private networks, and be unencrypted"
    )
    webhook_seconds: Seconds = Field(2.0, description="messages of webhooks that are due are looked for this often")

    # Quotas of a new project
    project_max_bytes: Bytes = Field(1_000_000_000_000, description="stored bytes of a new project")
    project_max_active_jobs: Count = Field(1_000, description="queued and running jobs of a new project")
    project_max_drives: Count = Field(100_000, description="drives of a new project")

    # Jobs
    heartbeat_seconds: Seconds = Field(5.0, description="interval of a running job's heartbeat")
    lease_seconds: Seconds = Field(
        45.0,
        description="a job without a heartbeat for this long is given to another worker; the same in all processes",
    )
    stalled_seconds: Seconds = Field(20.0, description="a job without a heartbeat for this long is shown as `STALLED`")
    visibility_timeout_seconds: Seconds = Field(
        60.0, description="the broker delivers a message again after this time, unless it is renewed"
    )
    visibility_renew_seconds: Seconds = Field(15.0, description="interval at which a worker renews its messages")
    reconcile_seconds: Seconds = Field(5.0, description="time between two passes of the reconciler")
    max_attempts: Annotated[int, Field(ge=1, le=10)] = Field(
        3, description="attempts that count against a job: the first and two retries"
    )
    max_losses: Annotated[int, Field(ge=1, le=10_000)] = Field(
        20,
        description="lost workers, kills and losses of the database without a finished stage in between, after which "
        "a job ends",
    )
    retry_delay_seconds: Seconds = Field(2.0, description="delay before the first retry")
    storage_retry_growth: Annotated[float, Field(ge=1, le=1000)] = Field(
        15.0, description="factor of that delay after a failure of a store or disk"
    )
    longest_retry_delay_seconds: Seconds = Field(120.0, description="upper bound of the delay between retries")
    storage_patience_seconds: Seconds = Field(
        120.0, description="a store that does not answer for this long fails an attempt"
    )
    job_timeout_seconds: Seconds = Field(24 * 3600.0, description="of one attempt")
    terminate_after_seconds: Seconds = Field(10.0, description="time from a cancel to SIGTERM")
    kill_after_seconds: Seconds = Field(30.0, description="time from a cancel to SIGKILL")
    drive_room_bytes: Bytes = Field(
        10_000_000_000,
        description="disk that a drive's files take in one worker process at one time, where the artifact store is not "
        "a folder: files of a larger drive come as they are needed",
    )
    engine_threads: Annotated[int, Field(ge=0, le=1024)] = Field(
        0, description="threads of one reconstruction; 0: all cores"
    )
    submap_workers: Annotated[int, Field(ge=0, le=1024)] | None = Field(
        None,
        description="number of workers that a long drive is cut for; 0 or 1: a reconstruction is one job; by default "
        "as many as there are worker processes when it begins",
    )

    # Retention
    drive_retention_days: Days | None = Field(None, description="drives are deleted after this time; by default never")
    scene_retention_days: Days | None = Field(None, description="scenes are deleted after this time; by default never")
    map_retention_days: Days | None = Field(
        None, description="maps are deleted this long after their newest version; by default never"
    )
    export_retention_days: Days | None = Field(
        None, description="exports are deleted after this time; by default with their scene or map"
    )
    job_retention_days: Days | None = Field(
        None, description="jobs, and maps without a version, are deleted after this time; by default never"
    )
    idempotency_hours: Hours = Field(24.0, description="answers to an `Idempotency-Key` are kept for this time")

    @field_validator(
        "artifacts_url",
        "redis_url",
        "metrics_token",
        "submap_workers",
        "console_tiles",
        "drive_retention_days",
        "scene_retention_days",
        "map_retention_days",
        "export_retention_days",
        "job_retention_days",
        mode="before",
    )
    @classmethod
    def _is_given(cls, value: object) -> object:
        """Compose passes what nobody has set as an empty text."""
        return None if value == "" else value

    @field_validator(*{name for first, _, second in _IN_STEP for name in (first, second)})
    @classmethod
    def _is_in_step(cls, value: float, info: ValidationInfo) -> float:
        """Checked with the later field of two, so that the error names a field; defaults are checked too."""
        given = {**info.data, info.field_name or "": value}
        for first, relation, second in _IN_STEP:
            if info.field_name not in (first, second) or not {first, second} <= given.keys():
                continue
            if not _FITS[relation](given[first], given[second]):
                names = f"MRASFM_{first.upper()}", f"MRASFM_{second.upper()}"
                raise ValueError(f"{names[0]} ({given[first]:g}) must be {relation} {names[1]} ({given[second]:g})")
        return value

    @property
    def database_file(self) -> Path:
        """The database of a service that keeps all its state in the data folder."""
        return self.data_dir.resolve() / "mrasfm.sqlite3"

    @property
    def resolved_database_url(self) -> str:
        """The database's URL, with the embedded one in its place where none is set."""
        if self.database_url is not None:
            return self.database_url.get_secret_value()
        path = str(self.database_file)
        return URL.create("sqlite", database=path).render_as_string()  # quoted: a folder may be named `a?b`

    @property
    def tile_origin(self) -> str | None:
        """Scheme and host of the map tiles; None where there are none."""
        return None if self.console_tiles is None else "{0.scheme}://{0.netloc}".format(urlsplit(self.console_tiles))

    @property
    def resolved_artifacts_url(self) -> str:
        """The artifact store's URL."""
        return self.artifacts_url or "file://" + quote(str(self.data_dir.resolve() / "artifacts"))

    @property
    def stores_in_folder(self) -> bool:
        """True where the artifact store is a folder, from which files come without being copied."""
        return self.resolved_artifacts_url.startswith("file://")

    @cached_property
    def spool_dir(self) -> Path:
        """Folder of bytes from outside until they are checked."""
        return self.data_dir.resolve() / "spool"

    @cached_property
    def uploads_dir(self) -> Path:
        """Folder of the bytes of resumable uploads until all are there; on the spool's file system."""
        return self.data_dir.resolve() / "uploads"

    @cached_property
    def metrics_dir(self) -> Path:
        """Folder in which the processes of one API share their metrics."""
        return self.data_dir.resolve() / "metrics"

    @cached_property
    def temporary_dir(self) -> Path:
        """Temporary files of the worker's main processes, a folder each."""
        return self.data_dir.resolve() / "temporary"

    @cached_property
    def scratch_dir(self) -> Path:
        """Folder of the attempts' files."""
        return self.data_dir.resolve() / "scratch"


def settings_of_command(*, data_dir: Path | None = None) -> Settings:
    """Settings of a command, which ends where one is not valid, and says which: like an argument that is not.

    Parameters
    ----------
    data_dir
        The folder that the command's arguments name, if they do.
    """
    for problem in misspelt_variables(os.environ):
        print(f"mrasfm: warning: {problem}", file=sys.stderr)
    try:
        return Settings() if data_dir is None else Settings(data_dir=data_dir)
    except ValidationError as error:
        for problem in invalid_settings(error):
            print(f"mrasfm: error: {problem}.", file=sys.stderr)
        raise SystemExit(2) from None


def misspelt_variables(environment: Mapping[str, str]) -> Iterator[str]:
    """Say of each variable that is spelt much like a setting's which one is meant: it has no effect.

    Others that begin with `MRASFM_` are of the client, the engine or the operator.
    """
    for variable in sorted(environment):
        prefix, _, name = variable.lower().partition("_")
        if prefix == "mrasfm" and name not in Settings.model_fields and variable not in _OF_COMPOSE:
            meant = similar_name(name, Settings.model_fields)
            if meant is not None:
                yield f"{variable} is no setting and has no effect; did you mean MRASFM_{meant.upper()}?"


def invalid_settings(error: ValidationError) -> Iterator[str]:
    """Say of each setting that is not valid what is wrong, and which variable to correct."""
    for problem in error.errors():
        name = ".".join(str(part) for part in problem["loc"])
        what = str(problem["msg"]).removeprefix("Value error, ")
        yield f"{name} is not valid: {what}. Correct MRASFM_{name.upper()}"
