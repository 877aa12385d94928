"""Settings of API, workers and reconciler: environment variables that begin with `MRASFM_`.

Everything has a default that suits one machine; production sets `MRASFM_DATABASE_URL`, `MRASFM_ARTIFACTS_URL` and
`MRASFM_REDIS_URL`. No setting has a default secret.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

from pydantic import Field, SecretStr, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict
from sqlalchemy import URL

# Numbers have both bounds: what does not fit the database's integers, or a date, would fail at the first request.
_MAX_BYTES = 2**60
Bytes = Annotated[int, Field(ge=1, le=_MAX_BYTES)]
Hours = Annotated[float, Field(gt=0, le=24 * 365, allow_inf_nan=False)]
Days = Annotated[float, Field(gt=0, le=36_500, allow_inf_nan=False)]
Seconds = Annotated[float, Field(gt=0, le=7 * 86400, allow_inf_nan=False)]
Ratio = Annotated[float, Field(gt=1, le=1e6, allow_inf_nan=False)]
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


class Settings(BaseSettings):
    """One comment a field. Sizes in bytes, times in seconds."""

    model_config = SettingsConfigDict(env_prefix="MRASFM_", frozen=True, extra="ignore")

    # Where things are
    data_dir: Path = Path("mrasfm-data")  # state of this machine: spool, scratch, and the embedded database and store
    database_url: SecretStr | None = None  # SQLAlchemy's; default: SQLite in data_dir
    artifacts_url: str | None = (
        None  # obstore's: file:///..., s3://bucket/prefix, gs://..., az://...; default: data_dir
    )
    redis_url: SecretStr | None = None  # redis://..., rediss://... or redis+socket:///...; standalone starts its own
    s3_endpoint: str | None = None  # of an S3-compatible store; credentials come from AWS_ACCESS_KEY_ID and so on
    s3_region: str = "us-east-1"

    # API
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    api_processes: Annotated[int, Field(ge=0, le=64)] = 0  # that take requests; 0: one a core, at most 2
    max_manifest_bytes: Bytes = 64_000_000
    max_json_bytes: Bytes = 8_000_000  # of every other JSON body
    max_file_bytes: Bytes = 256_000_000  # one image or mask
    max_archive_bytes: Bytes = 50_000_000_000  # one zip or tar, and what it unpacks to
    max_compression_ratio: Ratio = 200.0  # of one archive entry; images hardly compress
    min_free_disk_bytes: Annotated[int, Field(ge=0, le=_MAX_BYTES)] = 1_000_000_000  # below, uploads are refused (507)
    max_concurrent_writes: Count = 8  # uploads that write to disk at one time; the others wait their turn
    upload_hours: Hours = 24.0  # a resumable upload that nobody goes on with ends
    upload_idle_seconds: Seconds = 60.0  # a request of whose body nothing comes ends; resumable uploads keep what came
    # how often an event stream looks for news, and whether its key is still valid
    poll_seconds: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)] = 1.0

    # Quotas of a new project
    project_max_bytes: Bytes = 1_000_000_000_000
    project_max_active_jobs: Count = 1_000
    project_max_drives: Count = 100_000

    # Jobs
    heartbeat_seconds: Seconds = 5.0  # how often a running job reports
    lease_seconds: Seconds = 45.0  # without a heartbeat for this long, a job is given away; everywhere the same
    stalled_seconds: Seconds = 20.0  # without a heartbeat for this long, a job is shown as STALLED
    visibility_timeout_seconds: Seconds = 60.0  # the broker delivers a message again after this, unless renewed
    visibility_renew_seconds: Seconds = 15.0
    reconcile_seconds: Seconds = 5.0  # between two passes of the reconciler
    max_attempts: Annotated[int, Field(ge=1, le=10)] = 3  # the first and two retries
    retry_delay_seconds: Seconds = 2.0
    storage_retry_growth: Annotated[float, Field(ge=1, le=1000)] = 15.0  # of that delay, where a store or disk failed
    longest_retry_delay_seconds: Seconds = 120.0  # it grows no further
    storage_patience_seconds: Seconds = 120.0  # a store that is away for so long fails an attempt
    job_timeout_seconds: Seconds = 24 * 3600.0  # of one attempt
    terminate_after_seconds: Seconds = 10.0  # from a cancel to SIGTERM
    kill_after_seconds: Seconds = 30.0  # from a cancel to SIGKILL
    engine_threads: Annotated[int, Field(ge=0, le=1024)] = 0  # of one reconstruction; 0: all cores

    # Retention; None keeps for ever
    drive_retention_days: Days | None = None
    scene_retention_days: Days | None = None
    map_retention_days: Days | None = None  # since its newest version
    job_retention_days: Days | None = None  # also of maps that have no version
    idempotency_hours: Hours = 24.0

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
    def resolved_database_url(self) -> str:
        """The database's URL, with the embedded one in its place where none is set."""
        if self.database_url is not None:
            return self.database_url.get_secret_value()
        path = str(self.data_dir.resolve() / "mrasfm.sqlite3")
        return URL.create("sqlite", database=path).render_as_string()  # quoted: a folder may be named `a?b`

    @property
    def resolved_artifacts_url(self) -> str:
        """The artifact store's URL."""
        return self.artifacts_url or "file://" + quote(str(self.data_dir.resolve() / "artifacts"))

    @cached_property
    def spool_dir(self) -> Path:
        """Where bytes from outside wait until they are checked."""
        return self.data_dir.resolve() / "spool"

    @cached_property
    def uploads_dir(self) -> Path:
        """Where the bytes of resumable uploads gather until all are there; of the spool's file system."""
        return self.data_dir.resolve() / "uploads"

    @cached_property
    def scratch_dir(self) -> Path:
        """Where stages work."""
        return self.data_dir.resolve() / "scratch"
