"""Sessions of the web console."""

from __future__ import annotations

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column

from service.database.tables._base import Base, Id, Sha256, new_id, now_us


class ConsoleSession(Base):
    """A browser that was given a key: its cookie opens what the key opens, and ends with the key."""

    __tablename__ = "console_sessions"

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("ses"))
    key_id: Mapped[str] = mapped_column(ForeignKey("api_keys.id", ondelete="CASCADE"), index=True)
    secret_sha256: Mapped[str] = mapped_column(Sha256, unique=True)
    created_us: Mapped[int] = mapped_column(default=now_us)
    expires_us: Mapped[int] = mapped_column(index=True)
