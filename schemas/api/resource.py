"""What several resources share."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Item = TypeVar("Item")


class Resource(BaseModel):
    """Root of what the API answers."""

    model_config = ConfigDict(frozen=True)


class RequestBody(BaseModel):
    """Root of what the API is asked: unknown fields and not-a-number are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Page(Resource, Generic[Item]):
    """Part of a list, newest first unless said otherwise."""

    items: list[Item]
    next: str | None = Field(None, description="give it as `cursor` to go on; null at the end")


class Finding(Resource):
    """What the check of a drive found."""

    severity: str = Field(description="error stops a reconstruction, warning does not", examples=["warning"])
    code: str = Field(examples=["gnss-gap"])
    what: str = Field(examples=["GNSS has no sample for 12.4 s from 103.200 s"])
    remedy: str = Field(examples=["Check the receiver; poses there rest on images alone."])


class Times(Resource):
    """When a resource came and when it goes."""

    created_at: datetime
    expires_at: datetime | None = Field(None, description="when it will be deleted; null: never by itself")
