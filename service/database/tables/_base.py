"""Common part of all tables."""

from __future__ import annotations

import secrets
import time
from typing import Any

from sqlalchemy import JSON, BigInteger, MetaData, String
from sqlalchemy.orm import DeclarativeBase

_NAMES = {  # so that migrations can name what they change in every database
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
    "pk": "pk_%(table_name)s",
}
Id = String(40)
Sha256 = String(64)
Path = String(1024)
Name = String(200)


def now_us() -> int:
    """Microseconds since 1970."""
    return time.time_ns() // 1000


def new_id(prefix: str) -> str:
    """A random id of 120 bits whose prefix says what it names, such as `drv_`."""
    return f"{prefix}_{secrets.token_hex(15)}"


class Base(DeclarativeBase):
    """Root of all tables."""

    metadata = MetaData(naming_convention=_NAMES)
    type_annotation_map = {int: BigInteger, dict[str, Any]: JSON, list[Any]: JSON}  # noqa: RUF012 (SQLAlchemy's way)
